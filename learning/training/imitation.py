"""imitate: a policy that is begun with the edges of a tree (imitation pre-training)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.sim.grasp_states import GraspStates
from dexctl.state import Floats
from learning.algorithms.base import Algorithm
from learning.algorithms.config import ImitationConfig
from learning.envs.vector import ManipulationVectorEnv


def imitate(
    algorithm: Algorithm, env: ManipulationVectorEnv, config: ImitationConfig, seed: int
) -> int:
    """Clone the actions that lead from the parents of the starts to them; how many there were.

    Thesis chapter 5, Alg. IPT, whose D' grows from D here and from D' as it should be: the pairs
    of all edges are collected first. The states are those that episodes begin in. The critic's
    part of the algorithm is `PPOConfig.critic_steps`. The environments are left somewhere else.

    Raises:
        InvalidInput: the starts do not know which they were reached from.
    """
    states = env.simulation.starts
    found = None if states is None else edges(states, config)
    if states is None or found is None or not len(found[0]):
        raise InvalidInput(
            f"imitated is {config.imitated!r}, and no start knows which it was reached from; "
            "expected start_from 'paths', or a file of `dexctl plan states`"
        )
    parent, change = found
    observation, kept = _observed(env, states, parent)
    action = env.change_to_action(change[kept])
    algorithm.imitate(
        observation, np.asarray(action, np.float32),
        epochs=config.imitation_epochs, batch_size=config.imitation_batch, seed=seed,
    )  # fmt: skip
    return len(parent)


def edges(states: GraspStates, config: ImitationConfig) -> tuple[NDArray[np.int64], Floats] | None:
    """Rows of the parents ``(E,)`` and the set-point changes ``(E, d)`` [rad] that led on.

    a = beta (q_child - q_parent) of the measured joints (thesis chapter 5, eq. inv), or the change
    of the set-points, which is the very action of a tree of random ones. None where no parents are
    known.
    """
    if states.parent is None:
        return None
    child = np.flatnonzero(states.parent >= 0)
    parent = states.parent[child]
    if config.imitated == "set_points":
        return parent, states.q_target[child] - states.q_target[parent]
    return parent, config.imitation_beta * (states.q[child] - states.q[parent])


def _observed(
    env: ManipulationVectorEnv, states: GraspStates, rows: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Observations ``(E, k)`` in ``rows``, each with its object, and the order they come in."""
    objects = np.array(env.objects)
    found, kept = [], []
    waiting = {name: np.flatnonzero(states.object[rows] == name) for name in np.unique(objects)}
    while any(len(left) for left in waiting.values()):
        index = np.zeros(env.num_envs, np.int64)
        used = np.full(env.num_envs, -1, np.intp)
        for name, left in waiting.items():
            slots = np.flatnonzero(objects == name)
            some = left[: len(slots)]
            waiting[name] = left[len(slots) :]
            index[slots] = np.flatnonzero(states.object == name)[0]  # where nothing is left to see
            index[slots[: len(some)]] = rows[some]
            used[slots[: len(some)]] = some
        observation = env.place(states, index)
        found.append(observation[used >= 0])
        kept.append(used[used >= 0])
    return np.concatenate(found), np.concatenate(kept)
