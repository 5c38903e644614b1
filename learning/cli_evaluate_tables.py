"""What `dexctl evaluate` prints: a table for each object, or the transfer matrix."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.table import Table

from dexctl.cli.output import results
from dexctl.statistics import Estimate
from learning.evaluate import Evaluation, Protocol
from learning.robustness import disturbance
from learning.transfer import Transfer

_UNITS = {"joint": " rad", "position": " m", "normal": "", "force": "", "push": " N"}


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
    gravity, axis = protocol.gravity, protocol.axis
    palm = f"palm {gravity}" if isinstance(gravity, str) else f"gravity {_vector(gravity)} m/s²"
    late = f", sensors {protocol.latency:g} s late" if protocol.latency else ""
    return f"{palm}, about {axis if isinstance(axis, str) else _vector(axis)}{late}"


def _episodes(protocol: Protocol) -> str:
    return (
        f"{protocol.episodes} episodes of {protocol.seconds:g} s for each, seeds {protocol.seed} "
        f"to {protocol.seed + protocol.episodes - 1}; medians unless it says mean, 95 % intervals"
    )


def _vector(numbers: Sequence[float]) -> str:
    return f"({', '.join(f'{number:g}' for number in numbers)})"


def _table() -> Table:
    return Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))


def _interval(one: Estimate, factor: float = 1.0, digits: int = 2, unit: str = "") -> str:
    value, low, high = (f"{factor * x:.{digits}f}" for x in (one.value, one.low, one.high))
    return f"{value}{unit} ({low} to {high})"


def _disturbed(one: Evaluation) -> str:
    kind, level = disturbance(one.protocol)
    return f"{kind} {level:g}{_UNITS[kind]}" if kind else "none"
