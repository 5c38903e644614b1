"""What is there of a sweep, as one JSON: runs, and statistics over the seeds of each cell.

What is missing is missing: figures are of the seeds that have finished, with how many there are;
no run that failed or has not finished counts as a number.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dexctl.files import aside
from dexctl.statistics import bootstrap, wilson
from learning.sweep.config import Cell, Criterion, PlannedRun, SweepConfig
from learning.sweep.jobs import controller_folder, outcome, run_folder
from learning.sweep.table import DROPPED, FORMAT, RETURN, ROTATION, objects_of

STATES = ("finished", "failed", "unfinished", "not started")


def collect(config: SweepConfig, out: Path) -> dict[str, Any]:
    """Everything that the table and the figure say, from the folder of a sweep.

    Returns:
        What JSON can hold: the configuration, ``runs`` (one for each seed of each cell),
        ``controllers`` (evaluated in a policy's place), and ``cells`` (one for each method, group
        of controllers and object).
    """
    compared = {name: _controller(controller_folder(out, name)) for name in config.compared}
    runs = [_run(run, out) for run in config.runs]
    content = config.to_dict()
    return {
        "format": FORMAT,
        "command": "sweep",
        "name": config.name,
        "given": content["given"],
        "evaluation": content["evaluation"],
        "criterion": content["criterion"],
        "controllers": compared,
        "cells": [
            _cell(cell, name, config, runs, compared)
            for cell in config.cells
            for name in config.objects
        ],
        "settings": {
            cell.name: _without_seed(content["runs"], cell, config.runs) for cell in config.cells
        },
        "runs": runs,
    }


def write_csv(path: Path, results: Mapping[str, Any]) -> None:
    """One row for each run and object, whole or not at all; what is missing is empty."""
    names = ["method", "controllers", "seed", "state", "object", "rotation_median_rad",
             "rotation_low_rad", "rotation_high_rad", "speed_mean_rad_s", "return_mean",
             "share_dropped", "steps", "training_seconds", "error"]  # fmt: skip
    with aside(path) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        for run in results["runs"]:
            head = [run["method"], " ".join(run["controllers"]), run["seed"], run["state"]]
            tail = [run["steps"], run["training_seconds"], run["error"]]
            for name in objects_of(results):
                figures = (run["objects"] or {}).get(name, {})
                rotation = figures.get(ROTATION, {})
                row = [rotation.get(key) for key in ("value", "low", "high")]
                row += [
                    figures.get(key, {}).get("value")
                    for key in ("speed_mean_rad_s", RETURN, DROPPED)
                ]
                writer.writerow([*head, name, *row, *tail])


def _run(run: PlannedRun, out: Path) -> dict[str, Any]:
    found = outcome(run_folder(out, run))
    result = found.result or {}
    return {
        "name": run.name,
        "method": run.cell.method,
        "controllers": list(run.cell.controllers),
        "seed": run.config.seed,
        "state": found.state,
        "error": found.error,
        **{
            key: result.get(key)
            for key in ("steps", "training_seconds", "evaluation_seconds", "versions", "objects")
        },
    }


def _controller(folder: Path) -> dict[str, Any]:
    found = outcome(folder)
    objects = (found.result or {}).get("objects")
    return {"state": found.state, "error": found.error, "objects": objects}


def _cell(
    cell: Cell,
    name: str,
    config: SweepConfig,
    runs: Iterable[Mapping[str, Any]],
    compared: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    own = [run for run in runs if (run["method"], tuple(run["controllers"])) == _key(cell)]
    there = [run["objects"][name] for run in own if run["state"] == "finished"]
    rotation = [figures[ROTATION]["value"] for figures in there]
    threshold = _threshold(config.criterion, cell, name, compared)
    learned = None
    if there and threshold is not None:
        learned = wilson(sum(value >= threshold for value in rotation), len(there)).to_dict()
    return {
        "method": cell.method,
        "controllers": list(cell.controllers),
        "object": name,
        "seeds": {state: [run["seed"] for run in own if run["state"] == state] for state in STATES},
        "learned_at_rad": threshold,
        "learned": learned,
        "rotation_iqm_rad": _over_seeds(rotation, "iqm"),
        "return_iqm": _over_seeds([figures[RETURN]["value"] for figures in there], "iqm"),
        "dropped_mean": _over_seeds([figures[DROPPED]["value"] for figures in there], "mean"),
    }


def _key(cell: Cell) -> tuple[str, tuple[str, ...]]:
    return cell.method, cell.controllers


def _over_seeds(values: Sequence[float], statistic: str) -> dict[str, Any] | None:
    """With the bootstrap interval over seeds; one seed says nothing of others, so it has none."""
    if not values:
        return None
    found = bootstrap(values, statistic).to_dict()
    return found if len(values) > 1 else {**found, "low": None, "high": None}


def _threshold(
    criterion: Criterion, cell: Cell, name: str, compared: Mapping[str, Mapping[str, Any]]
) -> float | None:
    """What a seed's median rotation must reach [rad]; None where that is not known yet."""
    if criterion.rotation is not None:
        return criterion.rotation
    of = cell.controllers or tuple(compared)
    if any(compared[one]["objects"] is None for one in of):
        return None
    return max(compared[one]["objects"][name][ROTATION]["value"] for one in of)


def _without_seed(
    runs: Mapping[str, Mapping[str, Any]], cell: Cell, planned: Iterable[PlannedRun]
) -> dict[str, Any]:
    first = next(run.name for run in planned if run.cell == cell)
    return {key: value for key, value in runs[first].items() if key != "seed"}
