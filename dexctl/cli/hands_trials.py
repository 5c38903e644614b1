"""What the coordinated gait, and plain holding, make of a grasp of a hand, in trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dexctl.cli.hand_checks import check_holding
from dexctl.exceptions import SimulationError
from dexctl.hand_config import HandConfig
from dexctl.validation import check_numbers, check_whole

COUNTS = {"up": 1.0, "down": 0.5}
"""What a turn counts, by palm."""
_STAYS = 0.02  # how far from where it was grasped an object counts as held [m]


@dataclass(frozen=True, kw_only=True)
class Turning:
    """How suggested grasps are tried with the coordinated gait: all in short, the best longer."""

    grasps: int = 5
    """Of each object; 0: none is tried, and the one of the highest score is taken."""
    screening: float = 12.0
    """Simulated, each trial of every grasp [s]."""
    screening_trials: int = 4
    """Of every grasp there, palm up, and where it is turned so, palm down."""
    rounds: int = 4
    """How often the surroundings of those turned furthest are searched for better ones, which are
    tried as those before; 0: not."""
    around: int = 4
    """Grasps whose surroundings are searched in each round, and grasps that are taken of each."""
    finalists: int = 3
    """Of all objects together, which are tried again, longer; of those that plain holding holds,
    as ``dexctl hands check`` wants it, where there are so many."""
    seconds: float = 60.0
    """Simulated, each trial of these [s]: many a drop comes late."""
    trials: int = 16
    """Of each of these, each way up."""

    def __post_init__(self) -> None:
        check_whole(self, grasps=0, rounds=0, around=1, finalists=1, trials=1, screening_trials=1)
        check_numbers(self, positive=("screening", "seconds"))

    def screened(self, grasps: int) -> float:
        """Simulated with so many and with those around the best; all trials at once [s]."""
        return len(COUNTS) * self.screening * (grasps + self.rounds * self.around**2)


class Turned(NamedTuple):
    """What the gait made of a grasp.

    Attributes:
        held: share of the trials that still hold the object, by palm.
        rotation: median rotation up to the end or the drop, by palm [rad].
        clear: share of the time in which nothing but fingertips touches, by palm.
        trials: of each palm.
        seconds: of each [s].
    """

    held: dict[str, float]
    rotation: dict[str, float]
    clear: dict[str, float]
    trials: int
    seconds: float

    @property
    def value(self) -> float:
        """What grasps are compared by: turns that are held to the end, palm up before palm down.

        Links that touch count against them as drops do: they are what the next drop comes from.
        """
        return sum(
            COUNTS[palm] * (held * self.clear[palm]) ** 2 * max(self.rotation[palm], 0.0)
            for palm, held in self.held.items()
        )

    @property
    def note(self) -> str:
        """What came of it, in one line."""
        parts = [
            f"palm {palm} {self.rotation[palm]:.1f} rad, {round(self.held[palm] * self.trials)} of "
            f"{self.trials} hold"
            for palm in self.held
        ]
        return f"the coordinated gait, {self.seconds:g} s each: {'; '.join(parts)}"


def turned(
    config: HandConfig, name: str, palms: Sequence[str], trials: int, seconds: float, seed: int
) -> Turned:
    """Trials of the coordinated gait with the object as a hand's configuration says it."""
    from dexctl.gait import CoordinatedGait
    from dexctl.sim import SceneConfig, Simulation, run

    hand = config.build()
    held, rotation, clear = (dict.fromkeys(palms, 0.0) for _ in range(3))
    for palm in palms:
        scene = SceneConfig(hand=str(config.description), object=(name,), gravity=palm)
        try:
            sim = Simulation(scene, trials, seed, hand=hand)
        except SimulationError:  # with the digits of a toml, it does not settle
            continue
        with sim:
            gait = CoordinatedGait(hand, control_period=scene.control_period)
            sim.reset(seed)
            gait.reset(seed)
            trace = run(gait, sim, seconds, until_dropped=True)
        away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
        stays = trace.held[-1] & (away.max(axis=0) < _STAYS)  # does not lie on the palm
        held[palm] = float(stays.mean())
        rotation[palm] = float(np.median(trace.final_rotation))
        clear[palm] = 1.0 - float((trace.other_contact > 0)[trace.held].mean())
    return Turned(held, rotation, clear, trials, seconds)


def holds(config: HandConfig, name: str, seed: int) -> bool:
    """Whether plain holding holds an object, palm up and down, as ``dexctl hands check`` wants."""
    hand = config.build()
    return all(bool(check_holding(hand, name, palm, seed=seed).good) for palm in ("up", "down"))
