"""DAgger: what is remembered, what it is fitted to, against plain torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms import DAgger, DAggerConfig, Transitions
from learning.algorithms.labels import Labels

GROUPS = {"policy": slice(1, 3), "critic": slice(0, 3)}
SMALL: dict[str, Any] = {"batch_size": 8, "buffer_size": 64, "network": (16,)}


def build(num_envs: int = 4, turns: Any = None, **options: Any) -> DAgger:
    return DAgger(
        DAggerConfig(**SMALL | options), groups=GROUPS, observation_size=3, action_size=2,
        num_envs=num_envs, seed=3, turns=turns,
    )  # fmt: skip


def step(guided: Any = None, label: Any = None, count: int = 4, seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    seen = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    nowhere = np.zeros(count, bool)
    return Transitions(
        seen, rng.uniform(-1, 1, (count, 2)), np.zeros(count), seen, nowhere, nowhere, guided, label
    )


def test_only_labelled_states_are_remembered_as_the_policy_sees_them() -> None:
    agent, label = build(), np.arange(8.0).reshape(4, 2) / 8
    shown = step(np.array([True, False, True, False]), label)
    agent.observe(shown)
    agent.observe(step())  # nobody says what to do
    assert (agent.steps, agent.memory.count) == (8, 2)
    kept = agent.memory.state_dict()["rows"]
    np.testing.assert_allclose(kept[:, :2], shown.observation[[0, 2], 1:])
    np.testing.assert_allclose(kept[:, 2:], label[[0, 2]])


def test_nothing_is_learned_from_nothing() -> None:
    agent = build()
    before = agent.actor.flat.clone()
    agent.observe(step())
    agent.update()
    assert agent.updates == 0 and before.equal(agent.actor.flat)


def test_an_update_is_that_of_plain_torch() -> None:
    agent = build(policy_average=0.5, gradient_steps=1)
    agent.observe(step(np.ones(4, bool), step().action))
    first_layer, last_layer = torch.nn.Linear(2, 16), torch.nn.Linear(16, 2)
    plain = torch.nn.Sequential(first_layer, torch.nn.ReLU(), last_layer)
    with torch.no_grad():
        for layer, weight, bias in zip(
            (first_layer, last_layer), agent.actor.weights, agent.actor.biases, strict=True
        ):
            layer.weight.copy_(weight[0])
            layer.bias.copy_(bias[0])
    first = [weight.detach().clone() for weight in plain.parameters()]
    optimizer = torch.optim.Adam(plain.parameters(), 1e-3)
    index = np.random.default_rng(3).integers(0, 4, 8)
    seen = torch.as_tensor(step().observation[index, 1:])
    label = torch.as_tensor(step().action[index].astype(np.float32))
    loss = ((torch.tanh(plain(seen)) - label) ** 2).sum(dim=1).mean()
    loss.backward()
    optimizer.step()
    agent.update()
    assert agent.statistics["bc_loss"] == pytest.approx(loss.item(), rel=1e-5)
    found = [array for pair in agent.policy_layers() for array in pair]
    for ours, before, after in zip(found, first, plain.parameters(), strict=True):
        # the policy that is kept is half way between the weights before and after
        np.testing.assert_allclose(ours, ((before + after) / 2).detach().numpy(), atol=1e-6)


def test_the_policy_acts_with_noise() -> None:
    agent = build(num_envs=2000, action_noise=0.05)
    seen = np.zeros((2000, 3), np.float32)
    *_, (weight, bias) = agent.policy_layers()
    (first, offset), *_ = agent.policy_layers()
    mean = np.tanh(np.maximum(first @ seen[0, 1:] + offset, 0) @ weight.T + bias)
    found = agent.act(seen)
    np.testing.assert_allclose(found.std(axis=0), 0.05, atol=0.005)
    np.testing.assert_allclose(found.mean(axis=0), mean, atol=0.005)
    assert (build(action_noise=0.0).act(seen[:4]) == build(action_noise=0.0).act(seen[:4])).all()


class Mirror:
    """The identity, and everything with the other sign."""

    elements = (1, -1)

    def observation(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        return values * np.where(which, -1, 1)[:, None]

    action = observation


def test_labels_are_turned_with_their_states() -> None:
    agent = build(turns=Mirror())
    shown = step(np.ones(4, bool), step().action)
    agent.observe(shown)
    seen, label = agent.memory.sample(200)
    assert seen.shape == (200, 3)  # the symmetries are of whole observations
    row = (np.abs(seen[:, None]) == np.abs(shown.observation)).all(axis=2).argmax(axis=1)
    sign = np.sign(seen[:, 0] / shown.observation[row, 0])
    assert 60 < (sign < 0).sum() < 140
    np.testing.assert_allclose(label, sign[:, None] * shown.action[row], atol=1e-7)
    agent.update()
    assert agent.updates == 2


def test_the_oldest_labels_go() -> None:
    memory = Labels(5, observation_size=1, action_size=1)
    for k in range(0, 12, 3):
        rows = np.arange(k, k + 3.0)[:, None]
        memory.add(rows, -rows)
    assert sorted(memory.state_dict()["rows"][:, 0]) == [7, 8, 9, 10, 11]
    seen, label = memory.sample(100)
    assert set(seen[:, 0]) == {7, 8, 9, 10, 11} and (label == -seen).all()
    memory.add(np.arange(20.0)[:, None], np.zeros((20, 1)))  # more than there is room for
    assert sorted(memory.state_dict()["rows"][:, 0]) == [15, 16, 17, 18, 19]
    again = Labels(5, observation_size=1, action_size=1, seed=9)
    again.load_state_dict(memory.state_dict())
    assert (memory.sample(7)[0] == again.sample(7)[0]).all()
    with pytest.raises(InvalidInput, match=r"labels have shape \(5, 2\); expected up to \(4, 2\)"):
        Labels(4, observation_size=1, action_size=1).load_state_dict(memory.state_dict())


def test_without_labels_it_is_refused() -> None:
    with pytest.raises(InvalidInput, match="labels is False; expected True"):
        DAgger(
            DAggerConfig(), groups=GROUPS, observation_size=3, action_size=1, num_envs=1,
            labels=False,
        )  # fmt: skip


def test_it_begins_with_a_policy() -> None:
    agent, other = build(), build(network=(16,))
    with torch.no_grad():
        other.actor.flat.add_(0.1)
    other.networks["averaged_actor"].flat.data.copy_(other.actor.flat)
    agent.begin_with(other.policy_layers())
    for ours, theirs in zip(agent.policy_layers(), other.policy_layers(), strict=True):
        assert (ours[0] == theirs[0]).all() and (ours[1] == theirs[1]).all()
