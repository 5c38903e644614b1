"""The stability QP against enumeration, against ProxQP, and against grasps done by hand."""

from __future__ import annotations

import itertools
from time import thread_time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from dexctl.exceptions import InvalidInput
from dexctl.grasp import solve_stability, stability_forces


def grasp(rng, k, spread=0.3, n=None):
    """Contacts round a ring of radius 0.05 m, disturbed."""
    size = (k, 3) if n is None else (n, k, 3)
    angle = 2 * np.pi * np.arange(k) / k
    ring = 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    position = ring + 0.2 * spread * 0.05 * rng.normal(size=size)
    normal = -position + spread * 0.05 * rng.normal(size=size)
    return position, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def wrenches(position, normal, length):
    return np.vstack([normal.T, np.cross(position, normal).T / length])


def objective(w, c, rho):
    return float(np.sum((w @ c) ** 2) + rho * np.sum((1 - c) ** 2))


def enumerate_supports(w, rho, lower, upper):
    """The least (residual, spread) over every j and every set of forces at their bounds."""
    k = w.shape[1]
    best = (np.inf, np.inf, None, -1)
    for j in [i for i in range(k) if upper[i] == 1]:
        for sides in itertools.product((0, -1, 1), repeat=k - 1):
            sides = np.insert(np.array(sides), j, 1)
            c = np.where(sides < 0, lower, upper).astype(float)
            free = sides == 0
            if free.any():
                a = np.vstack([w[:, free], np.sqrt(rho) * np.eye(k)[:, free]])
                base = np.where(free, 1.0, c)
                b = np.concatenate([-w @ base, np.sqrt(rho) * (1 - base)])
                c = base + np.zeros(k)
                c[free] += np.linalg.lstsq(a, b, rcond=1e-10)[0]
            if (c < lower - 1e-9).any() or (c > upper + 1e-9).any():
                continue
            first = objective(w, c, rho) if rho else np.linalg.norm(w @ c)
            second = np.sum((1 - c) ** 2)
            if first < best[0] - 1e-9 or (first < best[0] + 1e-9 and second < best[1] - 1e-7):
                best = (first, second, c, j)
    return best


