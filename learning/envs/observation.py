"""What a policy observes: the parts, their order, and their layout in one vector.

The thesis's vector (chapter 4) is s = [q, q', p_1..m, n_1..m, c_1..m], the default here. Each part
is a block of the vector, in the order that the parts are named in; fingers come in the hand's
order, coordinates x, y, z in the world (= hand) frame:

| part | numbers | meaning |
|---|---|---|
| ``q`` | d | joint positions [rad] |
| ``q_target`` | d | joint set-points [rad] |
| ``contact_position`` | 3m | contact points [m] |
| ``contact_normal`` | 3m | unit normals, from the fingertips into the object |
| ``contact_force`` | m | normal forces [N] |
| ``touch`` | m | 1 where the fingertip touches, else 0 |
| ``object_position`` | 3 | [m] |
| ``object_quaternion`` | 4 | wxyz, w >= 0 |
| ``object_rotation`` | 6 | the same without jumps: where it takes x and y |
| ``gravity`` | 3 | its direction |
| ``goal_quaternion`` | 4 | orientation that the object is wanted in, wxyz, w >= 0 |
| ``goal_rotation`` | 6 | the turn from where the object is to there: where it takes x and y |
| ``goal_angular_velocity`` | 3 | how the object is wanted to turn [rad/s] |

Rows of fingers that do not touch are zero. ``VERSION`` counts the changes of this table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.rotations import inverse, multiply, rotate
from dexctl.state import Floats, GraspState

VERSION = 1
DEFAULT_PARTS = ("q", "q_target", "contact_position", "contact_normal", "contact_force")
# What is about 1 in a scaled observation.
_LENGTH_SCALE = 0.05  # [m]
_FORCE_SCALE = 2.0  # [N]
_OFFSET_SCALE = 0.05  # [rad]
_VELOCITY_SCALE = np.repeat([0.05, 0.5], 3)  # [m/s], [rad/s]


class Observation:
    """Makes observation vectors of states.

    Args:
        hand: the hand.
        parts: names out of `PARTS`, in the order wanted.
        scaled: bring every part to about unit size: joints to their range, positions to lengths
            of 0.05 m from ``centre``, forces to 2 N.
        centre: what scaled positions are measured from, ``(3,)`` [m].
        more: parts beside `PARTS` by name, a task's.

    Attributes:
        parts, scaled, centre: as given.
        size: k, the length of the vector.
        slices: where each part is.
        low, high: bounds of the numbers, ``(k,)``; infinite where there is none.

    Raises:
        UnknownName: no such part.
        InvalidInput: no part, or one named twice.
    """

    def __init__(
        self,
        hand: HandModel,
        parts: Sequence[str] = DEFAULT_PARTS,
        *,
        scaled: bool = False,
        centre: ArrayLike = (0.0, 0.0, 0.0),
        more: Mapping[str, Part] | None = None,
    ) -> None:
        known = {**PARTS, **(more or {})}
        self.parts = check_parts(parts, known)
        own = self._own = [known[name] for name in self.parts]
        self.scaled = bool(scaled)
        self._hand = hand
        self.centre = np.asarray(centre, float)
        d, m = hand.nq, hand.n_fingers
        sizes = [part.size(d, m) for part in own]
        ends = np.cumsum(sizes)
        self.size = int(ends[-1])
        self.slices = {
            name: slice(int(end) - size, int(end))
            for name, size, end in zip(self.parts, sizes, ends, strict=True)
        }
        self.low = np.repeat([part.bounds[0] for part in own], sizes).astype(np.float32)
        self.high = np.repeat([part.bounds[1] for part in own], sizes).astype(np.float32)
        middle, half = (hand.lower + hand.upper) / 2, (hand.upper - hand.lower) / 2
        limited = np.isfinite(half) & (half > 0)
        self._middle, self._half = np.where(limited, middle, 0.0), np.where(limited, half, np.pi)

    def __call__(self, state: GraspState) -> NDArray[np.float32]:
        """The observation ``(..., k)`` of ``state``.

        Raises:
            InvalidInput: a part needs the object's pose, or gravity, and the state has none.
        """
        batch = state.batch_shape
        out = np.empty((*batch, self.size), np.float32)
        for part, (name, columns) in zip(self._own, self.slices.items(), strict=True):
            value = part.read(state)
            if value is None:
                raise InvalidInput(
                    f"the observation part {name!r} needs {part.needs}, which this state does "
                    "not have"
                )
            if self.scaled:
                value = self._scale(name, value, state)
            out[..., columns] = value.reshape(*batch, -1)
        return out

    def _scale(self, name: str, value: Floats, state: GraspState) -> Floats:
        if name in ("q", "q_target"):
            return (value - self._middle) / self._half
        if name == "contact_position":  # a finger that does not touch stays zero
            return (value - self.centre) * state.in_contact[..., None] / _LENGTH_SCALE
        if name == "object_position":
            return (value - self.centre) / _LENGTH_SCALE
        if name == JOINT_OFFSET:
            return value / _OFFSET_SCALE
        if name == OBJECT_VELOCITY:
            return value / _VELOCITY_SCALE
        return value / _FORCE_SCALE if name in ("contact_force", FINGERTIP_FORCE) else value

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it; see `from_dict`."""
        return {
            "version": VERSION,
            "parts": list(self.parts),
            "scaled": self.scaled,
            "centre": self.centre.tolist(),
        }

    @classmethod
    def from_dict(cls, hand: HandModel, values: Mapping[str, Any]) -> Observation:
        """The observation that `to_dict` described.

        Raises:
            InvalidInput: it is of another version of the layout.
        """
        if values.get("version") != VERSION:
            raise InvalidInput(
                f"the observation layout has version {values.get('version')}; expected {VERSION}"
            )
        return cls(hand, values["parts"], scaled=values["scaled"], centre=values["centre"])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Observation) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.parts, self.scaled))

    def __repr__(self) -> str:
        return f"Observation({', '.join(self.parts)}{', scaled' if self.scaled else ''})"


