"""What every benchmark shares: settings, timing, trials, statistics, and JSON written whole.

A result holds `figures`, each a line of README's table with its goal beside it, and the numbers
they were made from.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import tyro
from poses import Pose, known

from dexctl.controller import Controller
from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.files import write_text
from dexctl.report.machine import machine
from dexctl.rotations import inverse, multiply
from dexctl.settings import from_plain
from dexctl.sim import Scene, SceneConfig, Simulation, Trace, run
from dexctl.statistics import bootstrap, wilson
from dexctl.validation import check_name

if TYPE_CHECKING:
    from learning.config import TrainConfig

RESULTS = Path(__file__).resolve().parent / "results"
FULL_TURN = 2 * np.pi
PALMS = ("up", "down")
FIXED = ("seed", "trials", "seconds")  # settings that rows of one result have in common
# settings that a result does not tell: where things are
_UNSAID = ("out", "resume", "picture", "peer", "runs")
_ROWS = ("trials", "runs")  # what of a result are rows
WITH = "measured_with"
"""What a row calls the settings of the run that measured it; in a file, their place in the list
of that name. None: in a result from before rows had it, nobody knows."""
THREADS = 2  # of the physics in the timing benchmarks
# of in-grasp manipulation; they give the same numbers
ENGINES = {"compiled": "compiled (extra `fast`)", "plain": "numpy only"}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a script takes from the command line; the defaults are the full measurement."""

    seed: int = 0
    """First seed; trial i has the seed seed + i."""
    out: Path = RESULTS
    """Folder for the result."""
    resume: bool = False
    """Keep the rows of an interrupted run with the same settings, where a script has rows."""


S = TypeVar("S", bound=Settings)


def settings(kind: type[S], description: str | None) -> S:
    """The command line's settings; what is wrong with them is said in one line from here on."""
    sys.excepthook = _say
    return tyro.cli(kind, description=description)


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, DexctlError):
        progress(str(error))
    elif isinstance(error, KeyboardInterrupt):
        progress("interrupted; where a script has rows, the same command with --resume goes on")
    else:
        sys.__excepthook__(kind, error, trace)


def check_chosen(what: str, chosen: Iterable[str], known: Iterable[str]) -> None:
    """Raise UnknownName where one of ``chosen`` is none of ``known``."""
    known = list(known)
    for name in chosen:
        check_name(what, name, known)


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes:
        what: what was measured.
        measured: the number, with unit, for people.
        goal: what was asked for; empty where nothing was.
        met: whether the goal is reached; None where there is none.
    """

    what: str
    measured: str
    goal: str = ""
    met: bool | None = None


# -- timing ---------------------------------------------------------------------------------


def timed(call: Callable[[], Any]) -> float:
    """Seconds that a call took."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def timings(call: Callable[[int], Any], count: int, warm_up: int = 50) -> np.ndarray:
    """Seconds that each of ``count`` calls took, ``(count,)``; ``call`` gets its index."""
    for i in range(min(warm_up, count)):
        call(i)
    return np.array([timed(lambda i=i: call(i)) for i in range(count)])


def in_turns(
    calls: dict[str, Callable[[int], Any]], count: int, rounds: int
) -> dict[str, np.ndarray]:
    """Timings ``(rounds, count)`` of each call, taken in turns so that all meet the same load."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for i in range(rounds):
        order = list(calls) if i % 2 == 0 else list(calls)[::-1]
        for name in order:
            rows[name].append(timings(calls[name], count))
    return {name: np.array(row) for name, row in rows.items()}


def spread(seconds: np.ndarray) -> dict[str, float]:
    """Median, p99 and count of timings, in microseconds."""
    return {
        "median_us": round(float(np.median(seconds) * 1e6), 2),
        "p99_us": round(float(np.percentile(seconds, 99) * 1e6), 2),
        "count": int(np.size(seconds)),
    }


def ratio(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Median over the rounds ``(rounds, ...)`` of the ratio of medians, with its extremes."""
    each = np.median(ours.reshape(len(ours), -1), 1) / np.median(theirs.reshape(len(theirs), -1), 1)
    return {
        "median": round(float(np.median(each)), 4),
        "least": round(float(each.min()), 4),
        "most": round(float(each.max()), 4),
        "rounds": len(each),
    }


def engines() -> list[str]:
    """The engines of in-grasp manipulation that are installed."""
    return [name for name in ENGINES if name == "plain" or find_spec("numba") is not None]


# -- trials ---------------------------------------------------------------------------------


def trials(
    controller: Controller,
    config: SceneConfig,
    seconds: float,
    count: int,
    *,
    seed: int = 0,
    parameters: dict[str, float] | None = None,
) -> Trace:
    """``count`` trials by the protocol of every measurement (see `dexctl.sim.run`)."""
    with Simulation(config, count, seed, hand=controller.hand) as sim:
        if parameters:
            sim.sim.set_parameters(**parameters)
        sim.reset(seed)
        controller.reset(seed)
        return run(controller, sim, seconds)


