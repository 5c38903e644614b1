"""The gait of the thesis and the coordinated gait side by side: 60 s, easy and harder objects.

The file is written after every row, so that an interrupted run leaves what it has; `--resume`
goes on from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import percent, percent_interval
from measuring.trials import PALMS, outcome, trials

import dexctl
from dexctl import controllers
from dexctl.sim import SceneConfig

EASY = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
HARDER = ("cuboid_tall", "cuboid_long", "l_shape", "u_shape")
GAITS = {"gait": "thesis", "coordinated": "coordinated"}
FULL_TURN_GOAL = 0.8  # of trials, on the first three
FLOOR = 3.1  # median on the cylinder [rad]
HEADER = (
    "Object, palm",
    *(
        f"{gait}: {what}"
        for gait in GAITS.values()
        for what in ("rotation [rad]", "held [s]", "full turn", "drift [mm]", "only fingertips")
    ),
)


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 64
    """Per object, palm direction and gait."""
    seconds: float = 60.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = (*EASY, *HARDER)
    """Objects to turn."""


def measure(gait: str, name: str, palm: str, given: Options) -> dict[str, Any]:
    """One row: an object, a palm direction, a gait."""
    controller = controllers.make(gait, dexctl.hands.load("dex5"))
    config = SceneConfig(object=(name,), gravity=palm)
    trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
    return {"object": name, "palm": palm, "gait": GAITS[gait], **outcome(trace)}


def cells(row: Mapping[str, Any]) -> list[str]:
    """What README shows of a row."""
    rotation, held = row["rotation_rad"], row["time_held_s"]
    return [
        f"{rotation['median']:.1f} ({rotation['p10']:.1f}-{rotation['p90']:.1f})",
        f"{held['median']:.0f} ({held['p10']:.0f}-{held['p90']:.0f})",
        percent_interval(row["reached"]),
        *steadiness(row),
    ]


def steadiness(row: Mapping[str, Any]) -> list[str]:
    """Largest drift, over the trials too, and share of samples with only fingertips touching."""
    if "drift_mm" not in row:  # of an earlier measurement
        return ["", ""]
    return [f"{row['drift_mm']['largest']:.0f}", f"{100 * row['only_fingertips']:.1f} %"]


def table_of(rows: list[dict[str, Any]], given: Options) -> dict[str, Any]:
    """Both gaits side by side: one line for each object and palm direction."""
    found = {(row["object"], row["palm"], row["gait"]): cells(row) for row in rows}
    lines = []
    for name, palm in dict.fromkeys((row["object"], row["palm"]) for row in rows):
        line = [f"{name.replace('_', ' ')}, {palm}"]
        for gait in GAITS.values():
            line += found.get((name, palm, gait), [""] * 5)
        lines.append(line)
    return {
        "title": f"Thesis gait and coordinated gait, {given.seconds:g} s, {given.trials} trials "
        "each: rotation before any drop and time held, medians (10th to 90th percentile), and "
        "share of trials with a full turn (95 % interval)",
        "header": list(HEADER),
        "rows": lines,
    }


def figures_of(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """What was asked: full turns of three objects, and a floor on the cylinder."""
    out = []
    for row in rows:
        if row["gait"] != "coordinated" or row["object"] not in EASY[:3]:
            continue
        where = f"the {row['object']}, palm {row['palm']}, {seconds:g} s"
        out.append(
            Figure(
                f"coordinated gait: a full turn of {where}",
                percent(row["reached"]),
                f"{100 * FULL_TURN_GOAL:.0f} % of trials",
                row["reached"]["share"] >= FULL_TURN_GOAL,
            )
        )
        if row["object"] == "cylinder":
            median = row["rotation_rad"]["median"]
            out.append(
                Figure(
                    f"coordinated gait: rotation of {where}",
                    f"median {median:.1f} rad",
                    f"floor: {FLOOR} rad",
                    median >= FLOOR,
                )
            )
    return out


def in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows as an uninterrupted run has them."""
    places = list(product((*EASY, *HARDER), PALMS, GAITS.values()))
    return sorted(rows, key=lambda row: places.index((row["object"], row["palm"], row["gait"])))


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    rows = in_order(rows)
    figures, table = figures_of(rows, given.seconds), table_of(rows, given)
    write("gaits", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("gaits", given)
    done = {(row["object"], row["palm"], row["gait"]) for row in rows}
    wanted = product(given.objects, PALMS, GAITS)
    for name, palm, gait in wanted:
        if (name, palm, GAITS[gait]) in done:
            continue
        rows.append(measure(gait, name, palm, given))
        progress(f"{name}, palm {palm}, {GAITS[gait]}: {' | '.join(cells(rows[-1]))}")
        save(rows, given, say=False)
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
