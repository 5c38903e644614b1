"""GuardedSwitch: phases, guards and motion of one finger, on a bench made of geometry."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, HandModel
from dexctl.exceptions import InvalidInput
from dexctl.switch import FingerIK, GuardedSwitch, GuardedSwitchConfig, Phase
from dexctl.switch.landing import azimuth, landing_at, turned, unit_across
from dexctl.switch.paths import SwingPaths

Z = np.array([0.0, 0.0, 1.0])
TIP_RADIUS = 0.014
STIFFNESS = 500.0  # N/m, of the object's surface
PRESS = 2e-3  # m, how deep every finger presses at first
SWING = -0.4
POSTURE = np.array([0.0, 0.4, -0.8])
WHOLE = [Phase.UNLOAD, Phase.LIFT, Phase.CARRY, Phase.PLACE, Phase.LOAD, Phase.IDLE]


class Bench:
    """N hands round upright cylinders; joints are where their set-points are.

    The finger that unloads goes back as its holder would let it, unless it is ``stuck``.
    """

    def __init__(self, hand: HandModel, q: np.ndarray, rate: float = 20.0, **settings) -> None:
        self.hand = hand
        self.q = q.copy()
        self.dt = 1.0 / rate
        self.switch = GuardedSwitch(hand, Z, GuardedSwitchConfig(**settings), self.dt)
        self.switch.start(len(q))
        tips = hand.fingertip_positions(q)
        self.radius = float(np.linalg.norm(tips[0, 0, :2])) - TIP_RADIUS + PRESS
        self.centre = np.tile([0.0, 0.0, tips[0, 0, 2]], (len(q), 1))
        self.solid = True
        self.stuck = False
        self.may_lift: Callable | None = None
        self.corner = np.zeros(hand.n_fingers)  # m, how far the object sticks out at each finger
        self.phases: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.tips: list[np.ndarray] = []

    def state(self) -> GraspState:
        tips = self.hand.fingertip_positions(self.q)
        lever = tips - self.centre[:, None]
        normal = -unit_across(lever, Z)
        deep = self.radius + self.corner + TIP_RADIUS - np.linalg.norm(lever[..., :2], axis=-1)
        touch = (deep > 0) & self.solid
        shown = touch[..., None]
        return GraspState(
            q=self.q,
            q_target=self.q.copy(),
            in_contact=touch,
            # rows out of touch are never read
            contact_position=np.where(shown, tips + TIP_RADIUS * normal, np.nan),
            contact_normal=np.where(shown, normal, np.nan),
            contact_force=np.where(touch, STIFFNESS * deep, np.nan),
            object_position=self.centre,
        )

    def put_on_a_corner(self, finger: int, corner: float) -> None:
        """Have a finger touch so much further out [m]."""
        tips = self.hand.fingertip_positions(self.q)
        ik = FingerIK(self.hand)
        out = unit_across(tips - self.centre[:, None], Z)
        for row, tip in enumerate(tips + (corner - self.corner[finger]) * out):
            self.q[row] = ik.solve(self.q[row], finger, tip[finger]).q
        self.corner[finger] = corner

    def begin(self, finger: list[int], swing: float = SWING, lift: float = 0.0) -> None:
        fingers = np.array(finger)
        tips = self.hand.fingertip_positions(self.q)[np.arange(len(fingers)), fingers]
        direction = turned(unit_across(tips - self.centre, Z), swing, Z)
        radius = np.full(len(fingers), self.radius + TIP_RADIUS)
        landing = landing_at(self.centre + np.array([0.0, 0.0, lift]), direction, radius)
        self.switch.begin(np.ones(len(fingers), bool), fingers, self.centre, landing)

    def step(self) -> None:
        state = self.state()
        now = self.hand.configuration(self.q)
        action = self.switch.command(state, now, self.centre, self.may_lift)
        rows = np.flatnonzero(self.switch.phase == Phase.UNLOAD)
        if len(rows) and not self.stuck:
            finger = self.switch.finger[rows]
            force = np.nan_to_num(state.contact_force[rows, finger])
            back = (
                -0.5
                * force[:, None]
                / STIFFNESS
                * np.nan_to_num(state.contact_normal[rows, finger])
            )
            self.q = self.q + self.switch.tip_motion(rows, now, back)
        self.q = self.q + action
        self.phases.append(self.switch.phase.copy())
        self.actions.append(action)
        self.tips.append(self.hand.fingertip_positions(self.q))

    def run(self, seconds: float) -> Bench:
        for _ in range(round(seconds / self.dt)):
            self.step()
        return self

    def order(self, row: int = 0) -> list[int]:
        """The phases in the order in which they came, without the idle time before."""
        return [phase for phase, _ in groupby(np.array(self.phases)[:, row])]

    def times(self, row: int = 0) -> dict[int, float]:
        phases = np.array(self.phases)[:, row]
        return {phase: self.dt * float((phases == phase).sum()) for phase in set(phases.tolist())}


@pytest.fixture
def make(dex5: HandModel) -> Callable[..., Bench]:
    def build(count: int = 1, **settings) -> Bench:
        return Bench(dex5, np.tile(POSTURE, (count, 5)), **settings)

    return build


@pytest.mark.parametrize("finger", range(5))
def test_phases_come_in_order(make, finger):
    bench = make()
    bench.begin([finger])
    assert bench.switch.finger.tolist() == [finger]
    bench.run(4.0)
    assert bench.order() == WHOLE
    assert bench.switch.finger.tolist() == [-1]
    config, times = bench.switch.config, bench.times()
    assert abs(times[Phase.UNLOAD] - config.unload_time) <= bench.dt + 1e-9
    assert abs(times[Phase.LOAD] - config.load_time) <= bench.dt + 1e-9
    for phase in (Phase.LIFT, Phase.CARRY, Phase.PLACE):
        assert 0 < times[phase] < config.time_limit


def test_touch_ends_placing_where_the_finger_was_to_land(make):
    bench = make(2)
    bench.begin([1, 3])
    start = bench.hand.fingertip_positions(bench.q)
    bench.run(4.0)
    for row, finger in enumerate((1, 3)):
        phases = np.array(bench.phases)[:, row]
        landed = bench.tips[int(np.flatnonzero(phases == Phase.LOAD)[0])][row, finger]
        gap = np.linalg.norm(landed[:2]) - bench.radius - TIP_RADIUS
        assert -2 * 0.06 * bench.dt < gap < 0.0
        angle = azimuth(start[row, finger] * [1, 1, 0], landed * [1, 1, 0], Z)
        assert abs(angle - SWING) < 0.03
        assert abs(landed[2] - bench.centre[row, 2]) < 3e-3


def test_the_carried_finger_keeps_off_the_surface(make):
    bench = make()
    bench.begin([2])
    bench.run(4.0)
    carried = np.array(bench.phases)[:, 0] == Phase.CARRY
    gap = np.linalg.norm(np.array(bench.tips)[:, 0, 2, :2], axis=-1) - bench.radius - TIP_RADIUS
    assert gap[carried].min() > 0.6 * bench.switch.config.clearance


def test_it_is_carried_outside_a_corner_that_another_finger_touches(make):
    outside = []
    for corner in (0.0, 0.01, 0.025):
        bench = make()
        bench.put_on_a_corner(4, corner)
        bench.begin([2], swing=-0.7)
        bench.run(4.0)
        assert bench.order() == WHOLE
        carried = np.array(bench.phases)[:, 0] == Phase.CARRY
        radius = np.linalg.norm(np.array(bench.tips)[:, 0, 2, :2], axis=-1)
        outside.append(float(radius[carried].max()) - bench.radius - TIP_RADIUS)
    clearance = make().switch.config.clearance
    assert abs(outside[0] - clearance) < 0.004  # nothing sticks out: the clearance counts
    assert abs(outside[1] - clearance) < 0.004  # less than the clearance
    assert outside[2] > 0.024  # past the corner, whose finger is not its neighbour


def test_another_object_may_be_smaller(make):
    bench = make(2)
    bench.put_on_a_corner(4, 0.025)
    bench.run(0.1)
    assert bench.switch.state_dict()["furthest"].min() > bench.radius + TIP_RADIUS + 0.02
    bench.put_on_a_corner(4, 0.0)
    bench.switch.clear(np.array([True, False]))
    bench.run(0.1)
    furthest = bench.switch.state_dict()["furthest"] - bench.radius - TIP_RADIUS
    assert abs(furthest[0]) < 0.004 and furthest[1] > 0.02


def test_only_the_finger_moves_and_only_while_it_is_released(make):
    bench = make(3)
    fingers = [0, 2, 4]
    bench.begin(fingers)
    for _ in range(80):
        bench.step()
        released = bench.switch.released
        assert released.sum() == sum(Phase.LIFT <= p <= Phase.PLACE for p in bench.switch.phase)
        for row, finger in enumerate(fingers):
            others = ~bench.hand.moves[finger]
            assert not bench.actions[-1][row, others].any()
            if not released[row, finger]:
                assert not bench.actions[-1][row].any()


def test_shares_of_the_grip(make):
    """Down to nothing while it unloads, up again while it loads; all of it otherwise."""
    bench = make()
    bench.begin([1])
    shares: dict[int, list[float]] = {}
    for _ in range(80):
        bench.step()
        share, phase = bench.switch.max_force[0], bench.switch.phase[0]
        assert np.delete(share, 1).tolist() == [1.0] * 4
        shares.setdefault(phase, []).append(share[1])
        rate = bench.switch.yielding[0]
        assert rate[1] == (10.0 if phase == Phase.UNLOAD else 0.0)
        assert not np.delete(rate, 1).any()
    falling, rising = shares[Phase.UNLOAD], shares[Phase.LOAD]
    dt, config = bench.dt, bench.switch.config
    np.testing.assert_allclose(np.diff(falling), -dt / config.unload_time, atol=1e-9)
    np.testing.assert_allclose(np.diff(rising), dt / config.load_time, atol=1e-9)
    assert rising[0] == 0.0
    assert set(shares[Phase.CARRY]) == {1.0} and set(shares[Phase.IDLE]) == {1.0}


def test_a_finger_that_cannot_be_unloaded_is_loaded_again(make):
    bench = make(time_limit=1.0)
    bench.stuck = True
    bench.begin([1])
    bench.run(3.0)
    assert bench.order() == [Phase.UNLOAD, Phase.LOAD, Phase.IDLE]
    assert abs(bench.times()[Phase.UNLOAD] - 1.0) <= 2 * bench.dt
    assert not np.any(bench.actions)


def test_a_finger_that_finds_nothing_is_handed_back_in_the_air(make):
    bench = make(time_limit=1.5)
    bench.begin([1])
    while bench.switch.phase[0] != Phase.CARRY:
        bench.step()
    bench.solid = False
    bench.run(5.0)
    assert bench.order() == [phase for phase in WHOLE if phase != Phase.LOAD]
    assert abs(bench.times()[Phase.PLACE] - 1.5) <= 2 * bench.dt
    assert bench.switch.finger.tolist() == [-1] and not bench.switch.released.any()
    assert not bench.actions[-1].any()


def test_a_refused_finger_is_loaded_again(make):
    """The guard is asked once, about the fingers about to lift; one hand's no is its own."""
    bench = make(3)
    asked: list[tuple[list[int], list[int]]] = []

    def may_lift(rows: np.ndarray, fingers: np.ndarray) -> np.ndarray:
        asked.append((rows.tolist(), fingers.tolist()))
        return rows != 1

    bench.may_lift = may_lift
    bench.begin([0, 2, 4])
    bench.run(4.0)
    assert asked == [([0, 1, 2], [0, 2, 4])]
    assert bench.order(0) == bench.order(2) == WHOLE
    assert bench.order(1) == [Phase.UNLOAD, Phase.LOAD, Phase.IDLE]
    assert not np.array(bench.actions)[:, 1].any()


