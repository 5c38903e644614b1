"""GraspState: what a controller may see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspState:
    """Joints, touch and (where known) the object, at one moment, of one hand or of a batch.

    Arrays carry leading batch dimensions ``(...)``: ``()`` for one hand, ``(N,)`` for N. World
    frame, SI units. The thesis's observation (chapter 4) is [q, q', p, n, c].

    Attributes:
        q: joint positions, ``(..., d)`` [rad].
        q_target: joint set-points, ``(..., d)`` [rad].
        in_contact: which fingertips touch the object, ``(..., m)`` bool.
        contact_position: contact point of each fingertip, ``(..., m, 3)`` [m].
        contact_normal: unit normal from the fingertip into the object, ``(..., m, 3)``.
        contact_force: normal force, >= 0, ``(..., m)`` [N]. Rows of the three contact arrays
            whose finger is not in contact are zero and are never read.
        object_position: object centre, ``(..., 3)`` [m], or None where nothing tracks it.
        object_quaternion: object orientation wxyz, ``(..., 4)``, or None.
        time: when the state was taken, ``(...)`` or one number for all [s].
        age: how old its oldest part is, ``(...)`` or one number for all [s].

    Raises:
        InvalidInput: shapes that do not belong together; the message names the field.
    """

    q: Floats
    q_target: Floats
    in_contact: Bools
    contact_position: Floats
    contact_normal: Floats
    contact_force: Floats
    object_position: Floats | None = None
    object_quaternion: Floats | None = None
    time: Floats | float = 0.0
    age: Floats | float = 0.0

    def __post_init__(self) -> None:
        q = _array(self, "q")
        touch = _array(self, "in_contact", bool)
        batch = q.shape[:-1]
        fingers = (*batch, touch.shape[-1] if touch.ndim else 0)
        _expect(self, "q_target", q.shape)
        _expect(self, "in_contact", fingers, bool)
        _expect(self, "contact_position", (*fingers, 3))
        _expect(self, "contact_normal", (*fingers, 3))
        _expect(self, "contact_force", fingers)
        if self.object_position is not None:
            _expect(self, "object_position", (*batch, 3))
        if self.object_quaternion is not None:
            _expect(self, "object_quaternion", (*batch, 4))
        for name in ("time", "age"):
            value = getattr(self, name)
            if type(value) is not float:
                shape = np.shape(value)
                _check_shape(self, name, shape, batch if shape else ())

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """``()`` for one hand, ``(N,)`` for N."""
        return self.q.shape[:-1]

    def object_centre(self) -> Floats:
        """Where the object is, ``(..., 3)`` [m]; where nothing tracks it, the contacts' centroid.

        The origin where there is neither.
        """
        if self.object_position is not None:
            return self.object_position
        touching = self.in_contact[..., None]
        total = np.where(touching, self.contact_position, 0.0).sum(axis=-2)
        return total / np.maximum(touching.sum(axis=-2), 1)

    def __getitem__(self, index: Any) -> GraspState:
        """The state of some environments: ``state[3]``, ``state[mask]``, ``state[None]``."""
        fields = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            fields[name] = np.asarray(value)[index] if np.ndim(value) else value
        return GraspState(**fields)

    def arrays(self) -> dict[str, Any]:
        """Its fields by name; ``GraspState(**it)`` is the same state."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def without(self, fingers: Bools) -> GraspState:
        """The same state with ``fingers`` ``(..., m)`` counted as out of contact."""
        return replace(self, in_contact=self.in_contact & ~fingers)


def merged(chosen: Bools, state: GraspState, other: GraspState) -> GraspState:
    """``state`` in the environments chosen ``(N,)``, ``other`` elsewhere."""
    if chosen.all():
        return state
    values = {}
    for name, value in state.arrays().items():
        if value is None:  # an object that nothing tracks
            continue
        a, b = np.asarray(value), np.asarray(getattr(other, name))
        values[name] = np.where(chosen.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
    return replace(state, **values)


def _array(state: GraspState, name: str, kind: type = float) -> NDArray:
    value = getattr(state, name)
    if not (type(value) is np.ndarray and value.dtype == kind):
        try:
            value = np.asarray(value, kind)
        except (TypeError, ValueError):
            raise InvalidInput(
                f"GraspState.{name} is {value!r}; expected an array of {kind.__name__}"
            ) from None
        object.__setattr__(state, name, value)
    return value


def _expect(state: GraspState, name: str, shape: tuple[int, ...], kind: type = float) -> None:
    _check_shape(state, name, _array(state, name, kind).shape, shape)


def _check_shape(
    state: GraspState, name: str, shape: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    if shape != expected:
        raise InvalidInput(
            f"GraspState.{name} has shape {shape}; expected {expected}, from q of shape "
            f"{state.q.shape} and in_contact of shape {state.in_contact.shape}"
        )
