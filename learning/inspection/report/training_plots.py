"""The plots over training: who acted, p_psi, return, rotation, drops, losses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dexctl.report.figures import WIDTH
from dexctl.report.style import (
    FAINT,
    INK,
    controller_line,
    legend_columns,
    new_figure,
    title_of,
)
from learning.exploration import Guiding
from learning.inspection.training import TrainingLog

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE = "#0072b2"
_LAST = (
    ("critic_loss", "", "Critic loss"),
    ("q_mean", "", "Mean value of the policy's actions"),
    ("bc_loss", "", "Cloning loss"),
    ("held", "share", "The policy's own episodes that would hold"),
)


def guide_title(name: str) -> str:
    """What people read for who guided a run, with the objects where it was with some only."""
    guide = Guiding.of(name)
    title = title_of(guide.controller)
    return f"{', '.join(guide.objects)}: {title}" if guide.objects else title


def acting_figure(log: TrainingLog) -> Figure:
    """Who acted, stacked up to 1, and how likely the critic found each controller."""
    figure = new_figure(WIDTH, 4.2)
    top, bottom = figure.subplots(2, 1, sharex=True)
    steps, shares = _millions(log), log.shares()
    if shares:
        stacked = [np.nan_to_num(share) for share in shares.values()]
        policy = np.clip(1.0 - np.sum(stacked, axis=0), 0.0, 1.0)
        labels = [*map(guide_title, shares), "policy"]
        top.stackplot(
            steps,
            *stacked,
            policy,
            labels=labels,
            colors=[*(controller_line(name)["color"] for name in shares), "#e8ecef"],
            alpha=0.85,
            lw=0,
        )
        top.legend(loc="lower left", bbox_to_anchor=(0, 1.0),
                   ncols=legend_columns(labels), handlelength=1.2)  # fmt: skip
    else:
        _say(top, "no controllers guided this run")
    top.set(ylabel="share of the steps", ylim=(0, 1))
    if log.has("p_psi"):
        for name in log.config.guides:
            if log.has(f"p_{name}"):
                bottom.plot(steps, log.columns[f"p_{name}"], label=guide_title(name),
                            **controller_line(name))  # fmt: skip
        if len(log.config.guides) > 1:
            bottom.plot(steps, log.columns["p_psi"], color=INK, lw=1.0, label="any of them")
        bottom.legend(loc="best")
    else:
        _say(bottom, "p_psi is not in this run's log")
    stop = log.config.guidance.hard_stop
    if log.config.guides and stop is not None and (stop := stop / _unit(log)[0]) <= steps[-1]:
        for axes in (top, bottom):
            axes.axvline(stop, color=INK, lw=1.0, ls=(0, (4, 2)))
        bottom.annotate(" hard stop", (stop, 0.98), va="top", fontsize=8)
    bottom.set(ylabel="p_psi", ylim=(0, 1), xlabel=_label(log))
    bottom.set_title("Mean probability of a controller at the choices", fontsize=9)
    bottom.margins(x=0)
    return figure


def learning_figure(log: TrainingLog) -> Figure:
    """Return, rotation, share dropped, length; losses and values."""
    figure = new_figure(WIDTH, 6.2)
    panels = figure.subplots(3, 2, sharex=True)
    steps = _millions(log)
    last = [one for one in _LAST if log.has(one[0])]
    (left, right) = (last if len(last) > 1 else _LAST)[:2]  # what there is depends on the algorithm
    for axes, name, label, title in (
        (panels[0, 0], "return", "[rad/s]", "Return of an episode"),
        (panels[0, 1], "rotation", "[rad]", "Rotation in an episode"),
        (panels[1, 0], "dropped", "share", "Episodes that ended with a drop"),
        (panels[1, 1], "length", "[control steps]", "Length of an episode"),
        (panels[2, 0], *left),
        (panels[2, 1], *right),
    ):
        if log.has(name):
            values = log.columns[name]
            known = np.isfinite(values)
            axes.plot(steps[known], values[known], color=_LINE, lw=1.2,
                      marker="." if known.sum() < 25 else "")  # fmt: skip
        else:
            _say(axes, "none yet")
        axes.set(ylabel=label)
        axes.set_title(title)
    panels[1, 0].set_ylim(0, 1.02)
    if left[0] == "critic_loss" and log.has(left[0]) and np.nanmin(log.columns[left[0]]) > 0:
        panels[2, 0].set_yscale("log")
    cloned = left[0] != "bc_loss" and log.has("bc_loss")
    if cloned and np.nanmax(np.abs(log.columns["bc_loss"])) > 0:
        cloning = panels[2, 1].twinx()
        cloning.plot(steps, log.columns["bc_loss"], color="#d55e00", lw=1.0, ls="--")
        cloning.set_ylabel("cloning loss (dashed)", color="#d55e00")
        cloning.tick_params(axis="y", colors="#d55e00")
        cloning.grid(visible=False)
    for axes in panels[2]:
        axes.set(xlabel=_label(log))
    figure.align_ylabels(panels[:, 0])
    return figure


def _say(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, ha="center", va="center", color=FAINT, transform=axes.transAxes)


def _unit(log: TrainingLog) -> tuple[float, str]:
    return (1e6, "million") if log.columns["step"][-1] >= 5e5 else (1e3, "thousand")


def _millions(log: TrainingLog) -> np.ndarray:
    return log.columns["step"] / _unit(log)[0]


def _label(log: TrainingLog) -> str:
    return f"environment steps [{_unit(log)[1]}]"
