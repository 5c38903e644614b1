"""Grasp states in a file of arrays: what planners write, and what episodes start from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.files import aside, read_arrays
from dexctl.hand import HandModel
from dexctl.state import Floats

TREE = "tree.npz"
"""What stands for a folder: the tree that was planned into it."""
_ROWS = ("q", "q_target", "object_position", "object_quaternion", "object")
_OPTIONAL = ("weight", "parent", "meta")


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
        weight: how likely each is drawn, above 0, ``(S,)``; None: all alike.
        parent: the row that each was reached from, -1 where there is none, ``(S,)``; None: not
            known. Parents may stand anywhere.
        meta: where they are from, as the JSON text of whoever made them; for people.

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
    weight: Floats | None = None
    parent: NDArray[np.int64] | None = None
    meta: str = ""

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
        object.__setattr__(self, "meta", str(self.meta))
        self._check_weight()
        self._check_parent()

    def _check_weight(self) -> None:
        if self.weight is None:
            return
        weight = np.asarray(self.weight)
        if weight.shape != (len(self),) or weight.dtype.kind not in "iuf":
            raise InvalidInput(
                f"GraspStates.weight has shape {weight.shape} of {weight.dtype}; expected "
                f"{(len(self),)} numbers"
            )
        if not (np.isfinite(weight) & (weight > 0)).all():
            raise InvalidInput("GraspStates.weight has numbers that are not finite and above 0")
        object.__setattr__(self, "weight", weight.astype(float))

    def _check_parent(self) -> None:
        if self.parent is None:
            return
        parent = np.asarray(self.parent)
        if parent.shape != (len(self),) or parent.dtype.kind not in "iu":
            raise InvalidInput(
                f"GraspStates.parent has shape {parent.shape} of {parent.dtype}; expected "
                f"{(len(self),)} whole numbers"
            )
        wrong = (parent < -1) | (parent >= len(self)) | (parent == np.arange(len(self)))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise InvalidInput(
                f"GraspStates.parent of row {i} is {parent[i]}; expected another of the "
                f"{len(self)} rows, or -1"
            )
        object.__setattr__(self, "parent", parent.astype(np.int64))

    def __len__(self) -> int:
        return len(self.object)

    def of(self, name: str) -> GraspStates:
        """Those with the object ``name``.

        Raises:
            InvalidInput: there are none.
        """
        return self.take(np.flatnonzero(self.object == name))

    def take(self, index: ArrayLike) -> GraspStates:
        """Those of ``index``, in its order.

        A parent that is left out is one no more; where rows are taken twice, nobody's is known.

        Raises:
            InvalidInput: there are none.
        """
        rows = np.arange(len(self))[np.asarray(index)]
        parent = None
        if self.parent is not None and len(np.unique(rows)) == len(rows):
            new = np.full(len(self) + 1, -1, np.int64)  # the last stands for none
            new[rows] = np.arange(len(rows))
            parent = new[self.parent[rows]]
        return GraspStates(
            hand=self.hand,
            joint_names=self.joint_names,
            weight=None if self.weight is None else self.weight[rows],
            parent=parent,
            meta=self.meta,
            **{field: getattr(self, field)[rows] for field in _ROWS},
        )

    @classmethod
    def concatenate(cls, parts: Sequence[GraspStates]) -> GraspStates:
        """All of ``parts``, of one hand, one after the other; weights count as they are.

        Where parts come from different places, ``meta`` has ``parts``: of each how many ``states``
        and its ``meta``.

        Raises:
            InvalidInput: none, or of different hands.
        """
        if not parts:
            raise InvalidInput("concatenate got no grasp states; expected some")
        first = parts[0]
        for one in parts:
            if tuple(one.joint_names) != tuple(first.joint_names):
                raise InvalidInput(
                    f"the grasp states are of {first.hand!r} and {one.hand!r}; expected one hand"
                )
        shifts = np.cumsum([0, *map(len, parts)])
        parents = [
            np.full(len(one), -1, np.int64)
            if one.parent is None
            else np.where(one.parent < 0, -1, one.parent + shift)
            for one, shift in zip(parts, shifts, strict=False)
        ]
        weights = [np.ones(len(one)) if one.weight is None else one.weight for one in parts]
        return cls(
            hand=first.hand,
            joint_names=first.joint_names,
            weight=None if all(p.weight is None for p in parts) else np.concatenate(weights),
            parent=None if all(p.parent is None for p in parts) else np.concatenate(parents),
            meta=first.meta if all(one.meta == first.meta for one in parts) else _metas(parts),
            **{name: np.concatenate([getattr(one, name) for one in parts]) for name in _ROWS},
        )

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        with aside(Path(path)) as part, part.open("wb") as stream:
            np.savez(stream, **{name: v for name, v in values.items() if v is not None})

    @classmethod
    def load(cls, path: str | Path) -> GraspStates:
        """Read what `save` wrote; of a folder, its tree.npz.

        Raises:
            InvalidInput: no such file, or not one of these.
        """
        names, path = [field.name for field in fields(cls)], states_file(path)
        what = f"grasp states {str(path)!r}"
        values: dict[str, Any] = read_arrays(path, what, names)
        missing = [name for name in names if name not in values and name not in _OPTIONAL]
        if missing:
            needed = ", ".join(name for name in names if name not in _OPTIONAL)
            raise InvalidInput(f"{what} lacks {', '.join(missing)}; expected {needed}")
        try:
            return cls(**values)
        except InvalidInput as error:
            raise InvalidInput(f"{what}: {error}") from None


def states_file(path: str | Path) -> Path:
    """The file of grasp states that is meant: of a folder, its tree.npz."""
    found = Path(path).expanduser()
    return found / TREE if found.is_dir() else found


def _metas(parts: Sequence[GraspStates]) -> str:
    """What `GraspStates.concatenate` says of where its parts are from."""
    found = []
    for one in parts:
        try:
            meta = json.loads(one.meta)
        except ValueError:  # whoever made them wrote what they liked
            meta = one.meta
        found.append({"states": len(one), "meta": meta})
    return json.dumps({"parts": found})


class StateSampler:
    """Draws, for each environment of a batch, a state of its own object, by the states' weights.

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
        self._until: Floats | None = None
        if states.weight is not None:
            self._until = np.concatenate([[0.0], np.cumsum(states.weight[self._order])])

    def __call__(self, fraction: Floats) -> NDArray[np.intp]:
        """The state for each environment, from uniform numbers ``(N,)`` in [0, 1)."""
        if self._until is None:
            return self._order[self._first + (fraction * self._count).astype(np.intp)]
        last = self._first + self._count
        low, high = self._until[self._first], self._until[last]
        place = np.searchsorted(self._until, low + fraction * (high - low), side="right") - 1
        # rounding may lead past the last of the object's own
        return self._order[np.clip(place, self._first, last - 1)]