@pytest.mark.parametrize("rho", [0.0, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("k", [1, 2, 3, 4])
@pytest.mark.parametrize("spread", [0.0, 0.1, 1.0, 5.0])
def test_agrees_with_the_enumeration_of_supports(rho, k, spread):
    rng = np.random.default_rng(k)
    for trial in range(8):
        position, normal = grasp(rng, k, spread)
        least = 0.3 * (trial % 2)
        limit = np.ones(k)
        if trial % 4 == 3:
            limit[rng.integers(k)] = 0.1
        got = stability_forces(
            position, normal, np.ones(k, bool), np.zeros(3),
            regulariser=rho, min_force=least, max_force=limit,
        )  # fmt: skip
        w = wrenches(position, normal, got.length)
        if (limit < 1).all():
            assert got.held == -1
            continue
        first, second, _, _ = enumerate_supports(w, rho, np.minimum(least, limit), limit)
        assert got.forces.max() == 1.0 and got.forces[got.held] == 1.0
        assert got.residual == pytest.approx(np.linalg.norm(w @ got.forces), abs=1e-12)
        if rho:
            assert objective(w, got.forces, rho) == pytest.approx(first, abs=1e-8)
        else:
            assert got.residual == pytest.approx(first, abs=1e-8)
            assert np.sum((1 - got.forces) ** 2) == pytest.approx(second, abs=1e-6)


@pytest.mark.parametrize("k", [3, 5, 8])
def test_agrees_with_proxqp(k):
    proxsuite = pytest.importorskip("proxsuite")
    rng = np.random.default_rng(7)
    rho, least = 1e-3, 0.2
    for _ in range(10):
        position, normal = grasp(rng, k, 0.5)
        got = stability_forces(
            position, normal, np.ones(k, bool), np.zeros(3), regulariser=rho, min_force=least
        )
        w = wrenches(position, normal, got.length)
        found = []
        for j in range(k):
            rest = np.delete(np.arange(k), j)
            h = 2 * (w.T @ w + rho * np.eye(k))
            qp = proxsuite.proxqp.dense.QP(k - 1, 0, k - 1)
            qp.settings.eps_abs = 1e-10
            qp.settings.check_duality_gap = True
            qp.settings.eps_duality_gap_abs = 1e-12
            qp.settings.max_iter = 1000
            qp.init(
                h[np.ix_(rest, rest)], h[rest, j] - 2 * rho, None, None,
                np.eye(k - 1), np.full(k - 1, least), np.ones(k - 1),
            )  # fmt: skip
            qp.solve()
            found.append(np.insert(np.array(qp.results.x), j, 1.0))
        values = [objective(w, c, rho) for c in found]
        assert objective(w, got.forces, rho) == pytest.approx(min(values), abs=1e-8)
        np.testing.assert_allclose(got.forces, found[got.held], atol=1e-6)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    m=st.one_of(st.integers(1, 8), st.sampled_from([12, 13, 14, 30])),
    spread=st.sampled_from([0.0, 0.05, 0.5, 3.0]),
    rho=st.sampled_from([0.0, 1e-5, 1e-3]),
    least=st.sampled_from([0.0, 0.2]),
    unload=st.booleans(),
)
def test_a_batch_gives_what_each_gives_alone(seed, m, spread, rho, least, unload):
    rng = np.random.default_rng(seed)
    n = 6
    position, normal = grasp(rng, m, spread, n)
    touch = rng.random((n, m)) < 0.8
    position[~touch] = np.nan
    normal[~touch] = 7.0
    origin = 0.003 * rng.normal(size=(n, 3))
    limit = np.where(rng.random((n, m)) < 0.3, rng.random((n, m)), 1.0) if unload else None
    options = dict(regulariser=rho, min_force=least)
    many = stability_forces(position, normal, touch, origin, max_force=limit, **options)
    assert (many.forces[~touch] == 0).all()
    for i in range(n):
        one = stability_forces(
            position[i], normal[i], touch[i], origin[i],
            max_force=None if limit is None else limit[i], **options,
        )  # fmt: skip
        np.testing.assert_allclose(many.forces[i], one.forces, atol=1e-8)
        assert many.residual[i] == pytest.approx(float(one.residual), abs=1e-8)
        assert many.held[i] == one.held
        assert many.length[i] == pytest.approx(float(one.length), abs=1e-12)


def scattered(m, seed, one_side=False):
    """Contacts all over a ball, or over half of it, which no forces balance."""
    outward = np.random.default_rng(seed).normal(size=(m, 3))
    if one_side:
        outward[:, 2] = np.abs(outward[:, 2])
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    return 0.04 * outward + [0.0, 0.01, 0.0], -outward


@pytest.mark.parametrize("one_side", [False, True])
@pytest.mark.parametrize("m", [12, 13, 18])
@pytest.mark.parametrize("rho", [1e-6, 1e-3, 1.0])
def test_many_contacts_have_the_answer_of_the_solver_for_few(m, rho, one_side):
    position, normal = scattered(m, m, one_side)
    got = stability_forces(
        position, normal, np.ones(m, bool), np.zeros(3), regulariser=rho, min_force=0.1
    )
    w = wrenches(position, normal, got.length)
    forces, held = solve_stability(w.T @ w + rho * np.eye(m), [0.1] * m, [1.0] * m, rho)
    assert got.held == held
    np.testing.assert_allclose(got.forces, forces, atol=1e-8)


@pytest.mark.parametrize("one_side", [False, True])
@pytest.mark.parametrize("rho", [0.0, 1e-3])
def test_a_hundred_contacts_in_bounded_time(rho, one_side):
    m = 100
    position, normal = scattered(m, 0, one_side)
    touch, options = np.ones(m, bool), dict(regulariser=rho, min_force=0.05)
    start = thread_time()
    one = stability_forces(position, normal, touch, np.zeros(3), **options)
    assert thread_time() - start < 2.0  # of processor time; 0.1 s alone on a machine
    many = stability_forces(position[None], normal[None], touch[None], np.zeros(3), **options)
    assert many.held[0] == one.held
    np.testing.assert_allclose(many.forces[0], one.forces, atol=1e-8)
    w = wrenches(position, normal, one.length)
    best = objective(w, one.forces, rho)
    for j in (one.held, *range(0, m, 20)):  # another solver, with this one held at one
        rest = np.arange(m) != j
        a = np.vstack([w, np.sqrt(rho) * np.eye(m)])
        b = np.append(np.zeros(6), np.full(m, np.sqrt(rho))) - a[:, j]
        found = lsq_linear(a[:, rest], b, (0.05, 1.0), "bvls", tol=1e-14)
        value = objective(w, np.insert(found.x, j, 1.0), rho)
        assert value >= best - 1e-9
        if j == one.held:
            assert value == pytest.approx(best, abs=1e-9)


@pytest.mark.parametrize("rho", [0.0, 1e-3])
def test_opposed_contacts_balance(rho):
    position = np.array([[0.05, 0, 0], [-0.05, 0, 0]])
    got = stability_forces(
        position, -position / 0.05, np.ones(2, bool), np.zeros(3), regulariser=rho
    )
    np.testing.assert_allclose(got.forces, [1, 1], atol=1e-9)
    assert got.residual == pytest.approx(0, abs=1e-9)
    assert got.held == 0 and got.length == pytest.approx(0.05)


def test_three_contacts_by_hand():
    # Two fingers at +-45 degrees against one: the one carries 1, they carry 1/sqrt(2) each,
    # and their torques about the common point are zero.
    direction = np.array([[-1.0, 0, 0], [1, 1, 0], [1, -1, 0]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    got = stability_forces(-0.04 * direction, direction, np.ones(3, bool), np.zeros(3))
    np.testing.assert_allclose(got.forces, [1, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-8)
    assert got.residual == pytest.approx(0, abs=1e-8)


def test_parallel_normals_leave_a_known_wrench():
    # Three fingers pushing the same way about their centroid: only one may stay, or all the
    # residual grows; the middle one has no torque and is the best.
    position = np.array([[-0.05, 0, 0], [0, 0, 0], [0.05, 0, 0]])
    normal = np.tile([0, 0, 1.0], (3, 1))
    got = stability_forces(position, normal, np.ones(3, bool), np.zeros(3))
    np.testing.assert_allclose(got.forces, [0, 1, 0], atol=1e-8)
    assert got.residual == pytest.approx(1, abs=1e-8) and got.held == 1


@pytest.mark.parametrize("rho", [0.0, 1e-3])
def test_one_contact_and_none(rho):
    position, normal = np.zeros((4, 3)), np.tile([0, 0, 1.0], (4, 1))
    one = stability_forces(position, normal, [0, 0, 1, 0], np.zeros(3), regulariser=rho)
    np.testing.assert_array_equal(one.forces, [0, 0, 1, 0])
    assert one.residual == pytest.approx(1) and one.held == 2 and one.length == 1e-3
    none = stability_forces(position * np.nan, normal, [0] * 4, np.zeros(3), regulariser=rho)
    np.testing.assert_array_equal(none.forces, np.zeros(4))
    assert none.residual == 0 and none.held == -1
    empty = stability_forces(np.zeros((2, 0, 3)), np.zeros((2, 0, 3)), np.zeros((2, 0)), [0, 0, 0])
    assert empty.forces.shape == (2, 0) and (empty.held == -1).all()
    nobody = stability_forces(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), [0, 0, 0])
    assert nobody.forces.shape == (0, 3)


def test_no_candidate_leaves_the_bounds_alone():
    position = np.array([[0.05, 0, 0], [-0.05, 0, 0]])
    for rho in (0.0, 1e-3):
        got = stability_forces(
            position, -position / 0.05, [1, 1], np.zeros(3),
            regulariser=rho, min_force=0.3, max_force=[0.5, 0.2],
        )  # fmt: skip
        assert got.held == -1
        # lower bounds 0.3 and 0.2, so the second stays at 0.2 and the first at 0.3
        np.testing.assert_allclose(got.forces, [0.3, 0.2], atol=1e-6)


def test_every_radial_contact_is_used_on_a_ring():
    position, normal = grasp(np.random.default_rng(0), 5, 0.0)
    got = stability_forces(position, normal, np.ones(5, bool), np.zeros(3))
    np.testing.assert_allclose(got.forces, np.ones(5), atol=1e-8)
    assert got.held == 0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), scale=st.sampled_from([0.01, 100.0]))
def test_forces_do_not_depend_on_units_or_frames(seed, scale):
    rng = np.random.default_rng(seed)
    position, normal = grasp(rng, 4, 0.4)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    touch, options = np.ones(4, bool), dict(regulariser=1e-3, min_force=0.1)
    a = stability_forces(position, normal, touch, np.zeros(3), **options)
    b = stability_forces(
        scale * position @ rotation.T + 1, normal @ rotation.T, touch, np.ones(3), **options
    )
    if b.length > 1e-3:
        np.testing.assert_allclose(a.forces, b.forces, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(contact_position=np.full((3, 3), np.nan)), "finite"),
        (dict(contact_normal=np.zeros((3, 3))), "length"),
        (dict(contact_normal=np.ones((2, 3))), "contact_normal has shape"),
        (dict(contact_position=np.ones(3)), "contact_position has shape"),
        (dict(contact_position="x"), "contact_position"),
        (dict(contact_normal=[["a", "b", "c"]] * 3), "contact_normal"),
        (dict(in_contact=np.ones(4, bool)), "in_contact has shape"),
        (dict(origin=np.zeros(2)), "origin has shape"),
        (dict(origin=np.full(3, np.inf)), "finite"),
        (dict(length=0.0), "length"),
        (dict(length="0.05"), "length is not an array of numbers: '0.05'"),
        (dict(length=b"0.05"), "length is not an array of numbers"),
        (dict(length=np.nan), "length"),
        (dict(length=np.ones(3)), "length has shape"),
        (dict(regulariser=-1.0), "regulariser"),
        (dict(regulariser=1e-9), "regulariser"),
        (dict(regulariser=np.nan), "regulariser"),
        (dict(min_force=1.5), "min_force"),
        (dict(max_force=[2.0, 1, 1]), "max_force"),
        (dict(max_force=[np.nan, 1, 1]), "max_force"),
        (dict(max_force=[1.0, 1]), "max_force has shape"),
    ],
)
@pytest.mark.parametrize("rho", [0.0, 1e-3])
def test_bad_arguments_are_named(change, message, rho):
    position, normal = grasp(np.random.default_rng(0), 3, 0.1)
    arguments = dict(
        contact_position=position, contact_normal=normal, in_contact=np.ones(3, bool),
        origin=np.zeros(3), regulariser=rho,
    )  # fmt: skip
    with pytest.raises(InvalidInput, match=message):
        stability_forces(**(arguments | change))
