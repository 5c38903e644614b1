"""What helps learning beyond the thesis: n-step returns, critics that see more, cloned states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from torch import nn

import dexctl
from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from learning.agents import GuidedReplayBuffer, GuidedSAC, GuidedTD3, state
from learning.agents.losses import cloning_weight
from learning.agents.networks import GuidedSACPolicy, GuidedTD3Policy
from learning.cli_train import Train
from learning.envs import EnvConfig
from learning.exploration import GuidanceConfig, Guide
from learning.export import policy_layers
from learning.settings import TrainConfig
from learning.train import build, train

BOX = gymnasium.spaces.Box


def filled(steps: int, capacity: int = 20) -> GuidedReplayBuffer:
    """Two environments; in step t they observe t and earn t and -t; one ends at 4, 9, 14 ...

    The first of them is cut at 4 and terminates at 9, and so on in turn.
    """
    buffer = GuidedReplayBuffer(
        2 * capacity, BOX(-1, 1, (1,)), BOX(-1, 1, (1,)), "cpu", 2, n_step=3, gamma=0.5, seed=0
    )
    for t in range(steps):
        ended = np.array([t % 5 == 4, False])
        buffer.add(
            np.full((2, 1), t), np.full((2, 1), t + 1), np.zeros((2, 1)), np.array([t, -t]),
            ended & (t % 10 == 9), ended=ended,
        )  # fmt: skip
    return buffer


def rows(buffer: GuidedReplayBuffer) -> set[tuple[float, ...]]:
    found = buffer.sample(3000)
    assert found.discounts is not None
    columns = (found.observations, found.next_observations, found.rewards, found.dones)
    return set(zip(*(c[:, 0].tolist() for c in (*columns, found.discounts)), strict=True))


def test_n_step_returns_by_hand() -> None:
    found = rows(filled(12))
    assert {
        (1.0, 4.0, 1 + 2 / 2 + 3 / 4, 0.0, 0.125),  # three whole steps
        (3.0, 5.0, 3 + 4 / 2, 0.0, 0.25),  # cut at 4: nothing of the next episode
        (8.0, 10.0, 8 + 9 / 2, 1.0, 0.25),  # terminated at 9
        (8.0, 11.0, -(8 + 9 / 2 + 10 / 4), 0.0, 0.125),  # the other one goes on
        (11.0, 12.0, 11.0, 0.0, 0.5),  # the youngest step
    } <= found


def test_n_step_returns_never_join_the_youngest_and_the_oldest_step() -> None:
    found = rows(filled(27))  # steps 20 to 26 stand where 0 to 6 were
    assert min(row[0] for row in found) == 7.0
    assert (26.0, 27.0, 26.0, 0.0, 0.5) in found
    assert (25.0, 27.0, -(25 + 26 / 2), 0.0, 0.25) in found
    assert (19.0, 22.0, -(19 + 20 / 2 + 21 / 4), 0.0, 0.125) in found
    assert all(after - before <= 3 for before, after, *_ in found)


def test_one_step_returns_are_the_rewards() -> None:
    buffer = GuidedReplayBuffer(10, BOX(-1, 1, (1,)), BOX(-1, 1, (1,)), "cpu", 1)
    buffer.add(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), np.full(1, 3.0), np.zeros(1))
    found = buffer.sample(4)
    assert found.discounts is None
    assert (found.rewards == 3.0).all()


@pytest.mark.parametrize(
    ("agent", "policy"), [(GuidedSAC, GuidedSACPolicy), (GuidedTD3, GuidedTD3Policy)]
)
def test_the_actor_sees_the_first_part_and_the_critics_all(agent: Any, policy: Any) -> None:
    env = gymnasium.make("Pendulum-v1")  # three numbers observed
    made = agent(
        policy, env, device="cpu", seed=0, buffer_size=100,
        policy_kwargs={"net_arch": [16], "actor_size": 2, "layer_norm": True},
    )  # fmt: skip
    obs = torch.zeros(1, 3)
    other = torch.tensor([[0.0, 0.0, 1.0]])
    with torch.no_grad():
        assert (made.actor(obs, True) if agent is GuidedSAC else made.actor(obs)).equal(
            made.actor(other, True) if agent is GuidedSAC else made.actor(other)
        )
        action = torch.zeros(1, 1)
        assert not made.critic(obs, action)[0].equal(made.critic(other, action)[0])
    for critic in (made.critic, made.critic_target):
        assert sum(isinstance(module, nn.LayerNorm) for module in critic.modules()) == 2
    for ours, theirs in zip(made.critic.parameters(), made.critic_target.parameters(), strict=True):
        assert ours.equal(theirs)
    watched = {id(p) for group in made.critic.optimizer.param_groups for p in group["params"]}
    assert watched == {id(p) for p in made.critic.parameters()}


def test_cloning_weights_by_hand() -> None:
    guide_value = torch.tensor([[2.0], [-1.0], [3.0], [5.0]])
    policy_value = torch.tensor([[1.0], [1.0], [4.0], [-2.0]])
    guided = torch.tensor([[1.0], [1.0], [1.0], [0.0]])

    def weights(kind: str) -> tuple[list[float], float]:
        weight, scale = cloning_weight(kind, guide_value, policy_value, guided)
        return weight.flatten().tolist(), float(scale)

    assert weights("value") == ([2.0, 0.0, 3.0, 0.0], 1.0)
    assert weights("equal") == ([1.0, 1.0, 1.0, 0.0], 2.0)  # mean |Q| of the policy's actions
    assert weights("better") == ([1.0, 0.0, 0.0, 0.0], 2.0)


def test_the_actor_is_updated_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gymnasium.make("Pendulum-v1")
    agent = GuidedSAC("MlpPolicy", env, device="cpu", seed=0, buffer_size=100, policy_delay=3)
    agent.learn(20)
    assert agent.replay_buffer is not None
    made: list[int] = []
    step = agent.actor.optimizer.step
    monkeypatch.setattr(agent.actor.optimizer, "step", lambda: (made.append(1), step())[1])
    before = agent._n_updates
    agent.train(10, 8)
    assert agent._n_updates == before + 10
    assert len(made) == (before + 10) // 3 - before // 3


class Waiting(dexctl.Controller):
    """Asks for the same change of every set-point."""

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        """Nothing to forget."""

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        return np.full_like(state.q_target, 0.05)


class FourHands:
    num_envs = 4

    def __init__(self, hand: dexctl.HandModel) -> None:
        m = hand.n_fingers
        self.state = dexctl.GraspState(
            q=np.zeros((4, hand.nq)), q_target=np.zeros((4, hand.nq)),
            in_contact=np.zeros((4, m), bool), contact_position=np.zeros((4, m, 3)),
            contact_normal=np.zeros((4, m, 3)), contact_force=np.zeros((4, m)),
        )  # fmt: skip

    def change_to_action(self, change: np.ndarray) -> np.ndarray:
        return change * 10


@pytest.mark.parametrize(("cloned", "labelled"), [("acted", 0), ("visited", 4)])
def test_states_that_the_policy_visits_are_labelled(
    cloned: str, labelled: int, dex5: dexctl.HandModel
) -> None:
    config = GuidanceConfig(method="vge+bc", cloned=cloned, horizon=2)
    guide = Guide(FourHands(dex5), [Waiting(dex5, control_period=0.05)], config, 0)
    learner = np.zeros((4, dex5.nq))
    # the critic finds the policy's action far better: nobody else acts
    choice = guide.act(0, learner, lambda rows, actions: np.array([[50.0], [0.0]]).repeat(4, 1))
    assert (choice.actor == 0).all() and (choice.action == 0).all()
    assert choice.guided.sum() == labelled
    if labelled:
        assert choice.label == pytest.approx(0.5)


def test_beta_falls_to_its_end(dex5: dexctl.HandModel) -> None:
    config = GuidanceConfig(method="vge+bc", beta=10, beta_end=2, beta_stop=100, hard_stop=1000)
    guide = Guide(FourHands(dex5), [Waiting(dex5, control_period=0.05)], config, 0)
    assert [guide.beta(step) for step in (0, 50, 100, 5000)] == [10, 6, 2, 2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cloned": "some"}, "'some'; known: None, acted, visited"),
        ({"cloning": "fast"}, "'fast'; known: likelihood, squared"),
        ({"cloning_weight": "heavy"}, "'heavy'; known: value, equal, better"),
        ({"method": "rl+bc", "cloned": "acted"}, "no controller acts"),
        ({"beta_stop": 0}, "beta_stop is 0"),
    ],
)
def test_bad_guidance(options: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=message):
        GuidanceConfig(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"critic_parts": ("mass",)}, "'mass'; known: "),
        ({"critic_parts": ("q",)}, "each named once"),
        ({"n_step": 0}, "n_step is 0"),
        ({"policy_delay": 0}, "policy_delay is 0"),
    ],
)
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=message):
        TrainConfig(**options)


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_a_policy_trained_with_all_of_it_needs_its_own_parts_only(
    algorithm: str, tmp_path: Path
) -> None:
    config = TrainConfig(
        env=EnvConfig(object="cylinder", episode_steps=30, parts=("q", "q_target", "touch")),
        guidance=GuidanceConfig(
            method="vge+bc", cloned="visited", cloning="squared", cloning_weight="better", beta=5
        ),
        controllers=("coordinated",),
        algorithm=algorithm, steps=200, num_envs=4, network=(16, 16), batch_size=16,
        learning_starts=40, buffer_size=200, n_step=3, layer_norm=True, policy_delay=2,
        critic_parts=("object_position", "object_quaternion"), device="cpu",
    )  # fmt: skip
    assert TrainConfig.from_dict(config.to_dict()) == config
    found = train(config, tmp_path / "run")
    assert np.isfinite(found["last"]["critic_loss"])
    policy = policies.load(found["policy"])
    assert policy.observation.parts == ("q", "q_target", "touch")
    assert policy.layers[0].weight.shape == (16, 35)


def test_recipes_on_the_command_line() -> None:
    def config(*arguments: str) -> TrainConfig:
        command = parse(Train, "dexctl train", arguments)
        assert command is not None
        return command.config()

    assert config("--recipe", "thesis") == TrainConfig(env=EnvConfig(latency=0.0))
    assert config() == config("--recipe", "fast") != TrainConfig()
    fast = config("--recipe", "fast", "--method", "vge+bc", "--tau", "0.1")
    assert (fast.n_step, fast.tau, fast.env.scaled, fast.layer_norm) == (5, 0.1, True, True)
    assert (fast.guidance.cloned, fast.guidance.beta) == ("visited", 10.0)
    assert config("--recipe", "fast", "--method", "rl").guidance.beta == GuidanceConfig().beta
    with pytest.raises(UnknownName, match="'slow'; known: thesis, fast"):
        config("--recipe", "slow")


@pytest.mark.parametrize("kind", [GuidedSAC, GuidedTD3])
def test_the_actor_is_averaged(kind: Any) -> None:
    env = gymnasium.make("Pendulum-v1")
    agent = kind("MlpPolicy", env, device="cpu", seed=0, buffer_size=100, average=0.9)
    agent.learn(30)
    expected = [p.detach().clone() for p in agent.averaged_actor.parameters()]
    before = [p.detach().clone() for p in agent.actor.parameters()]
    agent.train(2, 8)  # one update of TD3's actor, two of SAC's
    if kind is GuidedTD3:
        for old, new, mean in zip(
            expected, agent.actor.parameters(), agent.averaged_actor.parameters(), strict=True
        ):
            torch.testing.assert_close(mean, 0.9 * old + 0.1 * new)
    moved = [not a.equal(b) for a, b in zip(before, agent.actor.parameters(), strict=True)]
    assert any(moved)
    assert kind("MlpPolicy", env, device="cpu", seed=0, buffer_size=100).averaged_actor is None


def test_the_kept_policy_is_the_mean(tmp_path: Path) -> None:
    config = TrainConfig(
        env=EnvConfig(object="cylinder", episode_steps=30), guidance=GuidanceConfig(method="rl"),
        controllers=(), steps=200, num_envs=4, network=(8,), batch_size=16, learning_starts=40,
        buffer_size=200, policy_average=0.99, learning_rate=1e-3, learning_rate_end=0.0,
        device="cpu",
    )  # fmt: skip
    agent = build(config)
    agent.learn(100)
    assert agent.averaged_actor is not None
    kept, _ = policy_layers(agent)[0]
    (mean,) = [p for n, p in agent.averaged_actor.named_parameters() if n == "latent_pi.0.weight"]
    (last,) = [p for n, p in agent.actor.named_parameters() if n == "latent_pi.0.weight"]
    assert (kept == mean.numpy()).all()
    assert not np.allclose(kept, last.detach().numpy())
    assert [agent.lr_schedule(left) for left in (1.0, 0.5, 0.25, 0.0)] == pytest.approx(
        [1e-3, 1e-3, 5e-4, 0.0]
    )
    again = build(config)
    state.restore(again, state.capture(agent))
    for ours, theirs in zip(policy_layers(agent), policy_layers(again), strict=True):
        assert (ours[0] == theirs[0]).all()
