"""Force closure and grasp quality: by hand, against convex hulls, and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.grasp import epsilon_quality, is_force_closure, isotropy, smallest_singular_value
from dexctl.grasp.cones import check_cones, primitive_wrenches

OPPOSED = np.array([[0.03, 0, 0], [-0.03, 0, 0]])


def ring(count, radius=0.05):
    angle = 2 * np.pi * np.arange(count) / count
    position = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return position, -position / radius


def disturbed(rng, count, spread):
    position, _ = ring(count)
    position = position + 0.01 * spread * rng.normal(size=position.shape)
    normal = -position + 0.05 * spread * rng.normal(size=position.shape)
    return position, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def primitives(position, normal, friction, edges=16, torsion=0.0, length=0.05):
    """Primitive wrenches built one by one, with tangents of another origin than the library's."""
    found = []
    for p, n in zip(position, normal, strict=True):
        helper = np.eye(3)[np.argmin(np.abs(n))]
        first = np.cross(n, helper)
        first /= np.linalg.norm(first)
        second = np.cross(n, first)
        for angle in 2 * np.pi * np.arange(edges) / edges:
            f = n + friction * (np.cos(angle) * first + np.sin(angle) * second)
            found.append(np.concatenate([f, np.cross(p, f) / length]))
        for sign in (1, -1) if torsion else ():
            twist = np.cross(p, n) + sign * torsion * n
            found.append(np.concatenate([n, twist / length]))
    return np.array(found)


def test_two_hard_fingers_cannot_stop_a_spin_about_their_line_and_soft_ones_can():
    arguments = (OPPOSED, -OPPOSED / 0.03, [1, 1], np.zeros(3), 0.5)
    assert not is_force_closure(*arguments)
    assert is_force_closure(*arguments, model="soft")
    assert epsilon_quality(*arguments) == 0
    assert epsilon_quality(*arguments, model="soft") > 0


def test_fingers_that_push_the_same_way_do_not_close():
    position = np.array([[0.03, 0, 0], [-0.02, 0.02, 0], [-0.02, -0.02, 0], [0.0, 0.01, 0]])
    normal = np.tile([0, 0, 1.0], (4, 1))
    for model in ("hard", "soft"):
        assert not is_force_closure(
            position, normal, np.ones(4, bool), np.zeros(3), 1.0, model=model
        )


@pytest.mark.parametrize(("friction", "closed"), [(0.55, False), (0.62, True)])
def test_three_fingers_on_a_triangle_need_the_friction_of_its_half_angle(friction, closed):
    # Two fingers on the flat sides of a wedge of half angle 30 degrees push out along the
    # wedge; the third pushes along it the same way. They balance only if mu > tan 30 = 0.577.
    half = np.radians(30)
    normal = np.array(
        [[np.sin(half), -np.cos(half), 0], [np.sin(half), np.cos(half), 0], [1.0, 0, 0]]
    )
    position = np.array([[0, 0.03, 0.0], [0, -0.03, 0.0], [-0.05, 0, 0.02]])
    got = is_force_closure(position, normal, np.ones(3, bool), np.zeros(3), friction)
    assert bool(got) is closed


