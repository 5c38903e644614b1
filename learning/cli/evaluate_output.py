"""What `dexctl evaluate` prints, leaves in a folder, and says as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.table import Table

from dexctl.cli.output import facts, notes, results, table, to_json
from dexctl.exceptions import MissingExtra
from dexctl.files import write_text
from dexctl.hands.identity import identity
from dexctl.report.conditions import not_as_usual
from dexctl.report.machine import machine
from dexctl.report.words import about, interval
from dexctl.settings import to_plain
from learning.cli import evaluate_figures as figures
from learning.envs.tasks import NO_GOALS
from learning.evaluation import Evaluation, Protocol, files
from learning.evaluation.robustness import disturbance, levels_of
from learning.evaluation.transfer import Trained, Transfer

_UNITS = {"joint_noise": " rad", "position_noise": " m", "normal_noise": " rad", "push_force": " N"}
_ANY_WAY = 3.14  # from which tilt of gravity on a hand is held any way up [rad]


def described(
    trained: Sequence[Trained],
    protocol: Protocol,
    found: Sequence[Evaluation],
    matrix: Transfer | None,
) -> dict[str, Any]:
    """Everything that was found, and how."""
    cards = [one.subject.card for one in trained]
    if matrix is not None:
        what: dict[str, Any] = {"transfer": matrix.to_dict(), "cards": cards}
    else:
        what = {"policy": trained[0].name, "card": cards[0]}
        what["hand"] = identity(trained[0].subject.controller.hand)
        what["remark"] = trained[0].subject.remark(protocol)
        what["results"] = [
            {"object": one.object, "disturbance": levels_of(one.protocol), **one.to_dict()}
            for one in found
        ]
    return {
        "protocol": to_plain(protocol),
        "seeds": [protocol.seed, protocol.seed + protocol.episodes - 1],
        **what,
        "machine": machine(),
    }


def write(
    folder: Path, result: Mapping[str, Any], found: Sequence[Evaluation], matrix: Transfer | None
) -> None:
    """CSV files, figures and, last of all, ``evaluate.json``."""
    if matrix is not None:
        files.write_transfer(folder / "transfer.csv", matrix)
    else:
        conditions = result["conditions"]
        files.write_figures(folder / "figures.csv", found, conditions)
        files.write_curves(folder / "curves.csv", found, conditions)
        files.write_episodes(folder / "episodes.csv", found, conditions)
    try:
        _draw(folder, found, matrix)
    except MissingExtra as error:  # the numbers are worth more than the figures
        notes().print(f"dexctl: {error}; no figures are drawn")
    write_text(folder / "evaluate.json", to_json(result) + "\n")
    notes().print(f"written: {folder / 'evaluate.json'}, with CSV files and figures beside it")


def _draw(folder: Path, found: Sequence[Evaluation], matrix: Transfer | None) -> None:
    if matrix is not None:
        figures.draw_transfer(folder / "transfer.png", matrix)
        return
    first = {one.object: one for one in reversed(found)}  # undisturbed, with --robustness
    figures.draw_rotation(folder / "rotation.png", [*reversed(first.values())])
    if len(first) < len(found):
        figures.draw_robustness(folder / "robustness.png", found)


def print_evaluations(who: str, protocol: Protocol, found: Sequence[Evaluation]) -> None:
    """A table for each object: its figures, or a row for each disturbance."""
    console = results()
    console.print(f"{who}, {_setting(protocol)}", style="bold", soft_wrap=True)
    console.print(_episodes(protocol), soft_wrap=True)
    for name, group in groupby(found, key=lambda one: one.object):
        rows = list(group)
        console.print(f"\n{name}", style="bold")
        console.print(_figures(rows[0]) if len(rows) == 1 else _disturbances(rows))
    broken = sum(int(one.diverged.sum()) for one in found)
    if broken:
        console.print(f"{broken} simulations broke down; they count as dropped.")


def print_transfer(found: Transfer, protocol: Protocol) -> None:
    """The scores, with the rotations that they are of."""
    console = results()
    console.print(f"Transfer, {_setting(protocol)}", style="bold", soft_wrap=True)
    console.print(_episodes(protocol), soft_wrap=True)
    console.print(
        "Median rotation over that with the policy's own object (and the rotation itself)\n",
        soft_wrap=True,
    )
    matrix = table("policy of", *found.objects)
    for i, policy in enumerate(found.policies):
        cells = []
        for j in range(len(found.objects)):
            score, raw = found.score(i, j), found.raw(i, j)
            cells.append(
                f"{'   -' if score is None else f'{score.value:.2f}'} ({raw.value:.2f} rad)"
            )
        matrix.add_row(policy.object, *cells)
    console.print(matrix)


def _figures(one: Evaluation) -> Table:
    """One evaluation: a row for each figure."""
    figures = one.figures()
    return facts(
        (name, interval(figures[figure], unit, digits, factor))
        for name, figure, unit, digits, factor in (
            ("first goal reached", "share_first_goal_reached", "%", 0, 100.0),
            ("goals reached", "share_goals_reached", "%", 0, 100.0),
            ("time to the first", "first_goal_median_s", "s", 1, 1.0),
            ("goals in a row", "goals_in_a_row_median", "", 1, 1.0),
            ("rotation", "rotation_median_rad", "rad", 2, 1.0),
            ("revolutions", "revolutions_median", "", 2, 1.0),
            ("mean speed", "speed_mean_rad_s", "rad/s", 3, 1.0),
            ("held", "time_held_median_s", "s", 1, 1.0),
            ("dropped", "share_dropped", "%", 0, 100.0),
            (
                f"further than {500 * one.protocol.task.holding.drop_distance:g} mm",
                "share_strayed",
                "%",
                0,
                100.0,
            ),
            ("made a full turn", "share_full_turn", "%", 0, 100.0),
            ("mean return", "return_mean", "", 1, 1.0),
            ("only fingertips touch", "share_fingertips_only", "%", 0, 100.0),
            ("sinks by", "sink_median_m", "mm", 1, 1e3),
            ("drifts by", "drift_median_m", "mm", 1, 1e3),
            ("on average by", "mean_drift_median_m", "mm", 1, 1e3),
        )
        if figure in figures
    )


def _disturbances(rows: Sequence[Evaluation]) -> Table:
    """Several evaluations of one object: a row for each."""
    made = table("disturbed", "rotation, rad", "turns", "dropped", "mean return", gap=2, wrap=False)
    for one in rows:
        figures = one.figures()
        made.add_row(
            _disturbed(one, rows[0]),
            interval(figures["rotation_median_rad"]),
            f"{figures['revolutions_median'].value:.2f}",
            interval(figures["share_dropped"], "%", 0, 100.0),
            interval(figures["return_mean"], digits=0),
        )
    return made


def _setting(protocol: Protocol) -> str:
    task = protocol.task
    any_way = protocol.scene.randomisation.gravity_tilt >= _ANY_WAY
    said = ["any way up" if any_way else protocol.scene.palm, about(task.axis)]
    if task.goals != NO_GOALS:
        said[1] = f"goals {task.goals}"
    elif task.turning.commands:
        said[1] = f"commands {', '.join(task.turning.commands)}"
    said += [f"{what} {value}" for what, value in not_as_usual(protocol.scene)]
    return ", ".join(said)


def _episodes(protocol: Protocol) -> str:
    return (
        f"{protocol.episodes} episodes of {protocol.seconds:g} s for each, seeds {protocol.seed} "
        f"to {protocol.seed + protocol.episodes - 1}; medians unless it says mean, 95 % intervals"
    )


def _disturbed(one: Evaluation, first: Evaluation) -> str:
    kind, level = disturbance(one.protocol, first.protocol)
    return f"{kind.replace('_', ' ')} {level:g}{_UNITS.get(kind, '')}" if kind else "none"
