"""What holding an object badly costs, and when it is lost: whatever the task is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl.settings import from_plain, to_plain
from dexctl.sim import SceneConfig, Simulation
from learning.envs import EnvConfig
from learning.envs.holding import HoldingConfig
from learning.envs.task import Step
from learning.envs.tasks import TaskConfig

COSTS = {"end_on_links": True, "drop_cost": 5.0, "drift_cost": 2.0, "links_cost": 0.3}


def test_costs_by_hand() -> None:
    worth = np.array([0.3, -0.2, 0.5])

    def less(**costs: Any) -> np.ndarray:
        return worth - HoldingConfig(**costs).charged(
            worth,
            away=np.array([0.0, 0.01, 0.06]),
            lost=np.array([False, False, True]),
            links=np.array([False, True, True]),
        )

    assert less() == pytest.approx([0, 0, 0])
    assert less(drop_cost=5.0) == pytest.approx([0, 0, 5])
    assert less(drift_cost=10.0) == pytest.approx([0, 0.1, 0.6])
    assert less(links_cost=0.2) == pytest.approx([0, 0.2, 0.2])
    assert less(drop_cost=5.0, drift_cost=10.0, links_cost=0.2) == pytest.approx([0, 0.3, 5.8])


@pytest.mark.parametrize("goals", ["none", "uniform"])
def test_every_task_charges_them_and_loses_by_the_same_rule(goals: Any) -> None:
    """Four hands that do not move: held, held with links, lost by distance, broken down."""
    config = from_plain(SceneConfig, {"object": "cylinder", "threads": 1})
    with Simulation(config, 4) as simulation:
        state = simulation.state
        assert state.object_position is not None
        away = np.array([0.0, 0.01, 0.06, 0.06])
        step = Step(
            state=state,
            angular_velocity=np.zeros((4, 3)),
            fingertips_only=np.array([True, False, True, False]),
            start_position=state.object_position - away[:, None] * np.array([0.0, 0.0, 1.0]),
            diverged=np.array([False, False, False, True]),
        )
        lost = {False: [False, False, True, False], True: [False, True, True, False]}
        for ends in (False, True):
            holding = HoldingConfig(
                end_on_links=ends, drop_cost=2.0, drift_cost=10.0, links_cost=0.3
            )
            task = TaskConfig(goals=goals, holding=holding).build(simulation)
            task.begin(np.ones(4, bool), state)
            found = task.judge(step)
            assert found.dropped.tolist() == lost[ends]
            wanted = [0.0, -0.4 - 2.0 * ends, -2.6, 0.0]
            np.testing.assert_allclose(found.reward, wanted, atol=1e-6)


def test_what_turning_alone_was_charged_once_is_read_as_it_was_written() -> None:
    """Run folders and cards of policies of an earlier version, and sweeps that name paths."""
    now = TaskConfig(holding=HoldingConfig(drop_distance=0.04, **COSTS))
    content = to_plain(now)
    before = {key: value for key, value in content.items() if key != "holding"}
    before |= {"drop_distance": 0.04, "turning": content["turning"] | COSTS}
    assert from_plain(TaskConfig, before) == now
    env = from_plain(EnvConfig, {"task": before})
    assert env.task == now
    paths = {f"task.turning.{name}": value for name, value in COSTS.items()}
    assert from_plain(EnvConfig, paths).task.holding == replace(now.holding, drop_distance=0.05)
    assert from_plain(EnvConfig, COSTS).task.holding == replace(now.holding, drop_distance=0.05)