def test_frictionless_contacts_close_with_seven_and_not_with_six():
    # Pairs of contacts on a cube's faces, off centre so that they twist both ways.
    position, normal = [], []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for side in (1, -1):
            for shift in (0.4, -0.4):
                position.append(0.05 * (side * np.eye(3)[axis] + shift * u + 0.1 * shift * v))
                normal.append(-side * np.eye(3)[axis])
    position, normal = np.array(position), np.array(normal)
    touch = np.ones(12, bool)
    assert is_force_closure(position, normal, touch, np.zeros(3), 0.0)
    touch[6:] = False
    assert not is_force_closure(position, normal, touch, np.zeros(3), 0.0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_contacts_never_close(count):
    position, normal = ring(5)
    touch = np.arange(5) < count
    position[~touch], normal[~touch] = np.nan, np.nan
    assert not is_force_closure(position, normal, touch, np.zeros(3), 1.0)
    assert epsilon_quality(position, normal, touch, np.zeros(3), 1.0) == 0
    assert smallest_singular_value(position, normal, touch, np.zeros(3)) == pytest.approx(0)
    assert isotropy(position, normal, touch, np.zeros(3)) == pytest.approx(0)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(2, 5),
    spread=st.sampled_from([0.1, 0.5, 1.0, 3.0]),
    friction=st.sampled_from([0.0, 0.2, 0.5, 1.0]),
    soft=st.booleans(),
)
def test_closure_is_what_the_linear_program_says(seed, count, spread, friction, soft):
    rng = np.random.default_rng(seed)
    position, normal = disturbed(rng, count, spread)
    got = is_force_closure(
        position, normal, np.ones(count, bool), np.zeros(3), friction,
        model="soft" if soft else "hard",
    )  # fmt: skip
    # A polygon turned about the normal is another polygon: a little less and a little more
    # friction bound what any of them says.
    answers = []
    for factor in (0.97, 1.03):
        w = primitives(position, normal, factor * friction, torsion=0.005 * factor * soft).T
        k = w.shape[1]
        result = linprog(
            np.append(np.zeros(k), -1),
            A_eq=np.vstack([np.column_stack([w, w.sum(1)]), np.append(np.ones(k), k)]),
            b_eq=np.append(np.zeros(6), k),
            bounds=(0, None),
        )
        values = np.linalg.svd(w, compute_uv=False)
        ranked = len(values) == 6 and values[-1] > 3e-4 * values[0]
        answers.append(bool(ranked and result.status == 0 and result.x[-1] > 1e-5))
    if answers[0] == answers[1]:
        assert bool(got) == answers[0]


@pytest.mark.parametrize("soft", [False, True])
def test_batches_give_what_each_gives_alone(soft):
    rng = np.random.default_rng(5)
    grasps = [disturbed(rng, 4, spread) for spread in np.linspace(0.1, 2, 12)]
    position, normal = (np.array(part) for part in zip(*grasps, strict=True))
    touch = rng.random((12, 4)) < 0.9
    position[~touch] = np.nan
    model = "soft" if soft else "hard"
    for function in (is_force_closure, epsilon_quality):
        many = function(position, normal, touch, np.zeros((12, 3)), 0.6, model=model)
        alone = [
            function(p, n, t, np.zeros(3), 0.6, model=model)
            for p, n, t in zip(position, normal, touch, strict=True)
        ]
        np.testing.assert_allclose(many, alone, atol=1e-9)
    assert is_force_closure(
        position[:, :0], normal[:, :0], touch[:, :0], np.zeros(3), 0.5
    ).shape == (12,)
    assert is_force_closure(position[:0], normal[:0], touch[:0], np.zeros(3), 0.5).shape == (0,)


