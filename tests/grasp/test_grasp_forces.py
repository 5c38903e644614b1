"""The force distribution: balances by hand, limits, and how far an impossible wrench is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.grasp import grasp_forces, grasp_map
from dexctl.grasp.cones import check_cones, primitive_wrenches

OPPOSED = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
PINCH = (OPPOSED, -OPPOSED / 0.03, [1, 1], np.zeros(3))
WEIGHT = np.array([0, 0, -2.0, 0, 0, 0])


def tripod(rng=None, spread=0.0):
    angle = 2 * np.pi * np.arange(3) / 3
    position = 0.04 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    normal = -position / 0.04
    if rng is not None:
        normal = normal + spread * rng.normal(size=(3, 3))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return position, normal, np.ones(3, bool), np.zeros(3)


def test_a_pinch_carries_half_the_weight_on_each_side():
    # Each finger lifts 1 N by friction 0.5, so it presses with 2 N and no more; the polygon
    # has a vertex within 1 / cos(pi / 64) of any direction.
    got = grasp_forces(*PINCH, 0.5, WEIGHT, edges=64)
    assert got.feasible and got.violation < 1e-6
    np.testing.assert_allclose(got.forces[:, 2], [1, 1], atol=1e-6)
    np.testing.assert_allclose(got.normal, [2, 2], rtol=2e-3)
    assert (got.normal >= 2 - 1e-6).all()
    assert got.torques is None


def test_too_weak_a_grip_says_by_how_much():
    # At most 1 N a side gives 2 * 0.5 = 1 N of lift; 1 N of the 2 N is left.
    got = grasp_forces(*PINCH, 0.5, WEIGHT, edges=64, max_normal=1.0)
    assert not got.feasible
    assert got.violation == pytest.approx(1.0, abs=5e-3)
    assert got.normal.max() <= 1 + 1e-6


def test_a_pinch_cannot_hold_a_spin_unless_it_is_soft():
    spin = np.array([0, 0, 0, 0.01, 0, 0])
    hard = grasp_forces(*PINCH, 0.5, spin)
    assert not hard.feasible
    assert hard.violation == pytest.approx(0.01 / 0.03, rel=1e-6)
    soft = grasp_forces(*PINCH, 0.5, spin, model="soft", torsion=0.005)
    assert soft.feasible
    # each side takes 0.005 N m, which needs 1 N
    np.testing.assert_allclose(soft.normal, [1, 1], atol=1e-5)
    np.testing.assert_allclose(np.abs(soft.twist), 0.005, atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_forces_balance_stay_in_their_cones_and_are_the_least(seed):
    rng = np.random.default_rng(seed)
    arguments = tripod(rng, 0.2)
    wrench = np.concatenate([rng.normal(size=3), 0.02 * rng.normal(size=3)])
    friction = np.array([0.8, 1.0, 1.2])
    got = grasp_forces(*arguments, friction, wrench)
    assert got.feasible
    position, normal = arguments[:2]
    g = grasp_map(position, np.zeros(3))
    np.testing.assert_allclose(g @ got.forces.ravel(), -wrench, atol=1e-5)
    tangential = got.forces - got.normal[:, None] * normal
    assert (np.linalg.norm(tangential, axis=1) <= friction * got.normal + 1e-6).all()

    # An independent solver with the true cones needs a little less, at most what 16 edges cost.
    def slack(f):
        f = f.reshape(3, 3)
        n = (f * normal).sum(1)
        return np.concatenate([(friction * n) ** 2 - ((f - n[:, None] * normal) ** 2).sum(1), n])

    best = minimize(
        lambda f: f @ f, got.forces.ravel(), jac=lambda f: 2 * f, method="SLSQP",
        constraints=[
            {"type": "eq", "fun": lambda f: g @ f + wrench, "jac": lambda f: g},
            {"type": "ineq", "fun": slack},
        ],
    )  # fmt: skip
    effort = (got.forces**2).sum()
    assert best.success
    assert best.fun * (1 - 1e-6) <= effort <= best.fun * 1.08


def anywhere(rng, count):
    """Contacts all around a ball of 30 mm, more or less."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    spread = rng.choice([0.0, 0.003, 0.02])
    position = -0.03 * normal + spread * rng.normal(size=(count, 3))
    return position, normal, np.ones(count, bool), np.zeros(3)


