"""Randomised environments: what policies and critics see of it, and set-points stay true."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.sim import SceneConfig
from dexctl.sim.randomisation import Randomisation
from dexctl.sim.sensing import Sensing
from learning.envs import EnvConfig, ManipulationVectorEnv

DRAWS = Randomisation(mass_range=(0.05, 0.25), stiffness_range=(0.7, 1.3), gravity_tilt=np.pi)


def env(**scene: object) -> ManipulationVectorEnv:
    config = EnvConfig(
        scene=SceneConfig(object=("cylinder",), threads=1, **scene),  # type: ignore[arg-type]
        parts=("q", "gravity"),
        critic_parts=("object_position", "drawn"),
        scaled=True,
    )
    return ManipulationVectorEnv(config, 4, 0)


def test_critics_see_what_was_drawn_and_policies_gravity() -> None:
    made = env(randomisation=DRAWS)
    seen, _ = made.reset(seed=0)
    drawn = made.simulation.randomiser.drawn
    policy, critic = seen[:, made.groups["policy"]], seen[:, made.groups["critic"]]
    np.testing.assert_allclose(policy[:, -3:], drawn.gravity / 9.81, atol=1e-6)
    columns = made.observations[1].slices["drawn"]
    more = critic[:, made.observation.size :][:, columns]
    np.testing.assert_allclose(more[:, 1], (drawn.object_mass - 0.1) / 0.1, atol=1e-5)
    assert np.abs(more).max() < 3.0
    assert len(np.unique(more[:, 1])) == 4
    usual = env().reset(seed=0)[0][:, -more.shape[1] :]
    assert not usual.any()
    np.testing.assert_array_equal(seen[:, -3:].shape, (4, 3))


def test_critics_see_the_friction_of_tips_and_links_where_it_is_drawn() -> None:
    """Networks from before it could be drawn keep their width: 21 numbers and 4 of each joint."""
    before = env(randomisation=Randomisation(friction_range=(0.6, 1.4)))
    known = before.observations[1].slices["drawn"]
    assert known.stop - known.start == 21 + 4 * before.hand.nq
    made = env(randomisation=Randomisation(tip_friction_range=(0.7, 1.3)))
    seen, _ = made.reset(seed=0)
    columns = made.observations[1].slices["drawn"]
    assert columns.stop - columns.start == known.stop - known.start + 5 + 1
    more = seen[:, made.groups["critic"]][:, made.observation.size :][:, columns]
    drawn = made.simulation.randomiser.drawn
    np.testing.assert_allclose(more[:, -6:-1], (drawn.tip_friction - 1) / 0.3, atol=1e-5)
    assert np.unique(more[:, -6:-1]).size == 20
    assert not more[:, -1].any()  # that of the links, which is not drawn


def test_set_points_stay_where_no_action_asks_for_more() -> None:
    """Encoders that are off must not make set-points creep."""
    made = env(sensing=Sensing(joint_offset=0.05))
    made.reset(seed=0)
    before = made.state.q_target
    for _ in range(5):
        made.step(np.zeros((4, made.hand.nq)))
    np.testing.assert_allclose(made.state.q_target, before, atol=1e-12)


def test_critics_see_what_encoders_read_at_zero() -> None:
    scene = SceneConfig(object=("cylinder",), threads=1, sensing=Sensing(joint_offset=0.03))
    config = EnvConfig(scene=scene, critic_parts=("joint_offset",), scaled=True)
    made = ManipulationVectorEnv(config, 3, 0)
    seen, _ = made.reset(seed=0)
    offset = made.simulation.read().q - made.simulation.sim.read().q
    assert np.abs(offset).max() > 0.01
    np.testing.assert_allclose(seen[:, -made.hand.nq :], offset / 0.05, atol=1e-5)


def test_critics_see_velocity_and_net_forces() -> None:
    config = EnvConfig(
        scene=SceneConfig(object=("cylinder",), threads=1),
        critic_parts=("object_velocity", "fingertip_force"),
        scaled=True,
    )
    made = ManipulationVectorEnv(config, 3, 0)
    made.reset(seed=0)
    seen, *_ = made.step(np.full((3, made.hand.nq), 0.3))
    more = seen[:, made.observation.size :]
    sim = made.simulation.sim
    assert more.shape == (3, 6 + 15)
    np.testing.assert_allclose(more[:, :3], sim.object_velocity[:, :3] / 0.05, atol=1e-5)
    np.testing.assert_allclose(more[:, 3:6], sim.object_velocity[:, 3:] / 0.5, atol=1e-5)
    np.testing.assert_allclose(more[:, 6:], sim.fingertip_force.reshape(3, -1) / 2.0, atol=1e-5)
    with pytest.raises(UnknownName, match="unknown observation part 'fingertip_force'"):
        EnvConfig(parts=("q", "fingertip_force"))


def test_only_critics_see_what_was_drawn() -> None:
    with pytest.raises(UnknownName, match="unknown observation part 'drawn'"):
        EnvConfig(parts=("q", "drawn"))
    with pytest.raises(InvalidInput, match="each named once"):
        EnvConfig(critic_parts=("drawn", "drawn"))
