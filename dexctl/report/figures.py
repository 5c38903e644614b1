"""The plots of a report. Each function draws one matplotlib figure from traces.

Call them inside `dexctl.report.style.drawing`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.report.style import (
    FAINT,
    INK,
    controller_line,
    finger_colour,
    legend_above,
    new_figure,
    title_of,
)
from dexctl.report.summary import FULL_TURN, column, diagnostic
from dexctl.sim import Trace
from dexctl.state import Bools

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CROSS: dict[str, Any] = {"ms": 6, "mew": 1.8, "clip_on": False, "zorder": 5}  # where it dropped
WIDTH = 7.6  # [inch]; every figure has it, so that time axes line up on the page


def rotation_figure(traces: Mapping[str, Trace], index: int = 0) -> Figure:
    """Rotation over time, one line per controller, a cross where the object was dropped."""
    figure = new_figure(WIDTH, 3.2)
    axes = figure.add_subplot()
    for name, trace in traces.items():
        rotation, held = column(trace.rotation, index), column(trace.held, index)
        last = held.sum() - 1
        line = controller_line(name)
        axes.plot(trace.time[: last + 1], rotation[: last + 1], label=title_of(name), **line)
        if not held[-1]:
            axes.plot(trace.time[last], rotation[last], "x", color=line["color"], **_CROSS)
    if any(trace.dropped.any() for trace in traces.values()):
        axes.plot([], [], "x", color=INK, label="object dropped", **_CROSS)
    axes.set(xlabel="time [s]", ylabel="rotation [rad]")
    axes.set_xlim(0, max(trace.time[-1] for trace in traces.values()))
    turns = axes.secondary_yaxis("right", functions=(_to_turns, _to_radians))
    turns.set_ylabel("[turns]")
    legend_above(axes)
    return figure


def spread_figure(name: str, trace: Trace) -> Figure:
    """Rotation over time of N trials: every trial, the median, and the 10 to 90 % band."""
    figure = new_figure(WIDTH, 3.2)
    axes = figure.add_subplot()
    colour = controller_line(name)["color"]
    low, middle, high = np.percentile(trace.rotation, [10, 50, 90], axis=1)
    axes.plot(trace.time, trace.rotation, color=colour, lw=0.5, alpha=0.25)
    axes.fill_between(trace.time, low, high, color=colour, alpha=0.2, lw=0, label="10 to 90 %")
    axes.plot(trace.time, middle, color=colour, lw=2.0, label="median")
    last = trace.held.sum(axis=0) - 1
    rows = np.flatnonzero(trace.dropped)
    if len(rows):
        dropped = trace.rotation[last[rows], rows]
        axes.plot(trace.time[last[rows]], dropped, "x", color=INK, label="object dropped", **_CROSS)
    axes.set(xlabel="time [s]", ylabel="rotation [rad]")
    axes.margins(x=0)
    turns = axes.secondary_yaxis("right", functions=(_to_turns, _to_radians))
    turns.set_ylabel("[turns]")
    legend_above(axes)
    return figure


def trial_figure(trace: Trace, index: int = 0) -> Figure:
    """One trial, on one time axis: contact (gait) diagram, normal forces, residual of the QP."""
    residual = diagnostic(trace, "residual", index)
    heights = (1.5, 1.6, 1.0) if residual is not None else (1.5, 1.6)
    figure = new_figure(WIDTH, 1.25 * sum(heights) + 0.5)
    rows = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    contact_diagram(rows[0], trace, index)
    rows[0].set_title("Which fingertips touch")
    force = column(trace.contact_force, index, 1)
    for i in range(force.shape[1]):
        rows[1].plot(trace.time, force[:, i], color=finger_colour(i), lw=1.0)
    rows[1].set(ylabel="normal force [N]")
    rows[1].set_ylim(bottom=0)
    rows[1].set_title("How hard they press")
    if residual is not None:
        rows[2].plot(trace.time[:-1], residual, color=INK, lw=1.0)
        rows[2].set(ylabel="residual [-]")
        rows[2].set_ylim(bottom=0)
        rows[2].set_title("Wrench left by the stability QP, per unit of grip force")
    held = column(trace.held, index)
    for axes in rows:
        _mark_drop(axes, trace, held)
    rows[-1].set(xlabel="time [s]")
    rows[-1].set_xlim(trace.time[0], trace.time[-1])
    figure.align_ylabels(rows)
    return figure


def contact_diagram(axes: Axes, trace: Trace, index: int = 0) -> None:
    """The gait diagram: a row per finger, a bar while it touches, an outline while it switches."""
    touch = column(trace.in_contact, index, 1)
    switching = switching_fingers(trace, index)
    period = float(trace.time[1] - trace.time[0])
    count = touch.shape[1]
    for i in range(count):
        colour = finger_colour(i)
        axes.broken_barh(_spans(touch[:, i], period), (i - 0.32, 0.64), facecolor=colour, lw=0)
        if switching is not None:
            axes.broken_barh(
                _spans(switching[:, i], period),
                (i - 0.42, 0.84),
                facecolor="none",
                edgecolor=INK,
                lw=0.8,
            )
    axes.set_yticks(range(count), [f"finger {i + 1}" for i in range(count)])
    axes.set_ylim(count - 0.4, -0.6)  # finger 1 on top
    axes.set_xlim(trace.time[0], trace.time[-1])
    axes.grid(visible=False, axis="y")
    for label, i in zip(axes.get_yticklabels(), range(count), strict=True):
        label.set_color(finger_colour(i))
    axes.tick_params(axis="y", length=0)


def diagram_caption(trace: Trace) -> str:
    """What the reader of `trial_figure` must know."""
    told = switching_fingers(trace) is not None
    outline = " Outlined: the controller is switching this finger." if told else ""
    return f"A bar while the fingertip touches.{outline} Colours are the same in all plots."


def switching_fingers(trace: Trace, index: int = 0) -> Bools | None:
    """Which finger a controller is switching, ``(T, m)``; None where it does not tell.

    From the diagnostics ``switching`` ``(T, m)`` bool, or ``finger`` ``(T,)``, -1 for none.
    """
    count = trace.in_contact.shape[-1]
    switching = diagnostic(trace, "switching", index, 1)
    if switching is not None and switching.shape[-1] == count and switching.dtype == bool:
        return switching
    finger = diagnostic(trace, "finger", index)
    if finger is None:
        return None
    return finger[:, None] == np.arange(count)


def act_time_figure(traces: Mapping[str, Trace], control_period: float) -> Figure:
    """Share of the controller's calls that took at most so long."""
    figure = new_figure(WIDTH, 2.8)
    axes = figure.add_subplot()
    for name, trace in traces.items():
        ordered = np.sort(trace.act_seconds) * 1e3
        share = np.arange(1, len(ordered) + 1) / len(ordered) * 100
        axes.step(ordered, share, where="post", label=title_of(name), **controller_line(name))
    axes.axvline(control_period * 1e3, color=FAINT, lw=1.0, ls=(0, (2, 2)))
    axes.annotate(
        "control period ",
        (control_period * 1e3, 8),
        ha="right",
        color=FAINT,
        fontsize=8,
    )
    axes.set(
        xscale="log",
        xlabel="time of one call for one hand [ms]",
        ylabel="calls [%]",
        ylim=(0, 101),
    )
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    legend_above(axes)
    return figure


def _mark_drop(axes: Axes, trace: Trace, held: Bools) -> None:
    if held[-1]:
        return
    at, end = float(trace.time[held.sum() - 1]), float(trace.time[-1])
    axes.axvspan(at, end, color="white", alpha=0.7, lw=0, zorder=3)
    axes.axvline(at, color=INK, lw=1.0, zorder=4)
    axes.annotate(
        " dropped",
        (at, 1.0),
        xycoords=("data", "axes fraction"),
        va="top",
        fontsize=8,
        zorder=5,
    )


def _spans(active: Bools, period: float) -> list[tuple[float, float]]:
    """(start, duration) [s] of each run of True; row i stands for one period from i on."""
    edges = np.diff(np.concatenate([[0], active.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(a * period, (b - a) * period) for a, b in zip(starts, ends, strict=True)]


def _to_turns(angle: ArrayLike) -> ArrayLike:
    return np.asarray(angle) / FULL_TURN


def _to_radians(turns: ArrayLike) -> ArrayLike:
    return np.asarray(turns) * FULL_TURN
