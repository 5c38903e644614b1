"""Gait statistics: how fingers take turns, from which of them touch when."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats

FEWEST = 5
"""A phase is the mean of at least this many."""
LEAST = 0.1
"""Gaps and touches shorter than this are chatter, no steps of the gait [s]."""


@dataclass(frozen=True, eq=False)
class GaitStatistics:
    """How m fingers took turns over N episodes, while the object was held.

    A lift is the end of a touch, once gaps and then touches shorter than `least` are taken out.

    Attributes:
        seconds: held, of all episodes together [s].
        duty: share of this time that each finger touches, ``(m,)``.
        lifts: of each finger, ``(m,)``.
        stance, swing: medians of how long a finger stays on and off between two lifts or landings,
            ``(m,)`` [s]; NaN where it never did.
        chatter: touches and gaps shorter than `least`, ``(m,)``.
        contacts: share of the time that 0 to m fingers touch, ``(m + 1,)``.
        order: how often finger j was the next to lift after finger i, ``(m, m)``.
        reference: the finger that lifted most; its lifts begin the cycles of the next three; -1
            where there are fewer than `FEWEST` cycles.
        phase: where in the cycle each finger lifts, ``(m,)``, circular mean, from 0 to 1; NaN
            of fewer than `FEWEST` lifts.
        regularity: length of the mean vector of these phases, ``(m,)``; 1 where they are always
            the same, near 0 where there is no order.
        cycles: how many lifts each phase is of, ``(m,)``.
        least: [s].
    """

    seconds: float
    duty: Floats
    lifts: NDArray[np.int64]
    stance: Floats
    swing: Floats
    chatter: NDArray[np.int64]
    contacts: Floats
    order: NDArray[np.int64]
    reference: int
    phase: Floats
    regularity: Floats
    cycles: NDArray[np.int64]
    least: float

    @property
    def lift_rate(self) -> Floats:
        """Contact switches of each finger, ``(m,)`` [1/s]."""
        return self.lifts / self.seconds if self.seconds > 0 else np.zeros(len(self.lifts))

    @property
    def steps_round(self) -> Floats:
        """Share of lifts after which the next was by the finger k further on, ``(m,)``, k from 0.

        k = 1 is the next finger in the hand's order, m - 1 the one before.
        """
        m = len(self.order)
        offset = (np.arange(m)[None, :] - np.arange(m)[:, None]) % m
        count = np.bincount(offset.ravel(), weights=self.order.ravel(), minlength=m)
        return count / max(count.sum(), 1.0)

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it; units are in the names."""
        return {
            "held_s": self.seconds,
            "duty_factor": self.duty,
            "lifts": self.lifts,
            "lifts_per_s": self.lift_rate,
            "stance_median_s": self.stance,
            "swing_median_s": self.swing,
            "chatter": self.chatter,
            "fingers_in_contact_share": self.contacts,
            "next_to_lift": self.order,
            "steps_round_share": self.steps_round,
            "phase_reference_finger": self.reference + 1,
            "phase": self.phase,
            "phase_regularity": self.regularity,
            "phase_lifts": self.cycles,
            "least_s": self.least,
        }


def runs(active: Bools) -> list[tuple[int, int]]:
    """(first, one past the last) of each run of True in ``(T,)``."""
    edges = np.diff(np.concatenate([[0], np.asarray(active, bool).astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist()
    return list(zip(starts, ends, strict=True))


def steady(touch: Bools, least: int) -> tuple[Bools, int]:
    """``touch`` ``(T,)`` without gaps, and then without touches, shorter than ``least`` rows.

    Those at either end stay: nobody knows how long they are. Returns how many were taken out too.
    """
    out, taken = np.array(touch, bool), 0
    for value in (False, True):
        for start, end in runs(out == value):
            if start > 0 and end < len(out) and end - start < least:
                out[start:end] = not value
                taken += 1
    return out, taken


def gait_statistics(
    in_contact: Bools, held: Bools, period: float, least: float = LEAST
) -> GaitStatistics:
    """The gait of N episodes.

    Args:
        in_contact: ``(T, N, m)``.
        held: rows that count, ``(T, N)``: True up to the drop.
        period: between two rows [s].
        least: see `GaitStatistics` [s].
    """
    count, m = held.shape[1], in_contact.shape[-1]
    rows = max(1, round(least / period))
    chatter = np.zeros(m, np.int64)
    stance: list[list[float]] = [[] for _ in range(m)]
    swing: list[list[float]] = [[] for _ in range(m)]
    episodes: list[list[tuple[int, int]]] = []
    for n in range(count):
        touch = in_contact[: int(held[:, n].sum()), n]
        lifts: list[tuple[int, int]] = []
        for i in range(m):
            clean, taken = steady(touch[:, i], rows)
            chatter[i] += taken
            lifts += [(end, i) for _, end in runs(clean) if end < len(clean)]
            stance[i] += _inner(clean, period)
            swing[i] += _inner(~clean, period)
        episodes.append(sorted(lifts))
    order = np.zeros((m, m), np.int64)
    lifted = np.zeros(m, np.int64)
    for lifts in episodes:
        for _, i in lifts:
            lifted[i] += 1
        for (_, i), (_, j) in pairwise(lifts):
            order[i, j] += 1
    held_rows = held[..., None]
    total = max(int(held.sum()), 1)
    touching = (in_contact & held_rows).sum(axis=-1)[held]
    reference, phase, regularity, cycles = _phases(episodes, lifted, m)
    return GaitStatistics(
        seconds=float(held.sum() * period),
        duty=(in_contact & held_rows).sum(axis=(0, 1)) / total,
        lifts=lifted,
        stance=np.array([np.median(one) if one else np.nan for one in stance]),
        swing=np.array([np.median(one) if one else np.nan for one in swing]),
        chatter=chatter,
        contacts=np.bincount(touching, minlength=m + 1) / total,
        order=order,
        reference=reference,
        phase=phase,
        regularity=regularity,
        cycles=cycles,
        least=least,
    )


def _inner(active: Bools, period: float) -> list[float]:
    """Lengths [s] of the runs of True that begin and end within ``(T,)``."""
    return [(b - a) * period for a, b in runs(active) if a > 0 and b < len(active)]


def _phases(
    episodes: list[list[tuple[int, int]]], lifted: NDArray[np.int64], m: int
) -> tuple[int, Floats, Floats, NDArray[np.int64]]:
    """Where each finger lifts between two lifts of the finger that lifts most."""
    found: list[list[float]] = [[] for _ in range(m)]
    reference = int(lifted.argmax())
    for lifts in episodes:
        marks = [row for row, i in lifts if i == reference]
        for first, last in pairwise(marks):
            for row, i in lifts:
                if first <= row < last:
                    found[i].append((row - first) / (last - first))
    if len(found[reference]) < FEWEST:
        reference = -1
    turns = [
        np.exp(2j * np.pi * np.array(one)).mean() if len(one) >= FEWEST else np.nan for one in found
    ]
    mean = np.array(turns, complex)
    phase = np.angle(mean) / (2.0 * np.pi) % 1.0
    # a phase of -1e-17 is 0, not 1
    phase = np.where(np.isclose(phase, 1.0, atol=1e-9), 0.0, phase)
    return reference, phase, np.abs(mean), np.array([len(one) for one in found], np.int64)
