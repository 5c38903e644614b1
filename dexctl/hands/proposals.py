"""What the toml of a hand may say, guessed from its description file, with the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.description import read
from dexctl.exceptions import HandModelError
from dexctl.hand import HandModel
from dexctl.hand_config import Coupling, HandConfig, PalmConfig, Vector3
from dexctl.hands.fingers import Finger, Fingers, find_fingers, stretched
from dexctl.state import Bools, Floats

_ABDUCTION = 0.15  # a range whose middle is nearer to zero than this part of it bends no finger
_BESIDE = np.cos(np.deg2rad(45.0))  # fingers that point alike are within this angle
_TOGETHER = 0.85  # unit vectors whose mean is longer than this go one way
_MOSTLY = 0.5
_SNAP = np.cos(np.deg2rad(15.0))  # a direction this near to an axis of the file is that axis


class Proposal(NamedTuple):
    """A configuration and why it is what it is.

    Attributes:
        config: to be looked at.
        reasons: by dotted path of the setting; `HandConfig.write` takes them as comments.
        radii: half the width of each fingertip ``(m,)`` [m].
    """

    config: HandConfig
    reasons: dict[str, str]
    radii: Floats


def propose(path: str | Path, fingertips: Sequence[str] = (), base: str | None = None) -> Proposal:
    """What can be read off a description file: fingertips, palm, what is held.

    Args:
        path: MJCF or URDF.
        fingertips: bodies, links or sites that are the fingertips, where they are known.
        base: only what hangs on this body; for files of several hands.

    Raises:
        HandModelError: the file cannot be read, or no hand is found in it.
        UnknownName: a body or site that is not there.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        what = "a folder; expected an MJCF or URDF file" if path.is_dir() else "no such file"
        raise HandModelError(f"{path}: {what}")
    if path.suffix.lower() == ".toml":
        raise HandModelError(
            f"{path}: a toml; expected the MJCF or URDF file of a hand, for which one is proposed"
        )
    description = read(path.absolute())
    found = find_fingers(description, tuple(fingertips), base)
    reasons = {"fingertips": _why_fingers(found, bool(fingertips))}
    radii = np.array([finger.radius for finger in found.fingers])
    bodies = {body.name for body in description.bodies}
    inside = all(finger.body in bodies for finger in found.fingers)  # a site is the tip itself
    if inside:
        reasons["fingertip_radius"] = (
            "That half-width: where nothing feels contacts, they are taken to be this far from the "
            "tips."
        )
    reasons["finger_width"] = "The wider of the last two links, in the middle finger of them all."
    config = HandConfig(
        description=path.absolute(),
        fingertips={finger.body: _rounded(finger.offset, 4) for finger in found.fingers},
        fingertip_radius=round(float(np.median(radii)), 4) if inside else 0.0,
        finger_width=round(float(np.median([finger.width for finger in found.fingers])), 4),
        couplings={
            joint: Coupling(offset=stretched(description)[joint])
            for joint in found.trunk
            if joint not in description.mimics
        },
    )
    if config.couplings:
        reasons["couplings"] = (
            f"Held: all fingers share {', '.join(config.couplings)} (a wrist or an arm). Without "
            "these lines controllers move them, too."
        )
    hand = HandModel(description, config)
    palm, why = propose_palm(hand, found.fingers)
    reasons |= {f"palm.{name}": text for name, text in why.items()}
    return Proposal(replace(config, palm=palm), reasons, radii)


def closing(hand: HandModel) -> Floats:
    """Which way each joint bends its finger ``(d,)``: towards the longer end of its range.

    0 for a joint that has no longer end: it spreads the fingers, or has no limits.
    """
    with np.errstate(invalid="ignore"):  # without limits
        middle, span = (hand.lower + hand.upper) / 2, hand.upper - hand.lower
    bends = np.isfinite(span) & (np.abs(middle) > _ABDUCTION * span)
    return np.where(bends, np.sign(np.where(bends, middle, 0.0)), 0.0)


