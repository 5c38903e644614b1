"""Where and why drops begin.

From each drop we walk back to the last moment at which the grasp was sound. What failed first after
it is the cause. The rule, with the numbers of `DropRule`:

A grasp is *sound* where enough fingertips touch, they have force closure, nothing else touches the
object, and the object is tilted by no more than the task rewards. Only spells of at least 0.5 s
count: on the way down contacts flicker. The *onset* is the end of the last sound spell before the
drop. Its cause is the first of these that holds:

1. the simulation broke down at the drop (`broke_down`);
2. there was no sound spell (`never_sound`);
3. the grasp was sound up to the drop: the fingers carried the object out of bounds (`carried_off`);
4. something other than a fingertip touched the object (`palm_or_link`);
5. the object was tilted too far (`tilted`);
6. a finger let go, and in the 0.25 s before it
   a joint of it had its set-point at the end of its range (`out_of_reach`), or
   its set-point was taken back from the object by 3 mm or more (`lifted`), or
   it slid over the object by 3 mm or more (`slipped`), or
   neither: the object went away from it (`lost_touch`);
7. all fingers kept touching, but their forces no longer close (`no_closure`).

Several may hold at once; the others are kept as signs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.state import Bools, Floats
from learning.inspection.gait import runs

if TYPE_CHECKING:
    from dexctl.sim import Trace
    from learning.envs.turning import TurningConfig
    from learning.inspection.grasps import Grasps

CAUSES: Mapping[str, str] = {
    "slipped": "a finger slid off",
    "lifted": "a finger was lifted and the others did not hold",
    "out_of_reach": "a finger let go at the end of a joint's range",
    "lost_touch": "the object went away from a finger",
    "no_closure": "contacts stayed, their forces no longer closed",
    "palm_or_link": "the palm or a link touched the object",
    "tilted": "the object tilted too far",
    "carried_off": "carried out of bounds in a sound grasp",
    "never_sound": "the grasp was never sound",
    "broke_down": "the simulation broke down",
}
"""The causes, in words."""


@dataclass(frozen=True, kw_only=True)
class DropRule:
    """The numbers of the rule.

    Attributes:
        fingertips: that a sound grasp has at least.
        tilt: that it has at most [rad].
        spell: shortest that counts [s].
        window: before a finger lets go, looked at for why [s].
        retreat: of a set-point along the normal that counts as lifting [m].
        slip: over the object that counts as slipping [m].
    """

    fingertips: int = 3
    tilt: float = 0.5
    spell: float = 0.5
    window: float = 0.25
    retreat: float = 0.003
    slip: float = 0.003

    @classmethod
    def of(cls, task: TurningConfig) -> DropRule:
        """The rule with fingertips and tilt as the task rewards them."""
        return cls(fingertips=task.min_fingertips, tilt=task.max_tilt)


@dataclass(frozen=True, eq=False)
class Moments:
    """What the rule looks at, of one episode of T control steps.

    Attributes:
        in_contact: ``(T+1, m)`` bool.
        closure: ``(T+1,)`` bool.
        other_contact: of the object with all but fingertips, ``(T+1,)`` [N].
        tilt: ``(T+1,)`` [rad].
        slip, advance: see `Grasps`, ``(T, m)`` [m].
        at_limit: see `Grasps`, ``(T+1, m)`` bool.
        held: ``(T+1,)`` bool, True up to the drop.
        diverged: ``(T+1,)`` bool.
    """

    in_contact: Bools
    closure: Bools
    other_contact: Floats
    tilt: Floats
    slip: Floats
    advance: Floats
    at_limit: Bools
    held: Bools
    diverged: Bools

    def sound(self, rule: DropRule) -> Bools:
        """Where the grasp is sound, ``(T+1,)``."""
        return (
            (self.in_contact.sum(axis=-1) >= rule.fingertips)
            & self.closure
            & (self.other_contact == 0.0)
            & (self.tilt <= rule.tilt)
        )


@dataclass(frozen=True, eq=False)
class Drop:
    """How one drop began.

    Attributes:
        episode: which.
        cause: one of `CAUSES`.
        onset: last row of the last sound spell; -1 where there was none.
        drop: first row at which the object counts as dropped.
        fingers: that let go right after the onset, counted from 0.
        contacts: fingertips that touched right after it.
        closed: whether these still closed.
        signs: other causes that held as well.
        period: of a row [s].
    """

    episode: int
    cause: str
    onset: int
    drop: int
    fingers: tuple[int, ...]
    contacts: int
    closed: bool
    signs: tuple[str, ...]
    period: float

    @property
    def lead(self) -> float:
        """From onset to drop [s]."""
        return (self.drop - max(self.onset, 0)) * self.period

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "episode": self.episode,
            "cause": self.cause,
            "onset_s": None if self.onset < 0 else self.onset * self.period,
            "drop_s": self.drop * self.period,
            "lead_s": self.lead,
            "fingers": [i + 1 for i in self.fingers],
            "contacts_left": self.contacts,
            "closure_left": self.closed,
            "signs": list(self.signs),
        }


def find_drop(
    moments: Moments, period: float, rule: DropRule | None = None, episode: int = 0
) -> Drop | None:
    """How the drop of an episode began; None where there was none."""
    rule = rule if rule is not None else DropRule()
    if moments.held[-1]:
        return None
    drop = int(moments.held.sum())
    sound = moments.sound(rule)[:drop]
    least = max(1, round(rule.spell / period))
    spells = [end for start, end in runs(sound) if end - start >= least]
    onset = spells[-1] - 1 if spells else -1
    after = min(onset + 1, drop)
    fingers: tuple[int, ...] = ()
    if moments.diverged[drop]:
        found = ["broke_down"]
    elif onset < 0:
        found = ["never_sound"]
    elif after == drop:
        found = ["carried_off"]
    else:
        lost = moments.in_contact[onset] & ~moments.in_contact[after]
        fingers = tuple(np.flatnonzero(lost).tolist())
        found = _failed(moments, onset, after, lost, max(1, round(rule.window / period)), rule)
    return Drop(
        episode=episode,
        cause=found[0],
        onset=onset,
        drop=drop,
        fingers=fingers,
        contacts=int(moments.in_contact[after].sum()),
        closed=bool(moments.closure[after]),
        signs=tuple(found[1:]),
        period=period,
    )


def _failed(
    moments: Moments, onset: int, after: int, lost: Bools, window: int, rule: DropRule
) -> list[str]:
    """What failed between the rows ``onset`` and ``after``, the first of the rule first."""
    found = []
    if moments.other_contact[after] > 0.0:
        found.append("palm_or_link")
    if moments.tilt[after] > rule.tilt:
        found.append("tilted")
    enough = moments.in_contact[after].sum() >= rule.fingertips
    if enough and moments.closure[after]:
        return found
    if not lost.any():
        return [*found, "no_closure"]
    before = slice(max(after - window, 0), after)
    retreat = -moments.advance[before].sum(axis=0)
    slid = moments.slip[before].sum(axis=0)
    reasons = {
        "out_of_reach": (moments.at_limit[onset] & lost).any(),
        "lifted": (lost & (retreat >= rule.retreat)).any(),
        "slipped": (lost & (slid >= rule.slip)).any(),
    }
    return [*found, *([name for name, holds in reasons.items() if holds] or ["lost_touch"])]


def moments_of(trace: Trace, grasps: Grasps, episode: int) -> Moments:
    """What the rule looks at, of one episode of a trace."""
    return Moments(
        in_contact=trace.in_contact[:, episode],
        closure=grasps.closure[:, episode],
        other_contact=trace.other_contact[:, episode],
        tilt=grasps.tilt[:, episode],
        slip=grasps.slip[:, episode],
        advance=grasps.advance[:, episode],
        at_limit=grasps.at_limit[:, episode],
        held=trace.held[:, episode],
        diverged=trace.diverged[:, episode],
    )


def find_drops(
    trace: Trace, grasps: Grasps, period: float, rule: DropRule | None = None
) -> list[Drop]:
    """How each drop of N episodes began, in the order of the episodes."""
    every = (
        find_drop(moments_of(trace, grasps, i), period, rule, i) for i in range(trace.held.shape[1])
    )
    return [drop for drop in every if drop is not None]
