"""The page: what was inspected, how it gaits, why it drops, and how it was trained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexctl.report import figures, html
from dexctl.report.conditions import conditions, setting_text, units
from dexctl.report.style import drawing, title_of
from dexctl.report.words import interval, number, percent, spread
from dexctl.settings import differing, get
from learning.envs.tasks import TaskConfig
from learning.inspection.findings import MARGIN_EVERY, MARGIN_SHOWN, Inspection
from learning.inspection.grasps import MARGIN_EDGES
from learning.inspection.onset import DropRule
from learning.inspection.report import plots, training_plots
from learning.inspection.report.drops import drops_section
from learning.inspection.report.story import story
from learning.inspection.report.timeline import gait_figure, timeline_figure
from learning.inspection.rollout import MOTION

GAIT_WINDOW = 12.0
"""How much of the typical episode is drawn large [s]."""


def build(found: Inspection, *, command: str, machine: Mapping[str, Any]) -> str:
    """The report as one HTML document.

    Args:
        found: what was inspected.
        command: what was typed.
        machine: see `dexctl.report.machine`.
    """
    protocol = found.rollouts.evaluation.protocol
    with drawing():
        sections = [
            *(html.paragraph(remark, "note") for remark in found.remarks),
            _overview(found),
            _typical(found),
            _turns(found),
            _grasp(found),
            _angles(found),
            _critic(found),
            drops_section(found),
            *([_training(found)] if found.training is not None and len(found.training) else []),
            conditions(
                protocol.scene,
                command=command,
                machine=machine,
                seed=protocol.seed,
                scene=found.rollouts.scene,
                axis=protocol.task.axis,
                more=_task(protocol.task),
            ),
        ]
    title = f"{_who(found)}: {protocol.scene.hand_name} turns a {found.rollouts.scene.object}"
    subtitle = (
        f"{len(found.rollouts.evaluation.rotation)} episodes of {protocol.seconds:g} s, "
        f"{protocol.scene.palm}, seeds {protocol.seed} to {protocol.seed + protocol.episodes - 1}"
    )
    return html.page(f"{title[0].upper()}{title[1:]}", subtitle, sections)


def _task(task: TaskConfig) -> list[tuple[str, str]]:
    """The settings of the task that are not as usual, but for the axis."""
    found = []
    for path in differing(task, TaskConfig()):
        if path != "turning.axis":
            name, unit = path.rpartition(".")[2], units(TaskConfig).get(path, "")
            value = setting_text(get(task, path))
            found.append((name.replace("_", " "), f"{value} {unit}".strip()))
    return found


def _who(found: Inspection) -> str:
    subject = found.subject
    if subject.kind == "controller":
        return title_of(subject.name)
    trained = subject.trained
    return "policy" if trained is None else f"policy ({trained.guidance.method})"


def _overview(found: Inspection) -> str:
    figure = found.rollouts.evaluation.figures()
    rows = [
        ("rotation", interval(figure["rotation_median_rad"], "rad")),
        ("revolutions", interval(figure["revolutions_median"])),
        ("mean speed", interval(figure["speed_mean_rad_s"], "rad/s")),
        ("time held", interval(figure["time_held_median_s"], "s", 1)),
        ("dropped", interval(figure["share_dropped"], "%", 0, 100.0)),
        ("return", interval(figure["return_mean"], "rad/s", 1)),
        ("sound grasp", f"{percent(found.grip()['sound_share'])} of the time held"),
        ("sinks by", interval(figure["sink_median_m"], "mm", 1, 1e3)),
        ("drifts by", interval(figure["drift_median_m"], "mm", 1, 1e3)),
        ("on average by", interval(figure["mean_drift_median_m"], "mm", 1, 1e3)),
    ]
    if found.subject.kind != "controller":
        card = found.subject.card or {}
        rows += [("trained for", f"{card['steps']:,} steps")] if "steps" in card else []
        rows += [("guided by", ", ".join(map(title_of, found.subject.guides)) or "nobody")]
    return html.section(
        "What it does",
        *(html.paragraph(line) for line in story(found)),
        html.facts(rows),
        html.paragraph(
            "Medians, and means of speed and return, with 95 % bootstrap intervals over episodes; "
            "the share dropped with its Wilson interval.",
            "note",
        ),
        html.plot(
            figures.spread_figure(found.subject.name, found.rollouts.trace),
            "Rotation over time of every episode, with median and 10 to 90 % band",
            "Rotation of every episode; it stands still after a drop.",
        ),
    )


def _typical(found: Inspection) -> str:
    trace, episode = found.rollouts.trace, found.rollouts.typical
    end = float(trace.time_held[episode])
    middle = max(0.0, min(end - GAIT_WINDOW, 0.5 * end))
    window = (middle, max(min(middle + GAIT_WINDOW, end), middle + 10 * found.period))
    seed = found.rollouts.evaluation.protocol.seed + episode
    outline = (
        " Outlined: the controller is switching this finger."
        if figures.switching_fingers(trace, episode) is not None
        else ""
    )
    probability = ", and the critic's p_psi" if found.rollouts.valued is not None else ""
    return html.section(
        "A typical episode",
        html.paragraph(
            f"Seed {seed}, whose rotation and time held are nearest to the medians. A bar "
            f"while the fingertip touches, the darker the harder it presses.{outline} "
            "Shaded: the grasp is not sound."
        ),
        html.plot(
            gait_figure(found, episode, window),
            "Contact diagram of a part of the typical episode, with rotation below",
            f"Contact (gait) diagram, {window[0]:.0f} to {window[1]:.0f} s.",
        ),
        html.plot(
            timeline_figure(found, episode, (0.0, max(end, 10 * found.period))),
            "Contacts, rotation, drift, residual, margin and angles over the typical episode",
            "The whole episode: contacts, rotation, drift, residual and margin of the grasp, and "
            f"angles to the controllers (of motions over {MOTION:g} s){probability}.",
        ),
    )


def _turns(found: Inspection) -> str:
    gait, grip = found.gait, found.grip()
    rows = [
        (
            f"finger {i + 1}",
            f"{gait.duty[i]:.2f}",
            f"{gait.lift_rate[i]:.2f}",
            number(gait.stance[i], 2),
            number(gait.swing[i], 2),
            number(grip["force_mean_n"][i], 2),
            number(1e3 * grip["slip_m_per_s"][i], 1),
        )
        for i in range(len(gait.duty))
    ]
    return html.section(
        "How the fingers take turns",
        html.table(
            (
                "over all episodes", "duty factor", "switches [1/s]", "stance [s]", "swing [s]",
                "mean force [N]", "slip [mm/s]",
            ),
            rows,
        ),
        html.paragraph(
            f"A switch is a lift of the finger; gaps and touches shorter than {gait.least:g} s are "
            f"chatter and do not count ({int(gait.chatter.sum())} in {gait.seconds:.0f} s). "
            "Stance and swing are medians between landing and lift. Force and slip are means while "
            "the finger touches; slip is the fingertip's sliding over the object, without rolling.",
            "note",
        ),
        html.plot(
            plots.turns_figure(found),
            "Duty factors, fingers in contact, order and phase of the lifts",
            "Phase: where each finger lifts between two lifts of the finger that lifts most. "
            "Regularity is the length of the mean phase vector: 1 for one fixed gait in all "
            "episodes, near 0 where the fingers keep no order.",
        ),
    )  # fmt: skip


def _grasp(found: Inspection) -> str:
    grip, rule = found.grip(), found.rule
    alone = found.rollouts.evaluation.figures()["share_fingertips_only"]
    friction = found.grasps.friction
    rows = [
        ("sound grasp", percent(grip["sound_share"])),
        ("force closure", percent(grip["closure_share"])),
        ("nothing but fingertips touches", percent(alone.value)),
        ("residual", spread(grip["residual"], "", 3)),
        ("force-closure margin", spread(grip["margin"], "", 2)),
        ("tilt", spread(grip["tilt_rad"], "rad", 2)),
    ]
    return html.section(
        "How sound the grasp is",
        html.facts(rows),
        html.paragraph(
            "Over the time held; median (10 to 90 %). Residual: the wrench that the best normal "
            "forces leave on the object (stability QP), in units of the largest of them. Margin: "
            "Ferrari-Canny epsilon, the largest wrench that contact forces summing to 1 can resist "
            f"in any direction, with friction {friction:g} and pyramids of {MARGIN_EDGES} edges "
            f"(a lower bound), sampled every {MARGIN_EVERY:g} s, and every {MARGIN_SHOWN:g} s "
            f"where an episode is drawn. {sound_words(rule)}",
            "note",
        ),
        html.plot(
            plots.grasp_figure(found),
            "Residual and margin by number of fingertips that touch",
            "By the number of fingertips that touch: median, quartiles, 5 and 95 %.",
        ),
        html.plot(
            plots.soundness_figure(found),
            "Each episode as a row, sound and not sound",
            "When the grasp was sound: one row per episode, those that held longest on top.",
        ),
    )


def sound_words(rule: DropRule) -> str:
    """The definition of a sound grasp."""
    return (
        f"A grasp is sound where at least {rule.fingertips} fingertips touch with force closure, "
        f"nothing else touches, and the object is tilted by at most {rule.tilt:g} rad."
    )


def _angles(found: Inspection) -> str:
    joints = found.rollouts.hand.nq
    rows = []
    for name, one in found.angles().items():
        ratio = one["size_ratio_median"]
        rows.append(
            (
                title_of(name),
                *(spread(_degrees(one[which]), "°", 0) for which in ("all", "on", "off", "motion")),
                "-" if ratio is None else f"{ratio:.2f}",
                percent(one["all"]["undefined_share"]),
            )
        )
    return html.section(
        "Compared with the controllers",
        html.table(
            (
                "controller", "all joints", "fingers that touch", "fingers that do not",
                f"over {MOTION:g} s", "size, ratio", "undefined",
            ),
            rows,
        ),
        html.paragraph(
            "Angle between the set-point change that was made and the one that each controller, "
            "asked in the same state, would have made: 0° the same direction, 180° the opposite. "
            f"Random directions of {joints} joints are 90° apart, give or take "
            f"{np.rad2deg(1 / np.sqrt(joints)):.0f}° (grey band). Where either action is zero "
            f"there is no angle: undefined. Over {MOTION:g} s: of the sums of the actions, in "
            "which jitter cancels out. Size: of the action made, over the controller's. "
            "Controllers in shadow see every state but move nothing, so one that plans "
            "a switch of its own may be ahead of what the hand does.",
            "note",
        ),
        html.plot(
            plots.angle_figure(found),
            "Share of steps with at most a given angle, per controller",
            "How often the angle is at most so large.",
        ),
    )  # fmt: skip


def _degrees(found: Mapping[str, Any]) -> dict[str, Any]:
    """Percentiles in degrees by their plain names."""
    return {name: found[f"{name}_deg"] for name in ("median", "p10", "p90")}


def _critic(found: Inspection) -> str:
    told = found.critic()
    if told is None:
        return html.section(
            "What the critic thinks",
            html.paragraph(
                "There is no critic to ask: values and p_psi come with the checkpoint of a run.",
                "note",
            ),
        )
    rows = [
        (
            title_of(name),
            spread(one["value"]),
            spread(one["p"]),
            percent(one["best_share"]),
        )
        for name, one in told["candidates"].items()
    ]
    return html.section(
        "What the critic thinks",
        html.paragraph(
            f"The critic of the checkpoint at {told['checkpoint_steps']:,} steps, asked along the "
            f"rollouts. Any controller would act with p_psi = {spread(told['p_psi'])}."
        ),
        html.table(("action of", "value Q(s, a)", "probability", "best of all"), rows),
        html.paragraph(
            "Median (10 to 90 %) over the time held. The probability is the softmax of the values "
            f"at temperature {told['temperature']:g}, as in value guided exploration; training "
            f"chooses with it every {found.rollouts.horizon} steps, here it is drawn at every "
            "step. The policy's action is the deterministic one.",
            "note",
        ),
        html.plot(
            plots.critic_figure(found),
            "Values and probabilities over the episode",
            "The time axis is that of the episodes; later on, fewer of them still hold.",
        ),
    )


def _training(found: Inspection) -> str:
    log = found.training
    assert log is not None
    config = log.config
    last = {name: values[-1] for name, values in log.columns.items()}
    shares = ", ".join(
        f"{training_plots.guide_title(name)} {percent(float(np.nan_to_num(share[-1])))}"
        for name, share in log.shares().items()
    )
    return html.section(
        "Over training",
        html.paragraph(
            f"{config.guidance.method}, {config.algorithm}, {config.num_envs} environments, seed "
            f"{config.seed}; {int(last['step']):,} of {config.steps:,} steps."
            + (f" In the last row of the log acted: {shares}." if shares else "")
        ),
        html.plot(
            training_plots.acting_figure(log),
            "Share of the steps that each controller and the policy did, over training",
            "Who acted, and the mean of p_psi at the choices. A controller that is chosen acts for "
            "its whole motion, and episodes end sooner with one than with another: so the share of "
            "steps is not the probability.",
        ),
        html.plot(
            training_plots.learning_figure(log),
            "Return, rotation, drops, episode length and losses over training",
            "Episodes of the behaviour mixture, controllers included, not of the policy alone.",
        ),
    )
