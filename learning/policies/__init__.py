"""Policies: those that come with the package by name, files, and run folders, through one door.

Each shipped file has its card beside it, which says what trained it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dexctl import hands
from dexctl.exceptions import DexctlError, InvalidInput, UnknownName
from dexctl.hand import HandModel
from learning.policies.file import read, save
from learning.policies.policy import Layer, Policy, PolicySpec, other_hand

__all__ = ["Layer", "Policy", "PolicySpec", "learned", "load", "names", "other_hand", "save"]

FOLDER = Path(__file__).parent
IN_RUN = "policy.npz"
"""Name of the policy in a run folder."""


def names() -> tuple[str, ...]:
    """The policies that come with the package: HAND-OBJECT, or HAND-easy for several objects."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def load(
    name_or_path: str | Path,
    *,
    hand: HandModel | str | None = None,
    parts: Sequence[str] | None = None,
) -> Policy:
    """A policy, ready to run.

    Args:
        name_or_path: one of `names`, a policy file (``.npz``), or a run folder that holds one. The
            card need not be beside a file.
        hand: the hand to run it on; None loads the one that it was trained on.
        parts: refuse a policy that was trained with other observation parts than these.

    Raises:
        UnknownName: it is none of these, or there is no hand of that name.
        InvalidInput: no such file, one that is damaged or of another format, or a policy for
            another hand or with other observation parts.
    """
    path = _path(name_or_path)
    layers, spec, card = read(path)
    if isinstance(hand, str):
        hand = hands.load(hand)
    try:
        if parts is not None:
            spec.check_parts(parts)
        return Policy(hands.load(spec.hand) if hand is None else hand, layers, spec, card)
    except DexctlError as error:
        raise InvalidInput(f"policy {str(path)!r}: {error}") from None


def learned(
    hand: HandModel,
    *,
    control_period: float | None = None,
    policy: str | Path | None = None,
    axis: ArrayLike | None = None,
) -> Policy:
    """The controller of the name "learned": a policy that was trained on ``hand``.

    Args:
        hand: the hand.
        control_period: must be the one that the policy was trained with [s]; None takes it.
        policy: what `load` takes; None is the first of `names` that was trained on a hand of this
            name, one for several objects before those for single ones.
        axis: whichever; a policy turns about the axis that it was trained with.

    Raises:
        UnknownName, InvalidInput: there is no such policy or file, or none for this hand or period.
    """
    if policy is None:
        own = [name for name in names() if name.startswith(f"{hand.name}-")]
        if not own:
            known = sorted({name.rpartition("-")[0] for name in names()})
            raise InvalidInput(
                f"no learned policy comes with dexctl for the hand {hand.name!r}; there is "
                f"one for {', '.join(known)}, and `dexctl train` makes others"
            )
        own.sort(key=lambda name: not name.endswith("-easy"))
        policy = own[0]
    found = load(policy, hand=hand)
    if control_period is not None and not np.isclose(control_period, found.control_period):
        raise InvalidInput(
            f"control_period is {control_period}; the policy {str(policy)!r} was trained with "
            f"{found.control_period}"
        )
    return found


def _path(name_or_path: str | Path) -> Path:
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
    raise UnknownName("policy", str(name_or_path), known)
