"""The plots over all episodes: gait, grasp, angles, critic, soundness."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dexctl.report.figures import WIDTH
from dexctl.report.style import (
    FAINT,
    INK,
    controller_line,
    finger_colour,
    legend_columns,
    new_figure,
    title_of,
)
from learning.inspection.findings import Inspection
from learning.inspection.gait import runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SOUND, UNSOUND = "#8fc9b2", "#e39a5f"


def turns_figure(found: Inspection) -> Figure:
    """How the fingers take turns: duty, fingers in contact, order, phase."""
    gait = found.gait
    m = len(gait.duty)
    figure = new_figure(WIDTH, 4.9)
    (duty, contacts), (order, phase) = figure.subplots(2, 2)
    colours = [finger_colour(i) for i in range(m)]
    names = [str(i + 1) for i in range(m)]
    duty.bar(names, gait.duty, color=colours, width=0.7)
    duty.set(xlabel="finger", ylabel="share of the time", ylim=(0, 1))
    duty.set_title("Duty factor: in touch")
    contacts.bar(np.arange(m + 1), gait.contacts, color=INK, width=0.7)
    contacts.set(xlabel="fingertips that touch", ylabel="share of the time", ylim=(0, 1))
    contacts.set_xticks(range(m + 1))
    contacts.set_title("Fingers in contact")
    for axes in (duty, contacts):
        axes.grid(visible=False, axis="x")
    rows = gait.order.sum(axis=1, keepdims=True)
    share = gait.order / np.maximum(rows, 1)
    order.imshow(share, cmap="Greys", vmin=0, vmax=1)
    for i in range(m):
        for j in range(m):
            if gait.order[i, j]:
                ink = "white" if share[i, j] > 0.55 else INK
                order.text(j, i, f"{100 * share[i, j]:.0f}", ha="center", va="center",
                           fontsize=8, color=ink)  # fmt: skip
    order.set_xticks(range(m), names)
    order.set_yticks(range(m), names)
    order.set(xlabel="next finger to lift", ylabel="finger that lifted")
    order.grid(visible=False)
    order.set_title("Order: who lifts next [%]")
    _phases(phase, found)
    return figure


def _phases(axes, found: Inspection) -> None:
    gait = found.gait
    m = len(gait.duty)
    if gait.reference < 0:
        axes.text(0.5, 0.5, "too few lifts", ha="center", va="center", color=FAINT,
                  transform=axes.transAxes)  # fmt: skip
        axes.set_xticks([])
        axes.set_yticks([])
    else:
        for i in range(m):
            if np.isfinite(gait.phase[i]):
                axes.barh(i, gait.regularity[i], height=0.55, color=finger_colour(i), alpha=0.35)
                axes.plot(gait.phase[i], i, "o", color=finger_colour(i), ms=7)
        axes.set_yticks(range(m), [str(i + 1) for i in range(m)])
        axes.set_ylim(m - 0.4, -0.6)
        axes.set_xlim(-0.03, 1.03)
        axes.set(xlabel="dot: phase; bar: how regular it is", ylabel="finger")
    axes.grid(visible=False, axis="y")
    axes.set_title("Phase" + (f", from finger {gait.reference + 1}" if gait.reference >= 0 else ""))


def grasp_figure(found: Inspection) -> Figure:
    """Residual and margin by the number of fingertips that touch."""
    trace, grasps = found.rollouts.trace, found.grasps
    held = trace.held
    count = trace.in_contact.sum(axis=-1)[held]
    figure = new_figure(WIDTH, 2.7)
    left, right = figure.subplots(1, 2)
    for axes, values, label, title in (
        (left, grasps.residual[held], "residual [-]", "Residual of the stability QP"),
        (right, grasps.margin[held], "margin [-]", "Force-closure margin"),
    ):
        groups = [k for k in range(1, trace.in_contact.shape[-1] + 1)
                  if np.isfinite(values[count == k]).any()]  # fmt: skip
        drawn = [values[(count == k) & np.isfinite(values)] for k in groups]
        if drawn:
            axes.boxplot(
                drawn, positions=groups, widths=0.6, whis=(5, 95), showfliers=False,
                medianprops={"color": "#d55e00", "lw": 1.6}, boxprops={"color": INK},
                whiskerprops={"color": FAINT}, capprops={"color": FAINT},
            )  # fmt: skip
        axes.set(xlabel="fingertips that touch", ylabel=label)
        axes.set_ylim(bottom=0)
        axes.grid(visible=False, axis="x")
        axes.set_title(title)
    return figure


def angle_figure(found: Inspection) -> Figure:
    """How often the angle to each controller's action is at most so large."""
    rollouts = found.rollouts
    figure = new_figure(WIDTH, 3.0)
    panels = figure.subplots(1, 3, sharey=True)
    spread = np.rad2deg(1.0 / np.sqrt(rollouts.hand.nq))
    for axes, which, title in zip(
        panels,
        ("all", "on", "off"),
        ("All joints", "Fingers that touch", "Fingers that do not"),
        strict=True,
    ):
        for name in rollouts.shadows:
            angle = np.rad2deg(rollouts.angle(name, which)[rollouts.acting])
            angle = np.sort(angle[np.isfinite(angle)])
            if len(angle):
                share = np.linspace(0, 100, 181)
                axes.plot(np.percentile(angle, share), share, label=title_of(name),
                          **controller_line(name))  # fmt: skip
        axes.set(xlim=(0, 180), ylim=(0, 100), xlabel="angle [deg]")
        axes.set_xticks((0, 45, 90, 135, 180))
        axes.set_title(title)
    panels[0].axvspan(90 - spread, 90 + spread, color=FAINT, alpha=0.15, lw=0)
    panels[0].set(ylabel="steps with at most this angle [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper left",
                      ncols=legend_columns(labels), handlelength=2.2)  # fmt: skip
    return figure


