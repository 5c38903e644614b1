"""Figures of merit of a run's log: numbers, and the words in which people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.rotations import angle_between
from dexctl.state import Bools, Floats
from hardware.log import Log

_WORDS = {
    "seconds": ("time logged", "s", 1.0),
    "rate_hz": ("control rate", "Hz", 1.0),
    "tracking_rms_rad": ("set-points less joints, RMS", "rad", 1.0),
    "tracking_worst_rad": ("set-points less joints, worst", "rad", 1.0),
    "torque_rms_nm": ("torque, RMS", "N m", 1.0),
    "torque_worst_nm": ("torque, worst", "N m", 1.0),
    "late_over_1ms": ("ticks late by more than 1 ms", "%", 100.0),
    "lateness_p99_s": ("lateness of ticks, p99", "ms", 1e3),
    "stale_joints": ("joints read in vain", "%", 100.0),
    "mean_contacts": ("fingertips in touch, mean", "", 1.0),
    "rotation_rad": ("object's turn about z", "rad", 1.0),
    "rotation_as_told_rad": ("object's turn about the axis told", "rad", 1.0),
    "turning_speed_rad_s": ("its mean speed while the controller ran", "rad/s", 1.0),
    "object_lost_at_s": ("object lost at", "s", 1.0),
    "goal_reached_at_s": ("less than 0.2 rad from the goal at", "s", 1.0),
    "left_to_goal_rad": ("left to the goal at the end", "rad", 1.0),
}
"""Of each figure: what people read, unit, and how many of the unit are 1 of the figure's own."""
GOAL_ANGLE = 0.2
"""Angle to the goal within which the object is there [rad]."""


_OUTCOMES = {
    "idle": "ended as wanted",
    "hold": "was held",
    "fault": "ended in a fault",
}


def in_full(outcome: str, signal: str | None = None) -> str:
    """How a run ended, for people: as wanted, unless a ``signal`` ended it."""
    if outcome == "idle" and signal:
        return "was ended by Ctrl-C" if signal == "SIGINT" else f"was ended by {signal}"
    return _OUTCOMES.get(outcome, outcome)


def figures_of_merit(log: Log) -> dict[str, float]:
    """Numbers of a log, with units in their names; {} of a log without ticks.

    Raises:
        InvalidInput: the log is so damaged that its ticks do not hold what figures are made of.
    """
    ticks = log.ticks
    if len(ticks.get("time", ())) < 2:
        return {}
    check_ticks(log)
    time, error = ticks["time"], ticks["q_target"] - ticks["q"]
    found = {
        "seconds": float(time[-1] - time[0]),
        "rate_hz": float((len(time) - 1) / (time[-1] - time[0])),
        "tracking_rms_rad": float(np.sqrt(np.nanmean(error**2))),
        "tracking_worst_rad": float(np.nanmax(np.abs(error))),
        "torque_rms_nm": float(np.sqrt(np.nanmean(ticks["torque"] ** 2))),
        "torque_worst_nm": float(np.nanmax(np.abs(ticks["torque"]))),
        "late_over_1ms": float(np.nanmean(ticks["lateness"] > 1e-3)),
        "lateness_p99_s": float(np.nanpercentile(ticks["lateness"], 99)),
        "stale_joints": float(1.0 - np.nanmean(ticks["fresh"])),
        "mean_contacts": float(np.nanmean(ticks["in_contact"].sum(axis=1))),
    }
    turn = object_turn(log)
    if turn is not None:
        angle, held = turn
        found[turn_figure(log)] = float(angle[-1])
        turning = np.flatnonzero(held & (ticks.get("state", np.full(len(time), "run")) == "run"))
        if len(turning) > 1:  # neither the approach nor what follows the end counts
            first, last = turning[[0, -1]]
            found["turning_speed_rad_s"] = float(
                (angle[last] - angle[first]) / (time[last] - time[first])
            )
        if not held[-1]:
            found["object_lost_at_s"] = float(time[held.sum()])
    left = left_to_goal(log)
    if left is not None:
        found["left_to_goal_rad"] = float(left[-1])
        if (left < GOAL_ANGLE).any():
            found["goal_reached_at_s"] = float(time[np.argmax(left < GOAL_ANGLE)])
    return found


_DIMENSIONS = {"time": 1, "lateness": 1, "q": 2, "q_target": 2, "torque": 2, "fresh": 2,
               "in_contact": 2, "contact_force": 2}  # fmt: skip


