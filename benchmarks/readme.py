"""Writes the table of measured figures into README.md, from the results beside this script.

The table stands between two comments, `<!-- figures:begin -->` and `<!-- figures:end -->`. With
`--check` nothing is written; the exit code is 1 where README is out of date.
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
# in the order of the table; tables of those that are "open" stand there for all to see
ORDER = {
    "igm_latency": "open",
    "gait_batch": "open",
    "simulator": "open",
    "in_grasp": "open",
    "gaits": "open",
    "learned": "open",
    "learner": "open",
    "hardware_grasp": "open",
    "hardware_loop": "folded",
    "bus": "folded",
    "allegro": "folded",
    "ablation": "folded",
    "learning_ablation": "folded",
    "robustness": "folded",
}
SWEEP = "learning_table"


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to write, and where."""

    check: bool = False
    """Write nothing; exit with 1 where the table is out of date."""
    readme: Path = ROOT / "README.md"
    """The file with the two comments."""
    results: Path = ROOT / "benchmarks" / "results"
    """Folder of the results."""


def load(folder: Path) -> list[dict[str, Any]]:
    """The results that are there, in the order of the table."""
    paths = [folder / f"{name}.json" for name in ORDER]
    return [json.loads(path.read_text()) for path in paths if path.is_file()]


def load_sweep(folder: Path) -> dict[str, Any] | None:
    """The results of the sweep over methods; None where they are not there."""
    path = folder / SWEEP / "results.json"
    return json.loads(path.read_text()) if path.is_file() else None


def text(results: Sequence[dict[str, Any]], sweep: dict[str, Any] | None = None) -> str:
    """What stands between the comments."""
    parts = [_measured_on(results), _figures(results)]
    for result in results:
        for table in result["tables"]:
            body = _table(table["header"], table["rows"])
            command = f"`python benchmarks/{result['benchmark']}.py`"
            if ORDER[result["benchmark"]] == "open":
                parts.append(f"{table['title']} ({command}):\n\n{body}")
            else:
                title = f"<summary>{table['title']}</summary>"
                parts.append(f"<details>{title}\n\n{command}\n\n{body}\n\n</details>")
        if sweep is not None and result["benchmark"] == "learned":
            parts.append(_sweep(sweep))
    return "\n\n".join(part for part in parts if part)


def _measured_on(results: Iterable[dict[str, Any]]) -> str:
    machines = dict.fromkeys(_machine(result["machine"]) for result in results)
    return (
        f"Measured on {'; '.join(machines)}. `make bench` measures all of it again, but for tables "
        "that name another command."
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
        f"Methods of exploration and what guided them, the learned policy alone ({command}):\n\n"
        f"{markdown_table(found)}\n\n{caption(found)}"
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def renewed(readme: str, between: str) -> str:
    """README with the text between its comments replaced.

    Raises:
        ValueError: the comments are not there, once each and in order.
    """
    if (
        readme.count(BEGIN) != 1
        or readme.count(END) != 1
        or readme.index(BEGIN) > readme.index(END)
    ):
        raise ValueError(f"expected one {BEGIN} and after it one {END}")
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}\n{between}\n{END}{rest.split(END)[1]}"


def main() -> int:
    given = tyro.cli(Options, description=__doc__)
    results = load(given.results)
    if not results:
        print(f"{given.results}: no results; run `make bench`", file=sys.stderr)
        return 2
    old = given.readme.read_text()
    try:
        new = renewed(old, text(results, load_sweep(given.results)))
    except ValueError as error:
        print(f"{given.readme}: {error}", file=sys.stderr)
        return 2
    if new == old:
        print(f"{given.readme.name} is up to date")
        return 0
    if given.check:
        print(f"{given.readme.name} is out of date: python benchmarks/readme.py", file=sys.stderr)
        return 1
    given.readme.write_text(new)
    print(f"{given.readme.name} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
