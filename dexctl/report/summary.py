"""Figures of merit of a trace: of one trial, and of many."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.sim import Trace
from dexctl.state import Floats
from dexctl.statistics import wilson

FULL_TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class TrialSummary:
    """What one trial of one controller came to.

    Attributes:
        rotation: about the axis of the run up to the drop or the end [rad].
        time_held: until the drop or the end [s].
        dropped: whether the object was dropped.
        mean_contacts: fingertips in touch, averaged over the time held.
        largest_residual: of the stability QP over the time held, forces in shares of the grip;
            None for a controller that solves none.
        act_time_median, act_time_p99: of one call of the controller [s].
    """

    rotation: float
    time_held: float
    dropped: bool
    mean_contacts: float
    largest_residual: float | None
    act_time_median: float
    act_time_p99: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON; units are in the names."""
        names = {
            "rotation": "rotation_rad",
            "time_held": "time_held_s",
            "act_time_median": "act_time_median_s",
            "act_time_p99": "act_time_p99_s",
        }
        return {names.get(name, name): value for name, value in asdict(self).items()}


def summarise(trace: Trace, index: int = 0) -> TrialSummary:
    """The summary of one trial: of a trace without batch dimension, or of row ``index``."""
    held = column(trace.held, index)
    residual = diagnostic(trace, "residual", index)
    largest = None
    if residual is not None and np.isfinite(residual[held[:-1]]).any():
        largest = float(np.nanmax(residual[held[:-1]]))
    return TrialSummary(
        rotation=float(column(trace.rotation, index)[-1]),
        time_held=float(trace.time[held.sum() - 1]),
        dropped=not held[-1],
        mean_contacts=float(column(trace.in_contact, index, 1)[held].sum(axis=-1).mean()),
        largest_residual=largest,
        act_time_median=float(np.median(trace.act_seconds)),
        act_time_p99=float(np.percentile(trace.act_seconds, 99)),
    )


class Share(NamedTuple):
    """A share of trials with its 95 % Wilson interval."""

    count: int
    trials: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """From 0 to 1."""
        return self.count / self.trials

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**self._asdict(), "share": self.share}


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """What N trials of one controller came to.

    Attributes:
        rotation: of each trial up to the drop or the end, ``(N,)`` [rad].
        time_held: of each, ``(N,)`` [s].
        holding: the share that still held at the end.
        full_turn: the share that turned by 2 pi or more before any drop.
        diverged: how many simulations broke down (they count as dropped).
        mean_contacts: fingertips in touch over the time held, averaged over trials.
        act_time_median, act_time_p99: of one call of the controller for all N hands [s].
    """

    rotation: Floats
    time_held: Floats
    holding: Share
    full_turn: Share
    diverged: int
    mean_contacts: float
    act_time_median: float
    act_time_p99: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON; units are in the names."""
        return {
            "trials": len(self.rotation),
            "rotation_rad": percentiles(self.rotation),
            "time_held_s": percentiles(self.time_held),
            "holding": self.holding.as_dict(),
            "full_turn": self.full_turn.as_dict(),
            "diverged": self.diverged,
            "mean_contacts": self.mean_contacts,
            "act_time_median_s": self.act_time_median,
            "act_time_p99_s": self.act_time_p99,
            "trial_rotation_rad": self.rotation,
            "trial_time_held_s": self.time_held,
        }


def summarise_batch(trace: Trace) -> BatchSummary:
    """The summary of a trace of N trials."""
    held = trace.held
    if held.ndim != 2:
        raise InvalidInput(f"the trace's states have batch shape {held.shape[1:]}; expected (N,)")
    contacts = trace.in_contact.sum(axis=-1)
    each = (contacts * held).sum(axis=0) / np.maximum(held.sum(axis=0), 1)
    return BatchSummary(
        rotation=trace.final_rotation,
        time_held=trace.time_held,
        holding=share_of(held[-1]),
        full_turn=share_of(trace.final_rotation >= FULL_TURN),
        diverged=int(trace.diverged[-1].sum()),
        mean_contacts=float(each.mean()),
        act_time_median=float(np.median(trace.act_seconds)),
        act_time_p99=float(np.percentile(trace.act_seconds, 99)),
    )


def share_of(successes: np.ndarray) -> Share:
    """The share of True in ``(N,)`` bool, with its 95 % Wilson interval."""
    count, trials = int(successes.sum()), len(successes)
    found = wilson(count, trials)
    return Share(count, trials, found.low, found.high)


def percentiles(values: Floats) -> dict[str, float]:
    """Median, 10th and 90th percentile of ``(N,)``."""
    low, middle, high = np.percentile(values, [10, 50, 90])
    return {"median": float(middle), "p10": float(low), "p90": float(high)}


def column(values: np.ndarray, index: int = 0, trailing: int = 0) -> np.ndarray:
    """Trial ``index`` of ``(T, ..., *trailing dimensions)``; without batch, ``values`` itself."""
    return values[:, index] if values.ndim - trailing == 2 else values


def diagnostic(trace: Trace, name: str, index: int = 0, trailing: int = 0) -> np.ndarray | None:
    """A controller's diagnostic of one trial, ``(T, *trailing)``; None where it has none.

    A superposition's diagnostics carry the index of its part in front ("0.residual").
    """
    for key, values in trace.diagnostics.items():
        if key.rpartition(".")[2] == name:
            return column(np.asarray(values), index, trailing)
    return None
