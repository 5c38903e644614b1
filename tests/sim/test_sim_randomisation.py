"""Randomisation: what is drawn, from which ranges, and that it takes effect in its environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.settings import from_plain, to_plain
from dexctl.sim import BatchSimulator, LimitedHand, Scene, SceneConfig
from dexctl.sim.pushes import Push
from dexctl.sim.randomisation import Drawn, Randomisation, Randomiser, nominal
from dexctl.sim.sensing import Sensing, Sensor
from dexctl.sim.simulation import Simulation
from dexctl.state import GraspState
from dexctl.streams import Streams

EVERYTHING = Randomisation(
    friction_range=(0.6, 1.4),
    mass_range=(0.05, 0.25),
    size_range=(0.9, 1.1),
    centre_of_mass=0.005,
    stiffness_range=(0.7, 1.3),
    damping_range=(0.7, 1.3),
    gear_friction_range=(0.0, 0.02),
    armature_range=(0.001, 0.004),
    speed_range=(0.6, 3.0),
    torque_range=(0.5, 1.0),
    action_latency_range=(0.0, 0.05),
    noise_range=(0.0, 1.0),
    sensor_latency_range=(0.0, 0.1),
    touch_threshold_range=(0.05, 0.5),
    touch_dropout_range=(0.0, 0.1),
    joint_offset_range=(-0.05, 0.02),
    tip_friction_range=(0.7, 1.2),
    link_friction_range=(0.5, 1.5),
    push_range=(0.0, 0.5),
    gravity_tilt=np.pi,
    gravity_turning_range=(0.0, 0.5),
)
NOISE = Sensing(joint_noise=0.02, joint_offset=0.03, position_noise=0.002, force_noise_share=0.2)


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder")


def randomiser(scene: Scene, config: Randomisation, count: int, seed: int = 0) -> Randomiser:
    usual = nominal([(scene, count)], Sensing(), HandLimits(), Push())
    return Randomiser(config, usual, Streams(seed, (count,)))


def test_numbers_are_uniform_in_their_ranges(cylinder: Scene) -> None:
    made = randomiser(cylinder, EVERYTHING, 4000)
    made.draw(np.ones(4000, bool))
    drawn = made.drawn
    for name, low, high in (
        ("friction", 0.6, 1.4),
        ("object_mass", 0.05, 0.25),
        ("speed_limit", 0.6, 3.0),
        ("sensor_latency", 0.0, 0.1),
        ("touch_dropout", 0.0, 0.1),
        ("joint_offset", -0.05, 0.02),
        ("tip_friction", 0.7, 1.2),
        ("link_friction", 0.5, 1.5),
    ):
        values = getattr(drawn, name)
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.02 * (high - low))
    share = drawn.kp / cylinder.stiffness
    assert share.min() >= 0.7
    assert share.max() <= 1.3
    assert np.unique(share.round(9)).size > 4000  # each servo its own
    assert drawn.tip_friction.shape == (4000, 5)  # each fingertip its own
    assert np.abs(np.corrcoef(drawn.tip_friction.T) - np.eye(5)).max() < 0.1
    assert set(np.unique(drawn.object_size.round(6))) == {0.9, 0.95, 1.0, 1.05, 1.1}
    assert np.abs(drawn.centre_of_mass).max() == pytest.approx(0.005, rel=0.01)


def test_gravity_points_anywhere_or_within_a_cap(cylinder: Scene) -> None:
    for most, mean in ((np.pi, 0.0), (0.5, (1 + np.cos(0.5)) / 2)):
        made = randomiser(cylinder, Randomisation(gravity_tilt=most), 4000)
        made.draw(np.ones(4000, bool))
        gravity = made.drawn.gravity
        np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81)
        down = -gravity[:, 2] / 9.81
        assert down.min() >= np.cos(most) - 1e-9
        assert down.mean() == pytest.approx(mean, abs=0.03)  # the height on a sphere is uniform
        assert np.abs(gravity[:, :2].mean(axis=0)).max() < 0.3


def test_a_share_of_the_episodes_has_gravity_along_the_scenes_own_line(cylinder: Scene) -> None:
    for most, others in ((np.pi, 0.1), (0.5, 0.0)):
        config = Randomisation(gravity_tilt=most, gravity_straight_share=0.2)
        made = randomiser(cylinder, config, 4000)
        made.draw(np.ones(4000, bool))
        down = -made.drawn.gravity[:, 2] / 9.81
        assert np.mean(down > 1 - 1e-12) == pytest.approx(0.2 - others, abs=0.02)
        assert np.mean(down < -1 + 1e-12) == pytest.approx(others, abs=0.02)
        plain = randomiser(cylinder, Randomisation(gravity_tilt=most), 4000)
        plain.draw(np.ones(4000, bool))
        same = (made.drawn.gravity == plain.drawn.gravity).all(axis=1)
        assert same.mean() == pytest.approx(0.8, abs=0.02)  # the others are as they were


def test_gravity_turns_about_its_axis(cylinder: Scene) -> None:
    made = randomiser(cylinder, Randomisation(gravity_turning_range=(0.3, 0.3)), 5)
    made.draw(np.ones(5, bool))
    before, turning = made.drawn.gravity, made.drawn.gravity_turning
    np.testing.assert_allclose(np.linalg.norm(turning, axis=1), 0.3)
    assert made.turn(1e-4)
    rate = (made.drawn.gravity - before) / 1e-4
    np.testing.assert_allclose(rate, np.cross(turning, before), atol=1e-3)
    for _ in range(1000):
        made.turn(0.05)
    np.testing.assert_allclose(np.linalg.norm(made.drawn.gravity, axis=1), 9.81)


def test_level_narrows_ranges_towards_what_is_usual(cylinder: Scene) -> None:
    made = randomiser(cylinder, EVERYTHING, 500)
    usual = made.drawn
    made.level = 0.0
    made.draw(np.ones(500, bool))
    for name in Drawn._fields:
        if name not in ("speed_limit", "torque_limit", "noise"):
            np.testing.assert_allclose(getattr(made.drawn, name), getattr(usual, name), atol=1e-12)
    assert set(made.drawn.speed_limit) == {3.0}  # no limit is the range's high end
    assert not made.drawn.noise.any()
    made.level = 0.5
    made.draw(np.ones(500, bool))
    assert 0.8 <= made.drawn.friction.min() < 0.82
    tilt = np.arccos(np.clip(-made.drawn.gravity[:, 2] / 9.81, -1, 1))
    assert tilt.max() <= np.pi / 2 + 1e-9
    assert 0.4 < made.drawn.noise.max() <= 0.5


def test_each_range_widens_in_its_own_part_of_the_level(cylinder: Scene) -> None:
    """Friction and mass 1 and 0.1 kg by themselves; nothing, half, all: of the range's width."""
    made = randomiser(cylinder, EVERYTHING, 4000)
    made.schedule = {
        "friction_range": (0.0, 0.4), "mass_range": (0.6, 1.0), "gravity_tilt": (0.0, 0.0),
        "centre_of_mass": (1.0, 1.0), "stiffness_range": (0.2, 0.2),
    }  # fmt: skip
    for level, friction, mass, tilt, centre, stiffness, damping in (
        (0.0, (1.0, 1.0), (0.1, 0.1), np.pi, 0.0, 1.0, 1.0),
        (0.1, (0.9, 1.1), (0.1, 0.1), np.pi, 0.0, 1.0, 0.97),
        (0.4, (0.6, 1.4), (0.1, 0.1), np.pi, 0.0, 0.7, 0.88),
        (0.8, (0.6, 1.4), (0.075, 0.175), np.pi, 0.0, 0.7, 0.76),
        (1.0, (0.6, 1.4), (0.05, 0.25), np.pi, 0.005, 0.7, 0.7),
    ):
        made.level = level
        made.draw(np.ones(4000, bool))
        drawn = made.drawn
        for value, (low, high) in ((drawn.friction, friction), (drawn.object_mass, mass)):
            close = pytest.approx(0.0, abs=0.01 * (high - low) + 1e-12)
            assert value.min() - low == close and value.max() - high == close
        lowest = (-drawn.gravity[:, 2] / 9.81).min()
        assert lowest == pytest.approx(np.cos(tilt), abs=0.01)
        assert np.abs(drawn.centre_of_mass).max() == pytest.approx(centre, abs=1e-4)
        assert (drawn.kp / cylinder.stiffness).min() == pytest.approx(stiffness, abs=1e-3)
        share = drawn.kv / made.usual.kv
        assert share.min() == pytest.approx(damping, abs=1e-3)  # as far as the level itself


