"""Evaluation: what came of a rollout, in figures with intervals.

Episodes are independent, so intervals are over them; claims about a method need several seeds of
training (`dexctl.statistics`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats
from dexctl.statistics import Estimate, bootstrap, wilson
from learning.envs.tasks import NO_GOALS
from learning.evaluation.judged import Judged
from learning.evaluation.protocol import Protocol

if TYPE_CHECKING:
    from dexctl.sim import Scene, Trace

FULL_TURN = 2.0 * np.pi
# rotation over time is kept at no more moments than this, so that many evaluations stay small
_MOMENTS = 120


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """What came of N episodes with one object; arrays are ``(N,)``.

    An episode ends where its object is lost, as a success where its last goal is reached, or with
    the protocol's time.

    Attributes:
        object: its name.
        protocol: as evaluated.
        rotation: about the task's axis, or those that it commanded, up to the drop or the end
            [rad].
        time_held: until then [s].
        dropped: whether it was dropped; a simulation that broke down counts as dropped.
        strayed: whether its centre went further than half the drop distance, or it was dropped.
        time_near: until then, or the end [s].
        diverged: whether the simulation broke down.
        returns: sum of the task's reward up to the drop or the end [rad/s].
        goals_reached, goals_missed, goals_in_a_row, first_goal_time: see `Goals`; without goals 0,
            and no time is finite.
        fingertips_only: share of the time held in which nothing but fingertips touched.
        drift: how far the object's centre was from where it started, at most, while it was held
            [m].
        mean_drift: the same on average over the time held [m].
        sink: the same along gravity, as it was in that episode at that time; 0 where it never was
            below its start, or where there is no gravity [m].
        moments: times ``(K,)`` [s], from 0 to the end.
        rotations: at these moments, standing still from the drop or the end on, ``(K, N)`` [rad].
    """

    object: str
    protocol: Protocol
    rotation: Floats
    time_held: Floats
    dropped: Bools
    strayed: Bools
    time_near: Floats
    diverged: Bools
    returns: Floats
    goals_reached: NDArray[np.int64]
    goals_missed: NDArray[np.int64]
    goals_in_a_row: NDArray[np.int64]
    first_goal_time: Floats
    fingertips_only: Floats
    drift: Floats
    mean_drift: Floats
    sink: Floats
    moments: Floats
    rotations: Floats

    @classmethod
    def of(cls, trace: Trace, scene: Scene, protocol: Protocol, judged: Judged) -> Evaluation:
        """The evaluation of a trace of N episodes in ``scene``, as the task judged them."""
        steps, within, held = len(trace.time) - 1, judged.within(), judged.held(trace)
        counts = held & within
        moments = np.unique(np.linspace(0, steps, min(_MOMENTS, steps) + 1).round().astype(int))
        goals, rotation = judged.goals(trace), trace.rotation
        if protocol.task.goals == NO_GOALS and protocol.task.turning.commands:
            rotation = judged.rotation
        last = np.maximum.accumulate(np.where(counts, np.arange(steps + 1)[:, None], 0), axis=0)
        rotation = np.take_along_axis(rotation, last, axis=0)
        alone = (counts & (trace.other_contact == 0.0)).sum(axis=0)
        away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
        near = np.logical_and.accumulate(
            held & (away <= protocol.task.holding.drop_distance / 2), axis=0
        )
        return cls(
            object=scene.object,
            protocol=protocol,
            rotation=rotation[-1],
            time_held=trace.time[counts.sum(axis=0) - 1],
            dropped=np.asarray((within & ~held).any(axis=0)),
            strayed=np.asarray((within & ~near).any(axis=0)),
            time_near=trace.time[(within & near).sum(axis=0) - 1],
            diverged=np.asarray((within & trace.diverged).any(axis=0)),
            returns=judged.returns(trace),
            goals_reached=goals.reached,
            goals_missed=goals.missed,
            goals_in_a_row=goals.in_a_row,
            first_goal_time=goals.first_time,
            fingertips_only=alone / counts.sum(axis=0),
            drift=away.max(axis=0, where=counts, initial=0.0),
            mean_drift=away.mean(axis=0, where=counts),
            sink=np.where(counts, sunk(trace, judged.gravity), 0.0).max(axis=0),
            moments=trace.time[moments],
            rotations=rotation[moments],
        )

    @property
    def speed(self) -> Floats:
        """Mean angular velocity while held, ``(N,)`` [rad/s]; 0 where it was not held at all."""
        held = self.time_held > 0
        return np.where(held, self.rotation / np.where(held, self.time_held, 1.0), 0.0)

    def held(self, moments: Floats, *, near: bool = False) -> Floats:
        """How many episodes still hold the object, ``(K,)``, at times ``(K,)`` [s].

        One that has ended as a success does, from then on.

        Args:
            moments: the times.
            near: by the stricter rule: hold it within half the drop distance.
        """
        gone, ended = (self.strayed, self.time_near) if near else (self.dropped, self.time_held)
        gone = np.where(gone, ended, np.inf)
        return (gone >= moments[:, None]).sum(axis=1)

    def survival(self, *, near: bool = False) -> tuple[Floats, Floats]:
        """Times ``(K,)`` [s] after which fewer hold the object, and the share that does ``(K,)``.

        Every episode ends at the same time, so this is the Kaplan-Meier estimate; but that one
        which has ended as a success counts as holding it. It begins at time 0; the share of a time
        holds from right after it to the next.

        Args:
            near: by the stricter rule: hold it within half the drop distance.
        """
        ends = self.time_near[self.strayed] if near else self.time_held[self.dropped]
        times = np.unique([0.0, *ends])
        return times, 1.0 - (ends <= times[:, None]).sum(axis=1) / len(self.rotation)

    def figures(self) -> dict[str, Estimate]:
        """Medians and means with 95 % bootstrap intervals, shares with Wilson's.

        The time to failure is the time held: in the episodes that did not fail, all of it.
        """
        count = len(self.rotation)
        goals = {} if self.protocol.task.goals == NO_GOALS else self._goals()
        return goals | {
            "rotation_median_rad": bootstrap(self.rotation, "median"),
            "revolutions_median": bootstrap(self.rotation / FULL_TURN, "median"),
            "speed_mean_rad_s": bootstrap(self.speed, "mean"),
            "time_held_median_s": bootstrap(self.time_held, "median"),
            "return_mean": bootstrap(self.returns, "mean"),
            "share_dropped": wilson(int(self.dropped.sum()), count),
            "share_strayed": wilson(int(self.strayed.sum()), count),
            "share_full_turn": wilson(int((self.rotation >= FULL_TURN).sum()), count),
            "share_fingertips_only": bootstrap(self.fingertips_only, "mean"),
            "drift_median_m": bootstrap(self.drift, "median"),
            "mean_drift_median_m": bootstrap(self.mean_drift, "median"),
            "sink_median_m": bootstrap(self.sink, "median"),
        }

    def _goals(self) -> dict[str, Estimate]:
        """Of goals, which an episode's share is of: those that were reached, missed or dropped.

        The first goal's time is that of all episodes; not reached, it counts as the time that
        there is for one. First goals of episodes are independent, those that follow are not.
        """
        resolved = self.goals_reached + self.goals_missed + self.dropped
        share = self.goals_reached / np.maximum(resolved, 1)
        longest = min(self.protocol.task.reorientation.goal_seconds, self.protocol.seconds)
        reached = np.isfinite(self.first_goal_time)
        return {
            "share_first_goal_reached": wilson(int(reached.sum()), len(reached)),
            "share_goals_reached": bootstrap(share, "mean"),
            "first_goal_median_s": bootstrap(np.minimum(self.first_goal_time, longest), "median"),
            "goals_in_a_row_median": bootstrap(self.goals_in_a_row.astype(float), "median"),
            "goals_reached_mean": bootstrap(self.goals_reached.astype(float), "mean"),
        }

    def to_dict(self) -> dict[str, Any]:
        """The figures and the survival curve, as JSON can hold them."""
        found: dict[str, Any] = {name: one.to_dict() for name, one in self.figures().items()}
        times, shares = self.survival()
        found["survival"] = {"time_s": times.tolist(), "share_held": shares.tolist()}
        times, shares = self.survival(near=True)
        found["survival_near"] = {"time_s": times.tolist(), "share_held": shares.tolist()}
        return found | {"diverged": int(self.diverged.sum())}


def sunk(trace: Trace, gravity: Floats) -> Floats:
    """How far the object is from its start along ``gravity``, ``(T+1, N)`` [m].

    Args:
        trace: of N episodes.
        gravity: in each row, ``(T+1, N, 3)``; 0 where there is none.
    """
    moved = trace.object_position - trace.object_position[0]
    size = np.linalg.norm(gravity, axis=-1)
    along = (moved * gravity).sum(axis=-1)
    return np.asarray(np.where(size > 0, along / np.where(size > 0, size, 1.0), 0.0))
