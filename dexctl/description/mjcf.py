"""MJCF files, compiled by MuJoCo: defaults, includes, frames and welds are resolved there.

The tree is taken from the compiled model, so that it is what the simulator moves.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dexctl.description.tree import FARTHEST, Body, Description, Joint, Mimic
from dexctl.description.xml_text import check_numbers
from dexctl.exceptions import HandModelError


def load_mujoco() -> ModuleType:
    """MuJoCo, imported when it is first needed.

    Raises:
        HandModelError: it cannot be imported, as with a MUJOCO_GL that does not work here.
    """
    try:
        return importlib.import_module("mujoco")
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        asked = os.environ.get("MUJOCO_GL")
        hint = f" with MUJOCO_GL={asked}: unset it, or set it to egl" if asked else ""
        raise HandModelError(f"MuJoCo cannot be loaded{hint} ({error})") from None


def compile_mjcf(path: Path) -> Any:
    """The model that MuJoCo makes of a file.

    Raises:
        HandModelError: it cannot, or makes one of numbers that are not finite.
    """
    mujoco = load_mujoco()
    check_numbers(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # a fingertip may be a body without joints
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        if "XML_ELEMENT_DEPTH_EXCEEDED" in reason:
            raise HandModelError(
                f"{path}: bodies lie inside of each other deeper than MuJoCo reads; expected fewer "
                "than 500"
            ) from None
        raise HandModelError(f"{path}: MuJoCo cannot compile it: {reason}") from None
    for name, what in (("body_pos", "pos"), ("body_quat", "orientation"), ("body_mass", "mass")):
        values = getattr(model, name).reshape(model.nbody, -1)
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise HandModelError(
                f"{path}: body {model.body(wrong[0]).name!r} has the {what} "
                f"{values[wrong[0]].tolist()}; expected finite numbers"
            )
    far = np.flatnonzero(np.abs(model.body_pos).max(axis=1) > FARTHEST)
    if len(far):
        raise HandModelError(
            f"{path}: body {model.body(far[0]).name!r} has the pos "
            f"{model.body_pos[far[0]].tolist()}; expected metres, at most {FARTHEST:g}"
        )
    return model


def read_mjcf(path: Path) -> Description:
    """Read an MJCF file through MuJoCo's compiler."""
    mujoco, model = load_mujoco(), compile_mjcf(path)
    kinds = {
        mujoco.mjtJoint.mjJNT_HINGE: "hinge",
        mujoco.mjtJoint.mjJNT_SLIDE: "slide",
        mujoco.mjtJoint.mjJNT_BALL: "ball",
        mujoco.mjtJoint.mjJNT_FREE: "free",
    }
    joints = []
    for j in range(model.njnt):
        info = model.joint(j)
        limited = bool(model.jnt_limited[j])
        effort = model.jnt_actfrcrange[j, 1] if model.jnt_actfrclimited[j] else np.inf
        joints.append(
            Joint(
                name=info.name or f"joint {j}",
                kind=kinds[mujoco.mjtJoint(model.jnt_type[j])],
                axis=model.jnt_axis[j].copy(),
                anchor=model.jnt_pos[j].copy(),
                reference=float(model.qpos0[model.jnt_qposadr[j]]),
                lower=float(model.jnt_range[j, 0]) if limited else -np.inf,
                upper=float(model.jnt_range[j, 1]) if limited else np.inf,
                effort=float(effort),
            )
        )
    mimics = _equalities(model, joints)
    tendons = _fixed_tendons(model)
    mimics |= _tight_tendons(path, model, joints, tendons, mimics)
    mimics |= _driven_tendons(model, joints, tendons, mimics)
    description = Description(path, [], {}, mimics)
    description.bodies = _bodies(model, joints)
    _limit_efforts(model, joints, tendons, description)
    description.sites = {
        model.site(s).name: (int(model.site_bodyid[s]), model.site_pos[s].copy())
        for s in range(model.nsite)
        if model.site(s).name
    }
    return description


def _bodies(model: Any, joints: list[Joint]) -> list[Body]:
    mujoco, bodies = load_mujoco(), []
    for b in range(model.nbody):
        first, count = model.body_jntadr[b], model.body_jntnum[b]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.body_quat[b])
        bodies.append(
            Body(
                name=model.body(b).name or f"body {b}",
                parent=int(model.body_parentid[b]) if b else -1,
                rotation=rotation.reshape(3, 3),
                translation=model.body_pos[b].copy(),
                joints=joints[first : first + count] if count else [],
            )
        )
    return bodies


