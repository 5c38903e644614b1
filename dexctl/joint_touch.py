"""JointTouch: touch from joint torques over time, with what one moment cannot tell."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import check_state
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.touch import (
    TouchConfig,
    check_hand,
    estimate_touch,
    per_joint,
    servo_torques,
    touch_config,
)
from dexctl.validation import check_mask, number, shown


class JointTouch:
    """What the fingertips of N hands feel, or of one, step by step.

    `GraspState.from_joint_torques` for joints that move: the torque that the servos' damping takes
    is not taken for a force, torques are smoothed, and a finger that touched counts as touching
    until it presses with less than `TouchConfig.release_force`. Where switches say which
    fingertips touch, only forces and normals are estimated.

    Args:
        hand: the hand.
        stiffness: of the servos, ``(d,)`` or one number [N m/rad].
        damping: of servos and joints, ``(d,)`` or one number [N m s/rad]. Joint speeds at the end
            of a control period are told from how far joints moved in it, where set-points change
            once, at its beginning.
        config: thresholds and smoothing; None: the defaults.
        control_period: from one call to the next [s].
        weights: torques that hold the links against gravity ``(..., 3)`` [m/s^2] at joints
            ``(..., d)`` [rad], ``(..., d)`` [N m], such as `dexctl.sim.LinkWeights`; taken off
            where a state has gravity and ``config.weigh_links`` is on. None: not known.

    Raises:
        InvalidInput: a number out of range, or of another number of joints; a hand or settings
            that are none.
    """

    def __init__(
        self,
        hand: HandModel,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        config: TouchConfig | None = None,
        *,
        control_period: float = 0.05,
        weights: Callable[[Floats, Floats], Floats] | None = None,
    ) -> None:
        check_hand(hand)
        self.hand = hand
        self.config = touch_config(config)
        servo_torques(hand, np.zeros(hand.nq), np.zeros(hand.nq), stiffness)  # says what is wrong
        self._stiffness = np.asarray(stiffness, float)
        drag = per_joint(hand, "damping", damping)
        if not (drag >= 0).all():
            raise InvalidInput(f"damping is {shown(damping)}; expected N m s/rad from 0 on")
        control_period = number(
            "control_period", control_period, 0.0, sys.float_info.max, "seconds above 0", above=True
        )
        self._weights = weights if self.config.weigh_links else None
        self._drag = _drag(self._stiffness, drag, control_period)
        smoothing = self.config.smoothing_time
        self._new = 1.0 if smoothing == 0 else float(-np.expm1(-control_period / smoothing))
        self._past: dict[str, np.ndarray] = {}

    def reset(self, mask: Bools | None = None) -> None:
        """Forget the past of all hands, or of those in ``mask`` ``(N,)``.

        Raises:
            InvalidInput: the mask is not of bools, one for each hand.
        """
        if mask is None or not self._past:
            self._past = {}
        else:
            fresh = self._past["fresh"]
            self._past["fresh"] = fresh | check_mask(mask, fresh.shape)

    def __call__(
        self,
        state: GraspState,
        switches: Bools | None = None,
        torque: Floats | None = None,
        mask: Bools | None = None,
        free_torque: Floats | None = None,
    ) -> GraspState:
        """``state`` with the touch that its joints tell of; what it said of touch is not read.

        Args:
            state: joints, and the object where something tracks it.
            switches: which fingertips touch, ``(..., m)``; None: the torques decide.
            torque: what was measured in place of stiffness and damping, ``(..., d)`` [N m].
            mask: in which hands ``(N,)`` a control period has passed; None is all. The past of
                the others stays as it is.
            free_torque: what the joints need there to hold the finger itself, such as the weight of
                its links, ``(..., d)`` [N m]; taken off. None: what ``weights`` says.

        Raises:
            InvalidInput: a state of another hand, joints or torques that are not finite, or an
                argument of another shape. The past stays as it was.
        """
        check_state(self.hand, state)
        for name in ("q", "q_target"):  # one NaN would be in the smoothed torque for good
            per_joint(self.hand, name, getattr(state, name), state.q.shape)
        if switches is not None:
            switches = check_mask(switches, state.in_contact.shape, "switches")
        if mask is not None:
            mask = check_mask(mask, state.batch_shape)
        measured = torque is not None
        if measured:
            torque = per_joint(self.hand, "torque", torque, state.q.shape)
        else:
            torque = servo_torques(self.hand, state.q, state.q_target, self._stiffness)
        past = self._past
        if not past:
            past = self._begin(state, torque)
        fresh = past["fresh"][..., None]
        if not measured:
            moved = np.where(fresh, 0.0, state.q - past["q"])
            torque = torque - self._drag * moved
        if free_torque is None and self._weights is not None and state.gravity is not None:
            free_torque = self._weights(state.q, state.gravity)
        if free_torque is not None:
            torque = torque - per_joint(self.hand, "free_torque", free_torque, state.q.shape)
        smooth = np.where(fresh, torque, past["torque"] + self._new * (torque - past["torque"]))
        found = estimate_touch(
            self.hand,
            state.q,
            smooth,
            self.config,
            in_contact=switches,
            touched=past["touched"] & ~fresh,
            object_position=state.object_position,
        )
        now = {
            "q": np.array(state.q),
            "torque": smooth,
            "touched": found.in_contact,
            "fresh": np.zeros(state.batch_shape, bool),
        }
        if mask is not None:
            now = {
                name: np.where(mask.reshape(-1, *(1,) * (value.ndim - 1)), value, past[name])
                for name, value in now.items()
            }
        self._past = now
        return replace(state, **found._asdict(), normals_felt=np.zeros(state.batch_shape, bool))

    def _begin(self, state: GraspState, torque: Floats) -> dict[str, np.ndarray]:
        return {
            "q": np.array(state.q),
            "torque": np.zeros_like(torque),
            "touched": np.zeros((*state.batch_shape, self.hand.n_fingers), bool),
            "fresh": np.ones(state.batch_shape, bool),
        }

    def state_dict(self) -> dict[str, Any]:
        """The past, as arrays, to be given to `load_state_dict`."""
        return {"past": copies(self._past) if self._past else None}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with a saved past.

        Raises:
            InvalidInput: it is none, or of another hand.
        """
        past = check_names("touch", saved, ("past",))["past"]
        if past is None:
            self._past = {}
            return
        batch = batch_shape("touch", past, "fresh")
        made: dict[str, np.ndarray] = {
            "q": np.zeros((*batch, self.hand.nq)),
            "torque": np.zeros((*batch, self.hand.nq)),
            "touched": np.zeros((*batch, self.hand.n_fingers), bool),
            "fresh": np.zeros(batch, bool),
        }
        check_names("touch", past, made)
        fill("touch", made, past)
        self._past = made


def _drag(stiffness: Floats, damping: Floats, period: float) -> Floats:
    """Torque of damping at the end of a control period, for each radian moved in it [N m/rad].

    A joint that follows a set-point by stiffness k and damping d slows down as exp(-k t / d): with
    x = k h / d for the period h, its last speed is x / (e^x - 1) of its mean one. Where the mean is
    taken for the last, joints that only follow seem to press.
    """
    with np.errstate(divide="ignore"):  # infinite without damping
        x = stiffness * period / damping
    return stiffness / np.expm1(np.clip(x, 1e-9, 700.0))  # where it does not overflow
