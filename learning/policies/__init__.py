"""Policies: those that come with the package by name, files, and run folders, through one door.

Each shipped file has its card beside it, which says what trained it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl import hands
from dexctl.controllers import paced
from dexctl.exceptions import DexctlError, InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.validation import unit_axis
from learning.envs.observation import TURNING
from learning.policies.file import annotate, read, save
from learning.policies.policy import (
    Commanded,
    Layer,
    Policy,
    PolicySpec,
    check_pace,
    other_hand,
)

__all__ = [
    "Commanded", "Layer", "Policy", "PolicySpec", "annotate", "check_pace", "learned", "load",
    "names", "other_hand", "save",
]  # fmt: skip

FOLDER = Path(__file__).parent
IN_RUN = "policy.npz"
"""Name of the policy in a run folder."""
GENERAL = {"dex5": "dex5-easy-any"}
"""By hand, the policy for most objects and any way up of those that need no tracker."""


def names(hand: str | None = None) -> tuple[str, ...]:
    """The policies that come with the package, HAND-WHAT: of the hand of that name, or all."""
    found = sorted(path.stem for path in FOLDER.glob("*.npz"))
    return tuple(name for name in found if hand in (None, name.partition("-")[0]))


def load(
    name_or_path: str | Path,
    *,
    hand: HandModel | str | None = None,
    parts: Sequence[str] | None = None,
    goal: ArrayLike | None = None,
    angular_velocity: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    pace: float | None = None,
) -> Policy:
    """A policy, ready to run.

    Args:
        name_or_path: one of `names`, a policy file (``.npz``), or a run folder that holds one. The
            card need not be beside a file. With ``@`` and a number behind it the policy goes at
            that pace: ``dex5-robust@0.8``.
        hand: the hand to run it on; None loads the one that it was trained on.
        parts: refuse a policy that was trained with other observation parts than these.
        goal, angular_velocity: what is wanted where a state does not tell; see `Policy`.
        axis: hand frame, ``(3,)``, that the object is to be turned about: at the middle of the
            speeds of the commands that the policy was trained with, or as the hand's symmetry makes
            it of the axis that it was trained for. On dex5, which is its own mirror image, a policy
            for z turns as well about -z. None: the policy's own.
        pace: above 0 and at most 1, see `Policy`. None: what stands behind the name, or 1.

    Raises:
        UnknownName: it is none of these, or there is no hand of that name.
        InvalidInput: no such file, one that is damaged or of another format, or a policy for
            another hand, with other observation parts, or for an axis that cannot be turned to
            this one; an axis or speed that a policy which is told was never told in training; a
            pace that is none.
    """
    plain, own_pace = paced(str(name_or_path))
    path = _path(plain)
    layers, spec, card = read(path)
    if isinstance(hand, str):
        hand = hands.load(hand)
    try:
        if parts is not None:
            spec.check_parts(parts)
        model = hands.load(spec.hand) if hand is None else hand
        if axis is not None and angular_velocity is None and TURNING in spec.observation["parts"]:
            angular_velocity = _commanded_speed(card) * np.array(unit_axis(axis))
        found = Policy(
            model, layers, spec, card, goal=goal, angular_velocity=angular_velocity,
            pace=own_pace if pace is None else pace,
        )  # fmt: skip
        found = found if axis is None else found.turned_to(axis)
        if angular_velocity is not None:
            found.check_told(angular_velocity)
        return found
    except DexctlError as error:
        raise InvalidInput(f"policy {str(path)!r}: {error}") from None


def learned(
    hand: HandModel,
    *,
    control_period: float | None = None,
    policy: str | Path | None = None,
    axis: ArrayLike | None = None,
    pace: float | None = None,
) -> Policy:
    """The controller of the name "learned": a policy that was trained on ``hand``.

    Args:
        hand: the hand.
        control_period: must be the one that the policy was trained with [s]; None takes it.
        policy: what `load` takes; None is the one in `GENERAL` for a hand of this name, or of the
            `names` that were trained on it the one for the object that the hand's toml names, or
            the first.
        axis, pace: see `load`.

    Raises:
        UnknownName, InvalidInput: there is no such policy or file, or none for this hand or period.
    """
    if policy is None:
        own = names(hand.name)
        if not own:
            known = sorted({name.partition("-")[0] for name in names()})
            raise InvalidInput(
                f"no learned policy comes with dexctl for the hand {hand.name!r}; there is "
                f"one for {', '.join(known)}, and `dexctl train` makes others"
            )
        suits = (GENERAL.get(hand.name), f"{hand.name}-{hand.config.object.shape}")
        policy = next((name for name in suits if name in own), own[0])
    found = load(policy, hand=hand, axis=axis, pace=pace)
    if control_period is not None and not np.isclose(control_period, found.control_period):
        raise InvalidInput(
            f"control_period is {control_period}; the policy {str(policy)!r} was trained with "
            f"{found.control_period}"
        )
    return found


def _commanded_speed(card: Mapping[str, Any]) -> float:
    """The middle of the speeds that a policy was trained to turn at [rad/s].

    Raises:
        InvalidInput: its card does not say.
    """
    own = Commanded.of_card(card)
    if own is None:
        raise InvalidInput(
            "the policy's card does not say at which speeds it was trained; expected "
            "angular_velocity in place of axis"
        )
    return 0.5 * sum(own.speeds)


def _path(name_or_path: str) -> Path:
    """The file that is meant; it need not be there."""
    if name_or_path in names():
        return FOLDER / f"{name_or_path}.npz"
    path = Path(name_or_path).expanduser()
    if path.suffix == ".npz" and not path.is_dir():
        return path
    if (path / IN_RUN).is_file():
        return path / IN_RUN
    if path.is_dir():
        raise InvalidInput(
            f"{str(path)!r} is no run folder with a policy: there is no {IN_RUN} in it (it comes "
            "with the first checkpoint)"
        )
    known = (*names(), "a policy file (.npz)", "a run folder")
    raise UnknownName("policy", name_or_path, known)
