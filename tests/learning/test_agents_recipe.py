"""What helps learning beyond the thesis: n-step returns, critics that see more, cloned states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")


import dexctl
from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from learning import checkpoint
from learning.cli_train import Train
from learning.envs import EnvConfig
from learning.exploration import GuidanceConfig, Guide
from learning.export import policy_layers
from learning.policy import load_policy
from learning.settings import TrainConfig
from learning.train import build, train

BOX = gymnasium.spaces.Box


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
    policy = load_policy(found["policy"])
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
    checkpoint.restore(again, checkpoint.capture(agent))
    for ours, theirs in zip(policy_layers(agent), policy_layers(again), strict=True):
        assert (ours[0] == theirs[0]).all()