@pytest.mark.parametrize("seed", range(60))
def test_what_is_left_over_is_the_least_that_allowed_forces_leave(seed):
    """No allowed force is further against what is left over: that is proved for each answer."""
    rng = np.random.default_rng(seed)
    count = int(rng.choice([2, 3, 4, 5, 8, 12]))
    contacts = anywhere(rng, count)
    friction, most = rng.choice([0.1, 0.4, 0.8]), rng.choice([0.1, 1.0])
    wrench = np.concatenate([[0, 0, -1.0], rng.choice([0, 0.03, 0.3]) * rng.normal(size=3)])
    got = grasp_forces(*contacts, friction, wrench, max_normal=most)
    assert got.normal.min() >= -1e-9 and got.normal.max() <= most + 1e-9
    tangential = got.forces - got.normal[:, None] * contacts[1]
    assert (np.linalg.norm(tangential, axis=-1) <= friction * got.normal + 1e-9).all()
    cones = check_cones(*contacts, friction, "hard", 16, 0.0, None)
    scale = np.r_[np.ones(3), np.full(3, 1 / cones.length)]
    reached = scale * (grasp_map(contacts[0], np.zeros(3)) @ got.forces.ravel())
    left = reached + scale * wrench
    assert got.violation == pytest.approx(np.linalg.norm(left), abs=1e-9)
    # of each finger the pyramid's edge that helps most, pressed as hard as it may be
    edges = (left @ primitive_wrenches(cones)).reshape(count, -1)
    assert left @ reached <= most * np.minimum(edges.min(axis=1), 0.0).sum() + 1e-7


def with_torques(rng, count):
    """A finger of three joints for each contact: Jacobians ``(m, 3, 3m)`` and limits."""
    jacobian = np.zeros((count, 3, 3 * count))
    for i in range(count):
        jacobian[i, :, 3 * i : 3 * i + 3] = 0.05 * rng.normal(size=(3, 3))
    return {"jacobian": jacobian, "effort": rng.choice([0.0, 0.02, 0.1, np.inf], size=3 * count)}


@pytest.mark.parametrize("model", ["hard", "soft"])
@pytest.mark.parametrize("seed", range(20))
def test_with_torque_limits_a_linear_program_finds_no_force_that_helps_more(seed, model):
    rng = np.random.default_rng(100 + seed)
    count = int(rng.choice([2, 3, 5, 6]))
    contacts, friction = anywhere(rng, count), rng.choice([0.0, 0.1, 0.6])
    wrench = np.concatenate([[0, 0, -1.0], 0.03 * rng.normal(size=3)])
    hand = with_torques(rng, count)
    got = grasp_forces(*contacts, friction, wrench, max_normal=1.0, model=model, **hand)
    assert got.torques is not None and (np.abs(got.torques) <= hand["effort"] + 1e-9).all()
    cones = check_cones(*contacts, friction, model, 16, 0.005, None)
    wrenches = primitive_wrenches(cones)  # (6, count * edges), of unit normal forces
    rays = cones.rays[..., :3] @ np.swapaxes(cones.basis, -1, -2)  # their forces, world frame
    torques = np.concatenate(
        [j.T @ r.T for j, r in zip(hand["jacobian"], rays, strict=True)], axis=1
    )
    bounded = np.isfinite(hand["effort"])
    normals = np.kron(np.eye(count), np.ones(rays.shape[1]))
    scale = np.r_[np.ones(3), np.full(3, 1 / cones.length)]
    reached = scale * (grasp_map(contacts[0], np.zeros(3)) @ got.forces.ravel())
    reached[3:] += (got.twist[:, None] * contacts[1]).sum(axis=0) / cones.length
    left = reached + scale * wrench
    assert got.violation == pytest.approx(np.linalg.norm(left), abs=1e-9)
    best = linprog(
        left @ wrenches,
        A_ub=np.vstack([torques[bounded], -torques[bounded], normals]),
        b_ub=np.concatenate([np.tile(hand["effort"][bounded], 2), np.ones(count)]),
        method="highs",
    )
    assert left @ reached <= best.fun + 1e-7


def test_of_forces_that_balance_none_are_less():
    """Six fingers squeezed at low friction: forces of many newtons for a weight of one."""
    proved = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        contacts, wrench = anywhere(rng, 6), np.array([0, 0, -1.0, 0, 0, 0])
        got = grasp_forces(*contacts, 0.3, wrench)
        if not got.feasible:
            continue
        # Multipliers y of the balance prove it: |f|^2 / 2 grows along each edge of the pyramids,
        # less what y makes of its wrench, and does not along f itself.
        cones = check_cones(*contacts, 0.3, "hard", 16, 0.0, None)
        rays = cones.rays[..., :3] @ np.swapaxes(cones.basis, -1, -2)
        wrenches = primitive_wrenches(cones)
        slope = np.einsum("mei,mi->me", rays, got.forces).ravel()
        scale = np.r_[np.ones(3), np.full(3, 1 / cones.length)]
        effort = (got.forces**2).sum()
        proof = linprog(
            scale * -wrench,
            A_ub=-wrenches.T,
            b_ub=slope,
            bounds=(None, None),
            method="highs",
        )
        assert proof.x is not None
        assert -proof.fun <= effort * (1 + 1e-6) + 1e-9 and effort <= -proof.fun * (1 + 1e-6) + 1e-6
        proved += 1
    assert proved >= 5