def earlier(name: str, given: Settings, fixed: Sequence[str] = FIXED) -> list[dict[str, Any]]:
    """Rows that an interrupted run has left, none without ``--resume``.

    Each has the settings that it was measured with (``measured_with``), as `write` wants them.

    Raises:
        InvalidInput: the result is damaged, or was measured with other ``fixed`` settings: going
            on with none of its rows would write over them.
    """
    path = given.out / f"{name}.json"
    if not (given.resume and path.is_file()):
        return []
    found = read(path)
    try:
        rows, had = found["trials"], {key: found["settings"][key] for key in fixed}
    except (LookupError, TypeError) as error:
        raise InvalidInput(f"{path} is no result to go on with: {error}") from error
    other = [key for key in fixed if had[key] != getattr(given, key)]
    if other:
        wanted = " ".join(f"--{key.replace('_', '-')} {had[key]}" for key in other)
        raise InvalidInput(
            f"{path} cannot be gone on with, it was measured with {wanted}; expected these, or no "
            "--resume, which writes over it"
        )
    return rows


def read(path: Path) -> dict[str, Any]:
    """A result whose rows have the settings that they were measured with, or None.

    Raises:
        InvalidInput: it is damaged.
    """
    try:
        found = json.loads(path.read_text())
        known = found.get(WITH, [])
        for row in (row for name in _ROWS for row in found.get(name, [])):
            number = row.get(WITH)
            row[WITH] = None if number is None else known[number]
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput(f"{path} is no result to go on with: {error}") from error
    return found


def grid(
    rows: Sequence[dict[str, Any]], key: str, texts: dict[str, str], scenes: Sequence[Any]
) -> tuple[list[str], list[list[str]]]:
    """Header and lines of a table: one line for each ``row[key]``, one column for each scene.

    Cells have the median rotation and the share still holding with its Wilson interval.
    """
    cells = {
        (row[key], row["object"], row["palm"]): f"{row['rotation_rad']['median']:.1f} rad, "
        + percent_interval(row["holding"])
        for row in rows
    }
    lines = [
        [text, *(cells.get((name, *scene), "") for scene in scenes)]
        for name, text in texts.items()
        if any(row[key] == name for row in rows)
    ]
    return ["", *(f"{name}, palm {palm}" for name, palm in scenes)], lines


def measure_in_scenes(
    name: str,
    given: Any,
    column: str,
    texts: dict[str, str],
    chosen: Sequence[str],
    scenes: Sequence[tuple[str, str]],
    title: str,
    measure: Callable[[str, SceneConfig], Trace],
) -> None:
    """One row for each one chosen and each scene; written after every row.

    Args:
        name: of the script.
        given: its settings, with trials and seconds.
        column: what a row calls the one that was measured.
        texts: name of one: what people read.
        chosen: those that are measured.
        scenes: (object, palm).
        title: of the table, before its "median rotation in ...".
        measure: (one, scene) -> its trials.
    """
    check_chosen(column, chosen, texts)
    rows = earlier(name, given)

    def save(*, say: bool) -> list[list[str]]:
        header, lines = grid(rows, column, texts, scenes)
        table = {
            "title": f"{title}: median rotation in {given.seconds:g} s, share still holding "
            f"(95 % interval), {given.trials} trials each",
            "header": header,
            "rows": lines,
        }
        write(name, given, [], [table], trials=rows, say=say)
        return lines

    done = {(row[column], row["object"], row["palm"]) for row in rows}
    for one, (turned, palm) in product(chosen, scenes):
        if (one, turned, palm) in done:
            continue
        trace = measure(one, SceneConfig(object=(turned,), gravity=palm))
        rows.append({column: one, "object": turned, "palm": palm, **outcome(trace)})
        (line,) = (line for line in save(say=False) if line[0] == texts[one])
        cell = line[1 + scenes.index((turned, palm))]
        progress(f"{one}, {turned}, palm {palm}: {cell}")
    save(say=True)


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
        return from_plain(type(wanted), had).with_mass() == wanted.with_mass()
    except DexctlError:  # it has one that there is no longer
        return False


def controls(scene: Scene, q_target: np.ndarray, substeps: int) -> np.ndarray:
    """What MuJoCo gets to hold set-points ``(N, d)``, ``(N, substeps, nu)``."""
    ctrl = np.zeros((len(q_target), scene.model.nu))
    ctrl[:, scene.actuators] = q_target * scene.ctrl_per_radian
    return np.repeat(ctrl[:, None], substeps, axis=1)


