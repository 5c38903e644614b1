"""Writes the measured figures into README.md and docs/measured.md, from the results beside this.

README gets five of them, docs/measured.md all, with the tables. In either file they stand between
two comments, `<!-- figures:begin -->` and `<!-- figures:end -->`. With `--check` nothing is
written; the exit code is 1 where one of the files is out of date.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from learning.sweep.table import caption, markdown_table

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
ROOT = Path(__file__).resolve().parents[1]
# in the order of the tables, each with the heading of its own
HEADINGS = {
    "igm_latency": "In-grasp step",
    "compiled_or_plain": "In-grasp step, compiled or plain",
    "force_distribution": "Forces that hold a wrench",
    "gait_batch": "A batch of hands",
    "simulator": "Simulator",
    "in_grasp": "In-grasp manipulation",
    "reach": "The end of the reach",
    "touch": "Without touch sensors",
    "touch_tracking": "Tracked by touch",
    "gaits": "Gaits",
    "gaits_long": "Gaits for ten minutes",
    "learned": "Learned gaits",
    "reorientation": "Goal orientations and commanded axes",
    "told": "Turned as told",
    "goal_policies": "Policies for goals",
    "goals_any_way_up": "Policies for goals, any way up",
    "learner": "Training throughput",
    "devices": "Training on a GPU",
    "algorithms": "Algorithms and their peers",
    "hardware_grasp": "Simulator and servo bus",
    "servo_hand": "The emulated servo hand",
    "servo_goals": "Goals on the emulated servo hand",
    "servo_told": "Turned as told on the emulated servo hand",
    "hardware_loop": "Runner of the servo hand",
    "identification": "What the joints are like",
    "bus": "Servo bus",
    "hands": "Grasps of other hands",
    "hands_turning": "Other hands turn objects",
    "hands_learned": "Policies of other hands",
    "ablation": "Parts of the coordinated gait",
    "learning_ablation": "Parts of the recipe fast",
    "feedback": "What a policy has to feel",
    "feedback_x": "What a policy has to feel about x",
    "seen_ablation": "Parts of the recipe behind dex5-seen",
    "commanded_speed": "Commanded speeds",
    "planning": "Planning",
    "starts": "Starts of episodes",
    "predictive_sampling": "Against predictive sampling",
    "robustness": "Robustness of the coordinated gait",
    "conditions": "Conditions",
    "ranges": "One setting at a time",
}
SWEEP = "learning_table"
# what README shows: of the results of a script the figure that says this, the last one where
# more than one does (what is asked for, behind the floor)
CHOSEN = (
    (
        "igm_latency",
        "in-grasp step for one hand, five changing contacts, against mink's `solve_ik` with five "
        "frame tasks, compiled (extra `fast`)",
    ),
    ("gaits", "coordinated gait: a full turn of the cube, palm up, 60 s"),
    ("learned", "learned, on all five any way up: rotation of the cube in 60 s"),
    (
        "reorientation",
        "sequence:dex5-cube-z-any,dex5-cube-x-any: first goals reached (cube, touch), 60 s",
    ),
    (
        "learner",
        "training, our learner, VGE with the coordinated gait, against stock stable-baselines3 "
        "SAC, 128 environments",
    ),
    (
        "hardware_grasp",
        "coordinated gait for 60 s in real time through the emulated bus, 0.6 rad/s, 0.5 N m, "
        "0.05 s latency",
    ),
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to write, and where."""

    check: bool = False
    """Write nothing; exit with 1 where a file is out of date."""
    readme: Path = ROOT / "README.md"
    """The file that gets six figures, with the two comments."""
    measured: Path = ROOT / "docs" / "measured.md"
    """The file that gets all figures and tables, with the two comments."""
    results: Path = ROOT / "benchmarks" / "results"
    """Folder of the results."""


def load(folder: Path) -> list[dict[str, Any]]:
    """The results that are there, in the order of the tables."""
    paths = [folder / f"{name}.json" for name in HEADINGS]
    return [json.loads(path.read_text()) for path in paths if path.is_file()]


