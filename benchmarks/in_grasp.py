"""In-grasp manipulation, fingers closing in again where they lose touch: 10 s, three objects.

Counts the trials that turn the object by what is asked before any drop.
"""

from __future__ import annotations

from dataclasses import dataclass

from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.shares import percent
from measuring.trials import PALMS, outcome, trials

import dexctl
from dexctl.sim import SceneConfig

TARGETS = {"cube": 0.8, "cylinder": 1.0, "sphere": 1.0}  # [rad]
GOAL, FLOOR = 0.95, 0.85


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 64
    """Per object and palm direction."""
    seconds: float = 10.0
    """Simulated, each trial."""


def main() -> None:
    given = settings(Options, __doc__)
    controller = dexctl.InGraspManipulation(dexctl.hands.load("dex5"))
    rows, figures = [], []
    for name, target in TARGETS.items():
        for palm in PALMS:
            progress(f"{name}, palm {palm}")
            config = SceneConfig(object=(name,), gravity=palm)
            trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
            row = {"object": name, "palm": palm, **outcome(trace, target)}
            rows.append(row)
            figures.append(
                Figure(
                    f"in-grasp manipulation turns the {name} by {target} rad in "
                    f"{given.seconds:g} s, palm {palm}",
                    f"{percent(row['reached'])}, median {row['rotation_rad']['median']:.1f} rad",
                    f"{100 * GOAL:.0f} % of trials (floor {100 * FLOOR:.0f} %)",
                    row["reached"]["share"] >= GOAL,
                )
            )
    write("in_grasp", given, figures, trials=rows)


if __name__ == "__main__":
    main()
