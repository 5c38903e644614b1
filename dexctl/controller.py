"""Controller: what every controller, learned policies included, looks like from outside."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import isfinite
from types import MappingProxyType
from typing import Any, Self, final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.saved import check_names
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import number, shown

UNIT_TOLERANCE = 0.02
"""Of the squared length of normals and quaternions."""
FARTHEST = 1e3
"""Farthest that contacts [m] and joints [rad, m] may be; its square bounds forces [N]."""
FALLEN = 1e7
"""Farthest that the object may be [m]; a dropped one falls 1800 km in the ten minutes of a batch.
Bounds gravity [m/s^2] and goals' angular velocities [rad/s] too."""


class Controller(ABC):
    """Maps a :class:`GraspState` to a change of joint set-points.

    The caller applies ``q_target = clip(q_target + act(state), lower, upper)`` once every
    ``control_period`` seconds. Speeds are held per second, so the motion does not depend on the
    control rate. The same numbers come out for one hand ``()`` and for each of a batch ``(N,)``.

    Attributes:
        hand: the hand that is controlled.
        control_period: time between two calls of :meth:`act` [s].
        object: name of the object that it was made for, as a tree is of one; None: any.
        gravity: under which it was made, hand frame, ``(3,)`` [m/s^2]; None: any.
        tracks: whether it acts only where the state has the object's pose.
        goes_to_goals: True: it acts only where the state has a ``goal_quaternion``; False: it does
            nothing about goals; None: it does not say.
        turns_as_told: the same of a ``goal_angular_velocity``.
        pose_age: how old the object's pose was that it has learned by [s], so that a quicker
            tracker is better made as late; None: the newer the better.
        made_with: positional and keyword arguments of its class that it was made with, whichever
            class that is: with the class they are all that decides what it does.
    """

    object: str | None = None
    gravity: tuple[float, ...] | None = None
    tracks: bool = False
    goes_to_goals: bool | None = None
    turns_as_told: bool | None = None
    pose_age: float | None = None
    made_with: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        made = super().__new__(cls)
        made.made_with = (args, kwargs)  # here, where no subclass can forget to
        return made

    def __init__(self, hand: HandModel, *, control_period: float = 0.05) -> None:
        if not isinstance(hand, HandModel):
            raise InvalidInput(
                f"hand is {shown(hand)}; expected a HandModel, such as dexctl.hands.load('dex5')"
            )
        self.hand = hand
        self.control_period = number(
            "control_period", control_period, 0.0, sys.float_info.max, "seconds above 0", above=True
        )
        self._diagnostics: dict[str, Any] = {}

    @abstractmethod
    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Forget the past of all environments, or of those in ``mask`` ``(N,)``.

        Args:
            seed: restarts the random streams too; environment i gets stream ``seed + i``, or
                seed[i] where one is given for each. None: the streams go on.
            mask: which environments; None is all of them, and lets the next :meth:`act` come
                with another batch shape.
        """

    @abstractmethod
    def act(self, state: GraspState) -> Floats:
        """The set-point change ``(..., d)`` [rad] for this control period."""

    def check_told(self, angular_velocity: ArrayLike) -> None:  # noqa: B027 (most take any)
        """Raise InvalidInput where it was not made to turn as a state is about to tell it.

        Args:
            angular_velocity: ``(3,)`` [rad/s], hand frame.
        """

    def state_dict(self) -> dict[str, Any]:
        """All that decides the actions to come, beyond hand and settings.

        A nested dictionary of numpy arrays, None, bool, int, float and str, which a file can hold
        without holding code.

        Raises:
            NotImplementedError: this controller does not give its state; it can only begin anew.
        """
        raise NotImplementedError(f"{type(self).__name__} does not give its state: no state_dict")

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave, of a controller with the same hand and settings.

        The batch size is part of it; a controller that is at work must have the same.

        Raises:
            InvalidInput: it is of another controller, hand or batch; this one is to be reset then.
            NotImplementedError: this controller cannot continue.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot continue: no load_state_dict")

    def _signed(self, **parts: Any) -> dict[str, Any]:
        """A saved state of ``parts`` that says of which controller and hand it is."""
        return {
            "controller": type(self).__name__,
            "joints": ", ".join(self.hand.joint_names),
            **parts,
        }

    def _parts(self, saved: Mapping[str, Any], *names: str) -> Mapping[str, Any]:
        """``saved`` where it is what `_signed` gave, with parts of these names."""
        own = self._signed()
        for name, value in own.items():
            found = saved.get(name) if isinstance(saved, Mapping) else None
            if not (isinstance(found, str) and found == value):
                raise InvalidInput(f"the saved state has {name} {shown(found)}; expected {value!r}")
        return check_names(type(self).__name__, saved, (*own, *names))

    @property
    def diagnostics(self) -> Mapping[str, Any]:
        """What the last :meth:`act` found: named arrays with the batch dimensions in front."""
        return MappingProxyType(self._diagnostics)


class BatchController(Controller):
    """A controller that is written for a batch; one hand is a batch of one to it."""

    @abstractmethod
    def act_batch(self, state: GraspState) -> Floats:
        """As `act`, for N hands whose states are sound: ``(N, d)`` [rad]."""

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        check_sound(self.hand, state)
        if state.batch_shape:
            return self.act_batch(state)
        action = self.act_batch(state[None])[0]
        self._diagnostics = {name: value[0] for name, value in self._diagnostics.items()}
        return action


@final
class Superposition(Controller):
    """The sum of several controllers' actions (thesis chapter 4, psi_FG = psi_IGM + psi_CS)."""

    def __init__(self, controllers: Sequence[Controller]) -> None:
        if not isinstance(controllers, Sequence) or not controllers:
            raise InvalidInput(f"controllers is {shown(controllers)}; expected at least one")
        hand = getattr(controllers[0], "hand", None)  # one that is none has no hand: it is refused
        period = check_parts(hand, {f"controller {i}": c for i, c in enumerate(controllers)})
        super().__init__(controllers[0].hand, control_period=period)
        self.controllers = tuple(controllers)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        for controller in self.controllers:
            controller.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(
            **{str(i): controller.state_dict() for i, controller in enumerate(self.controllers)}
        )

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        names = [str(i) for i in range(len(self.controllers))]
        parts = self._parts(saved, *names)
        for name, controller in zip(names, self.controllers, strict=True):
            controller.load_state_dict(parts[name])

    def act(self, state: GraspState) -> Floats:
        action = self.controllers[0].act(state)
        for controller in self.controllers[1:]:
            action = action + controller.act(state)
        self._diagnostics = {
            f"{i}.{name}": value
            for i, controller in enumerate(self.controllers)
            for name, value in controller.diagnostics.items()
        }
        return action