def test_the_landing_moves_with_the_object_until_the_finger_lifts(make):
    shift = np.array([0.004, -0.003, 0.002])
    ends = []
    for before, after in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        bench = make()
        bench.begin([2])
        bench.centre = bench.centre + before * shift
        while bench.switch.phase[0] < Phase.LIFT:
            bench.step()
        bench.centre = bench.centre + after * shift
        bench.solid = False  # so that it goes on to the end of its path
        bench.run(4.0)
        ends.append(bench.tips[-1][0, 2])
    np.testing.assert_allclose(ends[1] - ends[0], shift, atol=5e-4)
    np.testing.assert_allclose(ends[2] - ends[0], 0.0, atol=5e-4)


def test_begin_and_clear_of_some(make):
    bench = make(2)
    bench.begin([1, 3])
    bench.switch.clear(np.array([True, False]))
    assert bench.switch.phase.tolist() == [Phase.IDLE, Phase.UNLOAD]
    assert bench.switch.finger.tolist() == [-1, 3]
    bench.run(4.0)
    assert bench.order(0) == [Phase.IDLE] and bench.order(1) == WHOLE


def test_hands_do_not_know_of_each_other(make):
    together = make(4)
    together.q = together.q + np.random.default_rng(0).uniform(-0.01, 0.01, (4, 15))
    start = together.q.copy()
    together.begin([0, 1, 2, 3])
    together.run(4.0)
    for row in range(4):
        alone = make()
        alone.radius, alone.q = together.radius, start[row : row + 1]
        alone.begin([row])
        alone.run(4.0)
        assert alone.order() == together.order(row) == WHOLE
        tips = np.array(alone.tips)[:, 0], np.array(together.tips)[:, row]
        np.testing.assert_allclose(tips[0], tips[1], atol=1e-9)


