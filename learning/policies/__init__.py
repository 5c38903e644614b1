"""Trained policies that come with the package, by name; each file has its card beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from learning.policy import Policy, load_policy

FOLDER = Path(__file__).parent


def names() -> tuple[str, ...]:
    """What `load` takes: HAND-OBJECT, or HAND-easy for one policy for several objects."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def load(name: str, *, hand: HandModel | str | None = None) -> Policy:
    """The policy ``name``, with the hand it was trained on or with ``hand``.

    Raises:
        UnknownName: there is no such policy.
        InvalidInput: it is for another hand.
    """
    if name not in names():
        raise UnknownName("policy", name, names())
    return load_policy(FOLDER / f"{name}.npz", hand=hand)


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
        policy: one of `names`, or a policy file (``.npz``); None is the first that was trained on
            a hand of this name, one for several objects before those for single ones.
        axis: whichever; a policy turns about the axis that it was trained with.

    Raises:
        UnknownName, InvalidInput: there is no such policy or file, or none for this hand or period.
    """
    if policy is None:
        own = [name for name in names() if name.startswith(f"{hand.path.stem}-")]
        if not own:
            known = sorted({name.rpartition("-")[0] for name in names()})
            raise InvalidInput(
                f"no learned policy comes with dexctl for the hand {hand.path.stem!r}; there is "
                f"one for {', '.join(known)}, and `dexctl train` makes others"
            )
        own.sort(key=lambda name: not name.endswith("-easy"))
        policy = own[0]
    if Path(policy).suffix == ".npz":
        found = load_policy(policy, hand=hand)
    else:
        found = load(str(policy), hand=hand)
    if control_period is not None and not np.isclose(control_period, found.control_period):
        raise InvalidInput(
            f"control_period is {control_period}; the policy {str(policy)!r} was trained with "
            f"{found.control_period}"
        )
    return found
