"""The report of many trials of one controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dexctl.report import figures, html, words
from dexctl.report.conditions import conditions
from dexctl.report.style import drawing, title_of
from dexctl.report.summary import BatchSummary, percentiles
from dexctl.sim import Scene, SceneConfig, Trace


def figures_of_merit(summary: BatchSummary) -> list[tuple[str, str]]:
    """What the trials came to, as (what, value) for people."""
    rotation, held = percentiles(summary.rotation), percentiles(summary.time_held)
    rows = [
        ("rotation", words.spread(rotation, "rad")),
        ("time held", words.spread(held, "s")),
        ("still holding", words.share(*summary.holding)),
        ("made a full turn", words.share(*summary.full_turn)),
        ("fingertips in touch", f"{summary.mean_contacts:.1f} on average while held"),
        (
            "time of a call",
            f"{1e3 * summary.act_time_median:.2f} ms median, "
            f"{1e3 * summary.act_time_p99:.2f} ms p99, for {len(summary.rotation)} hands at once",
        ),
    ]
    if summary.diverged:
        rows.append(("simulations broken down", f"{summary.diverged}, counted as dropped"))
    return rows


def build(
    name: str,
    trace: Trace,
    summary: BatchSummary,
    *,
    config: SceneConfig,
    scene: Scene,
    axis: str | tuple[float, ...],
    seconds: float,
    seed: int,
    command: str,
    machine: Mapping[str, Any],
) -> str:
    """The report as one HTML document.

    Args:
        name: the controller's.
        trace: of N trials.
        summary: of the same.
        config, scene: what was simulated.
        axis: that rotation is counted about.
        seconds: of each trial [s].
        seed: of the first trial.
        command: what was typed.
        machine: see `dexctl.report.machine`.
    """
    with drawing():
        sections = [
            html.section(
                "Results",
                html.facts(figures_of_merit(summary)),
                html.paragraph(
                    "Medians with 10th and 90th percentile over trials; shares with their 95 % "
                    "Wilson interval. Rotation is the unwrapped angle about the axis, up to "
                    "the drop (centre more than 0.05 m from its start) or the end.",
                    "note",
                ),
                html.plot(
                    figures.spread_figure(name, trace),
                    "Rotation over time of every trial, with median and 10 to 90 % band",
                    "Rotation over time of every trial; it stands still after a drop.",
                ),
            ),
            html.section(
                "The first trial",
                html.plot(
                    figures.trial_figure(trace),
                    "Contacts, forces and residual of the first trial",
                    figures.diagram_caption(trace),
                ),
            ),
            conditions(config, command=command, machine=machine, seed=seed, scene=scene, axis=axis),
        ]
    title = f"{title_of(name)}: {config.hand} turns a {scene.object} {words.about(axis)}"
    subtitle = (
        f"{len(summary.rotation)} trials of {seconds:g} s, {config.palm}, "
        f"seeds {seed} to {seed + len(summary.rotation) - 1}"
    )
    return html.page(title[0].upper() + title[1:], subtitle, sections)