def axis_of(turner: Controller) -> Floats:
    """The axis that a controller turns an object about, ``(3,)``.

    Raises:
        InvalidInput: it has none of its own.
    """
    axis = getattr(turner, "axis", None)
    if axis is None:
        raise InvalidInput(
            f"{type(turner).__name__} does not turn about one axis; expected one that does"
        )
    return np.asarray(axis, float)


def check_parts(
    hand: HandModel | None, parts: Mapping[str, Controller], control_period: float | None = None
) -> float:
    """The control period of the controllers that another one is put together of [s].

    Args:
        hand: that they have to be of: joint by joint, since set-points go by the joints' order.
        parts: by the names that people know them by.
        control_period: that they have to have [s]; None: that of the first.

    Raises:
        InvalidInput: one is no controller, of other joints, or of another control period.
    """
    for name, one in parts.items():
        if not isinstance(one, Controller):
            raise InvalidInput(f"{name} is {shown(one)}; expected a Controller")
        joints = [] if hand is None else list(hand.joint_names)
        if list(one.hand.joint_names) != joints:
            raise InvalidInput(
                f"{name} is for joints in the order {shown(', '.join(one.hand.joint_names))}; "
                f"expected {shown(', '.join(joints))}"
            )
        wanted = one.control_period if control_period is None else control_period
        if not np.isclose(one.control_period, wanted):
            raise InvalidInput(
                f"{name} has a control_period of {one.control_period:g} s; expected {wanted:g} s"
            )
        control_period = wanted
    assert control_period is not None
    return control_period


def check_state(hand: HandModel, state: GraspState) -> None:
    """Raise InvalidInput where ``state`` is of a hand with other numbers of joints or fingers.

    Whether its numbers are right: `check_sound`.
    """
    if not isinstance(state, GraspState):
        raise InvalidInput(f"state is {shown(state)}; expected a GraspState")
    if state.q.shape[-1] != hand.nq or state.in_contact.shape[-1] != hand.n_fingers:
        raise InvalidInput(
            f"state has {state.q.shape[-1]} joints and {state.in_contact.shape[-1]} fingers; "
            f"the hand has {hand.nq} joints and {hand.n_fingers} fingers"
        )
    if state.q.ndim > 2:
        raise InvalidInput(f"state has batch shape {state.batch_shape}; expected () or (N,)")


_QUATERNIONS = ("object_quaternion", "goal_quaternion")
_VECTORS = ("object_position", "goal_angular_velocity", "gravity")


