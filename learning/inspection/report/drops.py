"""The section on drops: a table of causes, and example timelines."""

from __future__ import annotations

import numpy as np

from dexctl.report import html
from learning.inspection.findings import Inspection
from learning.inspection.onset import CAUSES, Drop
from learning.inspection.report.timeline import timeline_figure


def drops_section(found: Inspection) -> str:
    """Where and why drops begin."""
    evaluation = found.rollouts.evaluation
    count, seed = len(evaluation.rotation), evaluation.protocol.seed
    if not found.drops:
        return html.section(
            "Where and why drops begin",
            html.paragraph(f"None of the {count} episodes ended with a drop."),
        )
    rows = []
    for name, drops in found.causes():
        fingers = np.bincount([i for drop in drops for i in drop.fingers], minlength=1)
        most = np.flatnonzero(fingers == fingers.max()) if fingers.any() else []
        few = sum(drop.contacts < found.rule.fingertips for drop in drops)
        seeds = ", ".join(str(seed + drop.episode) for drop in drops[:4])
        rows.append(
            (
                CAUSES[name],
                f"{len(drops)} of {len(found.drops)}",
                f"{np.median([drop.lead for drop in drops]):.2f}",
                ", ".join(str(i + 1) for i in most) or "-",
                str(few),
                str(sum(not drop.closed for drop in drops)),
                seeds + (", ..." if len(drops) > 4 else ""),
            )
        )
    rule = found.rule
    distance = evaluation.protocol.task.holding.drop_distance
    return html.section(
        "Where and why drops begin",
        html.table(
            (
                "first thing that failed", "drops", "onset to drop [s]", "finger, mostly",
                "too few contacts", "no closure", "seeds",
            ),
            rows,
        ),
        html.paragraph(
            f"From each drop (centre more than {distance:g} m from its start) back to the end of "
            f"the last sound spell of at least {rule.spell:g} s, the onset. What failed first "
            "after it is the cause, the first of these that holds: something other than a "
            f"fingertip touched; tilt above {rule.tilt:g} rad; a finger let go, with a joint's "
            "set-point at the end of its range, or its set-point taken back by "
            f"{1e3 * rule.retreat:g} mm or more in the {rule.window:g} s before (lifted), or after "
            f"sliding by {1e3 * rule.slip:g} mm or more (slipped), or neither (the object went "
            "away from it); no closure with all fingers in touch. An object that leaves in a sound "
            "grasp was carried off. A long time from onset to drop says that the object was held "
            "somehow, but not soundly, in "
            "between. Too few contacts and no closure: how many drops had fewer than "
            f"{rule.fingertips} fingertips, or no force closure, right after the onset.",
            "note",
        ),
        *(_example(found, drop) for drop in found.examples),
    )  # fmt: skip


def _example(found: Inspection, drop: Drop) -> str:
    end = drop.drop * drop.period
    begin = drop.onset * drop.period if drop.onset >= 0 else end - 4.0
    window = (max(0.0, begin - 2.0), min(end + 0.5, float(found.rollouts.trace.time[-1])))
    seed = found.rollouts.evaluation.protocol.seed + drop.episode
    also = [CAUSES[name] for name in drop.signs]
    return "\n".join(
        [
            f"<h3>{html.text(CAUSES[drop.cause].capitalize())}: seed {seed}</h3>",
            html.paragraph(
                (f"Onset at {begin:.2f} s, dropped at {end:.2f} s." if drop.onset >= 0 else
                 f"Dropped at {end:.2f} s.")
                + (f" Let go: finger {', '.join(str(i + 1) for i in drop.fingers)}."
                   if drop.fingers else "")
                + (f" Also: {'; '.join(also)}." if also else "")
            ),
            html.plot(
                timeline_figure(found, drop.episode, window, drop),
                f"The drop of seed {seed}: contacts, rotation, residual, margin, angles",
            ),
        ]
    )  # fmt: skip
