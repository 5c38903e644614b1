"""One episode on one time axis: contacts, rotation, grasp, angles, critic."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dexctl.report.figures import WIDTH, switching_fingers
from dexctl.report.style import (
    FAINT,
    INK,
    controller_line,
    finger_colour,
    legend_columns,
    new_figure,
    title_of,
)
from dexctl.state import Bools, Floats
from learning.inspection.findings import Inspection
from learning.inspection.gait import runs
from learning.inspection.onset import Drop

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMOOTH = 1.0  # [s], over which the speed is averaged
_BAD, _ONSET = "#f3d9c4", "#d55e00"  # behind what is not sound; where a drop begins


def timeline_figure(
    found: Inspection, episode: int, window: tuple[float, float], drop: Drop | None = None
) -> Figure:
    """An episode within ``window`` [s]; the moment at which a drop begins and ends is marked."""
    critic = found.rollouts.valued is not None
    heights = [1.9, 1.0, 0.9, 0.9, 0.9, 1.2, *([1.0] if critic else [])]
    figure = new_figure(WIDTH, 0.95 * sum(heights) + 1.6)
    rows = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    contacts(figure, rows[0], found, episode, window)
    _speed(rows[1], found, episode, window)
    _drift(rows[2], found, episode)
    _residual(rows[3], found, episode)
    _margin(rows[4], found, episode)
    _angles(rows[5], found, episode)
    if critic:
        _chances(rows[6], found, episode)
    _mark(rows, found, episode, drop)
    rows[-1].set(xlabel="time [s]")
    rows[-1].set_xlim(*window)
    figure.align_ylabels(rows)
    return figure


def gait_figure(found: Inspection, episode: int, window: tuple[float, float]) -> Figure:
    """The contact diagram alone, and the object's speed under it."""
    figure = new_figure(WIDTH, 3.4)
    rows = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    contacts(figure, rows[0], found, episode, window)
    _speed(rows[1], found, episode, window)
    rows[1].set(xlabel="time [s]")
    rows[1].set_xlim(*window)
    figure.align_ylabels(rows)
    return figure


def contacts(
    figure: Figure, axes: Axes, found: Inspection, episode: int, window: tuple[float, float]
) -> None:
    """The gait diagram: a row per finger, a bar while it touches, the darker the harder."""
    trace, period = found.rollouts.trace, found.period
    touch = trace.in_contact[:, episode]
    force = np.where(touch, trace.contact_force[:, episode], np.nan)
    shown = slice(*np.searchsorted(trace.time, window))
    count = touch.shape[1]
    inside = force[shown]
    finite = inside[np.isfinite(inside)]
    top = max(float(np.percentile(finite, 98)), 0.1) if len(finite) else 1.0
    image = None
    start = float(trace.time[shown][0])
    end = start + len(inside) * period
    for i in range(count):
        image = axes.imshow(
            inside[None, :, i],
            extent=(start, end, i + 0.36, i - 0.36),
            aspect="auto",
            cmap=_force_colours(),
            vmin=0.0,
            vmax=top,
            interpolation="none",
        )
    switching = switching_fingers(trace, episode)
    if switching is not None:
        for i in range(count):
            spans = [(a * period, (b - a) * period) for a, b in runs(switching[:, i])]
            axes.broken_barh(spans, (i - 0.42, 0.84), facecolor="none", edgecolor=INK, lw=0.8)
    axes.set_yticks(range(count), [f"finger {i + 1}" for i in range(count)])
    axes.set_ylim(count - 0.4, -0.6)  # finger 1 on top
    axes.grid(visible=False, axis="y")
    for label, i in zip(axes.get_yticklabels(), range(count), strict=True):
        label.set_color(finger_colour(i))
    axes.tick_params(axis="y", length=0)
    axes.set_title("Which fingertips touch, and how hard")
    if image is not None:
        bar = figure.colorbar(image, ax=axes, pad=0.01, aspect=12)
        bar.set_label("force [N]", fontsize=8)
        bar.outline.set_visible(False)


def _force_colours():
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("force", ["#b9d9ee", "#0072b2", "#00243d"])


def _speed(axes: Axes, found: Inspection, episode: int, window: tuple[float, float]) -> None:
    trace = found.rollouts.trace
    held = trace.held[:, episode]
    rotation = trace.rotation[held, episode]
    time = trace.time[held]
    axes.plot(time, rotation, color=INK, lw=1.3)
    shown = rotation[(time >= window[0]) & (time <= window[1])]
    if len(shown):
        room = 0.08 * max(float(np.ptp(shown)), 0.2)
        axes.set_ylim(float(shown.min()) - room, float(shown.max()) + room)
    axes.set(ylabel="turned [rad]")
    axes.set_title("Rotation of the object (black) and its speed (blue)")
    speed = axes.twinx()
    smooth = moving_average(np.diff(rotation) / found.period, round(SMOOTH / found.period))
    speed.plot(time[1:], smooth, color="#0072b2", lw=0.9)
    speed.set_ylabel("[rad/s]", color="#0072b2")
    speed.tick_params(axis="y", colors="#0072b2")
    speed.spines["right"].set_visible(False)
    speed.grid(visible=False)


