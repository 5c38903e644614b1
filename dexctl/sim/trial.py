"""Trials: run a controller on the simulator and keep what happened.

Every measurement in this project is such a run: one read, act, write and step per control period;
the object is dropped when its centre is more than 0.05 m from where it started; rotation is the
unwrapped angle about the axis asked for, up to the drop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.plant import Plant
from dexctl.rotations import inverse, multiply
from dexctl.sim.grouped import GroupedSimulator
from dexctl.sim.simulation import Simulation
from dexctl.sim.simulator import BatchSimulator
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import DAY, unit_axis

DROP_DISTANCE = 0.05
Simulator = BatchSimulator | GroupedSimulator
Observer = Callable[[Any], None]


@dataclass(frozen=True, eq=False)
class Trace:
    """What happened in a run of T control periods; ``...`` is ``()`` or ``(N,)``.

    Rows 0 to T of the states: row 0 is the start, row T the end. Rows 0 to T-1 of ``diagnostics``:
    what the controller found in state i.

    Attributes:
        time: since the start, ``(T+1,)`` [s].
        q, q_target: ``(T+1, ..., d)`` [rad].
        in_contact, contact_force: ``(T+1, ..., m)``, bool and [N].
        contact_position, contact_normal: ``(T+1, ..., m, 3)`` [m] and unit, into the object.
        object_position, object_quaternion: ``(T+1, ..., 3)`` [m], ``(T+1, ..., 4)`` wxyz.
        other_contact: force of the object on all but fingertips, ``(T+1, ...)`` [N].
        diverged: whether the simulation of an environment broke down, ``(T+1, ...)`` bool.
        held: whether the object has not been dropped yet, ``(T+1, ...)`` bool.
        rotation: angle about the axis of the run since the start, standing still from the drop
            on, ``(T+1, ...)`` [rad].
        axis: that axis, unit, hand frame, ``(3,)``.
        diagnostics: those of the controller that are numbers, by name, ``(T, ...)`` each.
        act_seconds: wall time of each call of the controller, ``(T,)`` [s].
    """

    time: Floats
    q: Floats
    q_target: Floats
    in_contact: Bools
    contact_force: Floats
    contact_position: Floats
    contact_normal: Floats
    object_position: Floats
    object_quaternion: Floats
    other_contact: Floats
    diverged: Bools
    held: Bools
    rotation: Floats
    axis: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    diagnostics: Mapping[str, np.ndarray] = field(default_factory=dict)
    act_seconds: Floats = field(default_factory=lambda: np.zeros(0))

    def trial(self, index: int) -> Trace:
        """One trial of a batch, without the batch dimension."""
        alone = ("time", "axis", "act_seconds", "diagnostics")
        rows = {
            each.name: getattr(self, each.name)[:, index]
            for each in fields(self)
            if each.name not in alone
        }
        diagnostics = {name: value[:, index] for name, value in self.diagnostics.items()}
        return replace(self, **rows, diagnostics=diagnostics)

    @property
    def final_rotation(self) -> Floats:
        """Rotation up to the drop or the end, ``(...)`` [rad]."""
        return self.rotation[-1]

    @property
    def dropped(self) -> Bools:
        """Whether the object was dropped, ``(...)``."""
        return ~self.held[-1]

    @property
    def time_held(self) -> Floats:
        """Until the drop or the end, ``(...)`` [s]."""
        last = self.held.sum(axis=0) - 1
        return self.time[last]


def run(
    controller: Controller,
    sim: Simulator | Simulation,
    seconds: float,
    *,
    plant: Plant | None = None,
    axis: str | ArrayLike = "z",
    observers: Sequence[Observer] = (),
    drop_distance: float = DROP_DISTANCE,
    until_dropped: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Trace:
    """Run ``controller`` on ``sim``, from where both are, for ``seconds`` of simulated time.

    Reset both first for a trial: ``sim.reset(seed); controller.reset(seed)``.

    Args:
        controller: of the simulator's hand.
        sim: a `Simulation`, whose sensors and limits then stand between, or bare physics.
        seconds: of simulated time, rounded to control periods [s].
        plant: what the controller is to see of ``sim``, such as a `LimitedHand` in front of it;
            default ``sim`` itself. The object's pose in the trace is always that of ``sim``.
        axis: that rotation is counted about, hand frame: "x", "y", "z", "-x" ... or a vector.
        observers: each is called with the physics at the start and after each step (a
            `Recorder`, for one).
        drop_distance: how far the object's centre may go from where it is at the start [m].
        until_dropped: end as soon as no object is held any more.
        progress: called after each step with the simulated time so far [s].

    Raises:
        UnknownName, InvalidInput: no such axis, or the controller's and the simulator's control
            periods differ.
    """
    about = np.array(unit_axis(axis))
    if not np.isclose(controller.control_period, sim.control_period):
        raise InvalidInput(
            f"the controller's control_period is {controller.control_period} s and the simulator's "
            f"{sim.control_period} s; expected the same"
        )
    steps = round(seconds / sim.control_period) if abs(seconds) <= DAY else 0
    if steps < 1:
        raise InvalidInput(
            f"seconds is {seconds}; expected at least one control period, {sim.control_period} s, "
            "and a day at most"
        )
    seen: Plant = sim if plant is None else plant
    physics = sim.sim if isinstance(sim, Simulation) else sim

    def truth(state: GraspState) -> GraspState:
        """What is kept of a moment at which the controller sees ``state``."""
        if isinstance(sim, Simulation):
            return sim.state
        if plant is None:
            return state
        now = sim.read()
        pose = {name: getattr(now, name) for name in ("object_position", "object_quaternion")}
        return replace(state, **pose)

    state = seen.read()
    states = [truth(state)]
    other, diverged = [physics.other_contact], [physics.diverged]
    found: list[dict[str, np.ndarray]] = []
    act_seconds = np.zeros(steps)
    held = np.ones(physics.batch_shape, bool)
    for observe in observers:
        observe(physics)
    for i in range(steps):
        start = perf_counter()
        change = controller.act(state)
        act_seconds[i] = perf_counter() - start
        seen.write(state.q_target + change)
        seen.step()
        found.append(_numbers(controller.diagnostics, physics.batch_shape))
        state = seen.read()
        states.append(truth(state))
        other.append(physics.other_contact)
        diverged.append(physics.diverged)
        for observe in observers:
            observe(physics)
        if progress is not None:
            progress((i + 1) * sim.control_period)
        if until_dropped:
            now, first = (np.asarray(states[k].object_position) for k in (-1, 0))
            held &= (np.linalg.norm(now - first, axis=-1) <= drop_distance) & ~physics.diverged
            if not held.any():
                act_seconds = act_seconds[: i + 1]
                break
    time = np.arange(len(states), dtype=float) * float(sim.control_period)
    return _trace(time, states, other, diverged, found, act_seconds, drop_distance, about)


def _trace(
    time: Floats,
    states: list[GraspState],
    other: list[Floats],
    diverged: list[Bools],
    found: list[dict[str, np.ndarray]],
    act_seconds: Floats,
    drop_distance: float,
    axis: Floats,
) -> Trace:
    position = np.array([state.object_position for state in states])
    quaternion = np.array([state.object_quaternion for state in states])
    away = np.linalg.norm(position - position[0], axis=-1)
    broken = np.array(diverged)
    held = np.logical_and.accumulate((away <= drop_distance) & ~broken, axis=0)
    names = [name for name in found[0] if all(name in row for row in found)]
    return Trace(
        time=time,
        q=np.array([state.q for state in states]),
        q_target=np.array([state.q_target for state in states]),
        in_contact=np.array([state.in_contact for state in states]),
        contact_force=np.array([state.contact_force for state in states]),
        contact_position=np.array([state.contact_position for state in states]),
        contact_normal=np.array([state.contact_normal for state in states]),
        object_position=position,
        object_quaternion=quaternion,
        other_contact=np.array(other),
        diverged=broken,
        held=held,
        rotation=rotation_about(quaternion, axis, held),
        axis=axis,
        diagnostics={name: np.array([row[name] for row in found]) for name in names},
        act_seconds=act_seconds,
    )


def rotation_about(
    quaternion: Floats, axis: ArrayLike = (0.0, 0.0, 1.0), held: Bools | None = None
) -> Floats:
    """Unwrapped angle about ``axis`` since the first row, ``(T, ...)`` [rad].

    The turn about an axis is the twist of the swing-twist decomposition, so tilting alone does not
    count.

    Args:
        quaternion: ``(T, ..., 4)`` wxyz.
        axis: unit vector ``(3,)``, world frame.
        held: ``(T, ...)``; where it is False the angle stands still.
    """
    relative = multiply(quaternion, inverse(np.broadcast_to(quaternion[:1], quaternion.shape)))
    twist = relative[..., 1:] @ np.asarray(axis, float)
    angle = np.unwrap(2.0 * np.arctan2(twist, relative[..., 0]), axis=0)
    if held is None:
        return angle
    last = np.maximum.accumulate(
        np.where(held, np.arange(len(held)).reshape(-1, *(1,) * (held.ndim - 1)), 0), axis=0
    )
    return np.take_along_axis(angle, last, axis=0)


def _numbers(diagnostics: Mapping[str, object], batch: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Copies of the diagnostics that are numeric arrays with the batch dimensions in front."""
    kept = {}
    for name, value in diagnostics.items():
        array = np.asarray(value)
        if array.dtype.kind in "fiub" and array.shape[: len(batch)] == batch:
            kept[name] = array.copy()
    return kept
