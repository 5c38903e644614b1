"""The position servos of a simulated hand: those of its file, and those that the file lacks."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from dexctl.exceptions import SimulationError
from dexctl.hand import HandModel
from dexctl.sim.checks import listed
from dexctl.sim.servo_gains import SLUGGISH, proposed_gains
from dexctl.state import Floats

_STUCK = 0.1  # friction of a joint is left out where it keeps the joint this far back [rad]


def add_servos(
    spec: mujoco.MjSpec, model: mujoco.MjModel, hand: HandModel, notes: list[str]
) -> None:
    """Leave exactly one position servo on each of the d joints, and no other actuator.

    Position actuators of the file stay, with the gains of ``hand.config.servos`` where those say
    something; one on a tendon or on a follower goes over to the joint that its joints follow, so
    that it does the same there. Others are taken away, and joints without get a new one.

    Args:
        spec: changed in place.
        model: compiled from it.
        hand: joints, limits and gains.
        notes: gets a line for each kind of change.

    Raises:
        SimulationError: a tendon drives joints that nothing couples.
    """
    names = list(hand.joint_names)
    kept: dict[str, mujoco.MjsActuator] = {}
    moved: dict[str, _Servo] = {}
    removed: list[str] = []
    together: list[tuple[int, str, list[str]]] = []
    found = [(a, i, _driven(spec, model, hand, a)) for i, a in enumerate(spec.actuators)]
    for actuator, i, _ in found:
        direct = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in names
        if direct and _is_position(model, i) and actuator.target not in kept:
            kept[actuator.target] = actuator
    for actuator, i, driven in found:
        if any(actuator is one for one in kept.values()):
            continue
        joints = [name for name, ratio in driven.items() if name and ratio]
        free = len(joints) == 1 and joints[0] not in kept and joints[0] not in moved
        if free and _is_position(model, i):
            moved[joints[0]] = _Servo.of(model, i, driven[joints[0]], driven.get("", 0.0))
        elif len(joints) > 1:
            together.append((i, actuator.name, joints))
        elif len(joints) == 1 and joints[0] in kept and _is_damper(model, i):
            other = kept[joints[0]]
            prm = other.biasprm.copy()
            prm[2] -= model.actuator_gainprm[i, 0] * (driven[joints[0]] / other.gear[0]) ** 2
            other.biasprm = prm
        else:
            removed.append(actuator.name or f"actuator {i}")
        spec.delete(actuator)
    slow = [n for n, one in kept.items() if one.dyntype != mujoco.mjtDyn.mjDYN_NONE]
    for name in slow:  # their state would begin at zero, whatever the grasp
        kept[name].dyntype = mujoco.mjtDyn.mjDYN_NONE
    if slow:
        notes.append(f"filters of position actuators left out: {listed(slow)}")
    servos = hand.config.servos
    stiffness, damping = servos.of("stiffness", names), servos.of("damping", names)
    for i, name, joints in together:
        if any(j not in kept and np.isnan(stiffness[names.index(j)]) for j in joints):
            which = repr(name) if name else f"{i}, without a name,"
            raise SimulationError(
                f"{hand.path}: the actuator {which} drives {' and '.join(joints)} together, and "
                "nothing couples them: say how in [couplings] of the hand's toml "
                f"({joints[-1]} = {{joint = {joints[0]!r}, scale = 1.0}}), or give each a servo of "
                "its own with a stiffness in [servos]"
            )
        removed.append(name or f"actuator {i}")
    if removed:
        notes.append(f"actuators taken away, for servos of position: {listed(removed)}")
    for name, servo in moved.items():
        kept[name] = servo.add(spec, name)
    if moved:
        notes.append(f"driven through tendons or followers: {listed(moved)}")
    lacking = [name for name in names if name not in kept]
    if lacking:
        _add_lacking(spec, model, hand, lacking, notes)
    for j, name in enumerate(names):
        if name in kept:
            _overrule(kept[name], spec.joint(name), hand, j, stiffness[j], damping[j])


def _add_lacking(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    hand: HandModel,
    lacking: list[str],
    notes: list[str],
) -> None:
    names, servos = list(hand.joint_names), hand.config.servos
    said = servos.of("stiffness", names), servos.of("damping", names)
    gains = proposed_gains(model, hand, *said)
    filled, freed = [], []
    for name in lacking:
        j, joint = names.index(name), spec.joint(name)
        k = float(gains.stiffness[j])
        own = float(np.atleast_1d(joint.damping)[0])
        if joint.frictionloss > _STUCK * k:
            joint.frictionloss = 0.0
            freed.append(name)
        if own > SLUGGISH * k:
            joint.damping = np.zeros_like(joint.damping)
            freed.append(name)
        if gains.armature[j] > 0:
            joint.armature += float(gains.armature[j])
            filled.append(j)
        actuator = spec.add_actuator(
            name=f"servo {name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        limits = np.isfinite([hand.lower[j], hand.upper[j]]).all()
        actuator.set_to_position(k, float(gains.damping[j]))
        if limits and hand.lower[j] < hand.upper[j]:
            actuator.ctrlrange, actuator.ctrllimited = [hand.lower[j], hand.upper[j]], 1
        if np.isfinite(hand.effort[j]) and hand.effort[j] > 0:
            effort = float(hand.effort[j])
            actuator.forcerange, actuator.forcelimited = [-effort, effort], 1
    chosen = [names.index(name) for name in lacking]
    source = "proposed" if np.isnan(said[0][chosen]).any() else "from [servos]"
    text = (
        f"position servos added to {len(lacking)} of {len(names)} joints: stiffness "
        f"{_span(gains.stiffness[chosen])} N m/rad ({source}), damping "
        f"{_span(gains.damping[chosen])} N m s/rad"
    )
    if filled:
        text += f", armature {_span(gains.armature[filled])} kg m^2"
    notes.append(text)
    if freed:
        notes.append(
            "more friction or damping in the file than the servo can move, left out: "
            f"{listed(dict.fromkeys(freed))}"
        )


def _overrule(
    actuator: mujoco.MjsActuator,
    joint: mujoco.MjsJoint,
    hand: HandModel,
    j: int,
    stiffness: float,
    damping: float,
) -> None:
    """Give a servo of the file the gains and the torque limit that the owner states."""
    gear = float(actuator.gear[0])
    gain, bias = actuator.gainprm.copy(), actuator.biasprm.copy()
    if np.isfinite(stiffness):
        gain[0], bias[1] = stiffness / gear**2, -stiffness / gear**2
    if np.isfinite(damping):
        bias[2] = -damping / gear**2
    actuator.gainprm, actuator.biasprm = gain, bias
    effort = hand.config.servos.of("effort", hand.joint_names)[j]
    if np.isfinite(effort):
        actuator.forcerange = [-effort / abs(gear), effort / abs(gear)]
        actuator.forcelimited = 1
        joint.actfrclimited = 0


class _Servo(NamedTuple):
    """A position actuator as its joint feels it: gear 1, ctrl in radians."""

    kp: float
    kv: float
    limits: tuple[float, float] | None
    effort: tuple[float, float] | None

    @classmethod
    def of(cls, model: mujoco.MjModel, i: int, ratio: float, constant: float) -> _Servo:
        """Of an actuator whose length is ``ratio * q + constant``, gear included."""
        kp, kv = model.actuator_gainprm[i, 0], -model.actuator_biasprm[i, 2]
        limits = effort = None
        if model.actuator_ctrllimited[i]:
            ends = np.sort((model.actuator_ctrlrange[i] - constant) / ratio)
            limits = (float(ends[0]), float(ends[1]))
        if model.actuator_forcelimited[i]:
            ends = np.sort(model.actuator_forcerange[i] * ratio)
            effort = (float(ends[0]), float(ends[1]))
        return cls(float(kp) * ratio**2, float(kv) * ratio**2, limits, effort)

    def add(self, spec: mujoco.MjSpec, joint: str) -> mujoco.MjsActuator:
        actuator = spec.add_actuator(
            name=f"servo {joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_position(self.kp, self.kv)
        if self.limits is not None:
            actuator.ctrlrange, actuator.ctrllimited = list(self.limits), 1
        if self.effort is not None:
            actuator.forcerange, actuator.forcelimited = list(self.effort), 1
        return actuator


def _driven(
    spec: mujoco.MjSpec, model: mujoco.MjModel, hand: HandModel, actuator: mujoco.MjsActuator
) -> dict[str, float]:
    """What the actuator's length is in the d joints: ratio by name, gear included; "" constant."""
    transmission, gear = mujoco.mjtTrn, float(actuator.gear[0])
    if actuator.trntype in (transmission.mjTRN_JOINT, transmission.mjTRN_JOINTINPARENT):
        parts = {actuator.target: 1.0}
    elif actuator.trntype == transmission.mjTRN_TENDON:
        path = list(spec.tendon(actuator.target).path)
        if any(wrap.type != mujoco.mjtWrap.mjWRAP_JOINT for wrap in path):
            return {}  # a tendon in space: no fixed ratio
        parts = {}
        for wrap in path:
            parts[wrap.target.name] = parts.get(wrap.target.name, 0.0) + wrap.coef
    else:
        return {}
    found: dict[str, float] = {}
    for joint, ratio in parts.items():
        if joint in hand.joint_names:
            found[joint] = found.get(joint, 0.0) + gear * ratio
        elif joint in hand.couplings:
            mimic = hand.couplings[joint]
            found[""] = found.get("", 0.0) + gear * ratio * mimic.offset
            if mimic.master is not None:
                own = found.get(mimic.master, 0.0)
                found[mimic.master] = own + gear * ratio * mimic.scale
    # the constant stays under "", which is no joint
    return {name: value for name, value in found.items() if name or value}


def _is_position(model: mujoco.MjModel, i: int) -> bool:
    kinds = mujoco.mjtDyn
    direct = (kinds.mjDYN_NONE, kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT)
    return bool(
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and mujoco.mjtDyn(model.actuator_dyntype[i]) in direct
        and model.actuator_gainprm[i, 0] > 0
        and bool(np.isclose(model.actuator_biasprm[i, 1], -model.actuator_gainprm[i, 0]))
    )


def _is_damper(model: mujoco.MjModel, i: int) -> bool:
    """Whether it is a velocity servo, which damps as long as nobody drives it."""
    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    return bool(gain[0] > 0 and bias[1] == 0 and np.isclose(bias[2], -gain[0]))


def _span(values: Floats) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.2g}" if np.isclose(low, high) else f"{low:.2g} to {high:.2g}"