def critic_figure(found: Inspection) -> Figure:
    """What the critic finds over the episode: values, and who it would let act."""
    rollouts = found.rollouts
    assert rollouts.valued is not None
    time, acting = rollouts.trace.time[:-1], rollouts.acting
    enough = acting.sum(axis=1) > 0
    figure = new_figure(WIDTH, 4.4)
    top, bottom = figure.subplots(2, 1, sharex=True)
    names = ("policy", *rollouts.shadows)
    for k, name in enumerate(names):
        line = {"color": INK, "linestyle": "-"} if k == 0 else controller_line(name)
        for axes, values in ((top, rollouts.valued.values), (bottom, rollouts.valued.chances)):
            known = np.where(acting, values[..., k], np.nan)[enough]
            low, middle, high = np.nanpercentile(known, [10, 50, 90], axis=1)
            axes.plot(time[enough], middle, label=title_of(name), lw=1.1, **line)
            axes.fill_between(time[enough], low, high, color=line["color"], alpha=0.12, lw=0)
    top.set(ylabel="Q(s, a)")
    top.set_title("Value of each one's action: median over episodes, band 10 to 90 %")
    bottom.set(ylabel="probability", ylim=(0, 1), xlabel="time [s]")
    bottom.set_title("Who would act: softmax of these values")
    bottom.margins(x=0)
    columns = legend_columns([title_of(name) for name in names])
    top.legend(loc="best", ncols=columns, fontsize=8)
    return figure


def soundness_figure(found: Inspection) -> Figure:
    """Each episode as a row: where the grasp was sound, where it was not, where it was dropped."""
    trace, period = found.rollouts.trace, found.period
    count = trace.held.shape[1]
    figure = new_figure(WIDTH, 0.9 + 0.2 * min(count, 40))
    axes = figure.add_subplot()
    order = np.argsort(-found.rollouts.trace.time_held, kind="stable")[:40]
    onsets = {drop.episode: drop for drop in found.drops}
    for row, episode in enumerate(order.tolist()):
        held, sound = trace.held[:, episode], found.sound[:, episode]
        for active, colour in ((held & sound, SOUND), (held & ~sound, UNSOUND)):
            spans = [(a * period, (b - a) * period) for a, b in runs(active)]
            axes.broken_barh(spans, (row - 0.36, 0.72), facecolor=colour, lw=0)
        if episode in onsets:
            drop = onsets[episode]
            if drop.onset >= 0:
                axes.plot([drop.onset * period] * 2, [row - 0.45, row + 0.45], color=INK, lw=1.4)
            axes.plot(drop.drop * period, row, "x", color=INK, ms=5, mew=1.5, clip_on=False)
    seed = found.rollouts.evaluation.protocol.seed
    axes.set_yticks(range(len(order)), [str(seed + i) for i in order.tolist()], fontsize=7)
    axes.set_ylim(len(order) - 0.4, -0.6)
    axes.set(xlabel="time [s]", ylabel="seed")
    axes.set_xlim(0, trace.time[-1])
    axes.grid(visible=False, axis="y")
    axes.plot([], [], "s", color=SOUND, label="sound")
    axes.plot([], [], "s", color=UNSOUND, label="not sound")
    if found.drops:
        axes.plot([], [], "|", color=INK, mew=1.4, ms=8, label="onset")
        axes.plot([], [], "x", color=INK, mew=1.5, label="dropped")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, handlelength=1.0)
    return figure
