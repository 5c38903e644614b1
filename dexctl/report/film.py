"""What a video of a trial needs, kept while the trial runs, drawn when there is time for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.state import Bools, Floats

if TYPE_CHECKING:
    from dexctl.sim.record import Recorder


@dataclass(frozen=True)
class Moment:
    """One control step of one environment, as `Recorder` looks at a simulator.

    Attributes:
        time: simulated [s].
        qpos: MuJoCo's generalised positions ``(nq,)``.
        in_contact: which fingertips touch, ``(m,)``.
    """

    time: float
    qpos: Floats
    in_contact: Bools

    def read(self) -> Any:
        """A state with the touch in it."""
        return SimpleNamespace(in_contact=self.in_contact)


@dataclass
class Film:
    """Give it to `dexctl.sim.run` as an observer; keeps environment ``env``.

    Simulating ten seconds takes less than one, drawing them a quarter of a minute: so trials run
    first, and the drawing is done afterwards, of as much as is wanted.
    """

    env: int = 0
    moments: list[Moment] = field(default_factory=list)

    def __call__(self, sim: Any) -> None:
        """Keep where ``sim`` is now."""
        time, qpos = np.atleast_1d(sim.time), np.atleast_2d(sim.qpos)
        touch = np.atleast_2d(sim.read().in_contact)
        self.moments.append(Moment(float(time[self.env]), qpos[self.env], touch[self.env]))

    def at(self, time: float) -> Moment:
        """The moment nearest to ``time`` [s]."""
        return min(self.moments, key=lambda moment: abs(moment.time - time))

    def play(
        self,
        recorder: Recorder,
        caption: Callable[[int], str],
        *,
        until: float = np.inf,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        """Draw the film up to ``until`` [s] into a recorder's video.

        Args:
            recorder: what draws and writes.
            caption: the text for moment i.
            until: simulated time where to stop [s].
            progress: called with the simulated time drawn so far [s].
        """
        for i, moment in enumerate(self.moments):
            if moment.time > until:
                break
            recorder.caption = caption(i)
            recorder(moment)
            if progress is not None:
                progress(moment.time)