def to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance of each of ``points`` from the polyline ``line``."""
    start, way = line[:-1], np.diff(line, axis=0)
    part = np.einsum("psk,sk->ps", points[:, None] - start, way)
    part = np.clip(part / np.maximum((way * way).sum(-1), 1e-18), 0.0, 1.0)
    nearest = start + part[..., None] * way
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


def test_the_swing_is_the_same_at_any_control_rate(make):
    paths, times = [], []
    for rate in (20.0, 40.0):
        bench = make(rate=rate)
        bench.begin([2])
        bench.run(4.0)
        assert bench.order() == WHOLE
        phases = np.array(bench.phases)[:, 0]
        free = (phases >= Phase.LIFT) & (phases <= Phase.PLACE)
        paths.append(np.array(bench.tips)[free, 0, 2])
        times.append(free.sum() / rate)
    # placing starts on a tick of the clock, within 8 mm of the place to come down from
    for one, other in (paths, paths[::-1]):
        assert to_line(one, other).max() < 6e-3
    np.testing.assert_allclose(times[1], times[0], rtol=0.15)


# -- paths through joint angles ---------------------------------------------------------------


@pytest.mark.parametrize("finger", [0, 3])
def test_a_planned_swing_leads_to_touch(make, finger):
    bench = make(path="planned")
    bench.begin([finger])
    start = bench.hand.fingertip_positions(bench.q)[0, finger]
    bench.run(5.0)
    # the plan spans lifting and carrying
    assert bench.order() == [phase for phase in WHOLE if phase != Phase.LIFT]
    phases = np.array(bench.phases)[:, 0]
    landed = bench.tips[int(np.flatnonzero(phases == Phase.LOAD)[0])][0, finger]
    assert abs(azimuth(start * [1, 1, 0], landed * [1, 1, 0], Z) - SWING) < 0.05
    carried = np.array(bench.tips)[phases == Phase.CARRY, 0, finger]
    gap = np.linalg.norm(carried[:, :2], axis=-1) - bench.radius - TIP_RADIUS
    middle = gap[len(gap) // 3 : 2 * len(gap) // 3]
    assert middle.min() > bench.switch.config.clearance
    others = ~bench.hand.moves[finger]
    assert not np.array(bench.actions)[:, 0, others].any()


def test_where_no_plan_is_feasible_the_jacobian_leads(make):
    bench = make(path="planned")
    bench.begin([1], lift=0.3)  # out of reach
    bench.run(6.0)
    order = bench.order()
    assert Phase.LIFT in order and order[-1] == Phase.IDLE
    assert np.isfinite(bench.q).all()


def test_far_landings_go_through_inverse_kinematics(make, monkeypatch):
    found = []
    far = SwingPaths.far

    def spy(self, *arguments):
        found.append(far(self, *arguments))
        return found[-1]

    monkeypatch.setattr(SwingPaths, "far", spy)
    bench = make(2, far_distance=1e-3)
    bench.begin([1, 4])
    bench.run(5.0)
    assert len(found) == 2 and all(path is not None for path in found)
    assert bench.order(0) == bench.order(1) == WHOLE
    near = make(2)
    near.begin([1, 4])
    near.run(5.0)
    assert len(found) == 2
    # and it lands where the other way would have landed
    for row, finger in enumerate((1, 4)):
        landed = [
            one.tips[int(np.flatnonzero(np.array(one.phases)[:, row] == Phase.LOAD)[0])]
            for one in (bench, near)
        ]
        np.testing.assert_allclose(landed[0][row, finger], landed[1][row, finger], atol=4e-3)


def test_a_far_landing_out_of_reach_is_left_to_the_jacobian(make):
    bench = make(far_distance=1e-3, time_limit=1.0)
    bench.begin([1], lift=0.3)
    bench.run(5.0)
    assert bench.order()[-1] == Phase.IDLE and np.isfinite(bench.q).all()


# -- a wrist ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wrist_hand(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    mass = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
    fingers = ""
    for i in range(4):
        x, y = np.cos(np.pi * i / 2), np.sin(np.pi * i / 2)
        flex = f'axis="{-y} {x} 0"/>{mass}'
        fingers += (
            f'<body pos="{0.055 * x} {0.055 * y} 0"><joint name="roll{i}" axis="{x} {y} 0"/>{mass}'
            f'<body pos="0 0 .02"><joint name="mid{i}" {flex}'
            f'<body pos="0 0 .075"><joint name="end{i}" {flex}'
            f'<body name="tip{i}" pos="0 0 .075">{mass}</body></body></body></body>'
        )
    path: Path = tmp_path_factory.mktemp("wrist") / "wrist.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><default><joint range="-2 2"/>'
        f'</default><worldbody><body><joint name="wrist" axis="0 0 1"/>{mass}{fingers}</body>'
        "</worldbody></mujoco>"
    )
    return HandModel.from_mjcf(path, [f"tip{i}" for i in range(4)])


@pytest.mark.parametrize("settings", [{}, {"path": "planned"}, {"far_distance": 1e-3}], ids=str)
def test_the_wrist_stays_out_of_it(wrist_hand, settings):
    assert wrist_hand.shares_joints
    q = np.array([[0.0, *np.tile(POSTURE, 4)]])
    bench = Bench(wrist_hand, q, **settings)
    bench.begin([2])
    bench.run(5.0)
    assert bench.order()[-2:] == [Phase.LOAD, Phase.IDLE]
    moved = np.any(bench.actions, axis=(0, 1))
    assert [n for n, m in zip(wrist_hand.joint_names, moved, strict=True) if m] == [
        "roll2", "mid2", "end2",
    ]  # fmt: skip


# -- settings -----------------------------------------------------------------------------------

POSITIVE = (
    "unload_time", "yield_rate", "clearance", "lift_speed", "carry_speed", "place_speed",
    "load_time", "time_limit", "far_distance", "damping",
)  # fmt: skip
NOT_NEGATIVE = ("unloaded_force", "place_depth", "touch_force")


@pytest.mark.parametrize("field", [*POSITIVE, *NOT_NEGATIVE])
@pytest.mark.parametrize("value", [np.nan, np.inf, -0.1, "slow", None, True], ids=repr)
def test_settings_are_checked(field, value):
    settings: dict[str, Any] = {field: value}
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        GuardedSwitchConfig(**settings)


@pytest.mark.parametrize("field", POSITIVE)
def test_zero_where_it_makes_no_sense(field):
    settings: dict[str, Any] = {field: 0.0}
    with pytest.raises(InvalidInput, match=f"^{field} is 0"):
        GuardedSwitchConfig(**settings)


@pytest.mark.parametrize("path", ["straight", "", None, 3, ("planned",)], ids=repr)
def test_unknown_paths_list_the_known_ones(path):
    with pytest.raises(InvalidInput, match="expected one of jacobian, planned"):
        GuardedSwitchConfig(path=path)