def check_sound(hand: HandModel, state: GraspState) -> None:
    """Raise InvalidInput where ``state`` would move a motor wrongly.

    What a controller may read is finite, normals and quaternions are of unit length, forces are
    0 or more, and no contact and no joint is farther than `FARTHEST`. Rows of fingers out of touch
    are not read.
    """
    normal, point = state.contact_normal, state.contact_position
    square = np.einsum("...i,...i->...", normal, normal)
    far = np.einsum("...i,...i->...", point, point)
    # comparisons with NaN are false
    good = np.abs(square - 1.0) <= UNIT_TOLERANCE
    good &= (state.contact_force >= 0.0) & (far + state.contact_force <= FARTHEST**2)
    good |= ~state.in_contact
    size = np.einsum("...i,...i->...", state.q, state.q)
    size = size + np.einsum("...i,...i->...", state.q_target, state.q_target)
    right = good.all() and (size <= FARTHEST**2).all()
    for name in _VECTORS:
        value = getattr(state, name)
        if right and value is not None:
            right = (np.einsum("...i,...i->...", value, value) <= FALLEN**2).all()
    for name in _QUATERNIONS:
        quaternion = getattr(state, name)
        if right and quaternion is not None:
            length = np.einsum("...i,...i->...", quaternion, quaternion)
            right = (np.abs(length - 1.0) <= UNIT_TOLERANCE).all()
    if not right:
        refuse(hand, state)


def refuse(hand: HandModel, state: GraspState) -> None:
    """Raise InvalidInput that names what `check_sound` found; nothing where all is well."""
    touch = state.in_contact
    with np.errstate(over="ignore", invalid="ignore"):
        for name in ("q", "q_target", *_VECTORS, *_QUATERNIONS):
            value = getattr(state, name)
            if value is not None:
                _refuse_rows(name, value, ~np.isfinite(value).all(axis=-1))
        fingers = [f"finger {name!r}" for name in hand.fingertip_names]
        for name in ("contact_position", "contact_normal", "contact_force"):
            value = getattr(state, name)
            finite = np.isfinite(value if value.ndim == touch.ndim else value.sum(axis=-1))
            _refuse_rows(name, value, touch & ~finite, fingers)
        length = np.linalg.norm(state.contact_normal, axis=-1)
        wrong = touch & ~(np.abs(length**2 - 1.0) <= UNIT_TOLERANCE)
        _refuse_rows("contact_normal", state.contact_normal, wrong, fingers, "of unit length")
        # a finger that pulls presses the more, as far and as fast as it may
        pulls = touch & ~(state.contact_force >= 0.0)
        _refuse_rows("contact_force", state.contact_force, pulls, fingers, "0 N or more")
        for name, value in (
            ("contact_position", np.linalg.norm(state.contact_position, axis=-1)),
            ("contact_force", np.sqrt(np.abs(state.contact_force))),
        ):
            within = f"within {FARTHEST if name == 'contact_position' else FARTHEST**2:g}"
            over = touch & ~(value <= 0.7 * FARTHEST)
            _refuse_rows(name, getattr(state, name), over, fingers, within)
        for name in ("q", "q_target", *_VECTORS):
            value = getattr(state, name)
            if value is not None:
                most = FALLEN if name in _VECTORS else FARTHEST
                over = np.linalg.norm(value, axis=-1) > 0.7 * most
                _refuse_rows(name, value, over, (), f"within {most:g}")
        for name in _QUATERNIONS:
            value = getattr(state, name)
            if value is not None:
                length = np.linalg.norm(value, axis=-1)
                wrong = ~(np.abs(length**2 - 1.0) <= UNIT_TOLERANCE)
                _refuse_rows(name, value, wrong, (), "of unit length")


def _refuse_rows(
    name: str,
    value: Floats,
    wrong: Bools,
    fingers: Sequence[str] = (),
    expected: str = "finite",
) -> None:
    """Raise InvalidInput where a row of ``value`` is wrong; names the environments, the finger."""
    wrong = np.asarray(wrong)
    if not wrong.any():
        return
    at = tuple(np.argwhere(wrong)[0])
    batch = wrong.any(axis=-1) if fingers else wrong
    where = f" in environments {np.flatnonzero(batch)[:8].tolist()}" if batch.ndim else ""
    whose = f" of {fingers[at[-1]]}" if fingers else ""
    raise InvalidInput(
        f"the state is not {expected}{where}: {name}{whose} is {shown(value[at].tolist())}"
    )


def check_action(action: Floats) -> Floats:
    """``action`` if it is finite.

    Raises:
        InvalidInput: it is not, because the state was not; names the environments.
    """
    if not isfinite(action.sum()):  # far quicker than looking at each, and no less sure
        bad = np.flatnonzero(~np.isfinite(action).all(axis=-1))
        where = f" in environments {bad[:8].tolist()}" if action.ndim > 1 else ""
        raise InvalidInput(f"the state is not finite{where}: NaN or infinity in q, touch or pose")
    return action
