"""InGraspManipulation: stability and rotation superposed (thesis chapter 4, Algorithm IGM)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.configuration import HandConfiguration
from dexctl.controller import Controller, check_action, check_state
from dexctl.hand import HandModel
from dexctl.igm.inverse import ContactInverse
from dexctl.igm.regulation import Regulation
from dexctl.igm.stability import push_directions, stable_forces
from dexctl.limits import SetPointLimits
from dexctl.rotations import cross
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_numbers, check_twist


@dataclass(frozen=True, kw_only=True)
class InGraspManipulationConfig:
    """Settings of `InGraspManipulation`; speeds are per second.

    Attributes:
        twist: wanted object velocity (linear [m/s], angular [rad/s]), world frame; the thesis's
            Delta o over the control period.
        grip_force: normal force of the finger that presses hardest [N]; scales the QP's result.
        stability_gain: set-point speed per force error (alpha of eq. dqstab) [m/(N s)].
        regulariser: rho of the QP; pulls all forces towards the largest one.
        min_force: least force of a holding finger, as a fraction of `grip_force`.
        friction: how far a finger may push aside from the normal, towards the object's centre, as
            a friction coefficient; forces through the centre balance where normals do not. It
            must stay well below the real one. 0: along the normal only.
        length: torques are divided by it in the QP [m]; None: mean contact distance.
        damping: of the least-squares inverse [m].
        height_gain, centring_gain: pull the object back to where it was at the first call after
            a reset, along the axis of rotation and across it [1/s].
        tilt_gain: turns the object's axis back to where it was then [1/s].
        closing_speed: fingers out of touch move towards the object at this speed [m/s].
        max_joint_speed: set-points move at most this fast [rad/s].
        max_lead: set-points stay this close to the measured joints [rad].
    """

    twist: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.4)
    grip_force: float = 2.5
    stability_gain: float = 0.025
    regulariser: float = 1e-3
    min_force: float = 0.15
    friction: float = 0.3
    length: float | None = None
    damping: float = 0.005
    height_gain: float = 1.0
    centring_gain: float = 1.0
    tilt_gain: float = 1.0
    closing_speed: float = 0.03
    max_joint_speed: float = 2.0
    max_lead: float = 0.25

    def __post_init__(self) -> None:
        check_twist(self.twist)
        check_numbers(
            self,
            positive=("grip_force", "damping", "max_joint_speed", "max_lead"),
            not_negative=(
                "stability_gain",
                "regulariser",
                "friction",
                "height_gain",
                "centring_gain",
                "tilt_gain",
                "closing_speed",
            ),
            fractions=("min_force",),
        )
        if self.length is not None:
            check_numbers(self, positive=("length",))

    @classmethod
    def thesis(cls, **changes: Any) -> InGraspManipulationConfig:
        """The controller as the thesis has it: no regulariser, no bound, nothing added."""
        plain = cls(
            twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.45),
            regulariser=0.0,
            min_force=0.0,
            friction=0.0,
            height_gain=0.0,
            centring_gain=0.0,
            tilt_gain=0.0,
            closing_speed=0.0,
        )
        return replace(plain, **changes)

    def build(self, hand: HandModel, *, control_period: float = 0.05) -> InGraspManipulation:
        """The controller for ``hand``."""
        return InGraspManipulation(hand, self, control_period=control_period)


class Share(NamedTuple):
    """What a superposed controller leaves to in-grasp manipulation (all None: everything).

    Attributes:
        released: fingers that belong to another controller, ``(..., m)`` bool; they get no motion.
        max_force: upper bound of each finger's force, as a fraction of the grip, ``(..., m)``.
        twist: object twist instead of the configured one, ``(..., 6)``.
        yielding: rate at which a finger's set-point goes back to where the finger is,
            ``(..., m)`` [1/s]; where it is above zero it takes the place of force control.
    """

    released: Bools | None = None
    max_force: Floats | None = None
    twist: Floats | None = None
    yielding: Floats | None = None


class InGraspManipulation(Controller):
    """Moves the object with the fingers that hold it, and keeps the hold.

    Two set-point changes are superposed (thesis chapter 4, Algorithm IGM): one drives the normal
    forces to the solution of the grasp-stability QP, one moves the contacts with the wanted
    object twist. Fingers out of contact get zero unless `closing_speed` is set.

    Args:
        hand: the hand.
        config: the settings; keyword arguments change single ones.
        control_period: [s].
    """

    def __init__(
        self,
        hand: HandModel,
        config: InGraspManipulationConfig | None = None,
        *,
        control_period: float = 0.05,
        **changes: Any,
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = replace(config or InGraspManipulationConfig(), **changes)
        self._twist = np.array(self.config.twist, float)
        self._inverse = ContactInverse(hand, self.config.damping)
        self._limits = SetPointLimits(
            hand, self.config.max_joint_speed, self.config.max_lead, control_period
        )
        self._regulation = Regulation(
            self._twist,
            height_gain=self.config.height_gain,
            centring_gain=self.config.centring_gain,
            tilt_gain=self.config.tilt_gain,
        )

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._regulation.reset(mask)

    def act(self, state: GraspState) -> Floats:
        return self.command(state, Share())

    def command(
        self, state: GraspState, share: Share, hand_now: HandConfiguration | None = None
    ) -> Floats:
        """As `act`, with part of the hand left to another controller.

        ``hand_now`` is the hand's configuration at ``state.q``, where the caller has it already.
        """
        check_state(self.hand, state)
        config = self.config
        touch = state.in_contact if share.released is None else state.in_contact & ~share.released
        if hand_now is None:
            hand_now = self.hand.configuration(state.q)
        touching = touch[..., None]
        point = np.where(touching, state.contact_position, hand_now.fingertip_position)
        normal = np.where(touching, state.contact_normal, 0.0)
        origin = _origin(state, touch, point)
        lever = point - origin[..., None, :]

        push = push_directions(normal, lever, config.friction)
        upper = touch.astype(float) if share.max_force is None else touch * share.max_force
        forces, residual, held = stable_forces(
            lever,
            push,
            touch,
            upper,
            min_force=config.min_force,
            regulariser=config.regulariser,
            length=config.length,
        )
        desired = config.grip_force * forces
        jacobian = hand_now.finger_jacobian(point)

        # eq. dqstab: along the normal, by the force error
        press = config.stability_gain * (desired - np.where(touch, state.contact_force, 0.0))
        velocity = press[..., None] * push
        if share.yielding is not None:
            self._yield(velocity, share.yielding, state, jacobian)
        # eq. dqrot: with the object; superposed before the inverse, which is linear
        twist = self._twist if share.twist is None else share.twist
        twist = twist + self._regulation.twist(state, origin)
        velocity += np.where(touching, _rigid(twist, lever), 0.0)
        if config.closing_speed:
            free = ~touch if share.released is None else ~(touch | share.released)
            if free.any():
                velocity += np.where(free[..., None], self._closing(lever), 0.0)

        velocity *= self.control_period
        change = self._limits(state, self._inverse.solve(jacobian, velocity))
        self._diagnostics = {
            "desired_force": desired,
            "residual": residual,
            "held": held,
            "origin": origin,
        }
        return check_action(change)

    def _yield(self, velocity: Floats, rate: Floats, state: GraspState, jacobian: Floats) -> None:
        """Where ``rate`` is above zero, let the set-point go back to the finger, in place."""
        lead = (state.q_target - state.q)[..., self.hand.finger_joints][..., None, :]
        deflection = (lead @ jacobian)[..., 0, :]
        # exact over a control period of any length
        speed = -np.expm1(-rate * self.control_period) / self.control_period
        np.copyto(velocity, -speed[..., None] * deflection, where=(rate > 0)[..., None])

    def _closing(self, lever: Floats) -> Floats:
        """Velocity across the axis of rotation, towards the object's centre."""
        axis = self._regulation.axis
        across = lever - (lever @ axis)[..., None] * axis
        distance = np.sqrt((across * across).sum(axis=-1, keepdims=True))
        return -self.config.closing_speed * across / np.maximum(distance, 1e-9)


def _origin(state: GraspState, touch: Bools, point: Floats) -> Floats:
    """The object's centre; where nothing tracks it, the centroid of the contacts."""
    if state.object_position is not None:
        return state.object_position
    weight = touch.astype(float)[..., None]
    count = weight.sum(axis=-2)
    return np.where(
        count > 0, (weight * point).sum(axis=-2) / np.maximum(count, 1.0), point.mean(axis=-2)
    )


def _rigid(twist: Floats, lever: Floats) -> Floats:
    """G^T t: the velocities ``(..., m, 3)`` of points of an object that moves with ``twist``."""
    return twist[..., None, :3] + cross(twist[..., None, 3:], lever)
