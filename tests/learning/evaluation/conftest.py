"""Policies that leave the set-points where they are, for the tests of evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.settings import from_plain, to_plain
from learning import policies
from learning.config import TrainConfig
from learning.envs import EnvConfig, Observation, SetPointAction
from learning.evaluation import Subject, open_subject
from learning.policies import PolicySpec

MakePolicy = Callable[..., str]


@pytest.fixture
def policy_of(tmp_path: Path) -> MakePolicy:
    """Writes a policy that was trained in environments with some settings."""

    def make(card: Mapping[str, Any] | None = None, name: str = "", **settings: Any) -> str:
        env = from_plain(EnvConfig, settings)
        hand = dexctl.hands.load(env.scene.hand)
        observation = Observation(hand, env.parts, scaled=env.scaled)
        action = SetPointAction(
            hand,
            max_speed=env.max_speed,
            max_lead=env.max_lead,
            control_period=env.scene.control_period,
        )
        spec = PolicySpec(
            env.scene.hand, tuple(hand.joint_names), tuple(hand.fingertip_names),
            observation.to_dict(), action.to_dict(),
        )  # fmt: skip
        path = tmp_path / f"{name or '-'.join((*env.scene.object, str(env.scene.gravity)))}.npz"
        layers = [(np.zeros((hand.nq, observation.size)), np.zeros(hand.nq))]
        if card is None:
            card = {"trained": to_plain(TrainConfig(env=env, controllers=("igm", "gait")))}
        policies.save(path, layers, spec, card)
        return str(path)

    return make


@pytest.fixture
def still(policy_of: MakePolicy, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Subject:
    """One for the cylinder, by the name of its file."""
    from dataclasses import replace

    return replace(open_subject(policy_of(name="still", object="cylinder")), name="still")
