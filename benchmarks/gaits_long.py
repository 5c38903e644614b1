"""The coordinated gait for ten minutes: does it hold the object where it was, by its fingertips?

Written after every row; `--resume` goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

from gaits import EASY, steadiness
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.trials import PALMS, outcome, trials

import dexctl
from dexctl import controllers
from dexctl.sim import SceneConfig

DRIFT = 10.0  # largest that is asked for [mm]
FINGERTIPS = 0.995  # least share of samples in which only fingertips touch


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 100
    """First seed; trial i has the seed seed + i."""
    trials: int = 4
    """Per object and palm direction."""
    seconds: float = 600.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = EASY
    """Objects to turn."""


def figures_of(rows: list[dict[str, Any]]) -> list[Figure]:
    """Whether the drift and the touching stay within what is asked for, on every object."""
    seconds, count = rows[0]["seconds"], sum(row["holding"]["of"] for row in rows)
    held = sum(row["holding"]["count"] for row in rows)
    drift = max(row["drift_mm"]["largest"] for row in rows)
    least = min(row["only_fingertips"] for row in rows)
    where = f"coordinated gait, {seconds:g} s, {len(rows)} objects and palm directions, "
    where += f"{rows[0]['holding']['of']} trials each"
    return [
        Figure(f"{where}: still held", f"{held} of {count}", "all", held == count),
        Figure(
            f"{where}: largest drift of the object",
            f"{drift:.1f} mm",
            f"below {DRIFT:g} mm",
            drift < DRIFT,
        ),
        Figure(
            f"{where}: samples in which only fingertips touch, least",
            f"{100 * least:.2f} %",
            f"at least {100 * FINGERTIPS:g} %",
            least >= FINGERTIPS,
        ),
    ]


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    lines = [
        [
            f"{row['object']}, {row['palm']}",
            f"{row['rotation_rad']['median']:.0f}",
            f"{row['holding']['count']} of {row['holding']['of']}",
            f"{row['drift_mm']['median']:.0f}",
            *steadiness(row),
        ]
        for row in rows
    ]
    table = {
        "title": f"Coordinated gait, {given.seconds:g} s, {given.trials} trials each",
        "header": [
            "Object, palm", "Rotation: median [rad]", "Still held", "Largest drift: median [mm]",
            "of all [mm]", "Only fingertips touch",
        ],
        "rows": lines,
    }  # fmt: skip
    write("gaits_long", given, figures_of(rows), [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("gaits_long", given)
    done = {(row["object"], row["palm"]) for row in rows}
    for name, palm in product(given.objects, PALMS):
        if (name, palm) in done:
            continue
        controller = controllers.make("coordinated", dexctl.hands.load("dex5"))
        config = SceneConfig(object=(name,), gravity=palm)
        trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
        rows.append({"object": name, "palm": palm, "seconds": given.seconds, **outcome(trace)})
        progress(f"{name}, palm {palm}: {' | '.join(steadiness(rows[-1]))}")
        save(rows, given, say=False)
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