def _limit_efforts(
    model: Any, joints: list[Joint], tendons: dict[int, Tendon], description: Description
) -> None:
    """Torque limits of the joints, from the force limits of actuators on them or their tendons."""
    mujoco = load_mujoco()
    named = {joint.name: joint for joint in joints}
    for a in range(model.nu):
        if not model.actuator_forcelimited[a]:
            continue
        target = int(model.actuator_trnid[a, 0])
        gear = abs(float(model.actuator_gear[a, 0]))
        force = gear * float(np.abs(model.actuator_forcerange[a]).max())
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT:
            joints[target].effort = min(joints[target].effort, force)
        elif model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON and target in tendons:
            # length of the tendon per radian of the joint that all of its joints follow
            followed = [description.resolve(joints[j].name) for j in tendons[target]]
            masters = {one.master for one in followed if one.master is not None}
            if len(masters) == 1:
                ratios = zip(tendons[target].values(), followed, strict=True)
                lever = abs(sum(coefficient * one.scale for coefficient, one in ratios))
                master = named[masters.pop()]
                master.effort = min(master.effort, lever * force)


Tendon = dict[int, float]
"""A fixed tendon: the coefficient of each of its joints, in the order of the file."""


def _fixed_tendons(model: Any) -> dict[int, Tendon]:
    """The tendons whose length is a sum of joint positions, by number; not those in space."""
    mujoco, found = load_mujoco(), {}
    for t in range(model.ntendon):
        first, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
        wraps = range(first, first + count)
        if all(model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
            found[t] = {int(model.wrap_objid[w]): float(model.wrap_prm[w]) for w in wraps}
    return found


_TIGHT = 0.1  # a tendon whose limits leave less than this part of its travel is a coupling


def _tight_tendons(
    path: Path,
    model: Any,
    joints: list[Joint],
    tendons: dict[int, Tendon],
    mimics: dict[str, Mimic],
) -> dict[str, Mimic]:
    """Couplings by tendons of two joints that are held at a length, or nearly."""
    mujoco = load_mujoco()
    lengths = {}
    for t, tendon in tendons.items():
        travel = sum(abs(c) * (joints[j].upper - joints[j].lower) for j, c in tendon.items())
        low, high = (float(end) for end in model.tendon_range[t])
        if model.tendon_limited[t] and high - low < _TIGHT * travel:
            lengths[t] = (low + high) / 2
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_TENDON or not model.eq_active0[e]:
            continue
        t, other = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if other >= 0 or t not in tendons:
            raise HandModelError(
                f"{path}: the equality of the tendon {model.tendon(t).name!r} couples joints "
                "otherwise than by the sum of two joints; say how in [couplings] of the hand's "
                "toml and leave it out here"
            )
        lengths[t] = float(model.tendon_length0[t] + model.eq_data[e, 0])
    found: dict[str, Mimic] = {}
    for t, length in lengths.items():
        tendon = {j: c for j, c in tendons[t].items() if c}
        if len(tendon) != 2:
            continue  # a limit of one joint, or a sum that leaves more than one free
        (first, of_first), (second, of_second) = sorted(tendon.items())  # base to tip
        follower, master = joints[second].name, joints[first].name
        if follower not in mimics and follower not in found:
            found[follower] = Mimic(master, -of_first / of_second, length / of_second)
    return found


def _driven_tendons(
    model: Any, joints: list[Joint], tendons: dict[int, Tendon], mimics: dict[str, Mimic]
) -> dict[str, Mimic]:
    """Couplings by tendons that one actuator pulls: their joints move by the same force.

    Joints that nothing else drives and that give alike move in the ratio of their coefficients.
    """
    mujoco, found = load_mujoco(), {}
    kinds, targets = model.actuator_trntype[: model.nu], model.actuator_trnid[: model.nu, 0]
    driven = {int(t) for t, k in zip(targets, kinds, strict=True) if k == mujoco.mjtTrn.mjTRN_JOINT}
    for t, kind in zip(targets, kinds, strict=True):
        tendon = tendons.get(int(t), {}) if kind == mujoco.mjtTrn.mjTRN_TENDON else {}
        free = sorted(j for j, c in tendon.items() if c and joints[j].name not in mimics)
        if len(free) < 2 or driven & set(free):
            continue
        master = free[0]  # the one nearest to the base
        for j in free[1:]:
            found[joints[j].name] = Mimic(joints[master].name, tendon[j] / tendon[master], 0.0)
    return found


def _equalities(model: Any, joints: list[Joint]) -> dict[str, Mimic]:
    mujoco, mimics = load_mujoco(), {}
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e]:
            continue
        slave, master = joints[model.eq_obj1id[e]], model.eq_obj2id[e]
        constant, slope, *higher = (float(c) for c in model.eq_data[e, :5])
        # MuJoCo: slave - ref_slave = constant + slope (master - ref_master)
        offset = slave.reference + constant
        if master < 0:
            mimics[slave.name] = Mimic(None, 0.0, offset)
        else:
            offset -= slope * joints[master].reference
            mimics[slave.name] = Mimic(joints[master].name, slope, offset, not any(higher))
    return mimics