def test_a_schedule_takes_no_other_numbers(cylinder: Scene) -> None:
    one, other = (randomiser(cylinder, EVERYTHING, 4, seed=2) for _ in range(2))
    other.schedule = dict.fromkeys(EVERYTHING.drawn, (0.0, 1.0))
    for made in (one, other):
        made.level = 0.3
        made.draw(np.ones(4, bool))
    for name in Drawn._fields:
        np.testing.assert_array_equal(getattr(one.drawn, name), getattr(other.drawn, name), name)


def test_noise_of_one_share_grows_with_the_level(cylinder: Scene) -> None:
    made = randomiser(cylinder, Randomisation(noise_range=(1.0, 1.0)), 4)
    for level in (0.0, 0.25, 1.0):
        made.level = level
        made.draw(np.ones(4, bool))
        np.testing.assert_allclose(made.drawn.noise, level)


def test_one_range_more_leaves_the_others_as_they_are(cylinder: Scene) -> None:
    one = randomiser(cylinder, Randomisation(mass_range=(0.1, 0.2)), 8)
    two = randomiser(cylinder, Randomisation(mass_range=(0.1, 0.2), gravity_tilt=1.0), 8)
    for made in (one, two):
        made.draw(np.arange(8) % 2 == 0)
        made.draw(np.ones(8, bool))
    np.testing.assert_array_equal(one.drawn.object_mass, two.drawn.object_mass)