def test_joint_torque_limits_bind():
    hand = dexctl.hands.load("dex5")
    q = 0.5 * (hand.lower + hand.upper)
    position = hand.fingertip_positions(q)
    origin = position.mean(axis=0)
    normal = origin - position
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    jacobian = hand.contact_jacobian(q, position)
    arguments = (position, normal, np.ones(5, bool), origin, 0.8, WEIGHT)
    free = grasp_forces(*arguments, jacobian=jacobian)
    assert free.feasible and free.torques is not None
    expected = sum(j.T @ f for j, f in zip(jacobian, free.forces, strict=True))
    np.testing.assert_allclose(free.torques, expected, atol=1e-12)
    most = np.abs(free.torques).max()
    limited = grasp_forces(*arguments, jacobian=jacobian, effort=np.full(hand.nq, 0.9 * most))
    assert limited.torques is not None
    assert np.abs(limited.torques).max() <= 0.9 * most + 1e-6
    assert limited.normal.sum() > 0
    none = grasp_forces(*arguments, jacobian=jacobian, effort=np.zeros(hand.nq))
    assert not none.feasible and none.violation > 0.1
    unlimited = grasp_forces(*arguments, jacobian=jacobian, effort=np.full(hand.nq, np.inf))
    np.testing.assert_allclose(unlimited.forces, free.forces, atol=1e-6)


@pytest.mark.parametrize("model", ["hard", "soft"])
def test_batches_give_what_each_gives_alone(model):
    rng = np.random.default_rng(9)
    grasps = [tripod(rng, 0.3)[:2] for _ in range(6)]
    position, normal = (np.array(part) for part in zip(*grasps, strict=True))
    touch = rng.random((6, 3)) < 0.8
    position[~touch] = np.nan
    wrench = rng.normal(size=(6, 6)) * [1, 1, 1, 0.02, 0.02, 0.02]
    many = grasp_forces(position, normal, touch, np.zeros((6, 3)), 0.7, wrench, model=model)
    assert many.forces.shape == (6, 3, 3)
    assert (many.forces[~touch] == 0).all()
    for i in range(6):
        one = grasp_forces(
            position[i], normal[i], touch[i], np.zeros(3), 0.7, wrench[i], model=model
        )
        np.testing.assert_allclose(many.forces[i], one.forces, atol=1e-6)
        assert many.feasible[i] == one.feasible
        assert many.violation[i] == pytest.approx(float(one.violation), abs=1e-6)


def test_no_wrench_and_no_contacts():
    still = grasp_forces(*PINCH, 0.5, np.zeros(6))
    assert still.feasible and still.violation == 0
    np.testing.assert_array_equal(still.forces, 0)
    alone = grasp_forces(*PINCH[:2], [0, 0], np.zeros(3), 0.5, WEIGHT)
    assert not alone.feasible and alone.violation == pytest.approx(2.0)
    frictionless = grasp_forces(*PINCH, 0.0, [1.0, 0, 0, 0, 0, 0])
    assert frictionless.feasible
    np.testing.assert_allclose(frictionless.normal, [1, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(external_wrench=np.zeros(5)), "external_wrench has shape"),
        (dict(external_wrench=np.full(6, np.nan)), "external_wrench is not finite"),
        (dict(max_normal=0.0), "max_normal"),
        (dict(effort=np.ones(3)), "jacobian"),
        (dict(jacobian=np.ones((2, 2, 3))), "jacobian has shape"),
        (dict(jacobian=np.full((2, 3, 4), np.nan)), "jacobian is not finite"),
        (dict(jacobian=np.ones((2, 3, 4)), effort=np.ones(3)), "effort"),
        (dict(jacobian=np.ones((2, 3, 4)), effort=-np.ones(4)), "effort"),
        (dict(friction=-1.0), "friction"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = dict(
        contact_position=PINCH[0], contact_normal=PINCH[1], in_contact=PINCH[2], origin=PINCH[3],
        friction=0.5, external_wrench=WEIGHT,
    )  # fmt: skip
    with pytest.raises(InvalidInput, match=message):
        grasp_forces(**(arguments | change))
