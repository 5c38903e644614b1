"""The in-grasp step in numpy: thesis chapter 4, Algorithm IGM, line by line."""

from __future__ import annotations

import numpy as np

from dexctl.controller import check_sound
from dexctl.hand import HandModel
from dexctl.igm.config import InGraspManipulationConfig
from dexctl.igm.inverse import ContactInverse
from dexctl.igm.reach import Reach
from dexctl.igm.stability import push_directions, stable_forces
from dexctl.igm.step import StepInput, StepResult
from dexctl.limits import SetPointLimits
from dexctl.rotations import cross, rotate
from dexctl.state import Bools, Floats, GraspState


class PlainStep:
    """Algorithm IGM for N hands at once.

    Args:
        hand: the hand.
        config: the settings.
        axis: of the wanted rotation, unit vector.
        control_period: [s].
    """

    def __init__(
        self,
        hand: HandModel,
        config: InGraspManipulationConfig,
        axis: Floats,
        control_period: float,
    ) -> None:
        self._hand = hand
        self._config = config
        self._axis = axis
        self._dt = control_period
        self._inverse = ContactInverse(hand, config.damping)
        self._reach = Reach(hand, config)
        self._limits = SetPointLimits(hand, config.max_joint_speed, config.max_lead, control_period)

    def check(self, state: GraspState) -> None:
        """Raise InvalidInput where ``state`` would move a motor wrongly; see `check_sound`."""
        check_sound(self._hand, state)

    def __call__(self, step: StepInput) -> StepResult:
        """One step of every hand."""
        config = self._config
        touching = step.touch[..., None]
        point = np.where(touching, step.position, step.hand_now.fingertip_position)
        normal = np.where(touching, step.normal, 0.0)
        origin = _origin(step, point)
        lever = point - origin[:, None]

        push = push_directions(normal, lever, config.friction)
        forces, residual, held = stable_forces(
            lever,
            push,
            step.touch,
            step.touch * step.max_force,
            min_force=config.min_force,
            regulariser=config.regulariser,
            length=config.length,
        )
        desired = config.grip_force * forces
        jacobian = step.hand_now.finger_jacobian(point)
        if self._hand.shares_joints:  # fingers that rest do not make up for the wrist's motion
            moving = (step.touch | step.closing)[..., None, None]
            jacobian = np.where(moving, jacobian, 0.0)

        # eq. dqstab: along the push, by the force error
        press = config.stability_gain * (desired - np.where(step.touch, step.force, 0.0))
        velocity = press[..., None] * push
        if step.yielding.any():
            self._yield(velocity, step, jacobian)
        # eq. dqrot: with the object; superposed before the inverse, which is linear
        reach = np.ones(len(origin))
        if config.reach_distance:
            held_or_closing = step.touch | step.closing
            seen = (step.twist, point, normal, lever, held_or_closing)
            reach = self._reach(step.hand_now, step.q, step.q_target, *seen)
        twist = reach[:, None] * step.twist + self._regulation(step, origin)
        rigid = twist[:, None, :3] + cross(twist[:, None, 3:], lever)  # G^T t
        velocity += np.where(touching, rigid, 0.0)
        if step.closing.any():
            closing = self._closing(lever, self._ahead(step, jacobian))
            velocity += np.where(step.closing[..., None], closing, 0.0)

        change = self._inverse.solve(jacobian, velocity * self._dt)
        change = self._limits(step.q, step.q_target, change)
        return StepResult(change, desired, residual, np.asarray(held), origin, reach)

    def _yield(self, velocity: Floats, step: StepInput, jacobian: Floats) -> None:
        """Where fingers yield, let the set-point go back to the finger besides, in place."""
        # exact over a control period of any length
        speed = -np.expm1(-step.yielding * self._dt) / self._dt
        where = (step.yielding > 0) & step.touch
        velocity -= np.where(where, speed, 0.0)[..., None] * self._ahead(step, jacobian)

    def _ahead(self, step: StepInput, jacobian: Floats) -> Floats:
        """How far the set-points are ahead of each finger, at its contact or tip ``(N, m, 3)``."""
        lead = (step.q_target - step.q)[:, self._hand.finger_joints][..., None, :]
        return (lead @ jacobian)[..., 0, :]

    def _closing(self, lever: Floats, ahead: Floats) -> Floats:
        """Velocity across the axis of rotation, towards the object's centre.

        It ends, and turns round, where the set-points are too far ahead: the finger is stopped.
        """
        config = self._config
        across = lever - (lever @ self._axis)[..., None] * self._axis
        distance = np.sqrt((across * across).sum(axis=-1, keepdims=True))
        inward = -across / np.maximum(distance, 1e-9)
        lead = (inward * ahead).sum(axis=-1, keepdims=True)
        return config.closing_speed * np.clip(1.0 - lead / config.closing_lead, -1.0, 1.0) * inward

    def _regulation(self, step: StepInput, origin: Floats) -> Floats:
        """The twist ``(N, 6)`` that takes the objects back to their references."""
        config, reference = self._config, step.reference
        out = np.zeros((len(origin), 6))
        off = reference.position - origin
        along = (off @ self._axis)[:, None] * self._axis
        out[:, :3] = config.height_gain * along + config.centring_gain * (off - along)
        if config.tilt_gain and len(step.object_quaternion):
            carried = rotate(step.object_quaternion, reference.carried_axis)
            out[:, 3:] = config.tilt_gain * cross(carried, self._axis)
        return np.where(reference.known[:, None], out, 0.0)


def _origin(step: StepInput, point: Floats) -> Floats:
    """The object's centre; where nothing tracks it, the centroid of the contacts."""
    if len(step.object_position):
        return step.object_position
    weight: Bools = step.touch | ~step.touch.any(axis=1, keepdims=True)
    total = np.where(weight[..., None], point, 0.0).sum(axis=1)
    return total / weight.sum(axis=1, keepdims=True)