def test_an_environment_of_a_batch_is_one_alone() -> None:
    config = SceneConfig(object=("cylinder",), randomisation=EVERYTHING, sensing=NOISE, threads=1)
    with Simulation(config, 3, 5) as batch, Simulation(config, 1, 7) as single:
        for step in range(25):
            seen, alone = batch.read(), single.read()
            for name, value in alone.arrays().items():
                if value is not None:
                    np.testing.assert_array_equal(
                        np.asarray(getattr(seen, name))[2], value[0], name
                    )
            change = 0.02 * np.sin(step + np.arange(batch.hand.nq))
            batch.write(seen.q_target + change)
            single.write(alone.q_target + change)
            batch.step()
            single.step()
            if step == 12:
                batch.reset(None, np.array([True, False, True]))
                single.reset(None, np.ones(1, bool))


def test_a_restored_simulation_goes_on_with_the_same_bits() -> None:
    config = SceneConfig(object=("cylinder",), randomisation=EVERYTHING, sensing=NOISE, threads=1)

    def advance(sim: Simulation, steps: int) -> GraspState:
        for step in range(steps):
            sim.write(sim.read().q_target + 0.01)
            sim.step()
            if step % 4 == 1:
                sim.reset(None, np.array([True, False, False]))
        return sim.read()

    with Simulation(config, 3, 1) as sim, Simulation(config, 3, 99) as other:
        advance(sim, 6)
        saved = sim.save()
        expected = advance(sim, 9)
        other.restore(saved)
        found = advance(other, 9)
    for name, value in expected.arrays().items():
        if value is not None:
            np.testing.assert_array_equal(getattr(found, name), value, name)


