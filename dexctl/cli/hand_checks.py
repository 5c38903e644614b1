"""Checks of a hand: whether file, kinematics and simulator mean the same, and whether it holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dexctl.exceptions import DexctlError
from dexctl.hand import HandModel, random_configurations

if TYPE_CHECKING:
    from dexctl.sim import Scene

STEP = 1e-6  # of finite differences [rad]
JACOBIAN_ERROR = 1e-6  # between Jacobian and finite differences, at most [m/rad]
PLACE_ERROR = 1e-5  # between kinematics and simulator, at most [m]
TIP_DISTANCE = 0.02  # of a fingertip's point from what it touches with, at most [m]
POSTURES = 20
HELD_SHARE = 0.9  # of trials that hold, at least
TRIALS = 16  # disturbed grasps, palm up and as many palm down
SECONDS = 10.0  # for which they are to hold


class HandCheck(NamedTuple):
    """One check.

    Attributes:
        name: what was looked at.
        good: whether it passed; None: nothing that could be checked.
        said: what was found, one line.
    """

    name: str
    good: bool | None
    said: str


def check_hand(
    hand: HandModel,
    object: str | None = None,  # noqa: A002
    *,
    seconds: float = SECONDS,
    trials: int = TRIALS,
    seed: int = 0,
    built: Callable[[Scene], None] | None = None,
) -> Iterator[HandCheck]:
    """The checks of 'Add your hand', one after the other.

    Args:
        hand: the hand.
        object: what it is to hold; None: what its toml says, else a cube.
        seconds: how long it has to hold that.
        trials: how many disturbed grasps, palm up and as many palm down.
        seed: of postures and disturbances.
        built: called with the scene, once there is one.
    """
    from dexctl.sim import Scene

    yield _limits(hand)
    yield _jacobians(hand, seed)
    name = object or hand.config.object.shape or "cube"
    try:
        scene = Scene.build(hand, name)
    except DexctlError as error:
        yield HandCheck("simulator", False, str(error))
        return
    yield HandCheck("simulator", True, "; ".join(scene.notes) or "takes the file as it is")
    if built is not None:
        built(scene)
    yield _places(scene, seed)
    yield _touch(scene)
    yield _reach(scene, seed)
    for palm in ("up", "down"):
        yield check_holding(hand, name, palm, seconds=seconds, trials=trials, seed=seed)


def unlimited(hand: HandModel) -> str:
    """What a hand's file, and its toml, do not say of its joints' limits; empty: nothing."""
    names = np.array(hand.joint_names)
    missing = {
        "range": ~(np.isfinite(hand.lower) & np.isfinite(hand.upper)),
        "torque limit": ~np.isfinite(hand.effort),
        "speed limit": ~np.isfinite(hand.velocity),
    }
    return "; ".join(
        f"no {what}: {'any joint' if where.all() else ', '.join(names[where])}"
        for what, where in missing.items()
        if where.any()
    )


def _limits(hand: HandModel) -> HandCheck:
    empty = hand.lower >= hand.upper
    said = [unlimited(hand)]
    if empty.any():
        said.insert(0, f"no room to move: {', '.join(np.array(hand.joint_names)[empty])}")
    return HandCheck("joint limits", not empty.any(), "; ".join(filter(None, said)) or "all there")


def _jacobians(hand: HandModel, seed: int) -> HandCheck:
    worst = 0.0
    for q in random_configurations(hand, POSTURES, seed):
        tips = hand.fingertip_positions(q)
        jacobian = hand.contact_jacobian(q, tips)
        steps = STEP * np.eye(hand.nq)
        ahead, behind = hand.fingertip_positions(q + steps), hand.fingertip_positions(q - steps)
        slope = np.moveaxis(ahead - behind, 0, -1) / (2 * STEP)
        worst = max(worst, float(np.abs(jacobian - slope).max()))
    said = f"within {worst:.1g} m/rad of finite differences in {POSTURES} postures"
    return HandCheck("Jacobians", worst <= JACOBIAN_ERROR, said)


def _places(scene: Scene, seed: int) -> HandCheck:
    from dexctl.sim.tips import simulated_tips

    worst, which = 0.0, ""
    for q in random_configurations(scene.hand, POSTURES, seed):
        distance = np.linalg.norm(
            simulated_tips(scene, q) - scene.hand.fingertip_positions(q), axis=1
        )
        if distance.max() > worst:
            worst = float(distance.max())
            which = scene.hand.fingertip_names[int(distance.argmax())]
    said = f"kinematics and simulator place fingertips within {1000 * worst:.2g} mm"
    return HandCheck(
        "fingertips", worst <= PLACE_ERROR, said + (f" ({which})" if worst > PLACE_ERROR else "")
    )


def _touch(scene: Scene) -> HandCheck:
    """How far each fingertip's point is from the geometry that it touches with."""
    from dexctl.sim.tips import tip_gaps

    gaps = tip_gaps(scene)
    far = [
        f"{name} by {1000 * gap:.0f} mm"
        for name, gap in zip(scene.hand.fingertip_names, gaps, strict=True)
        if gap > TIP_DISTANCE
    ]
    if far:
        return HandCheck(
            "touch geometry", False, f"fingertips away from their geometry: {', '.join(far)}"
        )
    return HandCheck("touch geometry", True, "every fingertip is in or at its collision geometry")


def _reach(scene: Scene, seed: int) -> HandCheck:
    """Whether each finger comes to the object's surface, from a sample of its postures."""
    tips = scene.hand.fingertip_positions(random_configurations(scene.hand, 4000, seed))
    distance = np.linalg.norm(tips - scene.grasp_centre, axis=-1)
    near = distance.min(axis=0)
    allowed = 0.5 * scene.object_width + 0.02
    out = [
        f"{name} by {1000 * (one - allowed):.0f} mm"
        for name, one in zip(scene.hand.fingertip_names, near, strict=True)
        if one > allowed and scene.object_width
    ]
    if out:
        return HandCheck("reach", False, f"out of reach of the object: {', '.join(out)}")
    return HandCheck("reach", True, f"every finger comes to the {scene.object}")


def check_holding(
    hand: HandModel,
    name: str,
    palm: str,
    *,
    seconds: float = SECONDS,
    trials: int = TRIALS,
    seed: int = 0,
) -> HandCheck:
    """Whether the set-points alone hold an object in disturbed grasps; see `check_hand`."""
    from dexctl.controllers import Hold
    from dexctl.sim import BatchSimulator, Scene, run

    what = f"holds, palm {palm}"
    try:
        scene = Scene.build(hand, name, palm)
        with BatchSimulator(scene, num_envs=trials, disturbance=0.02, seed=seed) as sim:
            trace = run(Hold(hand, control_period=sim.control_period), sim, seconds)
    except DexctlError as error:
        return HandCheck(what, False, str(error))
    held = int((~trace.dropped).sum())
    said = f"{held} of {trials} disturbed grasps of the {name} for {seconds:g} s"
    return HandCheck(what, held >= HELD_SHARE * trials, said)
