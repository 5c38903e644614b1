"""GroupedSimulator: different objects in one batch, a `BatchSimulator` for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.sim import checks
from dexctl.sim.scene import Scene
from dexctl.sim.simulator import BatchSimulator, SimulatorState
from dexctl.state import Bools, Floats, GraspState


class GroupedSimulator:
    """Groups of environments, one scene each, of one hand, behind `BatchSimulator`'s interface.

    MuJoCo steps a batch of one model structure at a time, so the groups are stepped one after the
    other; there is no loop over the environments inside a group. Environments are numbered
    through, group after group, and environment i has the random stream ``seed + i``.

    Args:
        groups: (scene, number of environments) pairs; the scenes have the same hand.
        control_period, substeps, threads, touch_threshold, disturbance, seed: as
            `BatchSimulator`'s.

    Attributes:
        groups: the `BatchSimulator` of each group.
        slices: which environments are in each group.
        num_envs: of all groups together.
    """

    def __init__(
        self,
        groups: Sequence[tuple[Scene, int]],
        control_period: float = 0.05,
        substeps: int = 10,
        threads: int | None = None,
        touch_threshold: float = 0.05,
        disturbance: float = 0.02,
        seed: ArrayLike = 0,
    ) -> None:
        if not groups:
            raise InvalidInput("GroupedSimulator got no groups; expected (scene, count) pairs")
        hand = groups[0][0].hand
        for scene, _ in groups:
            if scene.hand.path != hand.path or scene.hand.joint_names != hand.joint_names:
                raise InvalidInput(
                    f"the scenes have different hands, {hand.path} and {scene.hand.path}; "
                    "expected one hand"
                )
        ends = np.cumsum([count for _, count in groups])
        self.slices = tuple(
            slice(int(end - count), int(end)) for end, (_, count) in zip(ends, groups, strict=True)
        )
        self.num_envs = int(ends[-1])
        self.batch_shape = (self.num_envs,)
        seeds = self._seeds(seed)
        self.groups = tuple(
            BatchSimulator(
                scene,
                count,
                control_period=control_period,
                substeps=substeps,
                threads=threads,
                touch_threshold=touch_threshold,
                disturbance=disturbance,
                seed=seeds[rows],
            )
            for (scene, count), rows in zip(groups, self.slices, strict=True)
        )
        self.hand = hand
        self.control_period = self.groups[0].control_period
        self.substeps = self.groups[0].substeps
        self.touch_threshold = self.groups[0].touch_threshold
        self.disturbance = self.groups[0].disturbance

    def _seeds(self, seed: ArrayLike) -> np.ndarray:
        seeds = np.asarray(seed)
        return seeds + np.arange(self.num_envs) if seeds.ndim == 0 else seeds

    @property
    def objects(self) -> tuple[str, ...]:
        """The object's name in each environment."""
        return tuple(
            name for group in self.groups for name in [group.scene.object] * (group.num_envs or 1)
        )

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """See `BatchSimulator.reset`."""
        seeds = None if seed is None else self._seeds(seed)
        chosen = self._mask(mask)
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.reset(None if seeds is None else seeds[rows], chosen[rows])

    def set_grasp(
        self,
        q: ArrayLike,
        q_target: ArrayLike,
        object_position: ArrayLike,
        object_quaternion: ArrayLike,
        mask: ArrayLike | None = None,
    ) -> None:
        """See `BatchSimulator.set_grasp`."""
        chosen = self._mask(mask)
        grasp = [self._rows(value) for value in (q, q_target, object_position, object_quaternion)]
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.set_grasp(*(value[rows] for value in grasp), mask=chosen[rows])

    def place_object(
        self, position: ArrayLike, quaternion: ArrayLike, mask: ArrayLike | None = None
    ) -> None:
        """See `BatchSimulator.place_object`."""
        chosen, pose = self._mask(mask), [self._rows(value) for value in (position, quaternion)]
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.place_object(*(value[rows] for value in pose), mask=chosen[rows])

    def read(self) -> GraspState:
        """See `BatchSimulator.read`."""
        states = [group.read() for group in self.groups]
        names = [name for name, value in states[0].arrays().items() if value is not None]
        return GraspState(
            **{name: np.concatenate([getattr(state, name) for state in states]) for name in names}
        )

    def write(self, q_target: ArrayLike) -> Floats:
        """See `BatchSimulator.write`."""
        rows_of = self._rows(q_target)
        return np.concatenate(
            [
                group.write(rows_of[rows])
                for group, rows in zip(self.groups, self.slices, strict=True)
            ]
        )

    def push(self, force: ArrayLike) -> None:
        """See `BatchSimulator.push`."""
        rows_of = self._rows(force)
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.push(rows_of[rows])

    def step(self, mask: ArrayLike | None = None) -> None:
        """See `BatchSimulator.step`."""
        chosen = None if mask is None else self._mask(mask)
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.step(None if chosen is None else chosen[rows])

    def set_parameters(self, mask: ArrayLike | None = None, **parameters: ArrayLike) -> None:
        """See `BatchSimulator.set_parameters`."""
        chosen = self._mask(mask)
        for group, rows in zip(self.groups, self.slices, strict=True):
            group.set_parameters(
                chosen[rows],
                **{
                    name: value if np.ndim(value) == 0 else self._rows(value)[rows]
                    for name, value in parameters.items()
                },
            )

    def save(self) -> list[SimulatorState]:
        """All that decides the future, group by group."""
        return [group.save() for group in self.groups]

    def restore(self, saved: Sequence[SimulatorState]) -> None:
        """Continue from what `save` returned."""
        if len(saved) != len(self.groups):
            raise SimulationError(
                f"the saved state has {len(saved)} groups; this simulator has {len(self.groups)}"
            )
        for group, state in zip(self.groups, saved, strict=True):
            group.restore(state)

    @property
    def time(self) -> Floats:
        """Simulated time since the last reset, ``(N,)`` [s]."""
        return self._gather(lambda group: group.time)

    @property
    def diverged(self) -> Bools:
        """``(N,)``, latched until reset."""
        return self._gather(lambda group: group.diverged)

    @property
    def other_contact(self) -> Floats:
        """Force between the object and everything but fingertips, ``(N,)`` [N]."""
        return self._gather(lambda group: group.other_contact)

    @property
    def object_angular_velocity(self) -> Floats:
        """``(N, 3)`` [rad/s], at control rate."""
        return self._gather(lambda group: group.object_angular_velocity)

    @property
    def object_velocity(self) -> Floats:
        """Linear [m/s] and angular [rad/s], ``(N, 6)``, as the simulation has it."""
        return self._gather(lambda group: group.object_velocity)

    @property
    def fingertip_force(self) -> Floats:
        """Of each fingertip on the object, ``(N, m, 3)`` [N]."""
        return self._gather(lambda group: group.fingertip_force)

    @property
    def start_position(self) -> Floats:
        """The object's centre after the last reset, ``(N, 3)`` [m]."""
        return self._gather(lambda group: group.start_position)

    @property
    def friction(self) -> Floats:
        """Sliding friction coefficient between object and fingertips, ``(N,)``."""
        return self._gather(lambda group: group.friction)

    @property
    def qpos(self) -> Floats:
        """MuJoCo's generalised positions ``(N, nq)``, for drawing."""
        return self._gather(lambda group: group.qpos)

    def close(self) -> None:
        """Stop the threads of all groups."""
        for group in self.groups:
            group.close()

    def __enter__(self) -> GroupedSimulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _gather(self, get: Callable[[BatchSimulator], np.ndarray]) -> np.ndarray:
        return np.concatenate([get(group) for group in self.groups])

    def _rows(self, value: ArrayLike) -> np.ndarray:
        rows = np.asarray(value, float)
        if rows.ndim == 0 or len(rows) != self.num_envs:
            raise InvalidInput(f"got an array of shape {rows.shape}; expected {self.num_envs} rows")
        return rows

    def _mask(self, mask: ArrayLike | None) -> Bools:
        return checks.mask(mask, self.batch_shape)