def check_ticks(log: Log) -> None:
    """InvalidInput unless the ticks are a run's: numbers of the right shapes, times that rise."""
    for name, dimensions in _DIMENSIONS.items():
        column = log.ticks.get(name)
        if column is None or column.dtype == object or column.ndim != dimensions:
            raise InvalidInput(
                f"{log.path}: its ticks hold no {name}; the log is damaged, or not of a run"
            )
    joints = {log.ticks[name].shape for name in ("q", "q_target", "torque", "fresh")}
    if len(joints) > 1:
        raise InvalidInput(f"{log.path}: its ticks differ in how many joints; the log is damaged")
    time = log.ticks["time"]
    if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
        raise InvalidInput(f"{log.path}: the times of its ticks do not rise; the log is damaged")


def in_words(figures: Mapping[str, float]) -> list[tuple[str, str]]:
    """Figures of merit as rows of what and how much, for people."""
    rows = []
    for name, value in figures.items():
        words, unit, scale = _WORDS[name]
        rows.append((words, f"{scale * value:.4g} {unit}".rstrip()))
    return rows


def object_turn(log: Log) -> tuple[Floats, Bools] | None:
    """How far the object is turned, and whether it is held, at each tick.

    It is turned about z, or about the axis of the angular velocity that the run was told.

    ``(T,)`` [rad] since the first tick, and ``(T,)`` bool: False once the object is farther from
    where it began than `dexctl.sim.trial.DROP_DISTANCE`; from there on the angle stands still. On a
    real hand it is as a tracker told it, or as the controller tracked it by touch
    (`TrackedByTouch`); None where neither did.
    """
    from dexctl.sim.trial import DROP_DISTANCE, rotation_about

    pose = _object_pose(log)
    if pose is None:
        return None
    position, quaternion = pose
    away = np.linalg.norm(position - position[0], axis=1)
    held = np.logical_and.accumulate(away <= DROP_DISTANCE)
    return rotation_about(quaternion, _told_axis(log) or (0.0, 0.0, 1.0), held), held


def turn_figure(log: Log) -> str:
    """Of `figures_of_merit`, the one that says how far the object was turned."""
    return "rotation_rad" if _told_axis(log) is None else "rotation_as_told_rad"


def title(figure: str) -> str:
    """What people read of a figure, and its unit."""
    words, unit, _ = _WORDS[figure]
    return f"{words} [{unit}]"


def _told_axis(log: Log) -> tuple[float, float, float] | None:
    """The axis that the run was told to turn the object about; None where it was told none."""
    spin = log.run.get("goal_angular_velocity")
    if not _finite(spin, 3) or not any(spin):
        return None
    x, y, z = (np.array(spin) / np.linalg.norm(spin)).tolist()
    return x, y, z


def left_to_goal(log: Log) -> Floats | None:
    """The angle to the run's goal orientation at each tick, ``(T,)`` [rad]; None without one."""
    goal, pose = log.run.get("goal_quaternion"), _object_pose(log)
    if pose is None or not _finite(goal, 4):
        return None
    return angle_between(pose[1], np.array(goal, float))


def _object_pose(log: Log) -> tuple[Floats, Floats] | None:
    """Where the object is at each tick: as the emulator knows, a tracker or the controller told."""
    none = np.empty(0)
    for whose in ("object", "tracked"):
        position, quaternion = (
            log.ticks.get(f"{whose}_{what}", none) for what in ("position", "quaternion")
        )
        if all(
            values.dtype != object and values.shape[1:] == (size,)
            for values, size in ((position, 3), (quaternion, 4))
        ):
            return position, quaternion
    return _tracked_by_touch(log)


def _tracked_by_touch(log: Log) -> tuple[Floats, Floats] | None:
    """Where the controller's tracking had the object, at each tick; as last where it is silent."""
    found = {}
    for i, said in enumerate(log.ticks.get("diagnostics", ())):
        if isinstance(said, Mapping):
            pose = (said.get("tracked_position"), said.get("tracked_quaternion"))
            if _finite(pose[0], 3) and _finite(pose[1], 4):
                found[i] = pose
    if not found:
        return None
    last = np.searchsorted(list(found), np.arange(len(log.ticks["time"])), side="right") - 1
    position, quaternion = (np.array(one, float) for one in zip(*found.values(), strict=True))
    return position[np.maximum(last, 0)], quaternion[np.maximum(last, 0)]


def _finite(value: object, size: int) -> TypeGuard[list[float]]:
    """Whether it is a list of so many finite numbers."""
    if not isinstance(value, list) or any(type(one) not in (int, float) for one in value):
        return False
    return len(value) == size and bool(np.isfinite(value).all())
