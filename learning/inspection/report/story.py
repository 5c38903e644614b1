"""What was found, in a few sentences made from the figures."""

from __future__ import annotations

import numpy as np

from dexctl.report.style import title_of
from learning.inspection.findings import Inspection
from learning.inspection.onset import CAUSES
from learning.inspection.rollout import MOTION


def story(found: Inspection) -> list[str]:
    """The sentences; each says a figure that is elsewhere on the page."""
    return [_gait(found), _likeness(found), _drops(found)]


def _gait(found: Inspection) -> str:
    gait = found.gait
    mean = float((np.arange(len(gait.contacts)) * gait.contacts).sum())
    lifts = int(gait.lifts.sum())
    evaluation = found.rollouts.evaluation
    turned = float(np.median(evaluation.rotation))
    words = (
        f"It turns the {evaluation.object} by {turned:.2f} rad (median) in up to "
        f"{evaluation.protocol.seconds:g} s, with {mean:.1f} fingertips on the object on average."
    )
    if not lifts:
        return f"{words} No finger lifts: it turns the object within one grasp."
    idle = [str(i + 1) for i in np.flatnonzero(gait.lifts == 0)]
    rate = float(gait.lift_rate.sum())
    words += f" Together its fingers lift {rate:.2f} times a second"
    words += f"; finger {', '.join(idle)} never." if idle else "."
    regular = np.delete(gait.regularity, gait.reference) if gait.reference >= 0 else np.zeros(0)
    regular = regular[np.isfinite(regular)]
    if len(regular) and gait.cycles.sum() >= 20:
        level = float(np.median(regular))
        how = "a fixed order" if level > 0.8 else "some order" if level > 0.4 else "no fixed order"
        words += f" They keep {how} (phase regularity {level:.2f})."
    return words


def _likeness(found: Inspection) -> str:
    known = {
        name: one["motion"]["median_deg"]
        for name, one in found.angles().items()
        if one["motion"]["median_deg"] is not None
    }
    if not known:
        return "It cannot be compared with a controller: no angle is defined."
    nearest = min(known, key=lambda name: known[name])
    others = ", ".join(
        f"{title_of(name)} {angle:.0f}°" for name, angle in known.items() if name != nearest
    )
    chance = np.rad2deg(1.0 / np.sqrt(found.rollouts.hand.nq))
    words = (
        f"Its motions are nearest to those of the controller {title_of(nearest)}, "
        f"{known[nearest]:.0f}° away (median, over {MOTION:g} s)"
    )
    words += f"; {others}." if others else "."
    if known[nearest] > 90.0 - 0.5 * chance:
        words += " That is no nearer than chance: it goes its own way."
    return words


def _drops(found: Inspection) -> str:
    count = len(found.rollouts.evaluation.rotation)
    if not found.drops:
        return f"It dropped the object in none of {count} episodes."
    name, drops = found.causes()[0]
    lead = float(np.median([drop.lead for drop in drops]))
    return (
        f"It dropped the object in {len(found.drops)} of {count} episodes. What most often failed "
        f"first: {CAUSES[name]} ({len(drops)} of {len(found.drops)}, {lead:.1f} s before the drop)."
    )
