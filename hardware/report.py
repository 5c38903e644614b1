"""A run's log as one HTML page: what happened, tracking, torques, temperatures, rates, contacts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexctl.files import write_text
from dexctl.report import html
from dexctl.report.style import (
    FAINT,
    GRID,
    INK,
    drawing,
    finger_colour,
    legend_above,
    new_figure,
)
from dexctl.state import Floats
from hardware.figures import (
    GOAL_ANGLE,
    figures_of_merit,
    in_full,
    in_words,
    left_to_goal,
    object_turn,
    title,
    turn_figure,
)
from hardware.findings import findings, joint_names, span, torque_limits, touch_thresholds
from hardware.log import Log, limits_of, of_joints

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH = 8.0  # [inch]; every figure has it, so that time axes line up on the page


def write(log: Log, path: Path) -> None:
    """Write the report to ``path``."""
    write_text(path, build(log))


def build(log: Log) -> str:
    """The report as one HTML document; a log without ticks gives a page that says so."""
    figures = figures_of_merit(log)
    sections = [html.section("What happened", *_what_happened(log))]
    if figures:
        if found := findings(log):
            parts = [html.paragraph(sentence) for sentence in found]
            sections.append(html.section("What to look at", *parts))
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
    sections.append(html.section("Run", html.facts([("log", log.path.name), *_about(log)])))
    name = str(log.run.get("controller", "a run"))
    where = "an emulated servo hand" if log.run.get("emulated") else "a servo hand"
    return html.page(f"{name} on {where}", str(log.run.get("date", "")), sections)


_RUN = {
    "controller": "controller",
    "date": "date",
    "hand": "hand",
    "emulated": "emulated",
    "models": "servos",
    "calibration_date": "calibrated",
    "stiffness_nm_per_rad": "stiffness [N m/rad]",
    "damping_nms_per_rad": "damping [N m s/rad]",
    "action_latency_s": "latency of actions [s]",
    "object": "object",
    "palm": "palm looks",
    "touch": "touch",
    "rate_hz": "control rate [Hz]",
    "seed": "seed",
}
"""Of what a log says first: what people read."""


def _about(log: Log) -> list[tuple[str, str]]:
    """What was run, with limits, as rows for people."""
    rows = [
        (words, _said(value))
        for key, words in _RUN.items()
        if not isinstance(value := log.run.get(key, {}), dict | list)
    ]
    count = len(joints) if isinstance(joints := log.run.get("joints"), list) else 1
    for key in ("stiffness_nm_per_rad", "damping_nms_per_rad"):
        each = of_joints(log.run, count, key)
        if isinstance(log.run.get(key), list) and each is not None:
            rows.append((_RUN[key], span(each)))
    for name, unit in (("speed_limit", "rad/s"), ("torque_limit", "N m")):
        if (each := limits_of(log.run, count, name)) is not None:
            rows.append((f"{name.replace('_', ' ')} [{unit}]", span(each)))
    return rows


def _said(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {True: "yes", False: "no", None: "none"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _what_happened(log: Log) -> list[str]:
    summary = log.summary
    parts = []
    if log.cut:
        parts.append(html.paragraph("The log ends before its end mark: the run was cut off."))
    if log.damage:
        parts.append(html.paragraph(f"The log is damaged: {log.damage}."))
    if summary:
        cause = f" ({summary['cause']})" if summary.get("cause") else ""
        torque = summary.get("torque_message", "the torque state is not known from this log")
        ended = in_full(str(summary.get("outcome")), summary.get("signal"))
        parts.append(html.paragraph(f"The run {ended}{cause}; {torque}."))
        counts = summary.get("counts")
        if isinstance(counts, dict):
            parts.append(html.table(("event", "times"), [(k, str(v)) for k, v in counts.items()]))
    else:
        parts.append(html.paragraph("No summary: the torque state is not known from this log."))
    rows = [
        (_seconds(e.get("time")), *(str(e.get(key)) for key in ("event", "state", "detail")))
        for e in log.events
    ]
    return [*parts, html.table(("time", "event", "state", "detail"), rows)]


def _tracking(log: Log) -> str:
    error = log.ticks["q_target"] - log.ticks["q"]
    alt = "set-points less joints over time"
    return _by_finger(log, error, "set-point less joint [rad]", alt, "Grey: no controller runs.")


def _torque(log: Log) -> str:
    caption = "Torque by what the servos measure."
    limits = torque_limits(log)
    if limits is not None:
        caption += f" The limit is {span(limits)} N m: thin lines, where it is near."
    return _by_finger(
        log, log.ticks["torque"], "torque [N m]", "torque over time", caption,
        [] if limits is None else [sign * each for each in np.unique(limits) for sign in (-1, 1)],
    )  # fmt: skip


def _force(log: Log) -> str:
    thresholds = touch_thresholds(log)
    caption = ""
    if len(thresholds) == 1:
        caption = f"Thin line: what counts as touch, {thresholds[0]:g} N."
    elif thresholds:
        caption = "Thin lines: touch begins at {:g} N and ends below {:g} N.".format(*thresholds)
    return _by_finger(
        log, log.ticks["contact_force"], "normal force [N]", "forces over time", caption,
        thresholds,
    )  # fmt: skip


_ALIKE = 0.005  # of a plot's height: about the width of a line
_STYLES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
_ORDINALS = ("1st", "2nd", "3rd", "4th", "5th")


def _by_finger(
    log: Log, values: Floats, label: str, alt: str, caption: str = "", bounds: Sequence[float] = ()
) -> str:
    """Columns of ``(T, k)`` over time: a colour for each finger, a line style for its joints."""
    fingers = _fingers(log, values.shape[1])
    figure = new_figure(_WIDTH, 2.9)
    axes = figure.subplots()
    place: Counter[int] = Counter()
    order = []  # of each joint in its finger
    for finger in fingers:
        order.append(place[finger])
        place[finger] += 1
    known: set[str] = set()
    for columns in _coinciding(values):
        among = sorted({fingers[j] for j in columns})
        # curves upon one another would all seem to be the last one's
        colour = INK if len(among) > 1 else finger_colour(among[0])
        name = f"finger {', '.join(str(finger + 1) for finger in among)}"
        name += " alike" if len(among) > 1 else ""
        axes.plot(
            log.ticks["time"], values[:, columns[0]], color=colour, linewidth=0.9,
            linestyle=_STYLES[order[columns[0]] % len(_STYLES)],
            label=None if name in known else name,
        )  # fmt: skip
        known.add(name)
    most = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0
    for bound in bounds:
        if most > 0.5 * abs(bound):  # far away it would only flatten the curves
            axes.axhline(bound, color=FAINT, linewidth=0.6)
    axes.set(xlabel="time [s]", ylabel=label)
    _shade(axes, log)
    legend_above(axes)
    joints = min(max(place.values()), len(_STYLES))
    if joints > 1:
        _legend_of_styles(axes, joints)
    return html.plot(figure, alt, caption)


def _legend_of_styles(axes: Axes, joints: int) -> None:
    """Which line style is which joint of a finger, in a row above the fingers' legend."""
    from matplotlib.lines import Line2D

    fingers = axes.get_legend()
    assert fingers is not None
    lines = [
        Line2D([], [], color=INK, linewidth=0.9, linestyle=style, label=f"{order} joint")
        for order, style in zip(_ORDINALS[:joints], _STYLES, strict=False)
    ]
    axes.legend(
        handles=lines, loc="lower left", bbox_to_anchor=(0, 1.08), ncols=joints,
        borderaxespad=0.2, handlelength=2.4, columnspacing=1.4,
    )  # fmt: skip
    axes.add_artist(fingers)


