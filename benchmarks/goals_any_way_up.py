"""Trains the two policies that `sequence` turns a cube with once more, for any way up.

They go on from two that know the palm up (`goal_policies.py`). Where these take over from each
other, whichever way up, is where episodes begin; gravity, which the new ones observe, points
anywhere; and the old ones are their guides: networks that go on from theirs, with critics that know
nothing, unlearn at once what they can. Then the new two show where the next training begins, and go
on themselves. A training that is there goes on, or is taken as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from goal_policies import (
    COLUMNS,
    SLOWLY,
    Asked,
    Palm,
    Rounds,
    cells,
    config,
    figure,
    pair,
    protocol,
    taken_over,
    title,
    train,
)
from measuring.results import write
from measuring.settings import check_chosen, progress, settings

from dexctl.sim import GraspStates
from learning.evaluation import evaluate

_ROUGHLY = (
    Asked("cube", palm="up"),
    Asked("cube", palm="down"),
    Asked("uniform", palm="any"),
    Asked("uniform", palm="down"),
)  # of policies that drop most cubes palm down
_SURELY = (
    Asked("uniform", palm="up"),
    Asked("uniform", images=True, palm="any"),
    Asked("cube", palm="any"),
    Asked("uniform", palm="down"),
    Asked("cube", palm="up"),
)
_TASK: dict[str, Any] = {
    "parts": ("q", "q_target", "contact_position", "contact_normal", "contact_force", "gravity"),
    "critic_parts": ("object_position", "object_quaternion", "object_velocity", "fingertip_force"),
    "joint_noise": 0.01,
    "drop_cost": 5.0,
    "drift_cost": 4.0,
    "max_tilt": 0.9,
    "episode_steps": 200,
    "gravity_tilt": np.pi,
    "gravity_straight_share": 0.4,
}
_ROUNDS = (_ROUGHLY, _SURELY)
_RUNS = tuple(f"{name}{i + 1}" for i in range(len(_ROUNDS)) for name in ("about", "across"))


@dataclass(frozen=True, kw_only=True)
class Options(Rounds):
    """Settings of the trainings."""

    about: str = "out/goal_policies/about3"
    """The policy about z to go on from: a run folder, a file or a name."""
    across: str = "out/goal_policies/across2"
    """The one about x."""
    any_steps: int = 1_000_000
    """Environment steps of the first training of each."""
    last_steps: int = 900_000
    """Of the second."""
    only: str = ""
    """Which run to train and then stop at, so that two are trained at once; empty is all."""
    evaluated: tuple[Palm, ...] = ("up", "down", "any")
    """Which way the palm looks in the evaluation."""
    runs: Path = Path("out/goals_any_way_up")


def trained(given: Options) -> list[tuple[Path | str, Path | str]]:
    """The pairs of policies, from those that are gone on from to the last."""
    pairs: list[tuple[Path | str, Path | str]] = [(given.about, given.across)]
    starts: list[tuple[Path, Path]] = []
    for number, asked in enumerate(_ROUNDS, start=1):
        new = (given.runs / f"new{number}-z.npz", given.runs / f"new{number}-x.npz")
        taken_over(*pairs[-1], asked, given.seed + 1800 + number, new, given)
        starts.append(new)
        runs = []
        for name, own, guide in (("about", 0, "dex5-easy-any"), ("across", 1, "igm")):
            path = given.runs / f"{name}{number}.npz"
            if not path.exists():
                GraspStates.concatenate([GraspStates.load(one[own]) for one in starts]).save(path)
            run, before = f"{name}{number}", pairs[-1][own]
            told = _TASK | {"initial_states": path, "axis": "zx"[own]}
            if number == 1:
                told["controllers"] = (before, guide)
                wanted = partial(config, given, "vge", given.any_steps, **told)
            else:
                told |= {"begin_from": before, "sac": SLOWLY}
                wanted = partial(config, given, "rl", given.last_steps, **told)
            if given.only in ("", run):
                train(run, given, wanted)
            runs.append(given.runs / run)
        pairs.append((runs[0], runs[1]))
        if given.only in (f"about{number}", f"across{number}"):
            raise SystemExit(0)
    return pairs


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("run", (given.only,) if given.only else (), _RUNS)
    given.runs.mkdir(parents=True, exist_ok=True)
    rows = []
    for (about, across), goals, palm in product(
        trained(given), ("cube", "uniform"), given.evaluated
    ):
        asked = protocol(given, given.seed + 50_000, goals, palm)
        got = evaluate(pair(about, across), asked).figures()
        who = {"about": Path(about).stem, "across": Path(across).stem}
        rows.append(who | {"goals": goals, "palm": palm} | {
            name: one.to_dict() for name, one in got.items()
        })  # fmt: skip
        progress(f"{who['about']}, {who['across']}: {goals}, palm {palm}")
        save(rows, given, say=False)
    save(rows, given, say=True)


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write what the pairs of policies reach."""
    table = {
        "title": title(given),
        "header": ["about z", "across", "goals", "palm", *COLUMNS],
        "rows": [
            [row["about"], row["across"], row["goals"], row["palm"], *cells(row)] for row in rows
        ],
    }
    last = rows[-1]["about"], rows[-1]["across"]
    found = [
        figure(row, f", palm {row['palm']}")
        for row in rows
        if (row["about"], row["across"]) == last
    ]
    write("goals_any_way_up", given, found, [table], trials=rows, say=say)


if __name__ == "__main__":
    main()
