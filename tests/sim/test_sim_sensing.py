"""Sensors: the size of their noise, their latency, and whose numbers are drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.gait import CoordinatedGait
from dexctl.rotations import rotation_vector
from dexctl.sim import SceneConfig, Sensing, Simulation
from dexctl.sim.sensing import Sensor
from dexctl.state import GraspState
from dexctl.streams import Streams

PERIOD = 0.05


def states(count: int, time: float = 0.0, q: float = 0.0) -> GraspState:
    """Two fingers with 2 N each along x, and a third that touches nothing."""
    touch = np.tile([True, True, False], (count, 1))
    normal = np.zeros((count, 3, 3))
    normal[touch, 0] = 1.0
    return GraspState(
        q=np.full((count, 4), q),
        q_target=np.full((count, 4), q),
        in_contact=touch,
        contact_position=np.where(touch[..., None], np.full(3, 0.1), 0.0),
        contact_normal=normal,
        contact_force=np.where(touch, 2.0, 0.0),
        object_position=np.zeros((count, 3)),
        object_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        time=np.full(count, time),
        age=np.full(count, 0.005),
    )


def sensor(count: int, seed: int = 0, **settings: Any) -> Sensor:
    return Sensor(Sensing(**settings), Streams(seed, (count,)), PERIOD)


def test_without_noise_and_latency_the_truth_is_told() -> None:
    truth = states(2)
    assert sensor(2)(truth, np.ones(2, bool)) is truth


def test_noise_has_the_size_asked_for() -> None:
    count = 4000
    told = sensor(count, joint_noise=0.01, position_noise=2e-3, normal_noise=0.05, force_noise=0.2)(
        states(count)
    )
    assert np.std(told.q) == pytest.approx(0.01, rel=0.03)
    assert told.q_target.tolist() == states(count).q_target.tolist()
    assert np.std(told.contact_position[:, :2] - 0.1) == pytest.approx(2e-3, rel=0.03)
    assert np.std(told.contact_force[:, :2]) == pytest.approx(0.2, rel=0.03)
    np.testing.assert_allclose(np.linalg.norm(told.contact_normal[:, :2], axis=-1), 1.0)
    # two axes, each of standard deviation 0.05, and none along the normal
    tilt = np.arccos(np.minimum(told.contact_normal[:, :2, 0], 1.0))
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(0.05 * np.sqrt(2), rel=0.03)
    for part in (told.in_contact, told.contact_position, told.contact_normal, told.contact_force):
        assert not part[:, 2].any()  # a finger that touches nothing tells nothing


def test_noise_as_a_share_of_the_force() -> None:
    told = sensor(4000, force_noise_share=0.1)(states(4000))
    assert np.std(told.contact_force[:, :2]) == pytest.approx(0.2, rel=0.03)
    assert told.in_contact[:, :2].all()


def test_too_little_force_is_no_touch() -> None:
    told = sensor(2000, force_noise=2.0, touch_threshold=1.0)(states(2000))
    gone = ~told.in_contact[:, :2]
    assert gone.mean() == pytest.approx(0.3085, abs=0.03)  # half a standard deviation below 2 N
    assert (told.contact_force[:, :2][~gone] >= 1.0).all()
    assert not told.contact_force[:, :2][gone].any()
    assert not told.contact_normal[:, :2][gone].any()


def test_each_environment_draws_its_own() -> None:
    both, alone = sensor(2, seed=5, joint_noise=0.1), sensor(1, seed=6, joint_noise=0.1)
    for _ in range(3):
        np.testing.assert_array_equal(both(states(2)).q[1], alone(states(1)).q[0])


def test_only_those_that_begin_move_on() -> None:
    some, all_of_them = sensor(2, joint_noise=0.1), sensor(2, joint_noise=0.1)
    some(states(2), np.array([False, True]))
    np.testing.assert_array_equal(some(states(2)).q[0], all_of_them(states(2)).q[0])


def test_what_is_sensed_is_late() -> None:
    """0.1 s are two steps; set-points are known at once, and until then the first is told."""
    late = sensor(2, sensor_latency=0.1)
    told = [late(states(2, 0.0, 0.0), np.ones(2, bool))]
    told += [late(states(2, PERIOD * k, 0.1 * k)) for k in range(1, 5)]
    assert [one.q[0, 0] for one in told] == pytest.approx([0.0, 0.0, 0.0, 0.1, 0.2])
    assert [one.q_target[0, 0] for one in told] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert [np.asarray(one.time)[0] for one in told] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
    ages = [np.asarray(one.age)[0] for one in told]  # it was 0.005 s old when it was new
    assert ages == pytest.approx([0.005, 0.055, 0.105, 0.105, 0.105])


def test_a_new_episode_forgets_the_old_one() -> None:
    late = sensor(2, sensor_latency=0.05)
    late(states(2, 0.0, 0.0), np.ones(2, bool))
    late(states(2, 0.05, 0.1))
    begun = late(states(2, 0.0, 0.7), np.array([True, False]))
    assert begun.q[0, 0] == 0.7
    after = late(states(2, 0.1, 0.2))
    assert after.q[:, 0] == pytest.approx([0.7, 0.1])


def test_saved_and_restored() -> None:
    late = sensor(3, joint_noise=0.1, sensor_latency=0.1)
    for k in range(4):
        late(states(3, PERIOD * k))
    saved = late.save()
    first = [late(states(3, PERIOD * k)).q for k in (4, 5, 6)]
    other = sensor(3, seed=9, joint_noise=0.1, sensor_latency=0.1)
    other.restore(saved)
    np.testing.assert_array_equal([other(states(3, PERIOD * k)).q for k in (4, 5, 6)], first)


CHOICES = ("touch", "joint_touch", "object_pose")
NUMBERS = [name for name in Sensing.__dataclass_fields__ if name not in CHOICES]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf, "much"])
def test_bad_settings(name: str, value: object) -> None:
    with pytest.raises(InvalidInput, match=f"{name} is {value!r}; expected"):
        Sensing(**{name: value})  # type: ignore[arg-type]


def test_an_unknown_kind_of_touch() -> None:
    with pytest.raises(UnknownName, match="unknown touch 'none'; known: full, binary, joint-torq"):
        Sensing(touch="none")  # type: ignore[arg-type]


@pytest.mark.parametrize("touch", ["binary", "joint-torque"])
def test_touch_told_from_joints_is_near_the_truth_and_repeats(touch: Any) -> None:
    config = SceneConfig(object=("cylinder",), sensing=Sensing(touch=touch, joint_offset=0.02))
    with Simulation(config, 2, 0) as sim:
        controller = CoordinatedGait(sim.hand)

        def run(steps: int) -> list[np.ndarray]:
            found = []
            for _ in range(steps):
                seen = sim.read()
                sim.write(seen.q_target + controller.act(seen))
                sim.step()
                found.append(sim.read().contact_force)
            return found

        run(15)
        seen, truth = sim.read(), sim.state
        both = seen.in_contact & truth.in_contact
        assert both.sum() >= 8
        along = (seen.contact_normal * truth.contact_normal).sum(-1)[both]
        assert np.median(along) > 0.9
        error = (seen.contact_force - truth.contact_force)[both]
        assert np.median(np.abs(error)) < 0.4
        if touch == "binary":
            assert seen.in_contact.tolist() == truth.in_contact.tolist()
        # encoders read joints and set-points alike off, by what differs between the joints
        offset = seen.q - truth.q
        np.testing.assert_allclose(seen.q_target - truth.q_target, offset, atol=1e-12)
        assert 0.01 < np.std(offset) < 0.04

        saved, state = sim.save(), controller.state_dict()
        first = run(10)
        sim.restore(saved)
        controller.load_state_dict(state)
        np.testing.assert_array_equal(run(10), first)


def test_gear_friction_holds_joints_back() -> None:
    moved = []
    for friction in (None, 0.1):
        with Simulation(SceneConfig(gear_friction=friction), 1, 0) as sim:
            start = sim.read()
            sim.write(start.q_target + 0.03)  # 0.09 N m
            sim.step()
            moved.append(np.abs(sim.read().q - start.q).max())
    assert moved[1] < 0.3 * moved[0]


def test_a_tracker_has_noise_of_its_own() -> None:
    count = 4000
    told = sensor(count, tracker_position_noise=3e-3, tracker_rotation_noise=0.05)(states(count))
    assert told.object_position is not None
    assert np.std(told.object_position) == pytest.approx(3e-3, rel=0.03)
    assert told.object_quaternion is not None
    turned = rotation_vector(told.object_quaternion)
    assert np.std(turned) == pytest.approx(0.05, rel=0.03)
    np.testing.assert_allclose(np.linalg.norm(told.object_quaternion, axis=-1), 1.0)
    np.testing.assert_array_equal(told.q, states(count).q)
    np.testing.assert_array_equal(told.contact_position, states(count).contact_position)


def test_a_tracker_is_later_than_the_rest() -> None:
    late = sensor(2, sensor_latency=PERIOD, tracker_latency=2 * PERIOD)
    for i in range(6):
        place = np.full((2, 3), float(i))
        now = replace(states(2, PERIOD * i, q=float(i)), object_position=place)
        told = late(now, np.ones(2, bool) if i == 0 else None)
        assert told.q[0, 0] == max(i - 1, 0)
        assert told.object_position is not None
        assert told.object_position[0, 0] == max(i - 3, 0)


def test_a_late_tracker_is_saved_and_restored() -> None:
    def told(one: Sensor, i: int) -> GraspState:
        return one(
            replace(states(1, PERIOD * i), object_position=np.full((1, 3), float(i))),
            np.ones(1, bool) if i == 0 else None,
        )

    settings: dict[str, Any] = {"tracker_latency": 2 * PERIOD, "tracker_position_noise": 0.01}
    one = sensor(1, **settings)
    for i in range(4):
        told(one, i)
    saved = one.save()
    after = [told(one, i).object_position for i in range(4, 8)]
    other = sensor(1, seed=5, **settings)
    other.restore(saved)
    np.testing.assert_array_equal([told(other, i).object_position for i in range(4, 8)], after)


def test_a_tracker_is_nothing_where_nobody_tracks() -> None:
    """Neither late nor random: what else is drawn is what it was."""
    settings: dict[str, Any] = {"joint_noise": 0.01, "object_pose": "unknown"}
    plain = sensor(3, **settings)
    other = sensor(3, tracker_latency=1.0, tracker_position_noise=0.1, **settings)
    for i in range(3):
        mask = np.ones(3, bool) if i == 0 else None
        a, b = (one(states(3, PERIOD * i), mask) for one in (plain, other))
        np.testing.assert_array_equal(a.q, b.q)
        assert b.object_position is None
