"""What `dexctl evaluate` prints, leaves in a folder, and says as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.table import Table

from dexctl.cli.output import notes, results, to_json
from dexctl.exceptions import MissingExtra
from dexctl.files import write_text
from dexctl.report.machine import machine
from dexctl.settings import to_plain
from dexctl.statistics import Estimate
from learning.cli import evaluate_figures as figures
from learning.evaluation import Evaluation, Protocol, files
from learning.evaluation.robustness import disturbance, levels_of
from learning.evaluation.transfer import Trained, Transfer

_UNITS = {"joint_noise": " rad", "position_noise": " m", "normal_noise": " rad", "push_force": " N"}


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
        files.write_figures(folder / "figures.csv", found)
        files.write_curves(folder / "curves.csv", found)
        files.write_episodes(folder / "episodes.csv", found)
    try:
        _draw(folder, found, matrix)
    except MissingExtra as error:  # the numbers are worth more than the figures
        notes().print(f"dexctl: {error}; no figures are drawn", markup=False)
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
    console.print(f"[bold]{who}, {_setting(protocol)}[/bold]", soft_wrap=True)
    console.print(_episodes(protocol), soft_wrap=True)
    for name, group in groupby(found, key=lambda one: one.object):
        rows = list(group)
        console.print(f"\n[bold]{name}[/bold]")
        console.print(_figures(rows[0]) if len(rows) == 1 else _disturbances(rows))
    broken = sum(int(one.diverged.sum()) for one in found)
    if broken:
        console.print(f"{broken} simulations broke down; they count as dropped.")


def print_transfer(found: Transfer, protocol: Protocol) -> None:
    """The scores, with the rotations that they are of."""
    console = results()
    console.print(f"[bold]Transfer, {_setting(protocol)}[/bold]", soft_wrap=True)
    console.print(_episodes(protocol), soft_wrap=True)
    console.print(
        "Median rotation over that with the policy's own object (and the rotation itself)\n",
        soft_wrap=True,
    )
    table = _table()
    for heading in ("policy of", *found.objects):
        table.add_column(heading)
    for i, policy in enumerate(found.policies):
        cells = []
        for j in range(len(found.objects)):
            score, raw = found.score(i, j), found.raw(i, j)
            cells.append(
                f"{'   -' if score is None else f'{score.value:.2f}'} ({raw.value:.2f} rad)"
            )
        table.add_row(policy.object, *cells)
    console.print(table)


def _figures(one: Evaluation) -> Table:
    """One evaluation: a row for each figure."""
    figures, table = one.figures(), _table()
    table.show_header = False
    for name, figure, factor, digits, unit in (
        ("rotation", "rotation_median_rad", 1.0, 2, " rad"),
        ("revolutions", "revolutions_median", 1.0, 2, ""),
        ("mean speed", "speed_mean_rad_s", 1.0, 3, " rad/s"),
        ("held", "time_held_median_s", 1.0, 1, " s"),
        ("dropped", "share_dropped", 100.0, 0, " %"),
        ("made a full turn", "share_full_turn", 100.0, 0, " %"),
        ("mean return", "return_mean", 1.0, 1, ""),
        ("only fingertips touch", "share_fingertips_only", 100.0, 0, " %"),
        ("sinks by", "drift_median_m", 1e3, 1, " mm"),
    ):
        table.add_row(name, _interval(figures[figure], factor, digits, unit))
    return table


def _disturbances(rows: Sequence[Evaluation]) -> Table:
    """Several evaluations of one object: a row for each."""
    table = _table()
    for heading in ("disturbed", "rotation, rad", "turns", "dropped", "mean return"):
        table.add_column(heading, no_wrap=True)
    for one in rows:
        figures = one.figures()
        table.add_row(
            _disturbed(one),
            _interval(figures["rotation_median_rad"]),
            f"{figures['revolutions_median'].value:.2f}",
            _interval(figures["share_dropped"], 100.0, 0, " %"),
            _interval(figures["return_mean"], digits=0),
        )
    return table


def _setting(protocol: Protocol) -> str:
    axis, late = protocol.task.axis, protocol.scene.sensing.sensor_latency
    about = axis if isinstance(axis, str) else f"({', '.join(f'{number:g}' for number in axis)})"
    return f"{protocol.scene.palm}, about {about}" + (f", sensors {late:g} s late" if late else "")


def _episodes(protocol: Protocol) -> str:
    return (
        f"{protocol.episodes} episodes of {protocol.seconds:g} s for each, seeds {protocol.seed} "
        f"to {protocol.seed + protocol.episodes - 1}; medians unless it says mean, 95 % intervals"
    )


def _table() -> Table:
    return Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))


def _interval(one: Estimate, factor: float = 1.0, digits: int = 2, unit: str = "") -> str:
    value, low, high = (f"{factor * x:.{digits}f}" for x in (one.value, one.low, one.high))
    return f"{value}{unit} ({low} to {high})"


def _disturbed(one: Evaluation) -> str:
    kind, level = disturbance(one.protocol)
    return f"{kind.replace('_', ' ')} {level:g}{_UNITS.get(kind, '')}" if kind else "none"
