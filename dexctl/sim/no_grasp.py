"""Why a search found no grasp: how near each fingertip came, and what to change."""

from __future__ import annotations

import numpy as np

from dexctl.sim.checks import listed
from dexctl.sim.grasp_search import LEAST_FINGERS, PALM_CLEAR, GraspSearch, Placement
from dexctl.sim.workspace import BAND

_STIFF = "only stretched or at the end of its range"
_PLACES = 60  # of those that the search draws, which are looked at again


def flat_fingers(search: GraspSearch) -> str:
    """Which fingers can never hold, in one line; empty where enough others are left."""
    names, flat = np.array(search.workspace.hand.fingertip_names), search.flat()
    needed = min(LEAST_FINGERS, len(names))
    if (~flat).sum() >= needed:
        return ""
    return (
        f"the joints of {listed(names[flat].tolist())} move the fingertip along a plane or a line "
        f"only, whatever the object and its place; expected {needed} fingers of three joints or "
        "more that do not all turn about one direction"
    )


def explained(search: GraspSearch) -> str:
    """The place that came closest, each fingertip in it, and what to change; one line."""
    places = search.drawn(_PLACES, np.random.default_rng(search.seed))
    looked = [(_said(search, place), _palm(search, place), place) for place in places]
    needed = min(LEAST_FINGERS, search.workspace.hand.n_fingers)

    def short(one: tuple[list[tuple[str, float]], float, Placement]) -> tuple[float, ...]:
        fingers, palm, _ = one
        nearest = sorted(gap for _, gap in fingers)[:needed]
        holding = sum(word == "touches" for word, _ in fingers)
        return max(PALM_CLEAR - palm, 0.0) > 0, -min(holding, needed), sum(nearest), -palm

    fingers, palm, place = min(looked, key=short)
    names = search.workspace.hand.fingertip_names
    parts = [f"{name} {word}" for name, (word, _) in zip(names, fingers, strict=True)]
    if palm < PALM_CLEAR:
        where = f"{-1000 * palm:.0f} mm inside it" if palm < 0 else "too near to it"
        parts.append(f"the palm {where}")
    size = f"{1000 * place.size:.0f} mm wide " if search.size is None else ""
    return (
        f"in the place that came closest, {size}at {np.round(place.centre, 4).tolist()}: "
        f"{', '.join(parts)}; {_advice([word for word, _ in fingers], palm, needed, search)}"
    )


def _said(search: GraspSearch, place: Placement) -> list[tuple[str, float]]:
    """Of each finger how it fares, and its nearest approach to the object [m]."""
    space, shape = search.workspace, search.shape.scaled(place.size)
    found = []
    for finger in range(space.hand.n_fingers):
        gap = space.approach(finger, shape, place.centre, place.turn)
        if gap > BAND:
            found.append((f"{1000 * gap:.0f} mm away", gap))
            continue
        touch = space.touches(finger, shape, place.centre, place.turn)
        strong, easy = search.able(finger, touch)
        if not len(touch.posture):
            word = "only with other links or an edge"
        elif not strong.any():
            word = "too weak"
        else:
            word = "touches" if (strong & easy).any() else _STIFF
        found.append((word, 0.0))
    return found


def _palm(search: GraspSearch, place: Placement) -> float:
    shape = search.shape.scaled(place.size)
    return search.workspace.palm_clearance(shape, place.centre, place.turn)


def _advice(words: list[str], palm: float, needed: int, search: GraspSearch) -> str:
    if palm < PALM_CLEAR:
        return "take a smaller object_size, or a grasp_centre further from the palm"
    if words.count("touches") >= needed:
        return (
            "but the contacts come too near to each other, or links of the hand cross: take "
            "another object_size or grasp_centre"
        )
    if any(word.endswith("away") for word in words):
        return "take another object_size, or a grasp_centre nearer to those that are away"
    if "too weak" in words:
        return f"take less grip than {search.grip:g} N, or mend the torque limits ([servos] effort)"
    if _STIFF in words:
        return "take another object_size or grasp_centre"
    return "take a smaller object_size, or another grasp_centre"
