"""Observations and actions turned by a hand's symmetries, and learning from them."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.settings import changed
from dexctl.sim.randomisation import Drawn
from dexctl.symmetry import HandSymmetry
from learning.config import TrainConfig
from learning.envs import PARTS, Observation
from learning.envs.observation import Part
from learning.envs.symmetry import Fixed, Symmetry
from learning.envs.truth import features, turned_features

UP = Fixed([np.array([0.0, 0.0, -9.81])])


@pytest.fixture(scope="module")
def state(dex5: dexctl.HandModel) -> dexctl.GraspState:
    """Twenty hands with numbers of their own everywhere."""
    random = np.random.default_rng(0)

    def unit(*shape: int) -> np.ndarray:
        vector = random.normal(size=shape)
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)

    touch = random.uniform(size=(20, 5)) < 0.7
    return dexctl.GraspState(
        q=random.uniform(dex5.lower, dex5.upper, (20, 15)),
        q_target=random.uniform(dex5.lower, dex5.upper, (20, 15)),
        in_contact=touch,
        contact_position=random.normal(0.0, 0.1, (20, 5, 3)) * touch[..., None],
        contact_normal=unit(20, 5, 3) * touch[..., None],
        contact_force=random.uniform(size=(20, 5)) * touch,
        object_position=random.normal(0.0, 0.1, (20, 3)),
        object_quaternion=unit(20, 4),
        gravity=random.normal(size=(20, 3)),
        goal_quaternion=unit(20, 4),
        goal_angular_velocity=random.normal(size=(20, 3)),
    )


@pytest.mark.parametrize("scaled", [False, True])
def test_what_is_seen_of_a_turned_state_is_turned(
    dex5: dexctl.HandModel, state: dexctl.GraspState, scaled: bool
) -> None:
    """Every part, of the policy and behind it of the critics, for all ten images at once."""
    names = tuple(PARTS)
    seen = [
        Observation(dex5, parts, scaled=scaled, centre=(0.0, 0.0, 0.13))
        for parts in (names, names[::-1])
    ]
    turns = Symmetry(dex5, seen, UP)
    assert len(turns.elements) == 10
    which = np.arange(20) % 10
    values = np.concatenate([one(state) for one in seen], axis=1)
    turned = turns.observation(which, values)
    for k, one in enumerate(turns.elements):
        rows = which == k
        there = one.of_state(state[rows])
        expected = np.concatenate([look(there) for look in seen], axis=1)
        np.testing.assert_allclose(turned[rows], expected, atol=2e-6)
    action = np.random.default_rng(1).uniform(-1, 1, (20, 15))
    np.testing.assert_array_equal(
        turns.action(which, action)[7], turns.elements[7].of_joints(action[7])
    )


def test_an_axis_or_an_object_that_stays_leaves_the_turns_only(dex5: dexctl.HandModel) -> None:
    """A mirror image turns the other way round, and makes another object of an L."""
    down, seen = UP.directions, [Observation(dex5, ("q",))]
    for fixed in (Fixed(down, axes=[np.array([0.0, 0.0, 1.0])]), Fixed(down, mirrored=False)):
        turns = Symmetry(dex5, seen, fixed)
        assert [one.mirrors for one in turns.elements] == [False] * 5
    with pytest.raises(InvalidInput, match="has no symmetry"):  # x is turned to other axes by all
        Symmetry(dex5, seen, Fixed(down, axes=[np.array([1.0, 0.0, 0.0])]))
    only = Symmetry(dex5, seen, Fixed(down, axes=[np.array([0.0, 1.0, 0.0])]))
    assert [one.mirrors for one in only.elements] == [False, True]


@pytest.mark.parametrize(
    ("changes", "axes", "mirrored"),
    [
        ({}, 1, True),
        ({"commands": ("x", "z"), "parts": ("q", "goal_angular_velocity")}, 0, True),
        ({"object": ("cube", "l_shape")}, 1, False),
    ],
)
def test_what_stays_in_an_environment(changes: dict[str, Any], axes: int, mirrored: bool) -> None:
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    from learning.training.build import build_env, what_stays

    config = changed(TrainConfig(), {"object": ("cube",), "num_envs": 2, **changes})
    with contextlib.closing(build_env(config)) as env:
        fixed = what_stays(env)
    np.testing.assert_allclose(fixed.directions, [[0.0, 0.0, -9.81]] * len(config.env.scene.object))
    assert (len(fixed.axes), fixed.mirrored) == (axes, mirrored)


def test_what_cannot_be_turned_is_refused(dex5: dexctl.HandModel) -> None:
    seen = [Observation(dex5, ("q",))]
    with pytest.raises(InvalidInput, match="symmetry is True, and the hand 'dex5' has no symmetry"):
        Symmetry(dex5, seen, Fixed([np.array([1.0, 0.5, 0.0])]))
    with pytest.raises(InvalidInput, match="symmetry is True, and the hand"):
        Symmetry(dex5, [Observation(dex5, ("q",), centre=(0.02, 0.01, 0.1))], UP)
    with pytest.raises(InvalidInput, match="symmetry is True and algorithm is 'ppo'"):
        changed(TrainConfig(), {"symmetry": True, "algorithm": "ppo", "method": "rl"})


# two joints, two fingers: of each number of `Drawn` that critics see, what it becomes
QUARTER = HandSymmetry(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([1, 0]),
    np.array([1, 0]),
    np.array([1.0, -1.0]),
)
MIRROR = HandSymmetry(
    np.diag([-1.0, 1.0, 1.0]), np.array([1, 0]), np.array([1, 0]), np.array([1.0, -1.0])
)
ROWS = {  # before, after a quarter turn about z, after the mirror image across x
    "friction": ([1], [1], [1]),
    "object_mass": ([2], [2], [2]),
    "object_size": ([3], [3], [3]),
    "centre_of_mass": ([4, 5, 6], [4, 5, 6], [4, -5, 6]),  # the object's own frame
    "kp": ([7, 8], [8, 7], [8, 7]),
    "kv": ([9, 10], [10, 9], [10, 9]),
    "damping": ([11, 12], [12, 11], [12, 11]),
    "gear_friction": ([13, 14], [14, 13], [14, 13]),
    "gravity_turning": ([15, 16, 17], [-16, 15, 17], [15, -16, -17]),
    "speed_limit": ([18], [18], [18]),
    "torque_limit": ([19], [19], [19]),
    "action_latency": ([20], [20], [20]),
    "noise": ([21], [21], [21]),
    "sensor_latency": ([22], [22], [22]),
    "touch_threshold": ([23, 24], [24, 23], [24, 23]),
    "touch_dropout": ([25], [25], [25]),
    "push_force": ([26], [26], [26]),
    "tip_friction": ([27, 28], [28, 27], [28, 27]),
    "link_friction": ([29], [29], [29]),
}


def test_what_an_episode_drew_is_turned() -> None:
    before, turned, mirrored = (
        np.concatenate([np.array(row[k], float) for row in ROWS.values()])[None] for k in range(3)
    )
    np.testing.assert_allclose(turned_features(QUARTER, before), turned, atol=1e-12)
    np.testing.assert_allclose(turned_features(MIRROR, before), mirrored, atol=1e-12)
    few = slice(0, 26)  # without tips and links, whose friction is not drawn
    for one, found in ((QUARTER, turned), (MIRROR, mirrored)):
        np.testing.assert_allclose(turned_features(one, before[:, few]), found[:, few], atol=1e-12)
    # the order of the rows is that of what critics see: one number after the other stands out
    nothing = Drawn(*(np.zeros((1, len(ROWS.get(name, ([0],))[0]))) for name in Drawn._fields))
    usual, start = Drawn(*(row + 1.0 for row in nothing)), 0
    for name, (row, _, _) in ROWS.items():
        off = usual._replace(**{name: getattr(usual, name) + 1.0})
        columns = np.flatnonzero(features(off, usual, surfaces=True)[0])
        assert columns.tolist() == list(range(start, start + len(row)))
        start += len(row)


def test_critics_that_see_what_was_drawn_are_turned(dex5: dexctl.HandModel) -> None:
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    from learning.training.build import build_algorithm, build_env

    ranges = {"friction_range": (0.6, 1.4), "stiffness_range": (0.7, 1.3), "num_envs": 2}
    config = changed(
        TrainConfig(),
        {
            "object": ("cube",),
            "symmetry": True,
            "critic_parts": ("drawn", "joint_offset"),
            **ranges,
        },
    )
    with contextlib.closing(build_env(config)) as env:
        build_algorithm(config, env)
        seen = env.observations
        values = np.random.default_rng(0).normal(size=(5, sum(one.size for one in seen)))
        turns = Symmetry(env.hand, seen, Fixed(UP.directions, [np.array([0.0, 0.0, 1.0])]))
    found = turns.observation(np.arange(5), values)
    columns = seen[1].slices["drawn"]
    where = slice(seen[0].size + columns.start, seen[0].size + columns.stop)
    np.testing.assert_array_equal(found[:, where][:, :3], values[:, where][:, :3])
    kp = slice(where.start + 6, where.start + 6 + dex5.nq)
    for row, one in enumerate(turns.elements):
        np.testing.assert_array_equal(found[row, kp][one.joints], values[row, kp])


def test_a_part_that_nobody_can_turn_is_refused(dex5: dexctl.HandModel) -> None:
    more = {"smell": Part(lambda d, m: 1, lambda state: state.q[..., :1])}
    with pytest.raises(InvalidInput, match="the part 'smell', which cannot be turned"):
        Symmetry(dex5, [Observation(dex5, ("q", "smell"), more=more)], UP)


def test_a_batch_to_learn_from_is_turned(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    """Each of a batch is a kept transition or one of its turns, all parts by the same turn."""
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    from learning.algorithms.base import Transitions
    from learning.algorithms.replay import Replay

    look = Observation(dex5, ("q", "contact_position", "goal_rotation"), scaled=True)
    turns = Symmetry(dex5, [look], UP)
    first, then = look(state), look(replace(state, q=0.9 * state.q))
    options: Any = {"num_envs": 20, "observation_size": look.size, "action_size": 15}
    replay = Replay(20, **options, labels=True, turns=turns)
    action = state.q[:, ::-1] / 3.0
    none = np.zeros(20, bool)
    replay.add(Transitions(first, action, np.arange(20.0), then, none, none, ~none, -action))
    batch = replay.sample(300)
    used = set()
    for i in range(300):
        row = int(batch.reward[i])
        every = [
            k
            for k in range(10)
            if np.allclose(
                batch.observation[i], turns.observation(np.array([k]), first[[row]])[0], atol=1e-5
            )
        ]
        assert len(every) == 1
        which = np.array(every)
        used.add(every[0])
        for found, value in ((batch.action, action), (batch.guide_action, -action)):
            np.testing.assert_allclose(found[i], turns.action(which, value[[row]])[0], atol=1e-6)
        following = turns.observation(which, then[[row]])[0]
        np.testing.assert_allclose(batch.next_observation[i], following, atol=1e-5)
    assert used == set(range(10))
