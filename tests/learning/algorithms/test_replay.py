"""What is remembered: n-step returns across the ends of episodes, labels, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

from dexctl.exceptions import InvalidInput
from learning.algorithms import Transitions
from learning.algorithms.replay import Replay


def step(t: float, n: int, **changes: Any) -> Transitions:
    nowhere = np.zeros(n, bool)
    given = Transitions(
        np.full((n, 1), t),
        np.zeros((n, 1)),
        np.full(n, t),
        np.full((n, 1), t + 1),
        nowhere,
        nowhere,
    )
    return given._replace(**changes)


def filled(steps: int, capacity: int = 20) -> Replay:
    """Two environments; in step t they observe t and earn t and -t; one ends at 4, 9, 14 ...

    The first of them is cut at 4 and terminates at 9, and so on in turn.
    """
    buffer = Replay(
        2 * capacity, num_envs=2, observation_size=1, action_size=1, n_step=3, gamma=0.5
    )
    for t in range(steps):
        ended = np.array([t % 5 == 4, False])
        reward = np.array([t, -t])
        buffer.add(step(t, 2, reward=reward, ended=ended, terminated=ended & (t % 10 == 9)))
    return buffer


def rows(buffer: Replay) -> set[tuple[float, ...]]:
    found = buffer.sample(3000)
    parts = (found.observation, found.next_observation, found.reward, found.discount)
    return set(zip(*(part[:, 0].tolist() for part in parts), strict=True))


def test_n_step_returns_by_hand() -> None:
    assert {
        (1.0, 4.0, 1 + 2 / 2 + 3 / 4, 0.125),  # three whole steps
        (3.0, 5.0, 3 + 4 / 2, 0.25),  # cut at 4: nothing of the next episode, its value counts
        (8.0, 10.0, 8 + 9 / 2, 0.0),  # terminated at 9: no value counts
        (8.0, 11.0, -(8 + 9 / 2 + 10 / 4), 0.125),  # the other one goes on
        (11.0, 12.0, 11.0, 0.5),  # the youngest step
    } <= rows(filled(12))


def test_n_step_returns_never_join_the_youngest_and_the_oldest_step() -> None:
    found = rows(filled(27))  # steps 20 to 26 stand where 0 to 6 were
    assert min(row[0] for row in found) == 7.0
    assert (26.0, 27.0, 26.0, 0.5) in found
    assert (25.0, 27.0, -(25 + 26 / 2), 0.25) in found
    assert (19.0, 22.0, -(19 + 20 / 2 + 21 / 4), 0.125) in found
    assert all(after - before <= 3 for before, after, *_ in found)


def test_one_step_returns_are_the_rewards() -> None:
    buffer = Replay(10, num_envs=1, observation_size=1, action_size=1, gamma=0.9)
    buffer.add(step(3, 1))
    found = buffer.sample(4)
    assert (found.reward == 3.0).all() and found.discount.numpy() == pytest.approx(0.9)


def test_labels_stay_beside_actions() -> None:
    buffer = Replay(10, num_envs=5, observation_size=1, action_size=3, labels=True)
    marked = np.array([True, False, True, False, True])
    for t in (1.0, 2.0, 3.0):  # the third step overwrites the first
        label = np.full((5, 3), -t)
        buffer.add(step(t, 5, action=np.full((5, 3), 0.5), guided=marked, guide_action=label))
    batch = buffer.sample(300)
    assert set(batch.reward.flatten().tolist()) == {2.0, 3.0}
    assert (batch.guide_action == -batch.reward).all() and (batch.action == 0.5).all()
    assert batch.guided.mean().item() == pytest.approx(0.6, abs=0.1)
    assert buffer.nbytes == 4 * 10 * (1 + 1 + 3 + 1 + 1 + 1 + 1 + 3)
    again = Replay(10, num_envs=5, observation_size=1, action_size=3, labels=True, seed=9)
    again.load_state_dict(buffer.state_dict())
    assert (again.sample(50).reward == buffer.sample(50).reward).all()


def test_refusals() -> None:
    buffer = Replay(10, num_envs=2, observation_size=1, action_size=1)
    for name in ("observation", "next_observation", "action"):
        with pytest.raises(InvalidInput, match=r"environments \[1\] is not finite"):
            buffer.add(step(0, 2, **{name: np.array([[0.0], [np.nan]])}))
    with pytest.raises(InvalidInput, match=r"environments \[0\] is not finite"):
        buffer.add(step(0, 2, reward=np.array([np.inf, 0.0])))
    assert len(buffer) == 0
    with pytest.raises(InvalidInput, match="holds 1 transitions"):
        Replay(1, num_envs=2, observation_size=1, action_size=1)
    with pytest.raises(InvalidInput, match="the saved replay buffer has shape"):
        buffer.load_state_dict(filled(3).state_dict() | {"rows": np.zeros((3, 2, 99))})
