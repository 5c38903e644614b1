"""SwitchProfile: the fixed trajectory with which one finger lets go and touches again (psi_CS)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import LateStreams
from dexctl.switch.chain import joint_roles
from dexctl.validation import check_mask, check_vector

Indices = NDArray[np.intp]


class SwitchProfile:
    """The contact-switching primitive of the thesis, as set-point changes of one finger.

    For a switch of duration T, with t from its start (thesis, section 4.2, psi_CS(s) =
    dq_switch(h); the shape and the speeds are those of the paper behind it, arXiv 2303.03533):

    - the middle joint moves away from the object at v_middle for t < T/2, then back;
    - the roll joint moves at v_roll for T/4 <= t < 3T/4, otherwise it rests;
    - the distal joint rests.

    v_middle and v_roll are drawn anew, uniformly from ``speed``, for every switch. Which joints
    these are follows from the hand: roll is the finger's first own joint, distal its last,
    middle the last but one. Their signs follow from the Jacobian at the start: the middle joint
    first takes the contact point against the contact normal; the roll joint takes it against
    the object's rotation, so that the finger gains room to turn the object further.

    Each set-point change is the exact integral of the profile over one control period, so the
    set-points pass through the same points at every control rate.

    Works on one environment ``()`` or a batch ``(N,)``; each environment has a random stream of
    its own, so that it draws the same alone and in a batch.

    Args:
        hand: the hand; every finger needs at least three joints of its own.
        duration: T [s]; H = duration / control_period steps (not published; ours).
        speed: least and greatest joint speed [rad/s].
        axis: axis of the object's rotation, world frame; it need not be of unit length.
        roll_direction: "against" the object's rotation, or +1 or -1 for a fixed sign of the roll
            joint's motion.
        control_period: time between two calls of `act` [s].

    Raises:
        InvalidInput: a value out of range, or a finger with too few joints.
    """

    def __init__(
        self,
        hand: HandModel,
        *,
        duration: float = 1.0,
        speed: tuple[float, float] = (0.1, 0.4),
        axis: ArrayLike = (0.0, 0.0, 1.0),
        roll_direction: Literal["against", 1, -1] = "against",
        control_period: float = 0.05,
    ) -> None:
        for name, value in (("duration", duration), ("control_period", control_period)):
            if not (np.isfinite(value) and value > 0):
                raise InvalidInput(f"{name} is {value}; expected seconds above 0")
        if duration < control_period:
            raise InvalidInput(
                f"duration is {duration} s; expected at least a control_period, {control_period} s"
            )
        low, high = check_vector("speed", speed, 2)
        if not 0 <= low <= high:
            raise InvalidInput(f"speed is {speed}; expected 0 <= least <= greatest [rad/s]")
        if roll_direction not in ("against", 1, -1):
            raise InvalidInput(f"roll_direction is {roll_direction!r}; expected 'against', 1 or -1")
        self.axis = check_vector("axis", axis, 3)
        if not self.axis.any():
            raise InvalidInput("axis is zero; expected the axis of the object's rotation")
        self.hand = hand
        self.duration = float(duration)
        self.speed = (float(low), float(high))
        self.roll_direction = roll_direction
        self.control_period = float(control_period)
        self._roles = joint_roles(hand)
        self._streams = LateStreams()
        self._allocate(())

    @property
    def steps(self) -> int:
        """H, the number of calls of `act` that one switch takes."""
        return int(np.ceil(self.duration / self.control_period - 1e-9))

    @property
    def finger(self) -> Indices:
        """The finger that is switching, ``(...)``; -1 where none is."""
        return np.array(self._finger)

    @property
    def active(self) -> Bools:
        """Whether a switch is under way, ``(...)``."""
        return self._finger >= 0

    @property
    def switching(self) -> Bools:
        """Which fingers are switching, ``(..., m)``."""
        return self._finger[..., None] == np.arange(self.hand.n_fingers)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """End every switch, or those of the environments in ``mask`` ``(N,)``.

        Args:
            seed: restarts the random streams too; environment i gets ``seed + i``, or seed[i]
                where one is given for each. None: the streams go on.
            mask: which environments; None is all of them, and lets the next `begin` come with
                another batch shape.
        """
        if mask is None:
            self._streams.reset(seed)
            self._finger[...] = -1
            return
        chosen = check_mask(mask, None)
        self._match(chosen.shape)
        self._finger[chosen] = -1
        self._streams.reset(seed, chosen)

    def begin(
        self, state: GraspState, finger: ArrayLike | None = None, mask: ArrayLike | None = None
    ) -> Bools:
        """Start a switch where none is under way.

        Args:
            state: joints and contacts now.
            finger: the finger to switch, ``(...)``, -1 for none. None: one that is in contact,
                at random.
            mask: the environments that may begin, ``(...)``; None is all of them.

        Returns:
            Where a switch began, ``(...)``: not where a switch is under way, nor where the
            finger is not in contact.

        Raises:
            InvalidInput: a finger that the hand does not have; a state of another batch shape
                while switches are under way.
        """
        self._match(state.batch_shape)
        may = ~self.active if mask is None else ~self.active & np.asarray(mask, bool)
        may &= state.in_contact.any(axis=-1)
        draw = self._streams.of(state.batch_shape).uniform((3,), may)
        chosen = random_contact(state.in_contact, draw[..., 0]) if finger is None else finger
        chosen = np.broadcast_to(np.asarray(chosen), state.batch_shape)
        if chosen.dtype.kind not in "iu" or np.any((chosen < -1) | (chosen >= self.hand.n_fingers)):
            raise InvalidInput(
                f"finger is {chosen.tolist()}; expected integers from -1 (none) to "
                f"{self.hand.n_fingers - 1}"
            )
        touching = np.take_along_axis(state.in_contact, chosen[..., None] % self.hand.n_fingers, -1)
        begun = may & (chosen >= 0) & touching[..., 0]
        if np.any(begun):  # a mask indexes () and (N,) alike; the rows below are those that begin
            low, high = self.speed
            speed = low + (high - low) * draw[begun][:, 1:]
            self._velocity[begun] = speed * self._signs(state[begun], chosen[begun])
            self._finger[begun] = chosen[begun]
            self._step[begun] = 0
        return begun

    def act(self, state: GraspState) -> Floats:
        """The set-point change ``(..., d)`` [rad] of this control period.

        It is zero but for the middle and the roll joint of the finger that is switching. The
        call that makes the last change also ends the switch.

        Raises:
            InvalidInput: the state has another batch shape than the one at `begin`.
        """
        self._match(state.batch_shape)
        action = np.zeros((*state.batch_shape, self.hand.nq))
        moving = self.active
        finger = np.where(moving, self._finger, 0)
        before = self._shape(self._step * self.control_period)
        after = self._shape((self._step + 1) * self.control_period)
        change = np.where(moving[..., None], self._velocity * (after - before), 0.0)
        for part, joints in enumerate((self._roles.middle, self._roles.roll)):
            np.put_along_axis(action, joints[finger][..., None], change[..., part, None], -1)
        self._step += moving
        self._finger[self._step >= self.steps] = -1
        return action

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"finger": self._finger, "step": self._step, "velocity": self._velocity}

    def state_dict(self) -> dict[str, Any]:
        """All that decides the switches to come, to be given to `load_state_dict`."""
        return {**copies(self._arrays()), "streams": self._streams.state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with saved switches.

        Raises:
            InvalidInput: they are none, or of another batch shape than those under way.
        """
        check_names("a switching profile", saved, (*self._arrays(), "streams"))
        shape = batch_shape("a switching profile", saved, "finger")
        self._match(shape)
        self._allocate(shape)
        fill("a switching profile", self._arrays(), saved)
        self._streams.load_state_dict(saved["streams"])

    def _shape(self, time: ArrayLike) -> Floats:
        """How far (middle, roll) have gone at ``time``, at unit speed, ``(..., 2)`` [s]."""
        half, quarter = self.duration / 2, self.duration / 4
        time = np.minimum(np.asarray(time, float), self.duration)
        return np.stack([half - np.abs(time - half), np.clip(time - quarter, 0.0, half)], axis=-1)

    def _signs(self, state: GraspState, finger: Indices) -> Floats:
        """Which way (middle, roll) of ``finger`` ``(K,)`` first move, +1 or -1, ``(K, 2)``."""
        row = np.arange(len(finger))
        point, normal = state.contact_position[row, finger], state.contact_normal[row, finger]
        twist = self.hand.configuration(state.q).joint_twist
        middle, roll = (
            twist[row, :3, joints[finger]] + np.cross(twist[row, 3:, joints[finger]], point)
            for joints in (self._roles.middle, self._roles.roll)
        )
        into_object = np.sum(middle * normal, axis=-1)
        away = np.where(into_object > 0, -1.0, 1.0)
        if self.roll_direction == "against":
            surface = np.cross(self.axis, point - state.object_centre())
            with_object = np.sum(roll * surface, axis=-1)
            sideways = np.where(with_object > 0, -1.0, 1.0)
        else:
            sideways = np.full_like(away, self.roll_direction)
        return np.stack([away, sideways], axis=-1)

    def _match(self, batch_shape: tuple[int, ...]) -> None:
        """Take the batch shape of a call, unless switches of another shape are under way."""
        if batch_shape == self._finger.shape:
            return
        if self.active.any():
            raise InvalidInput(
                f"batch shape is {batch_shape}; switches of batch shape {self._finger.shape} are "
                "under way (reset() lets the shape change)"
            )
        self._allocate(batch_shape)

    def _allocate(self, batch_shape: tuple[int, ...]) -> None:
        self._finger: Indices = np.full(batch_shape, -1, np.intp)
        self._step: Indices = np.zeros(batch_shape, np.intp)
        self._velocity: Floats = np.zeros((*batch_shape, 2))


def random_contact(in_contact: Bools, draw: Floats) -> Indices:
    """The finger in contact that ``draw`` in [0, 1) falls on, ``(...)``; -1 where none is."""
    order = np.cumsum(in_contact, axis=-1)
    count = order[..., -1]
    wanted = np.floor(draw * count).astype(np.intp) + 1
    found = in_contact & (order == wanted[..., None])
    return np.where(count > 0, found.argmax(axis=-1), -1)
