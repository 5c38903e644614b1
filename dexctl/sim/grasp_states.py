"""Grasp states in a file of arrays: what planners write, and what episodes start from."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.files import aside
from dexctl.hand import HandModel
from dexctl.state import Floats

_ROWS = ("q", "q_target", "object_position", "object_quaternion", "object")


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspStates:
    """S grasps of one hand, at rest. `save` and `load` keep them in a numpy ``.npz`` file.

    Attributes:
        hand: name of the hand.
        q: joint positions ``(S, d)`` [rad].
        q_target: set-points ``(S, d)`` [rad].
        object_position: ``(S, 3)`` [m], hand (= world) frame.
        object_quaternion: wxyz, unit, ``(S, 4)``.
        object: name of the object of each, ``(S,)``.
        joint_names: of the hand, ``(d,)``, in the order of ``q``.

    Raises:
        InvalidInput: shapes that do not belong together, or numbers that are not finite.
    """

    hand: str
    q: Floats
    q_target: Floats
    object_position: Floats
    object_quaternion: Floats
    object: NDArray[np.str_]
    joint_names: NDArray[np.str_]

    def __post_init__(self) -> None:
        for name in ("object", "joint_names"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.str_))
        object.__setattr__(self, "hand", str(self.hand))
        for name in ("object", "joint_names"):
            if getattr(self, name).ndim != 1:
                raise InvalidInput(f"GraspStates.{name} is {getattr(self, name)}; expected a list")
        count, d = len(self.object), len(self.joint_names)
        if not count:
            raise InvalidInput("GraspStates has no states; expected at least one")
        for name, width in (
            ("q", d),
            ("q_target", d),
            ("object_position", 3),
            ("object_quaternion", 4),
        ):
            try:
                value = np.asarray(getattr(self, name), float)
            except (TypeError, ValueError):
                raise InvalidInput(f"GraspStates.{name} has no numbers; expected them") from None
            if value.shape != (count, width):
                raise InvalidInput(
                    f"GraspStates.{name} has shape {value.shape}; expected {(count, width)}"
                )
            if not np.isfinite(value).all():
                raise InvalidInput(f"GraspStates.{name} has numbers that are not finite")
            object.__setattr__(self, name, value)
        norm = np.linalg.norm(self.object_quaternion, axis=1)
        if (np.abs(norm - 1.0) > 1e-3).any():
            bad = float(norm[np.argmax(np.abs(norm - 1.0))])
            raise InvalidInput(f"GraspStates.object_quaternion has norm {bad:.4g}; expected 1")

    def __len__(self) -> int:
        return len(self.object)

    def of(self, name: str) -> GraspStates:
        """Those with the object ``name``.

        Raises:
            InvalidInput: there are none.
        """
        rows = self.object == name
        arrays = {field: getattr(self, field)[rows] for field in _ROWS}
        return GraspStates(hand=self.hand, joint_names=self.joint_names, **arrays)

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        with aside(Path(path)) as part, part.open("wb") as stream:
            np.savez(stream, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: str | Path) -> GraspStates:
        """Read what `save` wrote.

        Raises:
            InvalidInput: no such file, or not one of these.
        """
        names = [field.name for field in fields(cls)]
        what = f"grasp states {str(path)!r}"
        try:
            with np.load(path, allow_pickle=False) as stored:
                missing = [name for name in names if name not in stored]
                values = {name: stored[name] for name in names if name in stored}
        except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InvalidInput(f"{what} cannot be read: {error}") from None
        if missing:
            raise InvalidInput(f"{what} lacks {', '.join(missing)}; expected {', '.join(names)}")
        try:
            return cls(**values)
        except InvalidInput as error:
            raise InvalidInput(f"{what}: {error}") from None


class StateSampler:
    """Draws, for each environment of a batch, a state of its own object.

    Args:
        states: what to draw from.
        hand: the hand of the environments.
        objects: the object of each environment, ``(N,)``.

    Raises:
        InvalidInput: states of another hand, or an object without states.
    """

    def __init__(self, states: GraspStates, hand: HandModel, objects: tuple[str, ...]) -> None:
        if tuple(states.joint_names) != tuple(hand.joint_names):
            raise InvalidInput(
                f"the grasp states are of the hand {states.hand!r}, whose "
                f"{len(states.joint_names)} joints are not the {hand.nq} of {hand.name!r}"
            )
        known = sorted(set(states.object.tolist()))
        missing = sorted(set(objects) - set(known))
        if missing:
            raise InvalidInput(
                f"the grasp states have none of the object {missing[0]!r}; they are of "
                f"{', '.join(known)}"
            )
        self.states = states
        self._order = np.argsort(states.object, kind="stable")
        names = states.object[self._order]
        wanted = np.array(objects)
        self._first = np.searchsorted(names, wanted, side="left")
        self._count = np.searchsorted(names, wanted, side="right") - self._first

    def __call__(self, fraction: Floats) -> NDArray[np.intp]:
        """The state for each environment, from uniform numbers ``(N,)`` in [0, 1)."""
        return self._order[self._first + (fraction * self._count).astype(np.intp)]
