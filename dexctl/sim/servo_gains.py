"""Gains of position servos for a hand of which nothing is known but its bodies."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from dexctl.hand import HandModel
from dexctl.sim.hand_joints import HandJoints
from dexctl.state import Bools, Floats

BANDWIDTH = 8.0
"""Natural frequency of a proposed servo with the joint's reflected inertia [Hz]."""
SAG = 0.05
"""How far gravity may pull a joint from its set-point, whichever way the hand is held [rad]."""
PRESSING = 2.0
"""Fingertip force [N] that a joint holds with `BEHIND` between set-point and joint."""
BEHIND = 0.1
"""[rad]"""
_LEVER = 0.1  # what a turning joint does in [rad], a sliding one does in [rad] times this [m]
RINGING = 0.2
"""Damping, as a share of what is critical, below which a joint rings for long."""
_ROOM = 1.5  # over what keeps a joint stable by itself: an object that is held stiffens it
SLUGGISH = 0.2
"""Damping of a joint is left out where it makes the joint this slow [s]."""


class ServoGains(NamedTuple):
    """Gains of position servos, joint by joint.

    Attributes:
        stiffness: ``(d,)`` [N m/rad].
        damping: ``(d,)`` [N m s/rad].
        armature: what the joint's inertia lacks for the stiffness at `BANDWIDTH`: the rotor of a
            geared motor as the joint feels it, ``(d,)`` [kg m^2].
        least: stiffness below which the joint sags or presses too little, ``(d,)`` [N m/rad].
    """

    stiffness: Floats
    damping: Floats
    armature: Floats
    least: Floats


def proposed_gains(
    model: mujoco.MjModel, hand: HandModel, stiffness: Floats, damping: Floats
) -> ServoGains:
    """Gains for joints of which nothing is known but their bodies.

    The stiffness is the largest of three: the joint's inertia in the middle of its range (mass
    matrix, armature included) at `BANDWIDTH`; the torque of the finger's weight over `SAG`; the
    torque of `PRESSING` at the fingertip over `BEHIND` (of a sliding joint in metres, a tenth of
    these). Damping is critical, what the joint has of
    its own taken off. A stiff joint of a light finger would ring faster than it can be simulated,
    so its inertia is filled up with armature.

    Args:
        model: the hand, with or without actuators.
        hand: its kinematics.
        stiffness, damping: what is known already ``(d,)``, NaN elsewhere.
    """
    q = hand.posture({})
    inertia = _inertia(model, hand, q)
    bare, weight = model.__copy__(), np.zeros((3, hand.nq))
    joints, data = HandJoints(bare, hand), mujoco.MjData(bare)
    for axis in range(3):
        bare.opt.gravity = 9.81 * np.eye(3)[axis]
        weight[axis] = joints.weight(data, q)
    tips = hand.fingertip_positions(q)
    lever = np.linalg.norm(hand.contact_jacobian(q, tips), axis=1).max(axis=0)
    fastest = (2 * np.pi * BANDWIDTH) ** 2
    kinds = [int(model.joint(name).type[0]) for name in hand.joint_names]
    unit = np.where(np.array(kinds) == int(mujoco.mjtJoint.mjJNT_SLIDE), _LEVER, 1.0)
    held = [np.linalg.norm(weight, axis=0) / (SAG * unit), PRESSING * lever / (BEHIND * unit)]
    least = np.max(held, axis=0)
    wanted = np.maximum(inertia * fastest, least)
    k = np.where(np.isnan(stiffness), wanted, stiffness)
    armature = np.maximum(k / fastest - inertia, 0.0)
    columns = [int(model.joint(name).dofadr[0]) for name in hand.joint_names]
    own = np.reshape(model.dof_damping[columns], (hand.nq, -1))[:, 0]
    own = np.where(own > SLUGGISH * k, 0.0, own)  # which `add_servos` leaves out
    critical = np.maximum(2 * np.sqrt(k * (inertia + armature)) - own, 0.0)
    return ServoGains(k, np.where(np.isnan(damping), critical, damping), armature, least)


def ringing(model: mujoco.MjModel, hand: HandModel, stiffness: Floats, damping: Floats) -> Bools:
    """Which joints ring for long, or run away from the physics' steps, ``(d,)``.

    Args:
        model: the hand, with or without an object.
        hand: its kinematics.
        stiffness: of the servos ``(d,)`` [N m/rad].
        damping: of servo and joint together ``(d,)`` [N m s/rad].
    """
    masses, step = _masses(model, hand, hand.posture({})), model.opt.timestep
    inertia = np.diag(masses)
    # a spring that is stepped explicitly, with a damper that is not, is stable above this; of a
    # joint whose neighbours yield less moves than where they stand still
    yielding = 1.0 / np.diag(np.linalg.inv(masses))
    least = (stiffness * step**2 - 4 * yielding) / (2 * step)
    return (damping < RINGING * 2 * np.sqrt(stiffness * inertia)) | (damping <= _ROOM * least)


def link_inertia(model: mujoco.MjModel, hand: HandModel, q: Floats) -> Floats:
    """What each joint feels of the links alone, without armature, ``(d,)`` [kg m^2].

    Args:
        model: the hand, with or without an object.
        hand: its kinematics.
        q: joints, ``(d,)`` [rad].
    """
    bare = model.__copy__()
    bare.dof_armature[:] = 0.0
    return _inertia(bare, hand, q)


def _inertia(model: mujoco.MjModel, hand: HandModel, q: Floats) -> Floats:
    """The mass matrix' diagonal for the d joints, armature included."""
    return np.diag(_masses(model, hand, q)).copy()


def _masses(model: mujoco.MjModel, hand: HandModel, q: Floats) -> Floats:
    """The mass matrix ``(d, d)``, armature included, followers with their masters."""
    joints, data, full = HandJoints(model, hand), mujoco.MjData(model), np.zeros((model.nv,) * 2)
    joints.place(data, q)
    mujoco.mj_kinematics(model, data)  # no contacts: links may lie in each other in this posture
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    mujoco.mj_makeM(model, data)
    mujoco.mj_fullM(model, data, full)
    return np.asarray(joints.expand.T @ full @ joints.expand, float)