def test_encoders_are_off_by_what_was_drawn_for_the_episode() -> None:
    drawn = Randomisation(joint_offset_range=(-0.05, 0.05), noise_range=(0.0, 0.0))
    for normal in (0.0, 0.1):  # its share of the noises is none, so it adds nothing
        config = SceneConfig(
            object=("cylinder",), randomisation=drawn, sensing=Sensing(joint_offset=normal)
        )
        with Simulation(config, 4, 0) as sim:
            first = sim.randomiser.drawn.joint_offset.copy()
            assert 0.04 < np.abs(first).max() <= 0.05
            assert np.unique(first).size == first.size
            for _ in range(3):
                seen = sim.read()
                np.testing.assert_allclose(seen.q, sim.state.q + first, atol=1e-12)
                np.testing.assert_allclose(seen.q_target, sim.state.q_target + first, atol=1e-12)
                np.testing.assert_allclose(sim.joint_offset, first, atol=1e-12)
                sim.write(seen.q_target)  # as they are held: nothing moves by the offset
                sim.step()
                np.testing.assert_allclose(sim.state.q_target, seen.q_target - first, atol=1e-12)
            sim.reset(None, np.array([True, False, True, False]))
            again = sim.randomiser.drawn.joint_offset
            np.testing.assert_array_equal((again == first).all(axis=1), [False, True, False, True])
            np.testing.assert_allclose(sim.read().q, sim.state.q + again, atol=1e-12)


FRICTION = [0.8638575565269407, 0.963248434826488]
TURNING = [
    [0.01024693458383043, 0.010669474386006619, 0.004611178695978196],
    [-0.07982271210648129, 0.01954187459619449, -0.056978030893172465],
]
OFFSET = -0.013748364384253142  # of the first joint, from before fingertips had their friction
"""Of EVERYTHING by seed 3, before there were offsets; what was measured is measured by these."""


def test_what_was_drawn_before_there_was_more_to_draw_stays(cylinder: Scene) -> None:
    made = randomiser(cylinder, EVERYTHING, 2, seed=3)
    made.draw(np.ones(2, bool))
    saved = made.save()
    np.testing.assert_allclose(made.drawn.friction, FRICTION, rtol=1e-12)
    np.testing.assert_allclose(made.drawn.gravity_turning, TURNING, rtol=1e-12)
    np.testing.assert_allclose(made.drawn.joint_offset[0, 0], OFFSET, rtol=1e-12)
    for name in ("joint_offset", "tip_friction", "link_friction"):
        del saved["drawn"][name]
    made.restore(saved)
    assert not made.drawn.joint_offset.any()
    assert (made.drawn.tip_friction == 1).all() and (made.drawn.link_friction == 1).all()
    np.testing.assert_allclose(made.drawn.friction, FRICTION, rtol=1e-12)


def test_fingertips_that_slip_drop_what_others_hold() -> None:
    """Two objects in one batch: each group gets its own rows."""
    fast, slow = (
        SceneConfig(
            object=("cylinder", "sphere"), gravity="down", threads=1,
            randomisation=Randomisation(tip_friction_range=share, link_friction_range=(0.3, 0.6)),
        )
        for share in ((0.1, 0.1), (0.9, 1.1))
    )  # fmt: skip
    fallen = []
    for config in (fast, slow):
        with Simulation(config, 4, 0) as sim:
            drawn = sim.randomiser.drawn
            np.testing.assert_allclose(sim.sim.friction, drawn.tip_friction.min(axis=1))
            for _ in range(20):
                sim.write(sim.read().q_target)
                sim.step()
            assert sim.state.object_position is not None
            fallen.append(
                np.linalg.norm(sim.state.object_position - sim.sim.start_position, axis=1)
            )
    assert fallen[0].min() > 0.05 and fallen[1].max() < 0.005


