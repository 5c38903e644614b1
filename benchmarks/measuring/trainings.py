"""Trainings of one thing each, with several seeds, in processes of their own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import from_plain
from measuring.results import FIXED, earlier
from measuring.settings import check_chosen, progress

if TYPE_CHECKING:
    from learning.config import TrainConfig


def measure_with_seeds(
    name: str,
    given: Any,
    column: str,
    known: Sequence[str],
    chosen: Sequence[str],
    config: Callable[[str, int, Any], Any],
    measure: Callable[[str, int, Any], dict[str, Any]],
    save: Callable[..., None],
    line: Callable[[dict[str, Any]], str],
    fixed: Sequence[str] = FIXED,
) -> None:
    """One row for each one chosen and each seed of training; written after every row.

    Each is measured in a process of its own: random states and thread counts belong to it.

    Args:
        name: of the script.
        given: its settings, with seeds and jobs.
        column: what a row calls the one that was measured.
        known: all that can be measured, in the order of the rows.
        chosen: those that are measured.
        config: (one, seed, given) -> its training's configuration, which rows that an interrupted
            run has left are to have too.
        measure: (one, seed, given) -> its row, with the training_seed and the config.
        save: (rows, given, say=) writes the result.
        line: row -> what whoever waits reads.
        fixed: see `earlier`.
    """
    check_chosen(column, chosen, known)
    order = [(one, given.seed + k) for k in range(given.seeds) for one in chosen]
    for each in order:  # what is wrong with the settings shows before any training
        config(*each, given)
    rows = {}
    for row in earlier(name, given, fixed):
        each = row[column], row["training_seed"]
        if each[0] not in known or not _same(row["config"], config(*each, given)):
            raise InvalidInput(
                f"{given.out / name}.json cannot be gone on with, {each[0]} (seed {each[1]}) was "
                "trained with other settings; expected the same, or no --resume, which writes over "
                "it"
            )
        rows[each] = row

    def write_down(*, say: bool) -> None:
        in_order = sorted(rows, key=lambda each: (known.index(each[0]), each[1]))
        save([rows[each] for each in in_order], given, say=say)

    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(given.jobs, spawn, max_tasks_per_child=1)
    try:
        waiting = {pool.submit(measure, *each, given): each for each in order if each not in rows}
        for done in as_completed(waiting):
            (one, seed) = each = waiting[done]
            rows[each] = done.result()
            write_down(say=False)
            progress(f"{one}, seed {seed}: {line(rows[each])}")
    finally:
        pool.shutdown(cancel_futures=True)
    write_down(say=True)


def _same(had: Mapping[str, Any], wanted: TrainConfig) -> bool:
    """Whether a row's configuration is this one; settings that came later have their defaults."""
    try:
        return _decisive(from_plain(type(wanted), had)) == _decisive(wanted)
    except DexctlError:  # it has one that there is no longer
        return False


def _decisive(config: TrainConfig) -> TrainConfig:
    """The same with the mass said, and without settings of trees that grow in other ways."""
    starts = config.starts
    tree = replace(type(starts.tree)(), **{starts.tree_expand: starts.expansion})
    return replace(config.with_mass(), starts=replace(starts, tree=tree))
