"""CSV files of evaluations; each is written whole or not at all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dexctl.files import aside
from dexctl.statistics import wilson
from learning.evaluation.figures import Evaluation
from learning.evaluation.robustness import KINDS, levels_of
from learning.evaluation.transfer import Transfer

_WHERE = ["object", "conditions", *KINDS, "sensor_latency"]
QUANTILES = (10, 25, 50, 75, 90)


def write_episodes(
    path: str | Path, evaluations: Iterable[Evaluation], conditions: Sequence[str] = ()
) -> None:
    """One row for each episode; the names of the ``conditions`` stand in each."""
    outcome = [
        "rotation_rad", "time_held_s", "dropped", "strayed", "time_near_s", "diverged", "return",
        "fingertips_only_share", "drift_m", "mean_drift_m", "sink_m",
        "goals_reached", "goals_missed", "goals_in_a_row", "first_goal_s",
    ]  # fmt: skip
    rows = []
    for one in evaluations:
        columns = (
            one.rotation, one.time_held, one.dropped, one.strayed, one.time_near, one.diverged,
            one.returns, one.fingertips_only, one.drift, one.mean_drift, one.sink,
            one.goals_reached, one.goals_missed, one.goals_in_a_row, one.first_goal_time,
        )  # fmt: skip
        for i, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
            rows.append([*_where(one, conditions), one.protocol.seed + i, *row])
    _write(path, [*_WHERE, "seed", *outcome], rows)


def write_figures(
    path: str | Path, evaluations: Iterable[Evaluation], conditions: Sequence[str] = ()
) -> None:
    """One row for each evaluation: every figure with its interval."""
    rows, names = [], []
    for one in evaluations:
        figures = one.figures()
        names = [f"{name}{end}" for name in figures for end in ("", "_low", "_high")]
        numbers = [number for figure in figures.values() for number in figure[:3]]
        count = one.protocol.episodes
        rows.append([*_where(one, conditions), count, *numbers, int(one.diverged.sum())])
    _write(path, [*_WHERE, "episodes", *names, "diverged"], rows)


def write_curves(
    path: str | Path, evaluations: Iterable[Evaluation], conditions: Sequence[str] = ()
) -> None:
    """Rotation over time: quantiles over episodes, and the shares that still hold the object.

    Held is within the drop distance, near within half of it.
    """
    rows = []
    for one in evaluations:
        quantiles = np.percentile(one.rotations, QUANTILES, axis=1).T
        held = (one.held(one.moments), one.held(one.moments, near=True))
        for time, row, *counts in zip(one.moments, quantiles, *held, strict=True):
            shares = [n for count in counts for n in wilson(int(count), len(one.rotation))[:3]]
            rows.append([*_where(one, conditions), round(float(time), 6), *row, *shares])
    names = [f"rotation_p{q}_rad" for q in QUANTILES]
    shares = [f"share_{rule}{end}" for rule in ("held", "near") for end in ("", "_low", "_high")]
    _write(path, [*_WHERE, "time_s", *names, *shares], rows)


def write_transfer(path: str | Path, found: Transfer) -> None:
    """One row for each policy and object."""
    rows = []
    for i, policy in enumerate(found.policies):
        for j, name in enumerate(found.objects):
            numbers = [
                number
                for kind in ("rotation", "return")
                for figure in (found.raw(i, j, kind), found.score(i, j, kind))
                for number in (figure[:3] if figure is not None else ("", "", ""))
            ]
            rows.append([policy.name, policy.object, name, *numbers])
    names = ["rotation_median_rad", "rotation_score", "return_mean", "return_score"]
    columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    _write(path, ["policy", "trained_on", "object", *columns], rows)


def _where(one: Evaluation, conditions: Sequence[str]) -> list[str | float]:
    levels = levels_of(one.protocol).values()
    latency = one.protocol.scene.sensing.sensor_latency
    return [one.object, " ".join(conditions), *levels, latency]


def _write(path: str | Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with aside(Path(path)) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows(rows)
