"""Imitation pre-training: labels by hand, what the policy makes of them, the critic after it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from dexctl.exceptions import InvalidInput
from dexctl.planning import Kinematic, grow, path_states
from dexctl.sim import GraspStates, Scene
from learning.algorithms.config import ImitationConfig
from learning.config import TrainConfig
from learning.training.build import build_algorithm, build_env
from learning.training.imitation import edges, imitate
from learning.training.run_folder import RunFolder
from learning.training.trainer import Trainer, train

Make = Callable[..., TrainConfig]
PPO = {"algorithm": "ppo", "method": "rl"}


@pytest.fixture(scope="module")
def planned() -> GraspStates:
    scene = Scene.build("dex5", "cylinder", "up")
    tree = grow(scene, Kinematic(batch=32), nodes=120, seed=0, threads=1)
    return path_states(tree, 100)


def test_labels_by_hand(planned: GraspStates) -> None:
    few = planned.take([0, 1, 2])
    assert few.parent is not None
    assert few.parent.tolist() == [-1, 0, 1]
    found = edges(few, ImitationConfig(imitated="joints"))
    assert found is not None
    parent, change = found
    assert parent.tolist() == [0, 1]
    np.testing.assert_allclose(change, 2.0 * (few.q[1:] - few.q[:2]))
    found = edges(few, ImitationConfig(imitated="set_points"))
    assert found is not None
    np.testing.assert_allclose(found[1], few.q_target[1:] - few.q_target[:2])


def test_the_policy_begins_with_the_edges(
    planned: GraspStates, small: Make, tmp_path: Path
) -> None:
    config = small(
        **PPO, imitated="joints", imitation_epochs=150, imitation_batch=32, num_envs=16,
        ppo__network=(64, 64), env__initial_states=tmp_path / "starts.npz",
    )  # fmt: skip
    planned.save(tmp_path / "starts.npz")
    made = build_env(config)
    algorithm = build_algorithm(config, made)
    assert imitate(algorithm, made, config.imitation, 0) == len(planned) - 1
    found = edges(planned, config.imitation)
    assert found is not None
    parent, change = found
    wanted = made.change_to_action(change)
    observation = np.concatenate(
        [made.place(planned, np.resize(parent[i : i + 16], 16)) for i in range(0, len(parent), 16)]
    )[: len(parent)]
    seen: Any = algorithm
    with torch.no_grad():
        inputs = seen._inputs(observation)["policy"]
        done = torch.tanh(seen.actor(torch.as_tensor(inputs))[0]).numpy()
    # several edges lead on from one state, so they are not matched to the last bit
    assert ((done - wanted) ** 2).mean() < 0.5 * (wanted**2).mean()


def test_only_the_critic_learns_at_first(planned: GraspStates, small: Make, tmp_path: Path) -> None:
    config = small(
        **PPO, num_envs=4, ppo__critic_steps=64, ppo__rollout_steps=8, ppo__normalise=False
    )
    made = build_env(config)
    algorithm: Any = build_algorithm(config, made)
    trainer = Trainer(config, RunFolder(tmp_path / "run"))
    algorithm = trainer.algorithm
    actor, critic = algorithm.actor.flat.detach().clone(), algorithm.critic.flat.detach().clone()
    spread = algorithm.log_std.detach().clone()
    for _ in range(16):  # two rollouts, to step 64
        trainer.turn(None)  # type: ignore[arg-type]
    assert algorithm.updates == 8
    assert torch.equal(actor, algorithm.actor.flat) and torch.equal(spread, algorithm.log_std)
    assert not torch.equal(critic, algorithm.critic.flat)
    for _ in range(8):
        trainer.turn(None)  # type: ignore[arg-type]
    assert not torch.equal(actor, algorithm.actor.flat)
    trainer.close()
    made.close()


def test_a_training_begins_by_imitating(small: Make, tmp_path: Path) -> None:
    config = small(
        **PPO, start_from="paths", start_count=30, tree_nodes=40, imitated="set_points", steps=64,
        ppo__critic_steps=32, imitation_epochs=2,
    )  # fmt: skip
    assert train(config, tmp_path / "run")["steps"] == 64
    assert (tmp_path / "run" / "starts.npz").exists()


def test_states_without_parents_cannot_be_imitated(
    planned: GraspStates, small: Make, tmp_path: Path
) -> None:
    planned.take([3]).save(tmp_path / "starts.npz")
    config = small(**PPO, imitated="joints", env__initial_states=tmp_path / "starts.npz")
    with pytest.raises(InvalidInput, match="no start knows which it was reached from") as caught:
        train(config, tmp_path / "run")
    assert "\n" not in str(caught.value)