def _coinciding(values: Floats) -> list[list[int]]:
    """Columns of ``(T, k)`` in groups of those that could not be told apart in a plot."""
    span = float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() else 0.0
    groups: list[list[int]] = []
    for j, column in enumerate(values.T):
        for group in groups:
            apart = np.nan_to_num(np.abs(column - values[:, group[0]]))
            if apart.max() <= _ALIKE * span:
                group.append(j)
                break
        else:
            groups.append([j])
    return groups


def _fingers(log: Log, count: int) -> list[int]:
    """Which finger each of ``count`` columns is of: by the log, or in equal shares."""
    if count == log.ticks["in_contact"].shape[1]:
        return list(range(count))
    said = log.run.get("joint_fingers")
    if isinstance(said, list) and len(said) == count and all(isinstance(f, int) for f in said):
        return said
    fingers = max(log.ticks["in_contact"].shape[1], 1)
    return [j * fingers // count for j in range(count)]


def _seconds(value: object) -> str:
    return f"{value:.2f} s" if isinstance(value, float | int) else "?"


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
    left = left_to_goal(log)
    figure = new_figure(_WIDTH, 2.2)
    plots = [(angle, title(turn_figure(log)))]
    if left is not None:
        plots.append((left, "left to the goal [rad]"))
    for axes, (values, label) in zip(
        figure.subplots(1, len(plots), squeeze=False)[0], plots, strict=True
    ):
        axes.plot(log.ticks["time"][held], values[held])
        axes.set(xlabel="time [s]", ylabel=label)
        _shade(axes, log)
    if left is not None:
        axes.axhline(GOAL_ANGLE, color=GRID)
        axes.set_ylim(bottom=0.0)
    whose = "As the emulator knows it" if log.run.get("emulated") else "As it was tracked by touch"
    return html.plot(figure, "the object's turn over time", f"{whose}, until it is lost.")


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
    time = np.array([item["time"] for item in log.health], float)
    figure = new_figure(_WIDTH, 2.6)
    axes = figure.subplots(1, 2)
    for axis, name, unit, high in (
        (axes[0], "temperature", "\N{DEGREE SIGN}C", "hottest"),
        (axes[1], "voltage", "V", "highest"),
    ):
        values = np.array([item[name] for item in log.health], float)
        low = {"hottest": "coolest", "highest": "lowest"}[high]
        axis.fill_between(time, values.min(axis=1), values.max(axis=1), color=GRID, linewidth=0)
        mean = np.nan_to_num(np.nanmean(values, axis=0))
        picked = [(1, high, int(mean.argmax())), (0, low, int(mean.argmin()))]
        for finger, word, servo in picked if np.ptp(mean) else picked[:1]:
            alike = np.ptp(mean) == 0
            axis.plot(
                time, values[:, servo], color=finger_colour(finger), linewidth=1.0,
                label="all servos" if alike else f"{word}: {_servo(log, servo)}",
            )  # fmt: skip
        axis.set(xlabel="time [s]", ylabel=f"{name} [{unit}]")
        middle, span = float(np.nanmean(values)), float(np.nanmax(values) - np.nanmin(values))
        if span < 1.0:  # a flat line is no drama
            axis.set_ylim(middle - 1.0, middle + 1.0)
        axis.legend(loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return html.plot(
        figure, "temperature and voltage over time", "Grey: from the lowest to the highest of all."
    )


def _servo(log: Log, column: int) -> str:
    """The servo of a column, by its joint where the log says it."""
    servos = log.run.get("servos")
    ids = servos if isinstance(servos, list) and len(servos) > column else None
    return f"servo {ids[column] if ids else column + 1} ({joint_names(log)[column]})"
