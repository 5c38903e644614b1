"""Observations of earlier control steps: in environments, and in a policy that acts alone."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.settings import changed
from learning import policies
from learning.envs import EnvConfig, make_vector
from learning.envs.history import History
from learning.policies import Layer, Policy, PolicySpec

PAST = changed(
    EnvConfig(),
    {
        "object": "cylinder", "episode_steps": 6, "joint_noise": 0.01, "threads": 1,
        "parts": ("q", "q_target"), "critic_parts": ("object_position",), "history": (1, 3),
    },
)  # fmt: skip
NOW = replace(PAST, history=())


def test_by_hand() -> None:
    history = History(2, (2,))
    assert history.size == 4
    one, two, three = (np.array([[i, -i], [10 * i, 0]], np.float32) for i in (1, 2, 3))
    history.begin(one, np.ones(2, bool))
    np.testing.assert_array_equal(history.look(), [[1, -1, 1, -1], [10, 0, 10, 0]])
    history.add(two)
    history.add(three)
    np.testing.assert_array_equal(history.look(), [[3, -3, 1, -1], [30, 0, 10, 0]])
    history.begin(three, np.array([False, True]))
    np.testing.assert_array_equal(history.look(), [[3, -3, 1, -1], [30, 0, 30, 0]])
    other = History(2, (2,))
    other.restore(history.save())
    history.add(one)
    np.testing.assert_array_equal(other.look()[:, :2], three)  # a copy
    with pytest.raises(InvalidInput, match=r"the saved observations are \(3, 2\) for each hand"):
        History(2, (1,)).restore(history.save())


@pytest.mark.parametrize("steps", [(0,), (101,), (1, 1), (1.5,), (True,)])
def test_steps_that_are_none(steps: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput, match="history is .*; expected different whole numbers"):
        replace(NOW, history=steps)


def test_environments_tell_what_was_before(wiggle: np.ndarray) -> None:
    """Against environments that tell only what is now: the same numbers, some steps later."""
    with_past, plain = make_vector(PAST, 2, seed=3), make_vector(NOW, 2, seed=3)
    size = plain.observation.size
    assert with_past.groups["policy"] == slice(0, 3 * size)
    assert with_past.single_observation_space.shape == (3 * size + 3,)
    first, _ = plain.reset(seed=3)
    seen = [first]
    observed, _ = with_past.reset(seed=3)
    np.testing.assert_array_equal(observed[:, : 3 * size], np.tile(first[:, :size], 3))
    for i, action in enumerate(wiggle[:9]):
        actions = np.stack([action, -action])
        expected, _, _, _, info = plain.step(actions)
        got, _, _, _, told = with_past.step(actions)
        seen.append(info["final_obs"])
        at = [len(seen) - 1, len(seen) - 2, max(len(seen) - 4, 0)]
        past = [seen[k][:, :size] for k in at]
        np.testing.assert_array_equal(told["final_obs"][:, : 3 * size], np.hstack(past))
        np.testing.assert_array_equal(told["final_obs"][:, 3 * size :], seen[-1][:, size:])
        if info["done"].any():
            assert i == 5 and info["done"].all()  # all at once: what was before is over
            seen = [expected]
            np.testing.assert_array_equal(got[:, : 3 * size], np.tile(expected[:, :size], 3))


def test_saved_environments_go_on_with_their_past(wiggle: np.ndarray) -> None:
    envs, other = make_vector(PAST, 2, seed=8), make_vector(PAST, 2, seed=99)
    for action in wiggle[:4]:
        envs.step(np.tile(action, (2, 1)))
    other.restore(deepcopy(envs.save()))
    for action in wiggle[4:9]:
        a, b = (one.step(np.tile(action, (2, 1)))[0] for one in (envs, other))
        np.testing.assert_array_equal(a, b)


@pytest.fixture
def policy(tmp_path: Path) -> Policy:
    """One that has been through a file."""
    envs = make_vector(PAST, 1, seed=0)
    spec = PolicySpec.of(envs.hand, envs.observation, envs.action, "dex5", history=(1, 3))
    weight = np.random.default_rng(0).standard_normal((15, envs.history.size))
    policies.save(tmp_path / "past.npz", [Layer(weight, np.zeros(15))], spec)
    return policies.load(tmp_path / "past.npz")


def moving(hand: dexctl.HandModel, count: int) -> list[dexctl.GraspState]:
    """Five states of as many hands that touch nothing."""
    random = np.random.default_rng(1)
    joints = hand.posture({}) + 0.1 * random.standard_normal((5, 2, count, hand.nq))
    return [
        dexctl.GraspState(
            q=q,
            q_target=q_target,
            in_contact=np.zeros((count, 5), bool),
            contact_position=np.zeros((count, 5, 3)),
            contact_normal=np.zeros((count, 5, 3)),
            contact_force=np.zeros((count, 5)),
        )
        for q, q_target in joints
    ]


def test_a_policy_remembers_what_it_has_seen(policy: Policy) -> None:
    states = moving(policy.hand, 2)
    seen = [policy.observation(state) for state in states]
    actions = []
    for i, state in enumerate(states):
        policy.act(state)
        actions.append(policy.diagnostics["action"])
        past = [seen[i], seen[max(i - 1, 0)], seen[max(i - 3, 0)]]
        np.testing.assert_allclose(actions[i], policy.predict(np.hstack(past)), atol=1e-6)
    policy.reset(mask=np.array([False, True]))  # in the second hand an episode begins
    policy.act(states[0])
    now = policy.diagnostics["action"]
    first = np.hstack([seen[0], seen[4], seen[2]])[0]
    np.testing.assert_allclose(now[0], policy.predict(first), atol=1e-6)
    np.testing.assert_allclose(now[1], actions[0][1], atol=1e-6)
    policy.reset()
    policy.act(states[0][1])  # one hand, not a batch
    np.testing.assert_allclose(policy.diagnostics["action"], actions[0][1], atol=1e-6)
    with pytest.raises(InvalidInput, match="1 hands are remembered and the state has 2"):
        policy.act(states[0])


def test_a_policy_goes_on_from_a_saved_state(policy: Policy) -> None:
    states, other = moving(policy.hand, 3), deepcopy(policy)
    for state in states[:3]:
        policy.act(state)
    policy.reset(mask=np.array([True, False, False]))
    other.load_state_dict(policy.state_dict())
    for state in states[3:]:
        np.testing.assert_array_equal(other.act(state), policy.act(state))
    saved = policy.state_dict()
    with pytest.raises(InvalidInput, match="lacks fresh"):
        other.load_state_dict({**saved, "history": {"seen": 0, "fresh": 0}})
    few = {"seen": saved["history"]["seen"][:1], "fresh": saved["history"]["fresh"]}
    with pytest.raises(InvalidInput, match="has 1 histories; expected 3"):
        other.load_state_dict({**saved, "history": few})
