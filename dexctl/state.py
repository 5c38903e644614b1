"""GraspState: what a controller may see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.rotations import Floats as Floats  # for those who take it from here
from dexctl.rotations import inverse, multiply, rotate
from dexctl.validation import check_mask, numbers, shown, truths

if TYPE_CHECKING:
    from dexctl.touch import Hand, TouchConfig

Bools = NDArray[np.bool_]
_REAL = "an array of real numbers"


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspState:
    """Joints, touch and (where known) the object, at one moment, of one hand or of a batch.

    Arrays carry leading batch dimensions ``(...)``: ``()`` for one hand, ``(N,)`` for N. SI units;
    the frame is the hand's, which is the world's unless the hand moves (see `in_frame`). The
    thesis's observation (chapter 4) is [q, q', p, n, c].

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
        gravity: ``(..., 3)`` [m/s^2], or None where nothing tells it.
        goal_quaternion: orientation that the object is wanted in, wxyz, ``(..., 4)``, or None
            where none is wanted.
        goal_angular_velocity: how the object is wanted to turn, ``(..., 3)`` [rad/s], or None.
        time: when the state was taken, ``(...)`` or one number for all [s].
        age: how old its oldest part is, ``(...)`` or one number for all [s].
        normals_felt: whether the contacts' normals were felt, ``(...)`` or one for all; where they
            are told from joints or switches they point to the middle, however a face leans.

    Raises:
        InvalidInput: shapes that do not belong together, or what is no real number (no bool, for
            ``in_contact``, where 0 and 1 are taken for them); the message names the field. NaN is
            taken: controllers refuse it where they read it.
    """

    q: Floats
    q_target: Floats
    in_contact: Bools
    contact_position: Floats
    contact_normal: Floats
    contact_force: Floats
    object_position: Floats | None = None
    object_quaternion: Floats | None = None
    gravity: Floats | None = None
    goal_quaternion: Floats | None = None
    goal_angular_velocity: Floats | None = None
    time: Floats | float = 0.0
    age: Floats | float = 0.0
    normals_felt: Bools | bool = True

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
        if self.gravity is not None:
            _expect(self, "gravity", (*batch, 3))
        if self.goal_quaternion is not None:
            _expect(self, "goal_quaternion", (*batch, 4))
        if self.goal_angular_velocity is not None:
            _expect(self, "goal_angular_velocity", (*batch, 3))
        for name in ("time", "age"):
            value = getattr(self, name)
            if type(value) is not float:
                shape = numbers(f"GraspState.{name}", value, "seconds").shape
                _check_shape(self, name, shape, batch if shape else ())
        if type(self.normals_felt) is not bool:
            felt = _truths("normals_felt", self.normals_felt)
            object.__setattr__(self, "normals_felt", felt)
            _check_shape(self, "normals_felt", felt.shape, batch if felt.shape else ())

    @classmethod
    def from_joint_torques(
        cls,
        hand: Hand,
        q: ArrayLike,
        q_target: ArrayLike,
        stiffness: ArrayLike | None = None,
        *,
        torque: ArrayLike | None = None,
        free_torque: ArrayLike | None = None,
        touched: ArrayLike | None = None,
        config: TouchConfig | None = None,
        object_position: ArrayLike | None = None,
        object_quaternion: ArrayLike | None = None,
        time: Floats | float = 0.0,
        age: Floats | float = 0.0,
    ) -> GraspState:
        """The state of a hand without touch sensors, by what its joints push against.

        At one moment and for joints at rest; `dexctl.JointTouch` smooths, remembers what touched
        and makes allowance for joints that move.

        Args:
            hand: the `HandModel`.
            q, q_target: ``(..., d)`` [rad].
            stiffness: of the servos, ``(d,)`` or one number [N m/rad]; the torque is
                stiffness * (q_target - q), within the hand's limits.
            torque: in its place what was measured (motor current times the motor's constant and
                the gear ratio), ``(..., d)`` [N m], positive where it moves the joint up.
            free_torque: the part that holds the finger itself, as measured with nothing in the
                hand, ``(..., d)`` [N m]; it is taken off.
            touched: which fingers touched before ``(..., m)``, for the lower of the two
                thresholds of ``config``; None: none did.
            config: the thresholds; None: the defaults.
            object_position, object_quaternion, time, age: as of the state.

        Raises:
            InvalidInput: shapes that do not belong together, both or neither of ``stiffness`` and
                ``torque``, a hand that is none, or another kind of ``config``.
        """
        if stiffness is None and torque is None:
            raise InvalidInput("neither stiffness nor torque is given; expected one of them")
        pose = {"object_position": object_position, "object_quaternion": object_quaternion}
        servos = (stiffness, torque, free_torque)
        return cls._sensed(
            hand, q, q_target, servos, config, {"touched": touched}, **pose, time=time, age=age
        )

    @classmethod
    def from_binary_touch(
        cls,
        hand: Hand,
        q: ArrayLike,
        q_target: ArrayLike,
        in_contact: ArrayLike,
        stiffness: ArrayLike | None = None,
        *,
        torque: ArrayLike | None = None,
        free_torque: ArrayLike | None = None,
        config: TouchConfig | None = None,
        object_position: ArrayLike | None = None,
        object_quaternion: ArrayLike | None = None,
        time: Floats | float = 0.0,
        age: Floats | float = 0.0,
    ) -> GraspState:
        """The state of a hand whose fingertips say whether they touch, and nothing more.

        Forces and normals are those of `from_joint_torques` where stiffness or torque is given;
        else the normals point to the object's centre (without tracking, the fingertips' middle)
        and the force is nominal, so that controllers cannot regulate it.

        Args:
            hand, q, q_target: as in `from_joint_torques`.
            in_contact: which fingertips touch, ``(..., m)``.
            stiffness, torque, free_torque: as there, or none of them.
            config: ``nominal_force``; None: the defaults.
            object_position, object_quaternion, time, age: as of the state.

        Raises:
            InvalidInput: shapes that do not belong together.
        """
        pose = {"object_position": object_position, "object_quaternion": object_quaternion}
        servos, switches = (stiffness, torque, free_torque), {"in_contact": in_contact}
        return cls._sensed(hand, q, q_target, servos, config, switches, **pose, time=time, age=age)

    @classmethod
    def _sensed(
        cls,
        hand: Hand,
        q: ArrayLike,
        q_target: ArrayLike,
        servos: tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None],
        config: TouchConfig | None,
        fingers: Mapping[str, ArrayLike | None],
        **pose: Any,
    ) -> GraspState:
        """The state by stiffness, torque and free torque, and by what is known of the fingers."""
        from dexctl.touch import (
            MOST,
            check_hand,
            estimate_touch,
            per_joint,
            servo_torques,
            touch_config,
        )

        check_hand(hand)
        settings = touch_config(config)
        stiffness, torque, free_torque = servos
        if stiffness is not None and torque is not None:
            raise InvalidInput("both stiffness and torque are given; expected one of them")
        joints = {"q": numbers("q", q, _REAL), "q_target": numbers("q_target", q_target, _REAL)}
        shape = joints["q"].shape
        for name, value in joints.items():
            if value.shape != shape or value.shape[-1:] != (hand.nq,):
                raise InvalidInput(f"{name} has shape {value.shape}; expected (..., {hand.nq})")
            per_joint(hand, name, value, shape)  # what is not finite would press nowhere, silently
        pressing = None
        if stiffness is not None:
            pressing = servo_torques(hand, **joints, stiffness=stiffness)
        elif torque is not None:
            pressing = per_joint(hand, "torque", torque, shape)
        if pressing is not None and free_torque is not None:
            pressing = pressing - per_joint(hand, "free_torque", free_torque, shape)
        shape = (*shape[:-1], hand.n_fingers)
        known = {name: truths(name, value) for name, value in fingers.items() if value is not None}
        for name, value in known.items():
            if value.shape != shape:
                raise InvalidInput(f"{name} has shape {value.shape}; expected {shape}")
        place = pose["object_position"]
        if place is not None:
            place = pose["object_position"] = numbers("object_position", place, _REAL)
            if place.shape != (*shape[:-1], 3):
                raise InvalidInput(
                    f"object_position has shape {place.shape}; expected {(*shape[:-1], 3)}"
                )
            if not (np.abs(place) <= MOST).all():
                raise InvalidInput(f"object_position is {shown(place)}; expected finite metres")
        found = estimate_touch(
            hand, joints["q"], pressing, settings, **known, object_position=place
        )
        return cls(**joints, **found._asdict(), **pose, normals_felt=False)

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

    def in_frame(self, position: ArrayLike, quaternion: ArrayLike) -> GraspState:
        """The same state as seen from another frame, such as that of a hand on a moving arm.

        Controllers know the hand where `HandModel` has it, so contacts and object must be in the
        hand's frame, and so are gravity and the twists that they are given. A vector of the world
        is ``rotate(inverse(quaternion), vector)`` there (`dexctl.rotations`).

        Args:
            position: of the frame, in the one that the state is in now, ``(..., 3)`` or ``(3,)``
                [m].
            quaternion: its orientation there, wxyz, unit, ``(..., 4)`` or ``(4,)``.

        Raises:
            InvalidInput: a shape that does not belong to the state, a length that is not one.
        """
        place = numbers("position", position, _REAL)
        turn = numbers("quaternion", quaternion, _REAL)
        for name, value, width in (("position", place, 3), ("quaternion", turn, 4)):
            if value.shape not in ((width,), (*self.batch_shape, width)):
                expected = " or ".join({str((width,)), str((*self.batch_shape, width))})
                raise InvalidInput(f"{name} has shape {value.shape}; expected {expected}")
            if not np.isfinite(value).all():
                raise InvalidInput(f"{name} is {value.tolist()}; expected finite numbers")
        length = np.linalg.norm(turn, axis=-1)
        if not np.allclose(length, 1.0, rtol=0, atol=1e-6):
            raise InvalidInput(f"quaternion has the length {length}; expected 1")
        back = inverse(turn)
        each = back[..., None, :]  # for every finger
        points = rotate(each, self.contact_position - place[..., None, :])
        values: dict[str, Any] = {
            "contact_position": np.where(self.in_contact[..., None], points, 0.0),
            "contact_normal": rotate(each, self.contact_normal),
        }
        if self.object_position is not None:
            values["object_position"] = rotate(back, self.object_position - place)
        for name in ("object_quaternion", "goal_quaternion"):
            if getattr(self, name) is not None:
                values[name] = multiply(back, getattr(self, name))
        for name in ("gravity", "goal_angular_velocity"):
            if getattr(self, name) is not None:
                values[name] = rotate(back, getattr(self, name))
        return replace(self, **values)

    def without(self, fingers: Bools) -> GraspState:
        """The same state with ``fingers`` ``(..., m)`` counted as out of contact.

        Raises:
            InvalidInput: they are not bools, one for each finger.
        """
        fingers = check_mask(fingers, self.in_contact.shape, "fingers")
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


def _truths(name: str, value: object) -> Bools:
    """``value`` as an array of bool; what is only taken for one, as a text is, is refused."""
    try:
        array: NDArray[Any] = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.zeros(0)
    if array.dtype != bool:
        raise InvalidInput(
            f"GraspState.{name} is {shown(value)}; expected a bool, for all hands or for each"
        )
    return array


def _array(state: GraspState, name: str, kind: type = float) -> NDArray:
    value = getattr(state, name)
    if not (type(value) is np.ndarray and value.dtype == kind):
        what = f"GraspState.{name}"
        value = truths(what, value) if kind is bool else numbers(what, value, _REAL)
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