def test_every_size_begins_in_a_grasp() -> None:
    config = SceneConfig(object=("cylinder", "cube"), randomisation=EVERYTHING, threads=1)
    with Simulation(config, 40, 0) as sim:
        touching = sim.state.in_contact.sum(axis=1)
        assert np.unique(sim.randomiser.drawn.object_size).size == 5
        assert (touching >= 4).all()
        start = sim.state.object_position
        for _ in range(20):
            sim.write(sim.read().q_target)
            sim.step()
        moved = np.linalg.norm(sim.state.object_position - start, axis=1)  # type: ignore[operator]
    assert (moved < 0.05).mean() > 0.9


def test_limits_of_each_hand(cylinder: Scene) -> None:
    speed, latency = np.array([0.6, np.inf, 1.0]), np.array([0.0, 0.075, 0.1])
    with BatchSimulator(cylinder, 3, threads=1, disturbance=0.0) as sim:
        many = LimitedHand(sim, HandLimits(), cylinder.stiffness)
        many.set_limits(speed, np.full(3, np.inf), latency, cylinder.stiffness)
        start = sim.read().q_target
        applied = []
        for _ in range(6):
            many.write(start + 0.2)
            many.step()
            applied.append(sim.read().q_target[:, 0] - start[:, 0])
    for i in range(3):
        limit = None if np.isinf(speed[i]) else float(speed[i])
        limits = HandLimits(speed_limit=limit, action_latency=float(latency[i]))
        with BatchSimulator(cylinder, 1, threads=1, disturbance=0.0) as sim:
            alone = LimitedHand(sim, limits, cylinder.stiffness)
            for k in range(6):
                alone.write(start[:1] + 0.2)
                alone.step()
                got = sim.read().q_target[0, 0] - start[0, 0]
                assert got == pytest.approx(applied[k][i], abs=1e-12)


def made_up(count: int, value: float) -> GraspState:
    return GraspState(
        q=np.full((count, 2), value),
        q_target=np.zeros((count, 2)),
        in_contact=np.ones((count, 2), bool),
        contact_position=np.full((count, 2, 3), value),
        contact_normal=np.tile([0.0, 0.0, 1.0], (count, 2, 1)),
        contact_force=np.tile([0.2, 0.6], (count, 1)),
        time=np.full(count, value),
        age=np.zeros(count),
    )


def test_sensors_of_each_environment() -> None:
    sensor = Sensor(Sensing(), Streams(0, (3,)), 0.1)
    threshold = np.array([[0.0, 0.0], [0.5, 0.5], [0.0, 0.7]])
    sensor.set_errors(np.ones(3), np.array([0.0, 0.2, 0.1]), threshold, np.zeros(3))
    sensor(made_up(3, 0.0), np.ones(3, bool))
    for step in range(1, 6):
        seen = sensor(made_up(3, 0.1 * step))
    np.testing.assert_allclose(seen.q[:, 0], [0.5, 0.3, 0.4])
    np.testing.assert_allclose(seen.age, [0.0, 0.2, 0.1])
    np.testing.assert_array_equal(seen.in_contact, [[1, 1], [0, 1], [1, 0]])
    assert not seen.contact_force[~seen.in_contact].any()


@pytest.mark.parametrize("force_noise", [0.0, 1e-6])
def test_a_threshold_drawn_below_the_scenes_counts(force_noise: float) -> None:
    """In place of it: the physics may not leave out what a sensor of an episode feels."""
    sensing = Sensing(touch_threshold=3.0, force_noise=force_noise)
    drawn = Randomisation(touch_threshold_range=(0.05, 0.06))
    with Simulation(SceneConfig(threads=1, sensing=sensing, randomisation=drawn), 2, 0) as made:
        made.step()
        seen = made.read()
        assert seen.in_contact.all() and (seen.contact_force < 3.0).all()
    higher = SceneConfig(threads=1, randomisation=Randomisation(touch_threshold_range=(9.0, 9.0)))
    with Simulation(higher, 2, 0) as made:
        made.step()
        assert not made.read().in_contact.any()


