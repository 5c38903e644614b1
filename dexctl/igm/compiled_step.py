"""CompiledStep: hands the arrays of one in-grasp step to the compiled loop."""

from __future__ import annotations

import numpy as np

from dexctl.controller import check_sound, refuse
from dexctl.hand import HandModel
from dexctl.igm.compiled import in_grasp_step, sound
from dexctl.igm.config import SLIP_SHARE, InGraspManipulationConfig
from dexctl.igm.step import StepInput, StepResult
from dexctl.state import Floats, GraspState


class CompiledStep:
    """`PlainStep` as one compiled loop; importing this module compiles it.

    Args:
        hand: the hand; its fingers must not share joints.
        config: the settings, with a regulariser.
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
        self._axis = np.ascontiguousarray(axis)
        self._joints = np.ascontiguousarray(hand.finger_joints)
        self._counts = np.ascontiguousarray(hand.moves.sum(axis=1))
        speed = np.minimum(config.max_joint_speed, hand.velocity) * control_period
        self._limits = np.array([hand.lower, hand.upper, speed])
        self._settings = (
            float(config.grip_force),
            float(config.stability_gain),
            float(config.regulariser),
            float(config.min_force),
            float(config.friction),
            float(config.length or 0.0),
            float(config.damping),
            float(control_period),
            float(config.height_gain),
            float(config.centring_gain),
            float(config.tilt_gain),
            float(config.closing_speed),
            float(config.closing_lead),
            float(config.max_lead),
            float(config.reach_distance),
            float(config.reach_margin),
            float(config.link_limit),
            float(config.slip_limit),
            float(SLIP_SHARE * config.slip_limit),
        )

    def check(self, state: GraspState) -> None:
        """Raise InvalidInput where ``state`` would move a motor wrongly; see `check_sound`."""
        if state.batch_shape or state.object_position is None or state.object_quaternion is None:
            check_sound(self._hand, state)
        elif not sound(
            state.q,
            state.q_target,
            state.contact_position,
            state.contact_normal,
            state.contact_force,
            state.in_contact,
            state.object_position,
            state.object_quaternion,
        ):
            refuse(self._hand, state)

    def __call__(self, step: StepInput) -> StepResult:
        """One step of every hand."""
        reference = step.reference
        return StepResult(
            *in_grasp_step(
                step.hand_now.finger_twist,
                step.hand_now.fingertip_position,
                self._joints,
                self._counts,
                step.q,
                step.q_target,
                step.touch,
                step.closing,
                step.position,
                step.normal,
                step.force,
                step.object_position,
                step.object_quaternion,
                reference.position,
                reference.carried_axis,
                reference.known,
                step.twist,
                step.max_force,
                step.yielding,
                self._axis,
                self._settings,
                self._limits,
            )
        )
