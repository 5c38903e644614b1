"""The demo's report: several controllers on the same object, one trial each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexctl import controllers
from dexctl.report import figures, html, words
from dexctl.report.conditions import conditions
from dexctl.report.film import Film
from dexctl.report.style import drawing, title_of
from dexctl.report.summary import TrialSummary
from dexctl.sim import Scene, SceneConfig, Trace

HEADINGS = (
    ("controller",),
    ("rotation", "[rad]"),
    ("time held", "[s]"),
    ("mean in", "touch"),
    ("largest", "residual"),
    ("call", "median", "[ms]"),
    ("call", "p99", "[ms]"),
)
"""Lines of each column's heading."""


@dataclass
class Trial:
    """One controller's trial.

    Attributes:
        name: the controller's.
        trace, summary: what happened, and what it came to.
        film: for drawing it.
        pictures: key frames as PNG files' contents, by simulated time [s].
    """

    name: str
    trace: Trace
    summary: TrialSummary
    film: Film
    pictures: dict[float, bytes] = field(default_factory=dict)


def row(trial: Trial) -> tuple[str, ...]:
    """A trial as a table row under `HEADINGS`."""
    found = trial.summary
    return (
        title_of(trial.name),
        words.number(found.rotation, 2),
        f"{found.time_held:.1f}" + (", dropped" if found.dropped else ""),
        f"{found.mean_contacts:.1f}",
        words.number(found.largest_residual, 3),
        f"{1e3 * found.act_time_median:.2f}",
        f"{1e3 * found.act_time_p99:.2f}",
    )


def key_times(trace: Trace, count: int) -> list[float]:
    """``count`` moments of one trial, evenly spread over the time that it holds the object [s]."""
    end = float(trace.time_held)
    return [float(time) for time in np.linspace(0.0, end, count)]


def build(
    trials: Mapping[str, Trial],
    *,
    config: SceneConfig,
    scene: Scene,
    axis: str | tuple[float, ...],
    seconds: float,
    seed: int,
    command: str,
    machine: Mapping[str, Any],
    remarks: tuple[str, ...] = (),
) -> str:
    """The report as one HTML document.

    Args:
        trials: by controller, in the order of the report.
        config, scene: what was simulated.
        axis: that rotation is counted about.
        seconds: of each trial [s].
        seed: of all of them.
        command: what was typed.
        machine: see `dexctl.report.machine`.
        remarks: what the reader should know, an interruption for example.
    """
    traces = {name: trial.trace for name, trial in trials.items()}
    with drawing():
        sections = [
            *(html.paragraph(remark, "note") for remark in remarks),
            _overview(trials, traces),
            *(_trial_section(trial) for trial in trials.values()),
            _act_time(traces, config.control_period),
            conditions(config, command=command, machine=machine, seed=seed, scene=scene, axis=axis),
        ]
    title = f"{config.hand} turns a {scene.object} {words.about(axis)}"
    subtitle = (
        f"{len(trials)} controllers, one trial of {seconds:g} s each, {config.palm}, seed {seed}"
    )
    return html.page(title, subtitle, sections)


def _overview(trials: Mapping[str, Trial], traces: Mapping[str, Trace]) -> str:
    return html.section(
        "Results",
        html.table(
            [" ".join(heading) for heading in HEADINGS], [row(trial) for trial in trials.values()]
        ),
        html.paragraph(
            "Rotation is the unwrapped angle about the axis, up to the drop (centre more than "
            "0.05 m from its start) or the end. Fingertips in touch is the mean over the time "
            "held. The residual is the norm of the wrench that the stability QP leaves, in units "
            "of the grip force. A call is one of the controller, for one hand, in wall time. This "
            "is one trial of each controller: `dexctl rotate` runs many.",
            "note",
        ),
        html.VIDEO_PLACE,
        html.plot(
            figures.rotation_figure(traces),
            "Rotation over time, one line per controller",
            "Rotation over time.",
        ),
    )


def _trial_section(trial: Trial) -> str:
    entry = controllers.entry(trial.name)
    parts = [html.paragraph(f"{entry.description[0].upper()}{entry.description[1:]}.")]
    if trial.pictures:
        parts.append(
            html.strip(
                html.image(content, f"{entry.title} after {time:.1f} s", f"{time:.1f} s")
                for time, content in trial.pictures.items()
            )
        )
    parts.append(
        html.plot(
            figures.trial_figure(trial.trace),
            f"{entry.title}: contacts, forces and residual over time",
            figures.diagram_caption(trial.trace),
        )
    )
    return html.section(f"{entry.title[0].upper()}{entry.title[1:]}", *parts)


def _act_time(traces: Mapping[str, Trace], control_period: float) -> str:
    return html.section(
        "Time of a call",
        html.plot(
            figures.act_time_figure(traces, control_period),
            "Distribution of the time that a call takes",
            "Share of the calls that took at most so long, one hand, measured during the trials; "
            "other work on the machine shows in the tail.",
        ),
    )