def test_epsilon_of_frictionless_contacts_on_the_axes_by_hand():
    # Soft fingers without friction at +-1 on three axes: forces +-e_i, each with a torque of
    # +-torsion e_i. In each plane (f_i, t_i) that is a square of points (+-1, +-1), and the
    # hull of three squares in orthogonal planes is at 1 / sqrt(3) from the origin.
    position = np.vstack([np.eye(3), -np.eye(3)])
    got = epsilon_quality(
        position, -position, np.ones(6, bool), np.zeros(3), 0.0,
        model="soft", torsion=1.0, length=1.0,
    )  # fmt: skip
    assert got == pytest.approx(1 / np.sqrt(3), rel=1e-9)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_epsilon_is_the_depth_of_an_independent_hull(seed, soft):
    rng = np.random.default_rng(seed)
    position, normal = disturbed(rng, 4, 0.3)
    arguments = (position, normal, np.ones(4, bool), np.zeros(3), 0.6)
    model = "soft" if soft else "hard"
    got = epsilon_quality(*arguments, length=0.05, model=model, edges=32)
    points = primitives(position, normal, 0.6, edges=32, torsion=0.005 * soft)
    hull = ConvexHull(points)
    assert got == pytest.approx(-hull.equations[:, -1].max(), rel=0.02)
    # no direction along which the support of the primitive wrenches is shorter
    directions = rng.normal(size=(4000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert (points @ directions.T).max(axis=0).min() >= got * 0.98


def test_epsilon_scales_with_torque_units_as_it_should():
    position, normal = ring(4)
    touch = np.ones(4, bool)
    one = epsilon_quality(position, normal, touch, np.zeros(3), 0.5)
    ten = epsilon_quality(10 * position, normal, touch, np.zeros(3), 0.5)
    assert one > 0
    assert one == pytest.approx(float(ten), rel=1e-6)
    assert one == pytest.approx(
        float(epsilon_quality(position, normal, touch, np.zeros(3), 0.5, length=0.05)), rel=1e-9
    )


def test_singular_values_by_hand():
    # Four contacts at +-1 on two axes, torques over 1 m: G G' = 4 I for forces, and for torques
    # sum (|p|^2 I - p p') = diag(2, 2, 4).
    position, normal = ring(4, 1.0)
    touch = np.ones(4, bool)
    arguments = (position, normal, touch, np.zeros(3))
    assert smallest_singular_value(*arguments, length=1.0) == pytest.approx(np.sqrt(2))
    assert isotropy(*arguments, length=1.0) == pytest.approx(np.sqrt(0.5))
    # soft, torsion 1: adds sum n n' = diag(2, 2, 0) to the torques, so all six are equal
    assert isotropy(*arguments, length=1.0, model="soft", torsion=1.0) == pytest.approx(1.0)


def test_bad_arguments_are_named():
    position, normal = ring(3)
    arguments = (position, normal, [1, 1, 1], np.zeros(3))
    for bad in (-0.1, np.nan, [0.5, np.inf, 0.5]):
        with pytest.raises(InvalidInput, match="friction"):
            is_force_closure(*arguments, bad)
    with pytest.raises(InvalidInput, match="friction has shape"):
        is_force_closure(*arguments, [0.5, 0.5])
    with pytest.raises(UnknownName, match="hard, soft"):
        is_force_closure(*arguments, 0.5, model="elastic")
    with pytest.raises(InvalidInput, match="edges"):
        is_force_closure(*arguments, 0.5, edges=2)
    with pytest.raises(InvalidInput, match="torsion"):
        epsilon_quality(*arguments, 0.5, model="soft", torsion=0.0)
    with pytest.raises(InvalidInput, match="length"):
        epsilon_quality(*arguments, 0.5, length=-1.0)
    with pytest.raises(InvalidInput, match="finite"):
        is_force_closure(position * np.nan, normal, [1, 1, 1], np.zeros(3), 0.5)


@pytest.mark.parametrize("model", ["hard", "soft"])
def test_growing_the_hull_gives_the_radius_in_the_whole_hull(model):
    """The hull of a few wrenches that grows where it must, against the hull of them all."""
    rng = np.random.default_rng(5)
    closed = 0
    for count in (3, 4, 5, 6, 8) * 4:
        position, normal = disturbed(rng, count, rng.choice([0.1, 0.5]))
        friction, edges = rng.choice([0.3, 0.8]), int(rng.choice([3, 8, 16]))
        torsion = 0.005 if model == "soft" else 0.0
        got = epsilon_quality(
            position, normal, np.ones(count, bool), np.zeros(3), friction,
            model=model, edges=edges, torsion=0.005, length=0.05,
        )  # fmt: skip
        cones = check_cones(
            position, normal, np.ones(count, bool), np.zeros(3), friction, model, edges, torsion,
            0.05,
        )  # fmt: skip
        plain = -ConvexHull(primitive_wrenches(cones).T).equations[:, -1].max()
        assert got == pytest.approx(max(0.0, plain), abs=1e-12)
        closed += got > 0
    assert closed >= 8