def _drift(axes: Axes, found: Inspection, episode: int) -> None:
    trace = found.rollouts.trace
    held = trace.held[:, episode]
    away = 1e3 * (trace.object_position[held, episode] - trace.object_position[0, episode])
    gravity = found.rollouts.scene.gravity
    size = float(np.linalg.norm(gravity))
    upwards = -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
    up = away @ upwards
    aside = np.linalg.norm(away - up[:, None] * upwards, axis=1)
    axes.plot(trace.time[held], up, color=INK, lw=1.1, label="up")
    axes.plot(trace.time[held], aside, color=FAINT, lw=1.1, label="aside")
    axes.set(ylabel="drift [mm]")
    axes.set_title("How far the object is from its start, and its tilt (blue)")
    _legend(axes)
    tilt = axes.twinx()
    tilt.plot(trace.time[held], found.grasps.tilt[held, episode], color="#0072b2", lw=0.9)
    tilt.set_ylabel("[rad]", color="#0072b2")
    tilt.set_ylim(bottom=0)
    tilt.tick_params(axis="y", colors="#0072b2")
    tilt.spines["right"].set_visible(False)
    tilt.grid(visible=False)


def _residual(axes: Axes, found: Inspection, episode: int) -> None:
    trace = found.rollouts.trace
    held = trace.held[:, episode]
    axes.plot(trace.time[held], found.grasps.residual[held, episode], color=INK, lw=0.9)
    axes.set(ylabel="residual [-]")
    axes.set_ylim(bottom=0)
    axes.set_title("Wrench that the stability QP leaves, per unit of grip force")


def _margin(axes: Axes, found: Inspection, episode: int) -> None:
    trace, grasps = found.rollouts.trace, found.grasps
    held = trace.held[:, episode]
    margin = np.where(held, grasps.margin[:, episode], np.nan)
    sampled = np.isfinite(margin)
    axes.plot(trace.time[sampled], margin[sampled], color="#009e73", lw=1.0, marker=".", ms=2)
    open_ = held & ~grasps.closure[:, episode]
    for a, b in runs(open_):
        axes.axvspan(a * found.period, b * found.period, color="#d55e00", alpha=0.25, lw=0)
    axes.set(ylabel="margin [-]")
    axes.set_ylim(bottom=0)
    axes.set_title("Force-closure margin (epsilon quality); orange: no force closure")


def _angles(axes: Axes, found: Inspection, episode: int) -> None:
    rollouts = found.rollouts
    time = rollouts.trace.time[:-1]
    for name in rollouts.shadows:
        angle = np.rad2deg(rollouts.angle(name, "motion")[:, episode])
        axes.plot(time, angle, label=title_of(name), lw=1.1, **controller_line(name))
    axes.axhline(90, color=FAINT, lw=0.8, ls=(0, (2, 2)))
    axes.set(ylabel="angle [deg]", ylim=(0, 180), yticks=(0, 45, 90, 135, 180))
    axes.set_title("Angle between what was done and what each controller would do")
    _legend(axes)


def _chances(axes: Axes, found: Inspection, episode: int) -> None:
    rollouts = found.rollouts
    assert rollouts.valued is not None
    acting = rollouts.acting[:, episode]
    time, chances = rollouts.trace.time[:-1][acting], rollouts.valued.chances[acting, episode]
    for k, name in enumerate(rollouts.shadows, start=1):
        axes.plot(time, chances[:, k], lw=1.0, label=title_of(name), **controller_line(name))
    axes.set(ylabel="probability", ylim=(0, 1))
    axes.set_title("p_psi: how likely the critic would let each controller act")


def _mark(rows: np.ndarray, found: Inspection, episode: int, drop: Drop | None) -> None:
    """Where the grasp was not sound, where the drop begins, and the drop itself."""
    trace, period = found.rollouts.trace, found.period
    held = trace.held[:, episode]
    for a, b in runs(held & ~found.sound[:, episode]):
        for axes in rows[:4]:
            axes.axvspan(a * period, b * period, color=_BAD, alpha=0.5, lw=0, zorder=-5)
    notes = []
    if not held[-1]:
        at = float(trace.time[held.sum() - 1])
        for axes in rows:
            axes.axvline(at, color=INK, lw=1.2, zorder=4)
            axes.axvspan(at, float(trace.time[-1]), color="white", alpha=0.6, lw=0, zorder=3)
        notes.append((at, "dropped", "right", INK))
    if drop is not None and drop.onset >= 0:
        at = drop.onset * drop.period
        for axes in rows:
            axes.axvline(at, color=_ONSET, lw=1.2, ls=(0, (4, 2)), zorder=4)
        notes.append((at, "onset", "right" if drop.onset > 10 else "left", _ONSET))
    for at, words, side, colour in notes:
        rows[0].annotate(
            words, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 1),
            textcoords="offset points", ha=side, va="bottom", fontsize=8, color=colour,
            annotation_clip=True,
        )  # fmt: skip
    if notes:  # between the axes and their title
        rows[0].set_title(rows[0].get_title(loc="left"), pad=15)


def _legend(axes: Axes) -> None:
    """The legend in a row at the top of the axes, the lines showing through."""
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        axes.legend(
            handles, labels, loc="upper right", ncols=legend_columns(labels), borderaxespad=0.1,
            handlelength=2.0, columnspacing=1.2, fontsize=8, frameon=True, facecolor="white",
            framealpha=0.8, edgecolor="none", borderpad=0.2,
        )  # fmt: skip


def moving_average(values: Floats, width: int) -> Floats:
    """Mean over ``width`` rows around each of ``(T,)``, of those that are numbers."""
    known: Bools = np.isfinite(values)
    ones = np.ones(max(1, min(width, len(values))))
    total = np.convolve(np.where(known, values, 0.0), ones, "same")
    count = np.convolve(known.astype(float), ones, "same")
    return np.where(known & (count > 0), total / np.maximum(count, 1.0), np.nan)
