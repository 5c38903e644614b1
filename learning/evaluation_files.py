"""CSV files of evaluations; each is written whole or not at all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from dexctl.files import aside
from dexctl.statistics import wilson
from learning.envs.noise import SensorNoise
from learning.evaluate import Evaluation
from learning.transfer import Transfer

_KINDS = [field.name for field in fields(SensorNoise)]
_DISTURBED = [*(f"{kind}_noise" for kind in _KINDS), "push_force_N", "latency_s"]
QUANTILES = (10, 25, 50, 75, 90)


def write_episodes(path: str | Path, evaluations: Iterable[Evaluation]) -> None:
    """One row for each episode."""
    outcome = ["rotation_rad", "time_held_s", "dropped", "diverged", "return"]
    rows = []
    for one in evaluations:
        columns = (one.rotation, one.time_held, one.dropped, one.diverged, one.returns)
        for i, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
            rows.append([one.object, *_disturbance(one), one.protocol.seed + i, *row])
    _write(path, ["object", *_DISTURBED, "seed", *outcome], rows)


def write_figures(path: str | Path, evaluations: Iterable[Evaluation]) -> None:
    """One row for each evaluation: every figure with its interval."""
    rows, names = [], []
    for one in evaluations:
        figures = one.figures()
        names = [f"{name}{end}" for name in figures for end in ("", "_low", "_high")]
        numbers = [number for figure in figures.values() for number in figure[:3]]
        count = one.protocol.episodes
        rows.append([one.object, *_disturbance(one), count, *numbers, int(one.diverged.sum())])
    _write(path, ["object", *_DISTURBED, "episodes", *names, "diverged"], rows)


def write_curves(path: str | Path, evaluations: Iterable[Evaluation]) -> None:
    """Rotation over time: quantiles over episodes, and the share that still holds the object."""
    rows = []
    for one in evaluations:
        quantiles = np.percentile(one.rotations, QUANTILES, axis=1).T
        held = one.held(one.moments)
        for time, row, count in zip(one.moments, quantiles, held, strict=True):
            share = wilson(int(count), len(one.rotation))[:3]
            rows.append([one.object, *_disturbance(one), round(float(time), 6), *row, *share])
    names = [f"rotation_p{q}_rad" for q in QUANTILES]
    held = ["share_held", "share_held_low", "share_held_high"]
    _write(path, ["object", *_DISTURBED, "time_s", *names, *held], rows)


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


def _disturbance(one: Evaluation) -> list[float]:
    noise = [getattr(one.protocol.noise, kind) for kind in _KINDS]
    return [*noise, one.protocol.push.force, one.protocol.latency]


def _write(path: str | Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with aside(Path(path)) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows(rows)
