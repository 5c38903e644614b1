"""SwingPlanner: plans keep every rule they state, at the knots and between them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dexctl.hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel, random_configurations
from dexctl.switch import GuardedSwitch, GuardedSwitchConfig
from dexctl.switch.chain import own_joints
from dexctl.switch.planner import SwingPlan, SwingPlanner
from dexctl.switch.swing_problem import SwingProblem, SwingShape

DEX5 = dexctl.hands.load("dex5")
PLANNER = SwingPlanner(DEX5)
OBJECT, TIP = 0.05, 0.014  # radii of a cylinder on the z axis, and of dex5's fingertips [m]


def radial(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def touching(finger: int, angle: float, height: float) -> np.ndarray:
    """dex5 with one fingertip touching the cylinder at ``angle`` from the finger's own base.

    In closed form: the roll turns the finger's plane about the radial axis through (0.055, 0, 0),
    so with s = tip's sideways offset and z = its height, tan(roll) = -s / z; the two flexion
    joints are then a planar arm of two links of 0.075 m from (0.055, 0.02).
    """
    x, side = (OBJECT + TIP) * np.cos(angle), (OBJECT + TIP) * np.sin(angle)
    roll = -np.arctan2(side, height)
    out, up = x - 0.055, np.hypot(side, height) - 0.02
    distance = np.hypot(out, up)
    half = np.arccos(distance / 0.15)
    lean = np.arctan2(out, up)
    q = np.zeros(15)
    q[3 * finger : 3 * finger + 3] = roll, lean + half, -2 * half
    return q


def swing(
    planner: SwingPlanner = PLANNER,
    finger: int = 0,
    start: tuple[float, float] = (0.3, 0.13),
    end: tuple[float, float] = (-0.3, 0.13),
) -> tuple[SwingPlan, dict[str, Any]]:
    """A plan on the cylinder between (angle from the finger's base, height) and another such."""
    base = 2 * np.pi * finger / 5
    surface: dict[str, Any] = {}
    for name, (angle, height) in (("lift", start), ("landing", end)):
        normal = -radial(base + angle)
        surface[f"{name}_position"] = -OBJECT * normal + [0, 0, height]
        surface[f"{name}_normal"] = normal
    return planner.plan(touching(finger, *start), finger, **surface), surface


def check(plan: SwingPlan, hand: HandModel, q: np.ndarray, planner: SwingPlanner, **surface):
    """Every rule of the class's docstring, measured with HandModel on a fine grid of time."""
    shape, joints = planner.shape, plan.joints
    radius = surface["lift_normal"] @ (
        surface["lift_position"] - hand.fingertip_positions(q)[plan.finger]
    )
    np.testing.assert_array_equal(plan.q[0], q[joints])
    time = np.linspace(0.0, plan.duration, 40 * (shape.knots - 1) + 1)
    full = np.tile(q, (len(time), 1))
    full[:, joints] = plan.at(time)
    assert (full[1:, joints] >= hand.lower[joints] - 1e-9).all()
    assert (full[1:, joints] <= hand.upper[joints] + 1e-9).all()
    speed = np.abs(np.diff(plan.q, axis=0)) / np.diff(plan.time)[:, None]
    assert speed.max() <= np.max(planner.speed_limit) * (1 + 1e-6)

    tip = hand.fingertip_positions(full)[:, plan.finger]

    def gap(name):
        return (surface[f"{name}_position"] - tip) @ surface[f"{name}_normal"] - radius

    def off(name, foot):
        return np.linalg.norm(np.cross(tip - foot, surface[f"{name}_normal"]), axis=-1)

    knot = np.linspace(0, shape.knots - 1, len(time))
    lifting, coming_down = knot <= shape.lifted, knot >= shape.approached
    assert off("lift", tip[0])[lifting].max() < shape.lateral + 1e-4
    assert off("landing", surface["landing_position"])[coming_down].max() < shape.lateral + 1e-4
    first = (knot >= shape.lifted) & (knot <= shape.turned)
    second = (knot >= shape.turned) & (knot <= shape.approached)
    assert gap("lift")[first].min() > shape.clearance - 1e-4
    assert gap("landing")[second].min() > shape.clearance - 1e-4
    assert np.diff(gap("lift")[lifting]).min() > -1e-5
    assert np.diff(gap("landing")[coming_down]).max() < 1e-5
    goal = surface["landing_position"] - surface["landing_normal"] * (radius + shape.pretouch)
    np.testing.assert_allclose(tip[-1], goal, atol=1e-4)


def test_closed_form_start_touches_the_cylinder():
    for finger, angle in ((0, 0.3), (2, -0.2)):
        tip = DEX5.fingertip_positions(touching(finger, angle, 0.13))[finger]
        expected = (OBJECT + TIP) * radial(2 * np.pi * finger / 5 + angle) + [0, 0, 0.13]
        np.testing.assert_allclose(tip, expected, atol=1e-8)


@pytest.mark.parametrize("name", ["dex5", "four_fingers"])
def test_product_of_exponentials_is_the_hand_models_kinematics(name, request):
    hand = request.getfixturevalue(name)
    shape = SwingShape(knots=8, clearance=0.01, pretouch=0.002, lateral=0.003, time_weight=1.0)
    for finger in range(hand.n_fingers):
        joints = own_joints(hand, finger)
        chain = SwingProblem(len(joints), shape, 0.0, 10).tip
        for start, other in random_configurations(hand, 20, finger).reshape(10, 2, -1):
            now, q = hand.configuration(start), start.copy()
            q[joints] = other[joints]
            said = chain(
                now.joint_twist[:, joints], now.fingertip_position[finger], (q - start)[joints]
            )
            found = hand.fingertip_positions(q)[finger]
            np.testing.assert_allclose(np.asarray(said).ravel(), found, atol=1e-12)


@settings(derandomize=True, deadline=None, max_examples=25)
@given(
    finger=st.integers(0, 4),
    angles=st.tuples(st.floats(-0.35, 0.35), st.floats(-0.35, 0.35)),
    heights=st.tuples(st.floats(0.11, 0.15), st.floats(0.11, 0.15)),
)
def test_swings_on_a_cylinder_keep_every_rule(finger, angles, heights):
    start, end = zip(angles, heights, strict=True)
    plan, surface = swing(finger=finger, start=start, end=end)
    assert plan.feasible, plan.violations
    assert not plan.violations
    check(plan, DEX5, touching(finger, *start), PLANNER, **surface)


def test_swings_of_four_fingers_keep_every_rule(four_fingers):
    hand, feasible = four_fingers, 0
    planner = SwingPlanner(hand)
    rng = np.random.default_rng(0)
    middle, reach = (hand.lower + hand.upper) / 2, 0.2 * (hand.upper - hand.lower)
    centre = np.array([0.015, -0.018, 0.09])  # normals point here
    for trial in range(16):
        finger = trial % 4
        q = middle + reach * rng.uniform(-1, 1, 16)
        goal = hand.clip(q + rng.uniform(-0.25, 0.25, 16))
        surface = {}
        for name, tip, gap in (
            ("lift", hand.fingertip_positions(q)[finger], 0.012),
            ("landing", hand.fingertip_positions(goal)[finger], 0.016),
        ):
            normal = (centre - tip) / np.linalg.norm(centre - tip)
            surface[f"{name}_position"] = tip + gap * normal
            surface[f"{name}_normal"] = normal
        plan = planner.plan(q, finger, **surface)
        feasible += plan.feasible
        if plan.feasible:
            check(plan, hand, q, planner, **surface)
    assert feasible >= 12  # the others say which rule they cannot keep


def test_round_the_corner_of_two_faces():
    """From one face of a box to the next: the path goes round the edge of the two planes."""
    q = touching(0, 0.0, 0.13)
    lift = np.array([OBJECT, 0.0, 0.13])
    planner = SwingPlanner(DEX5, clearance=0.006, pretouch=0.002)
    normal = np.array([-np.cos(0.9), np.sin(0.9), 0.0])  # the next face leans back by 0.9 rad
    surface: dict[str, Any] = {
        "lift_position": lift,
        "lift_normal": np.array([-1.0, 0.0, 0.0]),
        "landing_position": lift - np.array([0.012, 0.03, 0.0]),
        "landing_normal": normal,
    }
    plan = planner.plan(q, 0, **surface)
    assert plan.feasible, plan.violations
    check(plan, DEX5, q, planner, **surface)
    turn = plan.tip[planner.shape.turned]
    for name in ("lift", "landing"):
        gap = (surface[f"{name}_position"] - turn) @ surface[f"{name}_normal"] - TIP
        assert gap > 0.006 - 1e-6


def test_starts_and_ends_at_rest_and_follows_straight_lines_between_knots():
    plan, _ = swing()
    step = np.abs(np.diff(plan.q, axis=0)).max(axis=1)
    assert step[0] < 0.5 * step.max()
    assert step[-1] < 0.5 * step.max()
    np.testing.assert_allclose(np.diff(plan.time), plan.time[1], rtol=1e-12)
    halfway = 0.5 * (plan.time[4] + plan.time[5])
    np.testing.assert_allclose(plan.at(halfway), 0.5 * (plan.q[4] + plan.q[5]), atol=1e-12)
    np.testing.assert_array_equal(plan.at([-1.0, 99.0]), plan.q[[0, -1]])


def test_weight_of_time_and_speed_limit_set_the_duration():
    usual, _ = swing()
    hasty, _ = swing(SwingPlanner(DEX5, time_weight=200.0))
    slow, surface = swing(slow_planner := SwingPlanner(DEX5, speed_limit=0.25))
    assert hasty.feasible
    assert hasty.duration < 0.8 * usual.duration
    assert slow.feasible
    assert slow.duration > 1.2 * usual.duration
    check(slow, DEX5, touching(0, 0.3, 0.13), slow_planner, **surface)


def test_speed_limit_of_each_joint():
    limits = np.full(15, 2.0)
    limits[0] = 0.3
    plan, _ = swing(SwingPlanner(DEX5, speed_limit=limits))
    assert plan.feasible
    speed = np.abs(np.diff(plan.q, axis=0)).max(axis=0) / plan.time[1]
    assert speed[0] <= 0.3 * (1 + 1e-6)
    assert speed[0] > 0.29  # it is what holds this swing up


def test_landing_out_of_reach_is_reported_with_the_distance():
    plan, surface = swing(end=(0.0, 0.4))
    assert not plan.feasible
    goal = surface["landing_position"] - surface["landing_normal"] * (TIP + 0.004)
    assert plan.violations["landing"] == pytest.approx(np.linalg.norm(plan.tip[-1] - goal))
    assert plan.violations["landing"] > 0.2
    assert np.isfinite(plan.q).all()
    assert (plan.q >= DEX5.lower[:3] - 1e-9).all()


def test_too_little_time_is_reported():
    plan, _ = swing(SwingPlanner(DEX5, speed_limit=0.05, duration=(0.2, 1.0)))
    assert not plan.feasible


def test_start_beyond_a_joint_limit_comes_back_in():
    q, end = np.zeros((2, 15))
    q[:3], end[:3] = (0.71, 0.5, -0.85), (0.5, 0.5, -0.85)  # the roll ends at 0.7
    tip, goal = DEX5.fingertip_positions(np.stack([q, end]))[:, 0]
    normal = np.array([-1.0, 0.0, 0.0])
    surface: dict[str, Any] = {
        "lift_position": tip + TIP * normal,
        "lift_normal": normal,
        "landing_position": goal + (TIP + 0.004) * normal,
        "landing_normal": normal,
    }
    plan = PLANNER.plan(q, 0, **surface)
    assert plan.feasible, plan.violations
    assert plan.q[0, 0] == 0.71
    assert (plan.q[1:] <= DEX5.upper[:3]).all()


def test_same_question_same_answer():
    first, _ = swing(finger=3)
    swing(finger=1, end=(0.1, 0.4))
    again, _ = swing(finger=3)
    fresh, _ = swing(SwingPlanner(DEX5), finger=3)
    for other in (again, fresh):
        np.testing.assert_array_equal(other.q, first.q)
        np.testing.assert_array_equal(other.time, first.time)


def test_fingers_of_a_round_hand_plan_alike():
    """dex5 is symmetric: the same swing of each finger is the same in its joints."""
    plans = [swing(finger=finger)[0] for finger in range(5)]
    for plan in plans[1:]:
        np.testing.assert_allclose(plan.q, plans[0].q, atol=1e-3)


def test_tip_radius_given_or_measured():
    q, (_, surface) = touching(0, 0.3, 0.13), swing()
    given, measured = (PLANNER.plan(q, 0, tip_radius=r, **surface) for r in (TIP, None))
    np.testing.assert_allclose(given.q, measured.q, atol=1e-6)
    wide = PLANNER.plan(q, 0, tip_radius=0.02, **surface)
    assert np.linalg.norm(wide.tip[-1][:2]) == pytest.approx(OBJECT + 0.024, abs=1e-4)


def test_pickles_without_its_solvers():
    copy = pickle.loads(pickle.dumps(PLANNER))
    np.testing.assert_array_equal(swing(copy)[0].q, swing()[0].q)


def test_solves_in_milliseconds():
    times = sorted(swing(finger=i % 5)[0].solve_time for i in range(15))
    print(f"median plan: {1e3 * times[7]:.1f} ms")
    assert times[7] < 0.5  # about 8 ms on an idle core; room for a busy one


WRIST = """
<mujoco><compiler angle="radian"/><worldbody><body name="palm">
 <joint name="wrist" axis="0 1 0" range="-1 1"/><geom size="0.02"/>
 <body pos="0.05 0 0"><joint name="a" axis="1 0 0" range="-0.8 0.8"/><geom size="0.01"/>
  <body pos="0 0 0.03"><joint name="b" axis="0 1 0" range="-1 1.5"/><geom size="0.01"/>
   <body pos="0 0 0.06"><joint name="c" {c} range="-2 1.2"/><geom size="0.01"/>
    <body name="l" pos="0 0 0.06">{d}<geom size="0.01"/></body></body></body></body>
 <body name="r" pos="-0.05 0 0.1"><geom size="0.01"/></body>
</body></worldbody>{equality}</mujoco>
"""


@pytest.mark.parametrize("last", ['axis="0 1 0"', 'type="slide" axis="0 0 1"'])
def test_bent_wrist_and_sliding_joint(tmp_path, last):
    path = tmp_path / "hand.xml"
    path.write_text(WRIST.format(c=last, d="", equality=""))
    hand = HandModel.from_mjcf(path, ["l"] if "slide" in last else ["l", "r"])
    if "slide" in last:  # the limits of a slide are lengths
        hand.lower[-1], hand.upper[-1] = -0.05, 0.05
    names = {name: i for i, name in enumerate(hand.joint_names)}
    q, goal = np.zeros(hand.nq), np.zeros(hand.nq)
    bent = {"wrist": 0.4, "a": 0.1, "b": 0.5}
    for name, angle in bent.items():
        q[names[name]] = goal[names[name]] = angle
    c = names["c"]
    q[c], goal[c] = (0.0, 0.0) if "slide" in last else (-0.8, -0.8)
    goal[names["a"]] = -0.1
    tips = hand.fingertip_positions(np.stack([q, goal]))[:, 0]
    normal = np.array([-1.0, 0.0, 0.0])
    surface: dict[str, Any] = {
        "lift_position": tips[0] + 0.01 * normal,
        "lift_normal": normal,
        "landing_position": tips[1] + 0.014 * normal,
        "landing_normal": normal,
    }
    planner = SwingPlanner(hand)
    if "slide" not in last:
        with pytest.raises(InvalidInput, match="no joint of its own"):
            planner.plan(q, 1, **surface)
    plan = planner.plan(q, 0, **surface)
    assert plan.feasible, plan.violations
    check(plan, hand, q, planner, **surface)


def test_joints_that_follow_others_are_refused(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(
        WRIST.format(
            c='axis="0 1 0"',
            d='<joint name="d" axis="0 1 0" pos="0 0 -0.02"/>',
            equality='<equality><joint joint1="d" joint2="c" polycoef="0 1 0 0 0"/></equality>',
        )
    )
    with pytest.raises(InvalidInput, match="'l' .*follow others"):
        SwingPlanner(HandModel.from_mjcf(path, ["l"]))
    # and by a controller that plans, before it moves
    hand, axis = HandModel.from_mjcf(path, ["l"]), np.array([0.0, 0.0, 1.0])
    GuardedSwitch(hand, axis, GuardedSwitchConfig(), 0.05)
    with pytest.raises(InvalidInput, match="'l' .*follow others"):
        GuardedSwitch(hand, axis, GuardedSwitchConfig(path="planned"), 0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"knots": 5}, "knots is 5"),
        ({"knots": 8.5}, "knots is 8.5"),
        ({"clearance": -0.01}, "clearance is -0.01"),
        ({"pretouch": 0.02}, "pretouch is 0.02 m; expected less than clearance"),
        ({"lateral": np.nan}, "lateral is nan"),
        ({"speed_limit": [1.0, 2.0]}, "speed_limit is"),
        ({"speed_limit": 0.0}, "speed_limit is"),
        ({"duration": (2.0, 1.0)}, "duration is"),
        ({"time_weight": np.inf}, "time_weight is inf"),
        ({"max_iterations": 0}, "max_iterations is 0"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InvalidInput, match=message):
        SwingPlanner(DEX5, **options)


def test_bad_questions():
    q, (_, surface) = touching(0, 0.3, 0.13), swing()
    with pytest.raises(InvalidInput, match="q is "):
        PLANNER.plan(q[:4], 0, **surface)
    with pytest.raises(UnknownName, match="unknown finger 5"):
        PLANNER.plan(q, 5, **surface)
    wrong: dict[str, Any]
    for wrong, message in (
        ({"lift_normal": [0, 0, 0]}, "lift_normal is .*unit length"),
        ({"landing_position": [0, np.nan, 0]}, "landing_position is .*nan"),
    ):
        with pytest.raises(InvalidInput, match=message):
            PLANNER.plan(q, 0, **{**surface, **wrong})
    with pytest.raises(InvalidInput, match="tip_radius is -1"):
        PLANNER.plan(q, 0, tip_radius=-1.0, **surface)
