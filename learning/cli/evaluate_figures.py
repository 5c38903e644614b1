"""The figures of `dexctl evaluate`, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexctl.files import aside
from dexctl.report.style import FAINT, INK, drawing, finger_colour, new_figure
from dexctl.statistics import Estimate, wilson
from learning.evaluation.figures import FULL_TURN, Evaluation
from learning.evaluation.robustness import disturbance, levels_of
from learning.evaluation.transfer import Transfer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# kind of disturbance: what stands under the axis, and what a level is multiplied by for it
_KINDS = {
    "joint_noise": ("noise of joints [rad]", 1.0),
    "position_noise": ("noise of contact points [mm]", 1e3),
    "normal_noise": ("tilt of normals [rad]", 1.0),
    "force_noise": ("noise of forces [N]", 1.0),
    "force_noise_share": ("noise of forces [%]", 1e2),
    "push_force": ("force on the object [N]", 1.0),
}
_LINES = ("-", (0, (5, 2)), "-.", ":")


def draw_rotation(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """For each object: rotation over time, and the share of episodes that still hold it."""
    with drawing():
        count = len(evaluations)
        figure = new_figure(8.4, 0.5 + 2.3 * count)
        axes = figure.subplots(count, 2, sharex=True, sharey="col", squeeze=False)
        for row, one in zip(axes, evaluations, strict=True):
            _rotation(row[0], one)
            _survival(row[1], one)
            row[0].set_title(one.object)
        for panel in axes[-1]:
            panel.set(xlabel="time [s]")
            panel.set_xlim(0, max(float(one.moments[-1]) for one in evaluations))
        both = [panel.get_legend_handles_labels() for panel in axes[0]]
        handles, labels = ([*one, *other] for one, other in zip(*both, strict=True))
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
        _save(figure, path)


def _rotation(axes: Axes, one: Evaluation) -> None:
    colour = finger_colour(0)
    for low, high, alpha in ((10, 90, 0.15), (25, 75, 0.25)):
        ends = np.percentile(one.rotations, [low, high], axis=1)
        label = f"{low} to {high} % of the episodes"
        axes.fill_between(one.moments, *ends, color=colour, alpha=alpha, lw=0, label=label)
    median = np.median(one.rotations, axis=1)
    axes.plot(one.moments, median, color=colour, lw=2.0, label="median")
    axes.set(ylabel="rotation before a drop [rad]")
    if axes.get_ylim()[1] > FULL_TURN:
        axes.axhline(FULL_TURN, color=FAINT, lw=1.0, ls=(0, (2, 2)))
        axes.annotate(" full turn", (0, FULL_TURN), va="bottom", color=FAINT, fontsize=8)


def _survival(axes: Axes, one: Evaluation) -> None:
    for near, number, style in ((False, 1, "-"), (True, 2, (0, (4, 2)))):
        ends = one.time_near[one.strayed] if near else one.time_held[one.dropped]
        moments = np.unique([0.0, *ends, float(one.moments[-1])])
        # steps: what holds up to and with a moment falls right after it
        after = one.held(np.nextafter(moments, np.inf), near=near)
        shares = np.array([wilson(int(n), len(one.rotation))[:3] for n in after]) * 100.0
        value, low, high = shares.T
        colour, distance = finger_colour(number), one.protocol.task.holding.drop_distance
        label = f"within {1e3 * distance / (2 if near else 1):g} mm"
        axes.fill_between(moments, low, high, step="post", color=colour, alpha=0.2, lw=0)
        axes.step(moments, value, where="post", color=colour, ls=style, lw=2.0, label=label)
    axes.set(ylabel="episodes that hold it [%]", ylim=(0, 102))


def draw_robustness(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """A column for each kind of disturbance: rotation above, share dropped below.

    Args:
        path: of the PNG file.
        evaluations: of each object, that of the protocol as it is first.
    """
    objects = list(dict.fromkeys(one.object for one in evaluations))
    base = evaluations[0].protocol
    disturbed = [disturbance(one.protocol, base).kind for one in evaluations]
    kinds = [kind for kind in _KINDS if kind in disturbed]
    with drawing():
        figure = new_figure(2.3 * len(kinds) + 0.6, 5.0)
        axes = figure.subplots(2, len(kinds), sharex="col", sharey="row", squeeze=False)
        for column, kind in zip(axes.T, kinds, strict=True):
            label, factor = _KINDS[kind]
            for i, name in enumerate(objects):
                rows = [
                    one
                    for one, what in zip(evaluations, disturbed, strict=True)
                    if one.object == name and what in ("", kind)
                ]
                rows.sort(key=lambda one: levels_of(one.protocol)[kind])
                levels = [levels_of(one.protocol)[kind] * factor for one in rows]
                figures = [one.figures() for one in rows]
                _band(column[0], levels, [f["rotation_median_rad"] for f in figures], i, name)
                _band(column[1], levels, [f["share_dropped"] for f in figures], i, name, 100.0)
            column[0].set_title(kind.replace("_", " "))
            column[1].set(xlabel=label)
        axes[0, 0].set(ylabel="rotation before a drop [rad]\n(median, 95 % bootstrap)")
        axes[1, 0].set(ylabel="dropped [%]\n(95 % Wilson)")
        axes[1, 0].set_ylim(-3, 102)
        axes[0, 0].set_ylim(bottom=min(0.0, axes[0, 0].get_ylim()[0]))
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 5))
        _save(figure, path)


def _band(
    axes: Axes, levels: list[float], row: list[Estimate], i: int, name: str, factor: float = 1.0
) -> None:
    """A line through estimates, with the band of their intervals."""
    value, low, high = factor * np.array([one[:3] for one in row]).T
    colour, style = finger_colour(i), _LINES[i // 8 % len(_LINES)]
    axes.fill_between(levels, low, high, color=colour, alpha=0.15, lw=0)
    axes.plot(levels, value, color=colour, ls=style, marker="o", ms=3.5, label=name)


def draw_transfer(path: Path, found: Transfer) -> None:
    """The matrix of R_ij / R_ii as a heat map; rows are policies, columns objects."""
    rows, columns = len(found.policies), len(found.objects)
    scores = np.full((rows, columns), np.nan)
    for i in range(rows):
        for j in range(columns):
            score = found.score(i, j)
            scores[i, j] = np.nan if score is None else score.value
    with drawing():
        figure = new_figure(2.6 + 1.15 * columns, 1.5 + 0.75 * rows)
        axes = figure.add_subplot()
        top = max(1.0, float(np.nanmax(scores))) if np.isfinite(scores).any() else 1.0
        shown = axes.imshow(scores, cmap="cividis", vmin=0.0, vmax=top, aspect="auto")
        axes.set_facecolor("#d9dee3")  # where there is no score
        axes.grid(visible=False)
        for i in range(rows):
            for j in range(columns):
                dark = np.isfinite(scores[i, j]) and scores[i, j] < 0.62 * top
                text = "no score" if np.isnan(scores[i, j]) else f"{scores[i, j]:.2f}"
                axes.annotate(
                    f"{text}\n{found.raw(i, j).value:.2f} rad",
                    (j, i),
                    ha="center",
                    va="center",
                    color="white" if dark else INK,
                    fontsize=8.5,
                )
        axes.set_xticks(range(columns), found.objects)
        if columns > 4:
            for label in axes.get_xticklabels():
                label.set(rotation=30, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(rows), [policy.object for policy in found.policies])
        axes.set(xlabel="object", ylabel="policy of")
        axes.tick_params(length=0)
        axes.set_title("Median rotation over that with the policy's own object")
        figure.colorbar(shown, ax=axes, label="$R_{ij} / R_{ii}$")
        _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    with aside(path) as part:
        figure.savefig(part)
