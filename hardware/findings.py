"""What a person should look at in a log: sentences, each made of a number and a bound."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexctl.state import Bools, Floats
from hardware.log import Log, limits_of
from hardware.state_machine import Event

AT_LIMIT = 0.95
"""A joint is at its torque limit from this share of it on."""
LIMITED_SHARE = 0.05
"""Of the time that a joint may be there before it is told."""
CHATTER = 2.0
"""Touches that a fingertip may make in a second before it is told; a gait makes fewer."""
NEAR = 1.5
"""A force is near the threshold up to so many times it."""
CLAMPED_SHARE = 0.02
"""Of the ticks in which a set-point may be clamped before it is told."""
LATE_SHARE = 0.05
STALE_SHARE = 0.01


def findings(log: Log) -> list[str]:
    """Sentences for people, the gravest first; none where there is nothing to look at."""
    run = running(log)
    if run.sum() < 2:
        return []
    return [
        *_at_torque_limit(log, run),
        *_clamped(log, run),
        *_chattering(log, run),
        *_clock(log, run),
    ]


def running(log: Log) -> Bools:
    """Ticks in which the controller ran, ``(T,)``."""
    state = log.ticks.get("state")
    return np.ones(len(log.ticks["time"]), bool) if state is None else state == "run"


def joint_names(log: Log) -> list[str]:
    """Of the columns of joints."""
    count = log.ticks["q"].shape[1]
    names = log.run.get("joints")
    if isinstance(names, Sequence) and not isinstance(names, str) and len(names) == count:
        return [str(name) for name in names]
    return [f"joint {j + 1}" for j in range(count)]


def torque_limits(log: Log) -> Floats | None:
    """The limit that each joint had in the run, ``(d,)`` [N m], where the log says it."""
    return limits_of(log.run, log.ticks["q"].shape[1], "torque_limit")


def span(values: Floats) -> str:
    """The one number that all values are, or the least and the greatest."""
    low, high = f"{values.min():g}", f"{values.max():g}"
    return low if low == high else f"{low} to {high}"


def touch_thresholds(log: Log) -> tuple[float, ...]:
    """The forces at which a fingertip's touch began and ended [N]; one where they are the same.

    They are those of what told of touch in the run. None where the log does not say them, and none
    of switches, which tell of touch by themselves while the forces are told from the joints.
    """
    sensing = ("scene", "sensing")
    how = _at(log.run, *sensing, "touch")
    if how == "binary":
        return ()
    if how == "joint-torque":
        found = [
            _number(log.run, *sensing, "joint_touch", name)
            for name in ("touch_force", "release_force")
        ]
    else:
        found = [_number(log.run, *sensing, "touch_threshold")]
    known = [force for force in found if force is not None]
    return tuple(dict.fromkeys(known)) if len(known) == len(found) else ()


def shares_at_limit(log: Log, run: Bools) -> Floats:
    """Share of the running time that each joint was at its torque limit, ``(d,)``."""
    limits, torque = torque_limits(log), np.abs(log.ticks["torque"][run])
    if limits is None:
        return np.zeros(torque.shape[1])
    return (torque >= AT_LIMIT * limits).mean(axis=0)


def touches_per_second(log: Log, run: Bools) -> Floats:
    """How often each fingertip began to touch, ``(m,)`` [1/s]."""
    touch, time = log.ticks["in_contact"][run] > 0.5, log.ticks["time"][run]
    made = (touch[1:] & ~touch[:-1]).sum(axis=0)
    return made / max(float(time[-1] - time[0]), 1e-9)


def _at_torque_limit(log: Log, run: Bools) -> list[str]:
    shares, limits = shares_at_limit(log, run), torque_limits(log)
    names = joint_names(log)
    which = [
        f"{names[j]} ({shares[j]:.0%} of the run)"
        for j in np.argsort(-shares)
        if shares[j] > LIMITED_SHARE
    ]
    if limits is None or not which:
        return []
    return [
        f"At the torque limit of {span(limits)} N m: {', '.join(which)}. Blocked, the grasp "
        "too tight or the object too heavy."
    ]


def _clamped(log: Log, run: Bools) -> list[str]:
    counts = log.summary.get("counts")
    count = counts.get(Event.CLAMPED.value) if isinstance(counts, dict) else None
    if not isinstance(count, int) or count <= CLAMPED_SHARE * run.sum():
        return []
    limit = limits_of(log.run, log.ticks["q"].shape[1], "speed_limit")
    speed = "" if limit is None else f", {span(limit)} rad/s,"
    return [
        f"Set-points were clamped in {count} ticks: the controller asks for more than the limit of "
        f"speed{speed} or the joints' range, so the hand lags behind what it wants. A policy holds "
        "better at a pace that needs no clamp (NAME@0.5)."
    ]


def _chattering(log: Log, run: Bools) -> list[str]:
    rates, thresholds = touches_per_second(log, run), touch_thresholds(log)
    each = " and ".join(f"{force:g}" for force in thresholds)
    each = f"the thresholds of {each}" if len(thresholds) > 1 else f"the threshold of {each}"
    said = []
    for finger in np.flatnonzero(rates > CHATTER):
        touch = log.ticks["in_contact"][run][:, finger] > 0.5
        force = float(np.median(log.ticks["contact_force"][run][touch, finger]))
        text = f"Finger {finger + 1} made and lost touch {rates[finger]:.1f} times a second"
        if thresholds and force < NEAR * thresholds[0]:
            text += (
                f", at forces about {each} N (median {force:.1f} N): it presses too weakly to be "
                "told from not touching"
            )
        said.append(f"{text}.")
    return said


def _clock(log: Log, run: Bools) -> list[str]:
    said = []
    late = float(np.nanmean(log.ticks["lateness"][run] > 1e-3))
    if late > LATE_SHARE:
        said.append(
            f"{late:.0%} of the ticks began more than 1 ms late: fewer other programs, real-time "
            "scheduling or a lower --rate."
        )
    stale = 1.0 - log.ticks["fresh"][run].mean(axis=0)
    names = joint_names(log)
    said += [
        f"{names[j]} did not answer in {stale[j]:.0%} of the ticks: look at its cable."
        for j in np.flatnonzero(stale > STALE_SHARE)
    ]
    return said


def _at(tree: object, *path: str) -> object:
    for name in path:
        tree = tree.get(name) if isinstance(tree, dict) else None
    return tree


def _number(tree: object, *path: str) -> float | None:
    value = _at(tree, *path)
    good = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if good else None  # type: ignore[arg-type]