def propose_palm(hand: HandModel, fingers: Sequence[Finger]) -> tuple[PalmConfig, dict[str, str]]:
    """Where the palm looks and the fingers point, in the file's world frame; and why."""
    at = hand.configuration(np.clip(0.0, hand.lower, hand.upper))
    tips = at.fingertip_position @ hand.base_rotation  # back into the file's frame
    bending = closing(hand)[hand.finger_joints] * _parallel_to_last(hand, at)
    speed = np.einsum("mn,mnx->mx", bending, at.finger_jacobian(at.fingertip_position))
    speed = speed @ hand.base_rotation
    pointing = _unit(tips - np.array([finger.base for finger in fingers]))
    alike = pointing @ pointing.T > _BESIDE
    group = alike[np.argmax(alike.sum(axis=1))]
    up = _unit(pointing[group].sum(axis=0))
    across = speed[group] - np.outer(speed[group] @ up, up)
    together = _unit(across).mean(axis=0)
    names = ", ".join(f.body for f, inside in zip(fingers, group, strict=True) if inside)
    everyone = _unit(speed).mean(axis=0)
    why_up = f"Where {names} point when they are stretched."
    if len(fingers) > 2 and np.linalg.norm(everyone) > _TOGETHER:
        axis = _snapped(_unit(everyone))
        why = "Where all fingertips go when they bend."
    elif np.linalg.norm(together) > _MOSTLY:
        axis = _snapped(_unit(together))
        why = f"Where the tips of {names} go when they bend."
    elif group.sum() > 1:
        axis = _snapped(up)
        bases = np.array([finger.base for finger in fingers])
        up = bases[0] - bases.mean(axis=0)
        why = f"{names} stand side by side and bend towards each other: it looks along them."
        why_up = "Towards the base of the first finger."
    else:
        axis = np.array([0.0, 0.0, 1.0])
        why = "No two fingers point alike and none has a longer way to bend: a guess; mend it."
    up = up - (up @ axis) * axis
    if np.linalg.norm(up) < 1e-6:
        up = np.eye(3)[np.argmin(np.abs(axis))]
        up -= (up @ axis) * axis
    return PalmConfig(axis=_rounded(axis, 4), up=_rounded(_snapped(_unit(up)), 4)), {
        "axis": why,
        "up": why_up,
    }


def _parallel_to_last(hand: HandModel, at: HandConfiguration) -> Bools:
    """Which joints of each finger ``(m, n)`` turn about the axis of its last; others spread it."""
    axes = _unit(at.finger_twist[..., 3:])
    counts = hand.moves.sum(axis=1)
    last = axes[np.arange(hand.n_fingers), counts - 1]
    own = np.arange(axes.shape[1]) < counts[:, None]
    return own & (np.abs(np.einsum("mnx,mx->mn", axes, last)) > _BESIDE)


def _why_fingers(found: Fingers, given: bool) -> str:
    text = "As given" if given else "The ends of the tree that carry geometry"
    text += "; offset: the middle of the end of the geometry, one half-width inside"
    text += "; none for a site, which is the tip itself." if given else "."
    if found.drawn:
        text += (
            "\nMeasured by what is drawn, for want of collision geometry: "
            f"{', '.join(found.drawn)}; a fingertip among them touches with a ball at the tip when "
            "it is simulated."
        )
    for body, why in found.dropped.items():
        text += f"\nNot taken for a finger: {body} ({why})."
    return text


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-9)


def _snapped(direction: Floats) -> Floats:
    """The axis of the file that is very near to a direction, or the direction itself."""
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) < _SNAP:
        return direction
    return np.sign(direction[nearest]) * np.eye(3)[nearest]


def _rounded(vector: Floats, digits: int) -> Vector3:
    x, y, z = (round(float(one), digits) + 0.0 for one in vector)
    return x, y, z
