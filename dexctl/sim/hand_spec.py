"""A hand's file as a MuJoCo spec that can be simulated, whatever else the file holds."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dexctl.description import root_tag
from dexctl.exceptions import SimulationError
from dexctl.hand import HandModel
from dexctl.sim.checks import listed
from dexctl.sim.file_settings import (
    TIMESTEP,
    lean_model,
    own_contacts,
    own_options,
    plain_defaults,
    settle_masses,
)
from dexctl.sim.neighbours import exclude_neighbours
from dexctl.sim.servo_gains import ServoGains, proposed_gains
from dexctl.sim.servos import add_servos
from dexctl.sim.urdf_spec import TIP_RADIUS, read_urdf
from dexctl.state import Floats

# A joint equality holds against acceleration, and finger links are light: as stiff as it can be.
_COUPLING_SOLREF, _COUPLING_SOLIMP = (2 * TIMESTEP, 1.0), (0.999, 0.9999, 0.001, 0.5, 2.0)


class HandSpec(NamedTuple):
    """A hand, in its own frame, with one position servo on each of the d joints.

    Attributes:
        spec: nothing in it moves but the hand's joints; no keyframes and no sensors; solver,
            integrator, flags and sizes are dexctl's own (MuJoCo's defaults but for a timestep of
            5 ms, implicitfast, elliptic cones and impratio 100).
        notes: a line for everything that the file lacks, that was mended or left out.
    """

    spec: mujoco.MjSpec
    notes: tuple[str, ...]


def hand_spec(hand: HandModel) -> HandSpec:
    """The hand's file, made ready for simulation.

    Joints that move no fingertip stay at their reference position, as in `HandModel`; bodies that
    float or hang on a ball joint beside the hand (objects of a scene's file) are left out; floors
    and other fixed bodies stay. Joints that follow another do so by an equality constraint. Links
    that lie in each other do not collide.

    Raises:
        SimulationError: MuJoCo cannot compile the file, a fingertip has nothing to touch with, or
            a tendon drives joints that nothing couples.
    """
    spec, notes = _without_servos(hand)
    model = lean_model(spec, hand)
    exclude_neighbours(spec, model, hand, notes)
    add_servos(spec, model, hand, notes)
    return HandSpec(spec, tuple(notes))


def propose_servos(hand: HandModel) -> ServoGains:
    """Gains for a hand of whose servos nothing is known; see `dexctl.sim.servo_gains`.

    What its file or its ``config.servos`` say is not looked at; masses and armature are.
    """
    nothing = np.full(hand.nq, np.nan)
    return proposed_gains(lean_model(_without_servos(hand)[0], hand), hand, nothing, nothing)


def _without_servos(hand: HandModel) -> tuple[mujoco.MjSpec, list[str]]:
    notes: list[str] = []
    if root_tag(hand.path) == "robot":
        spec = read_urdf(hand, notes)
        own_options(spec)
    else:
        spec = _read_mjcf(hand)
        own_options(spec)
        own_contacts(spec)
        _strip(spec, hand, notes)
        settle_masses(spec, hand)
        plain_defaults(spec)
        _check_tips(spec, hand, notes)
    _couple(spec, hand, notes)
    _turn(spec, hand.base_rotation)
    return spec, notes


def _read_mjcf(hand: HandModel) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(hand.path))
    except ValueError as error:
        why = " ".join(str(error).split())
        raise SimulationError(f"{hand.path}: MuJoCo cannot read it: {why}") from None
    spec.compiler.fusestatic = False  # a fingertip may be a body without joints
    for kind in ("body", "joint"):  # what `HandModel` calls those without a name
        for i, item in enumerate(spec.bodies if kind == "body" else spec.joints):
            item.name = item.name or f"{kind} {i}"
    return spec


def _strip(spec: mujoco.MjSpec, hand: HandModel, notes: list[str]) -> None:
    """Take out what belongs to other simulations: keyframes, sensors, loose bodies, idle joints."""
    for item in (*spec.keys, *spec.sensors):
        spec.delete(item)
    used = {*hand.joint_names, *hand.couplings}
    loose = []
    for body in list(spec.worldbody.bodies):
        inside = [body, *body.find_all("body")]
        joints = [joint for one in inside for joint in one.joints]
        if any(joint.name in used for joint in joints) or _holds(inside, hand.fingertip_bodies):
            body.mocap = False  # nothing moves it here; `Scene.build(moving_base=True)` does
            continue
        free = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
        if body.mocap or any(joint.type in free for joint in joints):
            loose.append(body.name)
            _delete(spec, [joint.name for joint in joints])
            spec.delete(body)
    if loose:
        notes.append(f"loose bodies of the file left out: {listed(loose)}")
    closed = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    loops = [f"{e.name1} to {e.name2}" for e in spec.equalities if e.type in closed and e.active]
    if loops:
        notes.append(f"constraints that the kinematics does not know: {listed(loops)}")
    idle = [joint.name for joint in spec.joints if joint.name not in used]
    if idle:
        _delete(spec, idle)
        notes.append(f"joints that move no fingertip stay where they are: {listed(idle)}")


def _holds(bodies: list[mujoco.MjsBody], names: tuple[str, ...]) -> bool:
    return any(body.name in names for body in bodies)


def _delete(spec: mujoco.MjSpec, joints: list[str]) -> None:
    """Delete joints, and the tendons, actuators and equalities on them."""
    for tendon in list(spec.tendons):
        over = [w for w in tendon.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT]
        if any(wrap.target.name in joints for wrap in over):
            _delete_tendon(spec, tendon)
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for actuator in list(spec.actuators):
        if actuator.trntype in on_joint and actuator.target in joints:
            spec.delete(actuator)
    for equality in list(spec.equalities):
        on = equality.type == mujoco.mjtEq.mjEQ_JOINT
        if on and (equality.name1 in joints or equality.name2 in joints):
            spec.delete(equality)
    for name in joints:
        spec.delete(spec.joint(name))


def _delete_tendon(spec: mujoco.MjSpec, tendon: mujoco.MjsTendon) -> None:
    for actuator in list(spec.actuators):
        on = actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON
        if on and actuator.target == tendon.name:
            spec.delete(actuator)
    for equality in list(spec.equalities):
        on = equality.type == mujoco.mjtEq.mjEQ_TENDON
        if on and tendon.name in (equality.name1, equality.name2):
            spec.delete(equality)
    spec.delete(tendon)


def _check_tips(spec: mujoco.MjSpec, hand: HandModel, notes: list[str]) -> None:
    """Give a fingertip without collision geometry a sphere, unless its link has some elsewhere."""
    for name, offset in zip(hand.fingertip_bodies, hand.fingertip_offsets, strict=True):
        body = spec.body(name)
        if _solid(body):
            continue
        above = body
        while not above.joints and above.name != "world":
            above = above.parent
            if _solid(above) and above.name not in hand.fingertip_bodies:
                raise SimulationError(
                    f"{hand.path}: the fingertip body {name!r} has no collision geometry, and "
                    f"{above.name!r}, to which it is fixed, has: name that body as the fingertip, "
                    "with the offset of the tip in its frame"
                )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[TIP_RADIUS, 0, 0],
            pos=offset,
            mass=0,
            contype=1,
            conaffinity=1,
        )
        notes.append(
            f"fingertip {name!r} has no collision geometry: it gets a sphere of "
            f"{1000 * TIP_RADIUS:g} mm radius at the tip"
        )


def _solid(body: mujoco.MjsBody) -> bool:
    return any(geom.contype or geom.conaffinity for geom in body.geoms)


def _couple(spec: mujoco.MjSpec, hand: HandModel, notes: list[str]) -> None:
    """Have every follower follow, by one equality constraint that says what `HandModel` says."""
    if not hand.couplings:
        return
    joint_equality = mujoco.mjtEq.mjEQ_JOINT
    model = lean_model(spec, hand)  # a spec has angles as its file has them, in degrees or not

    def reference(joint: str) -> float:
        return float(model.qpos0[model.joint(joint).qposadr[0]])

    for tendon in spec.tendons:  # within one coupling its length is decided already
        names = [w.target.name for w in tendon.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT]
        masters = {hand.couplings[n].master if n in hand.couplings else n for n in names}
        if len(masters) == 1 and any(name in hand.couplings for name in names):
            tendon.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    for equality in list(spec.equalities):
        if equality.type == joint_equality and equality.name1 in hand.couplings:
            spec.delete(equality)
    for follower, mimic in hand.couplings.items():
        data = np.zeros(len(mujoco.MjSpec().add_equality().data))
        data[0] = mimic.offset - reference(follower)
        if mimic.master is not None:
            data[0] += mimic.scale * reference(mimic.master)
            data[1] = mimic.scale
        spec.add_equality(
            name=f"{follower} follows",
            type=joint_equality,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=follower,
            name2=mimic.master or "",
            data=data,
            solref=_COUPLING_SOLREF,
            solimp=_COUPLING_SOLIMP,
        )


def _turn(spec: mujoco.MjSpec, rotation: Floats) -> None:
    """Turn everything in the world."""
    if np.array_equal(rotation, np.eye(3)):
        return
    world = spec.worldbody
    items = [
        item
        for kind in ("bodies", "geoms", "sites", "cameras", "lights", "frames")
        for item in getattr(world, kind)
        if item.frame is None
    ]
    frame = world.add_frame(quat=Rotation.from_matrix(rotation).as_quat(scalar_first=True))
    for item in items:
        item.set_frame(frame)
