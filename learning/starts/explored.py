"""ExploredStarts: episodes begin where the training has been (explored restarts)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dexctl.sim.grasp_states import GraspStates
from dexctl.state import Bools, GraspState
from learning.envs.vector import ManipulationVectorEnv
from learning.starts.base import Remark, Starts
from learning.starts.config import StartsConfig

_EACH = 8  # states that are remembered of a step of all environments
_REFRESH = 100  # steps of all environments after which the newest are started from
_ROWS = ("q", "q_target", "object_position", "object_quaternion")
_Memory = tuple[dict[str, np.ndarray], np.ndarray]  # the rows, and which environment each was in


class ExploredStarts(Starts):
    """States that were visited are remembered, and a share of the episodes begins in one of them.

    The uniform restart of Tavakoli et al. 2018, "Exploring restart distributions", which chapter 5
    of the thesis compares with. Once the memory is full, random ones are written over, so
    older ones become rarer. Velocities are not kept.

    Args:
        env: the environments.
        config: the settings.
        seed: of what is remembered.
    """

    def __init__(self, env: ManipulationVectorEnv, config: StartsConfig, seed: int) -> None:
        super().__init__(env)
        self._count, self._share = config.start_count, config.explored_share
        self._random = np.random.default_rng(seed)
        self._rows: dict[str, np.ndarray] = {}
        self._objects = np.array(env.objects)
        self._where = np.empty(0, np.int64)  # which environment each row was in
        self._used: _Memory | None = None  # as it was when it was last started from
        self._turns = 0

    def begin(self, path: Path, remark: Remark) -> None:
        state = self.env.state
        self._settled = {name: _of(state, name).copy() for name in _ROWS}

    def after_step(self, step: int, done: Bools) -> None:
        going = np.flatnonzero(~done)
        chosen = self._random.choice(going, min(_EACH, len(going)), replace=False)
        self._remember(chosen)
        self._turns += 1
        if self._turns % _REFRESH == 0:
            self._start_from(_copied(self._rows), self._where.copy())

    def _remember(self, chosen: np.ndarray) -> None:
        state, size = self.env.state, len(self._where)
        new = {name: _of(state, name)[chosen] for name in _ROWS}
        if not self._rows:
            self._rows = {name: value[:0].copy() for name, value in new.items()}
        more = min(len(chosen), self._count - size)
        slots = self._random.integers(max(size, 1), size=len(chosen) - more)
        for name, value in new.items():
            self._rows[name][slots] = value[more:]
            self._rows[name] = np.concatenate([self._rows[name], value[:more]])
        self._where[slots] = chosen[more:]
        self._where = np.concatenate([self._where, chosen[:more]])

    def _start_from(self, rows: dict[str, np.ndarray], where: np.ndarray) -> None:
        self._used = rows, where
        objects = np.concatenate([self._objects, self._objects[where]])
        weight = np.empty(len(objects))
        for name in np.unique(self._objects):
            own = objects == name
            fixed = own & (np.arange(len(objects)) < len(self._objects))
            visited = own & ~fixed
            share = self._share if visited.any() else 0.0
            weight[fixed] = max(1.0 - share, 1e-12) / fixed.sum()
            weight[visited] = max(share, 1e-12) / max(visited.sum(), 1)
        hand = self.env.hand
        every: dict[str, Any] = {
            name: np.concatenate([self._settled[name], rows[name]]) for name in _ROWS
        }
        self.env.simulation.start_from(
            GraspStates(
                hand=hand.name,
                joint_names=np.array(hand.joint_names),
                object=objects,
                weight=weight,
                **every,
            )
        )

    def state_dict(self) -> dict[str, Any]:
        used = None
        if self._used is not None:
            rows, where = self._used
            used = {"rows": _copied(rows), "where": where.copy()}
        return {
            "rows": _copied(self._rows),
            "settled": _copied(self._settled),
            "where": self._where.copy(),
            "used": used,
            "turns": self._turns,
            "random": self._random.bit_generator.state,
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        self._rows, self._settled = _copied(saved["rows"]), _copied(saved["settled"])
        self._where, self._turns = saved["where"].copy(), int(saved["turns"])
        self._random.bit_generator.state = saved["random"]
        # the memory has gone on since; earlier checkpoints have nothing but that
        used = saved.get("used", saved if self._turns >= _REFRESH else None)
        if used is not None:
            self._start_from(_copied(used["rows"]), used["where"].copy())


def _copied(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: value.copy() for name, value in rows.items()}


def _of(state: GraspState, name: str) -> np.ndarray:
    value = getattr(state, name)
    assert value is not None
    return value
