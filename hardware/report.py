"""A run's log as one HTML page: what happened, tracking, torques, temperatures, rates, contacts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexctl.files import write_text
from dexctl.report import html
from dexctl.report.style import GRID, drawing, finger_colour, legend_above, new_figure
from dexctl.state import Floats
from hardware.figures import figures_of_merit, in_words, object_turn
from hardware.log import Log

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH = 8.0  # [inch]; every figure has it, so that time axes line up on the page


def write(log: Log, path: Path) -> None:
    """Write the report to ``path``."""
    write_text(path, build(log))


def build(log: Log) -> str:
    """The report as one HTML document; a log without ticks gives a page that says so."""
    run = log.run
    figures = figures_of_merit(log)
    sections = [html.section("What happened", *_what_happened(log))]
    if figures:
        sections.append(html.section("Figures", html.facts(in_words(figures))))
        with drawing():
            sections.append(html.section("Joints", _tracking(log), _torque(log)))
            sections.append(html.section("Clock", _clock(log)))
            if log.ticks["in_contact"].any():
                sections.append(html.section("Touch", _force(log), _turn(log)))
            if log.health:
                sections.append(html.section("Servos", _health(log)))
    else:
        sections.append(html.paragraph("The log holds no ticks.", "note"))
    about = [(key, str(value)) for key, value in run.items() if not isinstance(value, dict | list)]
    sections.append(html.section("Run", html.facts([("log", log.path.name), *about])))
    name = str(run.get("controller", "a run"))
    return html.page(f"{name} on a servo hand", str(run.get("date", "")), sections)


def _what_happened(log: Log) -> list[str]:
    summary = log.summary
    parts = []
    if log.cut:
        parts.append(html.paragraph("The log ends before its end mark: the run was cut off."))
    if summary:
        cause = f" ({summary['cause']})" if summary.get("cause") else ""
        parts.append(
            html.paragraph(f"Outcome: {summary['outcome']}{cause}; {summary['torque_message']}.")
        )
        counts = summary.get("counts", {})
        parts.append(html.table(("event", "times"), [(k, str(v)) for k, v in counts.items()]))
    else:
        parts.append(html.paragraph("No summary: the torque state is not known from this log."))
    rows = [
        (f"{e.get('time', 0):.2f} s", *(str(e.get(key)) for key in ("event", "state", "detail")))
        for e in log.events
    ]
    return [*parts, html.table(("time", "event", "state", "detail"), rows)]


def _tracking(log: Log) -> str:
    error = log.ticks["q_target"] - log.ticks["q"]
    alt = "set-points less joints over time"
    return _by_finger(log, error, "set-point less joint [rad]", alt, "Grey: no controller runs.")


def _torque(log: Log) -> str:
    return _by_finger(log, log.ticks["torque"], "torque, by current [N m]", "torque over time")


def _force(log: Log) -> str:
    return _by_finger(log, log.ticks["contact_force"], "normal force [N]", "forces over time")


def _by_finger(log: Log, values: Floats, label: str, alt: str, caption: str = "") -> str:
    """Columns of ``(T, k)`` over time; equal shares of them are each finger's."""
    fingers, count = max(log.ticks["in_contact"].shape[1], 1), values.shape[1]
    figure = new_figure(_WIDTH, 2.8)
    axes = figure.subplots()
    for j in range(count):
        finger = j * fingers // count
        first = j == 0 or (j - 1) * fingers // count < finger
        name = f"finger {finger + 1}" if first else None
        axes.plot(
            log.ticks["time"], values[:, j], color=finger_colour(finger), linewidth=0.8, label=name
        )
    axes.set(xlabel="time [s]", ylabel=label)
    _shade(axes, log)
    legend_above(axes)
    return html.plot(figure, alt, caption)


def _shade(axes: Axes, log: Log) -> None:
    """Grey where the controller does not run: before it starts, and while the hand is held."""
    time, state = log.ticks["time"], log.ticks.get("state")
    if state is not None:
        axes.fill_between(
            time, 0, 1, where=state != "run", transform=axes.get_xaxis_transform(),
            color=GRID, alpha=0.5, linewidth=0, zorder=0,
        )  # fmt: skip


def _turn(log: Log) -> str:
    turn = object_turn(log)
    if turn is None:
        return ""
    angle, held = turn
    figure = new_figure(_WIDTH, 2.2)
    axes = figure.subplots()
    axes.plot(log.ticks["time"][held], angle[held])
    axes.set(xlabel="time [s]", ylabel="object's turn about z [rad]")
    _shade(axes, log)
    return html.plot(
        figure, "the object's turn over time", "Known in simulation only, until it is lost."
    )


def _clock(log: Log) -> str:
    figure = new_figure(_WIDTH, 2.4)
    axes = figure.subplots(1, 2)
    axes[0].plot(log.ticks["time"], 1e3 * log.ticks["lateness"], linewidth=0.7)
    axes[0].set(xlabel="time [s]", ylabel="lateness of ticks [ms]")
    seconds = log.ticks.get("controller_seconds")
    if seconds is not None and np.isfinite(seconds).any():
        axes[1].hist(1e3 * seconds[np.isfinite(seconds)], bins=40)
    axes[1].set(xlabel="time that the controller took [ms]", ylabel="ticks")
    return html.plot(figure, "lateness over time, and how long the controller took")


def _health(log: Log) -> str:
    time = [item["time"] for item in log.health]
    figure = new_figure(_WIDTH, 2.4)
    axes = figure.subplots(1, 2)
    for axis, name, unit in ((axes[0], "temperature", "C"), (axes[1], "voltage", "V")):
        values = np.array([item[name] for item in log.health], float)
        axis.plot(time, values, linewidth=0.8)
        axis.set(xlabel="time [s]", ylabel=f"{name} [{unit}]")
    return html.plot(figure, "temperature and voltage over time", "One line per servo.")