def share(hits: np.ndarray) -> dict[str, Any]:
    """How many of the trials ``(N,)``, with the 95 % Wilson interval of their share."""
    k, n = int(hits.sum()), len(hits)
    found = wilson(k, n)
    interval = [_r(found.low), _r(found.high)]
    return {"count": k, "of": n, "share": round(k / n, 4), "wilson95": interval}


def over_seeds(values: np.ndarray) -> dict[str, Any]:
    """Median over trials ``(N,)`` with its 95 % bootstrap interval, 10th and 90th percentile."""
    found = bootstrap(values, "median")
    p10, p90 = np.percentile(values, [10, 90])
    return {
        "median": _r(found.value),
        "bootstrap95": [_r(found.low), _r(found.high)],
        "p10": _r(p10),
        "p90": _r(p90),
    }


def outcome(trace: Trace, target: float = FULL_TURN) -> dict[str, Any]:
    """What trials came to: rotation up to the drop, time held, and what stopped them.

    ``reached`` counts trials that turned the object by ``target`` [rad] before any drop;
    ``stalled`` those that still hold it and turned it by less than 0.1 rad in the last quarter.
    ``drift_mm`` is how far its centre was from where it had been at the start, the largest while
    it was held.
    """
    rotation, held = trace.rotation, trace.held
    quarter = len(rotation) - max(len(rotation) // 4, 1)
    last = rotation[-1] - rotation[quarter - 1]
    reached = rotation.max(axis=0) >= target
    other = (trace.other_contact > 0) & held
    away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
    drift = 1000 * np.where(held, away, 0.0).max(axis=0)
    return {
        "rotation_rad": over_seeds(rotation[-1]),
        "time_held_s": over_seeds(trace.time_held),
        "holding": share(held[-1]),
        "target_rad": _r(target),
        "reached": share(reached),
        "reached_and_holding": share(reached & held[-1]),
        "stalled": share(held[-1] & (np.abs(last) < 0.1)),
        "drift_mm": {**over_seeds(drift), "largest": _r(drift.max())},
        "second_before_drop": _before_drop(trace),
        "broke_down": _broke_down(trace),
        "mean_contacts": _r((trace.in_contact.sum(axis=-1) * held).sum() / held.sum()),
        "touched_by_more_than_fingertips": _r(other.sum() / held.sum()),
        "only_fingertips": _r(1.0 - other.sum() / held.sum()),
    }


def emulated_run(*words: str) -> dict[str, Any]:
    """What `dexctl hardware run WORDS --emulate` says, 50 ms from a set-point to its effect.

    Raises:
        SystemExit: it said nothing but an error.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = ["hardware", "run", *words, "--emulate", "--json", "--out", folder,
                   "--action-latency", "0.05", "--patience", "5"]  # fmt: skip
        done = subprocess.run(
            [sys.executable, "-m", "dexctl", *command], capture_output=True, text=True, check=False
        )
    if not done.stdout.strip():
        raise SystemExit(f"dexctl {' '.join(command)}: {done.stderr.strip()}")
    return json.loads(done.stdout)


def side_by_side(
    jobs: int, trial: Callable[..., dict[str, Any]], wanted: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Trials that wait for processes of their own, ``jobs`` at a time, with their rows as they end.

    After a Ctrl-C, which ends the trials under way, none begins.
    """
    pool = ThreadPoolExecutor(jobs)
    try:
        runs = {pool.submit(trial, *one): one for one in wanted}
        for run in as_completed(runs):
            yield runs[run], run.result()
    finally:
        pool.shutdown(cancel_futures=True)


def measure_by_palm(
    name: str,
    given: Any,
    fixed: Sequence[str],
    trial: Callable[..., dict[str, Any]],
    save: Callable[..., None],
) -> None:
    """Trials of each who with each palm on the emulated servo hand; written after every one.

    Args:
        name: of the script.
        given: its settings, with who, palms, trials, seed and jobs.
        fixed: settings that all rows have in common.
        trial: (who, palm, number, given) -> its row, whose seed is given.seed + number.
        save: (rows, given, say=) writes the result.
    """
    rows = earlier(name, given, fixed)
    pose = getattr(given, "pose", "touch")
    done = {
        (row["who"], row["palm"], row["seed"]) for row in rows if row.get("pose", "touch") == pose
    }
    wanted = [
        (who, palm, number, given)
        for who, palm, number in product(given.who, given.palms, range(given.trials))
        if (who, palm, given.seed + number) not in done
    ]
    for (*words, _), row in side_by_side(given.jobs, trial, wanted):
        rows.append(row)
        save(rows, given, say=False)
        progress(", ".join(map(str, words)))
    save(rows, given, say=True)


def seen_or_felt(
    who: str, thing: str, palm: str, seed: int, given: Any, *told: str, pose: Pose = "touch"
) -> dict[str, Any]:
    """One `emulated_run` with an object whose pose is known so, and encoders that are off."""
    settled = known(pose).items()
    words = [word for name, one in settled for word in (f"--{name.replace('_', '-')}", str(one))]
    return emulated_run(
        who, "--object", thing, "--gravity", palm, *words, *told,
        "--seconds", f"{given.seconds:g}", "--seed", str(seed),
        "--joint-offset", f"{given.joint_offset:g}",
    )  # fmt: skip


def _before_drop(trace: Trace) -> dict[str, float] | None:
    """How trials stood a second before they dropped the object, medians; None if none did."""
    dropped = np.flatnonzero(trace.dropped)
    if not len(dropped):
        return None
    period = float(trace.time[1] - trace.time[0])
    row = np.maximum(trace.held.sum(axis=0) - 1 - round(1.0 / period), 0)[dropped]
    pose = trace.object_quaternion[:, dropped]
    turned = multiply(pose[row, np.arange(len(row))], inverse(pose[0]))
    tilt = np.arccos(np.clip(1 - 2 * (turned[:, 1] ** 2 + turned[:, 2] ** 2), -1, 1))
    away = trace.object_position[row, dropped] - trace.object_position[0, dropped]
    return {
        "fingers_touching": _r(np.median(trace.in_contact[row, dropped].sum(axis=-1))),
        "tilt_rad": _r(np.median(tilt)),
        "height_m": _r(np.median(away[:, 2])),
        "sideways_m": _r(np.median(np.linalg.norm(away[:, :2], axis=-1))),
    }


def _broke_down(trace: Trace) -> int:
    """Trials that ended because the simulation broke down, not because the object fell."""
    first = np.minimum(trace.held.sum(axis=0), len(trace.held) - 1)
    return int(trace.diverged[first, np.arange(len(first))].sum())


def percent(part: dict[str, Any]) -> str:
    """A share for people: 61 of 64 (95 %)."""
    return f"{part['count']} of {part['of']} ({100 * part['share']:.0f} %)"


def percent_interval(part: dict[str, Any]) -> str:
    """A share for people with its interval: 95 % (87-98)."""
    low, high = part["wilson95"]
    return f"{100 * part['share']:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def _r(value: Any) -> float:
    return round(float(value), 4)


def progress(text: str) -> None:
    """A line for whoever waits."""
    print(text, file=sys.stderr, flush=True)


# -- results --------------------------------------------------------------------------------


def write(
    name: str,
    given: Settings,
    figures: Sequence[Figure],
    tables: Sequence[dict[str, Any]] = (),
    *,
    say: bool = True,
    **numbers: Any,
) -> Path:
    """Write ``name.json`` with settings and machine, aside first and then renamed.

    ``settings`` are those of the last run. Rows that it has taken over from others (`earlier`)
    keep theirs: ``measured_with`` has the settings that rows were measured with, each once, and
    every row its place there.

    Args:
        name: of the script.
        given: its settings.
        figures: lines of README's table.
        tables: further tables for README, each with title, header and rows.
        say: whether to print what is written.
        **numbers: what the figures were made from.
    """
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"{name}.json"
    chosen = {key: value for key, value in asdict(given).items() if key not in _UNSAID}
    known = _number_rows(numbers, json.loads(json.dumps(chosen, default=str)))
    where = machine()
    where["versions"]["numba"] = version("numba") if find_spec("numba") else "not installed"
    where["load"] = round(os.getloadavg()[0], 2)
    result = {
        "benchmark": name,
        "figures": [asdict(figure) for figure in figures],
        "tables": list(tables),
        **numbers,
        **({WITH: known} if known else {}),
        "settings": chosen,
        "machine": where,
    }
    write_text(path, json.dumps(result, indent=1, default=str) + "\n")
    if not say:
        return path
    for figure in figures:
        mark = {True: "reached", False: "NOT reached", None: ""}[figure.met]
        goal = f"  (goal: {figure.goal}) {mark}" if figure.goal else ""
        print(f"{figure.what}: {figure.measured}{goal}")
    for table in tables:
        print(table["title"], *(" | ".join(row) for row in table["rows"]), sep="\n")
    print(f"written: {path}")
    return path


def _number_rows(numbers: dict[str, Any], now: dict[str, Any]) -> list[dict[str, Any]]:
    """The settings that rows were measured with, each once; rows get their place in the list."""
    known: list[dict[str, Any]] = []
    for name in _ROWS:
        if name not in numbers:
            continue
        numbered = []
        for row in numbers[name]:
            own = row.get(WITH, now)
            if own is not None and own not in known:
                known.append(own)
            numbered.append({**row, WITH: None if own is None else known.index(own)})
        numbers[name] = numbered
    return known