class Part:
    """One part of the observation.

    Attributes:
        size: number of values for d joints and m fingers.
        read: the values of a state, None where it does not have them.
        bounds: least and greatest value.
        needs: what a state must tell for it.
    """

    def __init__(
        self,
        size: Callable[[int, int], int],
        read: Callable[[GraspState], Floats | None],
        bounds: tuple[float, float] = (-np.inf, np.inf),
        needs: str = "the object's pose",
    ) -> None:
        self.size, self.read, self.bounds, self.needs = size, read, bounds, needs


def _upper_half(quaternion: Floats | None) -> Floats | None:
    """The one of q and -q whose w is not negative."""
    if quaternion is None:
        return None
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _direction(vector: Floats | None) -> Floats | None:
    """Unit vectors; zero where there is none."""
    if vector is None:
        return None
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-9)


def _two_columns(turn: Floats | None) -> Floats | None:
    """Two columns of the rotation matrix: unlike an angle, they change without jumps.

    (Zhou et al., On the continuity of rotation representations in neural networks, 2019.)
    """
    if turn is None:
        return None
    columns = rotate(turn[..., None, :], np.broadcast_to(np.eye(3)[:2], (*turn.shape[:-1], 2, 3)))
    return columns.reshape(*turn.shape[:-1], 6)


def _goal_turn(state: GraspState) -> Floats | None:
    if state.goal_quaternion is None or state.object_quaternion is None:
        return None
    return multiply(state.goal_quaternion, inverse(state.object_quaternion))


DRAWN = "drawn"
OBJECT_VELOCITY, FINGERTIP_FORCE = "object_velocity", "fingertip_force"
JOINT_OFFSET = "joint_offset"
TRUTH = (DRAWN, OBJECT_VELOCITY, FINGERTIP_FORCE, JOINT_OFFSET)
"""The parts that only critics have; `learning.envs.truth` reads them from the simulation."""

PARTS: dict[str, Part] = {
    "q": Part(lambda d, m: d, lambda state: state.q),
    "q_target": Part(lambda d, m: d, lambda state: state.q_target),
    "contact_position": Part(lambda d, m: 3 * m, lambda state: state.contact_position),
    "contact_normal": Part(lambda d, m: 3 * m, lambda state: state.contact_normal, (-1.0, 1.0)),
    "contact_force": Part(lambda d, m: m, lambda state: state.contact_force, (0.0, np.inf)),
    "touch": Part(lambda d, m: m, lambda state: state.in_contact.astype(float), (0.0, 1.0)),
    "object_position": Part(lambda d, m: 3, lambda state: state.object_position),
    "object_quaternion": Part(
        lambda d, m: 4, lambda state: _upper_half(state.object_quaternion), (-1.0, 1.0)
    ),
    "object_rotation": Part(
        lambda d, m: 6, lambda state: _two_columns(state.object_quaternion), (-1.0, 1.0)
    ),
    "gravity": Part(
        lambda d, m: 3, lambda state: _direction(state.gravity), (-1.0, 1.0), "gravity's direction"
    ),
    "goal_quaternion": Part(
        lambda d, m: 4,
        lambda state: _upper_half(state.goal_quaternion),
        (-1.0, 1.0),
        "a goal orientation",
    ),
    "goal_rotation": Part(
        lambda d, m: 6,
        lambda state: _two_columns(_goal_turn(state)),
        (-1.0, 1.0),
        "a goal orientation and the object's pose",
    ),
    "goal_angular_velocity": Part(
        lambda d, m: 3, lambda state: state.goal_angular_velocity, needs="a wanted angular velocity"
    ),
}
ATTITUDES = ("object_quaternion", "object_rotation")
"""The parts that tell how the object lies."""
POSES = ("object_position", *ATTITUDES, "goal_rotation")
"""The parts that are there only where the object is tracked."""
ORIENTATIONS = ("goal_quaternion", "goal_rotation")
"""The parts that tell which orientation is wanted."""
TURNING = "goal_angular_velocity"
"""The part that tells how the object is wanted to turn."""
ANY = "any"
"""The command to turn about any direction, beside axes by name."""


def check_names(parts: Sequence[str], what: str = "parts") -> tuple[str, ...]:
    """The names as a tuple; ``what`` is the setting that has them.

    Raises:
        InvalidInput: no part, or one named twice.
    """
    names = (parts,) if isinstance(parts, str) else tuple(parts)
    if not names or len(set(names)) < len(names):
        raise InvalidInput(f"{what} is {names}; expected one or more, each named once")
    return names


def check_parts(
    parts: Sequence[str], known: Mapping[str, Part] = MappingProxyType(PARTS)
) -> tuple[str, ...]:
    """The names as a tuple.

    Raises:
        UnknownName: no such part.
        InvalidInput: no part, or one named twice.
    """
    names = check_names(parts)
    for name in names:
        if name not in known:
            raise UnknownName("observation part", name, known)
    return names