def test_touch_drops_out_as_often_as_drawn() -> None:
    sensor = Sensor(Sensing(), Streams(0, (2,)), 0.1)
    sensor.set_errors(np.ones(2), np.zeros(2), np.zeros((2, 2)), np.array([0.0, 0.2]))
    sensor(made_up(2, 0.0), np.ones(2, bool))
    felt = np.mean([sensor(made_up(2, 0.0)).in_contact for _ in range(1000)], axis=(0, 2))
    assert felt[0] == 1.0
    assert felt[1] == pytest.approx(0.8, abs=0.03)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"friction_range": (1.2, 0.8)}, r"friction_range is \(1.2, 0.8\); expected two finite"),
        ({"tip_friction_range": (0.0, 1.0)}, "tip_friction_range is .*two finite numbers above 0"),
        ({"link_friction_range": (2.0, 1.0)}, "link_friction_range is .*the lower one first"),
        ({"mass_range": (0.0, 0.2)}, r"mass_range is .*above 0 on, the lower one first"),
        ({"push_range": (0.0, np.nan)}, "push_range is"),
        ({"touch_dropout_range": (0.0, 1.5)}, "touch_dropout_range is .*expected shares, 0 to 1"),
        ({"gravity_tilt": 4.0}, "gravity_tilt is 4.0; expected 0 to pi"),
        ({"gravity_straight_share": 1.5}, "gravity_straight_share is 1.5; expected 0 to 1"),
        ({"centre_of_mass": -1.0}, "centre_of_mass is -1.0"),
        (
            {"joint_offset_range": (0.05, -0.05)},
            r"joint_offset_range is \(0.05, -0.05\); expected two finite numbers, the lower",
        ),
        ({"joint_offset_range": (-np.inf, 0.05)}, "joint_offset_range is"),
        ({"mass_range": (0.1,)}, r"mass_range is \(0.1,\); expected two finite numbers above 0"),
        ({"mass_range": (0.1, 0.2, 0.3)}, r"mass_range is \(0.1, 0.2, 0.3\); expected two"),
        ({"mass_range": 0.1}, "mass_range is 0.1; expected two finite numbers"),
        ({"mass_range": "ab"}, "mass_range is not an array of numbers: 'ab'; expected two"),
        ({"mass_range": [[0.1, 0.2], [0.1, 0.2]]}, "mass_range is .*; expected two finite"),
    ],
)
def test_ranges_that_are_none(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        Randomisation(**settings)


@pytest.mark.parametrize("drawn", [{"gravity_tilt": 1.0}, {"gravity_turning_range": (0.0, 0.5)}])
def test_there_has_to_be_gravity_to_turn(drawn: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match=r"gravity is \(0.0, 0.0, 0.0\), and gravity_tilt or"):
        SceneConfig(gravity=(0.0, 0.0, 0.0), randomisation=Randomisation(**drawn))
    SceneConfig(gravity=(0.0, 0.0, 0.0), randomisation=Randomisation(mass_range=(0.1, 0.2)))


def test_sizes_and_given_starts_do_not_go_together(tmp_path: Any) -> None:
    config = SceneConfig(randomisation=EVERYTHING, initial_states=tmp_path / "states.npz")
    with pytest.raises(InvalidInput, match="size_range is .* and initial_states is"):
        Simulation(config, 1, 0)


def test_as_plain_values() -> None:
    config = SceneConfig(randomisation=EVERYTHING)
    assert from_plain(SceneConfig, to_plain(config)) == config
    assert from_plain(SceneConfig, {"mass_range": [0.1, 0.2]}).randomisation.mass_range == (
        0.1,
        0.2,
    )