def load_sweep(folder: Path) -> dict[str, Any] | None:
    """The results of the sweep over methods; None where they are not there."""
    path = folder / SWEEP / "results.json"
    return json.loads(path.read_text()) if path.is_file() else None


def few(results: Sequence[dict[str, Any]]) -> str:
    """What stands between README's comments."""
    figures = {
        (result["benchmark"], figure["what"]): figure
        for result in results
        for figure in result["figures"]
    }
    rows = [
        [figure["what"], figure["measured"], figure["goal"]]
        for figure in (figures[chosen] for chosen in CHOSEN if chosen in figures)
    ]
    return f"{_table(['What', 'Measured', 'Goal'], rows)}\n\n{_reached(results)}"


def everything(results: Sequence[dict[str, Any]], sweep: dict[str, Any] | None = None) -> str:
    """What stands between the comments of docs/measured.md."""
    parts = [_measured_on(results), _reached(results), _figures(results)]
    for result in results:
        name = result["benchmark"]
        if result["tables"]:
            parts.append(f"## {HEADINGS[name]}")
        for table in result["tables"]:
            body = _table(table["header"], table["rows"])
            parts.append(f"{table['title']} (`python benchmarks/{name}.py`):\n\n{body}")
        if sweep is not None and name == "learned":
            parts.append(_sweep(sweep))
    return "\n\n".join(parts)


def _reached(results: Iterable[dict[str, Any]]) -> str:
    met = [figure["met"] for result in results for figure in result["figures"]]
    goals, missed = sum(one is not None for one in met), met.count(False)
    return (
        f"Of {goals} goals, the same for every controller and policy, {goals - missed} are reached "
        f"and **{missed} are not**."
    )


def _measured_on(results: Iterable[dict[str, Any]]) -> str:
    machines = dict.fromkeys(_machine(result["machine"]) for result in results)
    return (
        f"Measured on {'; '.join(machines)}. `make bench` measures all of it again, but for tables "
        "that name another command and training on a GPU."
    )


def _machine(machine: dict[str, Any]) -> str:
    versions = machine["versions"]
    return (
        f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, "
        f"mujoco {versions['mujoco']}, pin {versions['pin']}, mink {versions['mink']}"
    )


def _figures(results: Iterable[dict[str, Any]]) -> str:
    marks = {True: "yes", False: "**no**", None: ""}
    rows = [
        [
            figure["what"],
            figure["measured"],
            figure["goal"],
            marks[figure["met"]],
            f"`{result['benchmark']}.py`",
        ]
        for result in results
        for figure in result["figures"]
    ]
    return _table(["What", "Measured", "Goal", "Reached", "In `benchmarks/`"], rows)


def _sweep(found: dict[str, Any]) -> str:
    command = f"`dexctl sweep benchmarks/{SWEEP}.toml`"
    return (
        "## Methods of exploration\n\n"
        f"Methods of exploration and what guided them, the learned policy alone ({command}):\n\n"
        f"{markdown_table(found)}\n\n{caption(found)}"
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def renewed(text: str, between: str) -> str:
    """``text`` with what stands between its comments replaced.

    Raises:
        ValueError: the comments are not there, once each and in order.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ValueError(f"expected one {BEGIN} and after it one {END}")
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{between}\n{END}{rest.split(END)[1]}"


def main() -> int:
    given = tyro.cli(Options, description=__doc__)
    results = load(given.results)
    if not results:
        print(f"{given.results}: no results; run `make bench`", file=sys.stderr)
        return 2
    stale = []
    for path, between in (
        (given.readme, few(results)),
        (given.measured, everything(results, load_sweep(given.results))),
    ):
        old = path.read_text()
        try:
            new = renewed(old, between)
        except ValueError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 2
        if new != old:
            stale.append(path.name)
            if not given.check:
                path.write_text(new)
    if given.check and stale:
        print(f"out of date: {', '.join(stale)}; python benchmarks/readme.py", file=sys.stderr)
        return 1
    print(f"written: {', '.join(stale)}" if stale else "README and measured.md are up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
