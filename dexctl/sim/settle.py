"""The settled grasp: where the fingers of any hand go so that the object stays.

1. Each finger gets a point of the object's surface: the nearest one where the hand has a grasp
   posture; else that on the horizontal ray through the object's centre towards where the open hand
   has its fingertip; else one that the grasp search has found for it (`dexctl.sim.grasp_plans`).
2. Inverse kinematics brings the tips to touch, from a little way out.
3. The fingers close while the object is fixed to the world; their set-points are corrected until
   each presses with its share of the grip, shares that balance on the object.
4. The object is let go and the grasp rests for a second.

Where the object slips, it is tried turned about the vertical, and with the next points.

The same scene settles to the same bits, so what was found last is kept for the next of them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from hashlib import sha256
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from dexctl.exceptions import SimulationError
from dexctl.sim.grasp_plans import GraspPlan, posture_plans, searched_plans
from dexctl.sim.grasp_search import GraspSearch
from dexctl.sim.hand_balls import HandBalls, followers, set_followers
from dexctl.sim.settle_failure import DIVERGED, SettleAttempt, SettleFailure
from dexctl.sim.shapes import Shape
from dexctl.sim.tactile import TouchSensors
from dexctl.sim.workspace import Workspace
from dexctl.state import Floats

if TYPE_CHECKING:
    from dexctl.sim.scene import Scene

_APPROACH = 0.012  # the tips start closing this far from the surface [m]
_CLOSING_TIME = 0.2  # [s]
_PRESSING_TIME = 1.0  # [s]
_SETTLING_TIME = 1.0  # [s]
_YAWS = np.deg2rad([0.0, 9.0, 18.0, 30.0, 36.0, 45.0, 60.0, 90.0, 120.0, 150.0, 180.0])
_WEAKEST_SHARE = 0.4  # no finger presses with less than this part of the strongest
_RAYS = "on rays from its centre towards the open fingertips"
_KEPT = 64  # settled grasps of the process, a few kB each


class SettledGrasp(NamedTuple):
    """A grasp at rest; its arrays are read-only.

    Attributes:
        qpos: ``(nq,)``, MuJoCo's order.
        qvel: ``(nv,)``.
        q_target: set-points of the hand's joints, ``(d,)`` [rad].
        sensordata: of the last physics step, ``(nsensordata,)``.
        yaw: how far the object is turned about z [rad].
    """

    qpos: Floats
    qvel: Floats
    q_target: Floats
    sensordata: Floats
    yaw: float


def settle(scene: Scene, *, thorough: bool = True) -> SettledGrasp:
    """Find the settled grasp of a scene.

    Args:
        scene: hand and object.
        thorough: False: try nothing but the scene's grasp posture.

    Raises:
        SettleFailure: the object does not stay in the hand, whichever way it is turned.
        SimulationError: MuJoCo cannot step the scene.
    """
    key = (thorough, *_fingerprint(scene))
    try:
        found = _kept.pop(key, None) or _settled(scene, thorough)
    except mujoco.FatalError as error:  # every simulation of a scene begins here
        why = " ".join(str(error).split())
        raise SimulationError(
            f"{scene.hand.path}: MuJoCo cannot step the hand: {why}; expected links that lie in "
            "few others"
        ) from None
    _kept[key] = found  # the last again
    if len(_kept) > _KEPT:
        _kept.popitem(last=False)
    return found


_kept: OrderedDict[tuple[object, ...], SettledGrasp] = OrderedDict()


def _fingerprint(scene: Scene) -> tuple[object, ...]:
    """All that a settled grasp depends on: equal for scenes that settle alike, to the bit."""
    model = np.empty(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, model)
    arrays = (
        model, scene.gravity, scene.grasp_centre, scene.open_q, scene.grasp_q, scene.lower,
        scene.upper, scene.stiffness, scene.ctrl_per_radian, scene.hand.effort,
    )  # fmt: skip
    parts = [b"" if one is None else np.ascontiguousarray(one).tobytes() for one in arrays]
    named = (scene.object_body, scene.object_mass, scene.object_width, scene.grip)
    return (*(sha256(part).digest() for part in parts), *named, repr(scene.hand.config))


def _settled(scene: Scene, thorough: bool) -> SettledGrasp:
    attempts = []
    for yaw, plan in _plans(scene, thorough):
        held = _HeldObject(scene, yaw)
        try:
            chosen = held.on_rays() if plan is None else plan
        except SimulationError as error:  # no such ray, no such surface
            attempts.append(held.attempt(_RAYS, str(error)))
            continue
        grasp, attempt = _attempt(scene, held, chosen)
        if grasp is not None:
            for values in (grasp.qpos, grasp.qvel, grasp.q_target, grasp.sensordata):
                values.flags.writeable = False
            return grasp
        attempts.append(attempt)
    raise SettleFailure(scene, tuple(attempts))


def _plans(scene: Scene, thorough: bool) -> Iterator[tuple[float, GraspPlan | None]]:
    """How the object is turned and where the fingers go; None: on rays towards the open hand."""
    if scene.grasp_q is not None:
        balls = HandBalls(scene.model, scene.hand, scene.object_body)
        shape = Shape.of_body(scene.model, scene.object_body)
        for plan in posture_plans(balls, shape, scene.grasp_centre, scene.grasp_q):
            yield plan.yaw, plan
    if not thorough:
        return
    for yaw in _YAWS:
        yield float(yaw), None
    for plan in searched_plans(_search(scene)):
        yield plan.yaw, plan


def _search(scene: Scene) -> GraspSearch:
    """Of the object where it is, as large as it is."""
    hand, lower, upper = scene.hand, scene.lower, scene.upper
    return GraspSearch(
        workspace=Workspace(scene.model, hand, lower, upper, scene.open_q, scene.object_body),
        shape=Shape.of_body(scene.model, scene.object_body),
        size=1.0,
        centre=scene.grasp_centre,
        base=scene.open_q,
        torque=hand.effort,
        stiffness=scene.stiffness,
        grip=scene.grip,
        friction=scene.friction(),
        weight=scene.object_mass * float(np.linalg.norm(scene.gravity)),
    )


def _attempt(
    scene: Scene, held: _HeldObject, plan: GraspPlan
) -> tuple[SettledGrasp | None, SettleAttempt]:
    outside = held.reach(plan, _APPROACH)
    touching = held.reach(plan, 0.0)
    q_target = held.close(outside, touching, plan)
    grasp, reason = _release(scene, held, q_target)
    return grasp, held.attempt(plan.how, reason, touching)


class _HeldObject:
    """The scene with the object fixed to the world, and the hand closing on it."""

    def __init__(self, scene: Scene, yaw: float) -> None:
        self.scene = scene
        self.hand = scene.hand
        spec = scene.spec
        spec.compiler.discardvisual = True
        spec.delete(spec.joint(scene.object_body))
        body = spec.body(scene.object_body)
        body.quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        self.pose = np.concatenate([scene.grasp_centre, body.quat])
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name).id for name in self.hand.joint_names]
        self.qpos_columns = self.model.jnt_qposadr[joints]
        self.followers = followers(self.model)
        self.qvel_columns = self.model.jnt_dofadr[joints]
        self.sensors = TouchSensors(self.model, self.hand.n_fingers)
        body_id = self.model.body(scene.object_body).id
        self.object_geoms = np.flatnonzero(self.model.geom_bodyid == body_id)
        solid = (self.model.geom_contype | self.model.geom_conaffinity) != 0
        self.tip_geoms = [
            np.flatnonzero((self.model.geom_bodyid == self.model.body(name).id) & solid)
            for name in self.hand.fingertip_bodies
        ]
        for name, geoms in zip(self.hand.fingertip_bodies, self.tip_geoms, strict=True):
            if not len(geoms):
                raise SimulationError(
                    f"{self.hand.path}: fingertip body {name!r} has no collision geom to touch with"
                )

    def on_rays(self) -> GraspPlan:
        """One point of the surface per finger and the outward normal there."""
        model, data, centre = self.model, self.data, self.scene.grasp_centre
        mujoco.mj_kinematics(model, data)
        tips = self.hand.fingertip_positions(self.scene.open_q)
        points, normals = np.empty_like(tips), np.empty_like(tips)
        for i, tip in enumerate(tips):
            outward = np.array([tip[0] - centre[0], tip[1] - centre[1], 0.0])
            if np.linalg.norm(outward) < 1e-6:
                raise SimulationError(
                    f"{self.hand.name}: the open fingertip {self.hand.fingertip_names[i]!r} "
                    f"is straight above or below the grasp centre {centre.tolist()}"
                )
            outward /= np.linalg.norm(outward)
            points[i], normals[i] = self._outermost(centre, outward)
        everyone = np.ones(len(tips), bool)
        return GraspPlan(_RAYS, 0.0, points, normals, everyone, self.scene.open_q)

    def _outermost(self, centre: Floats, outward: Floats) -> tuple[Floats, Floats]:
        """Where a ray from far outside towards ``centre`` first meets the object."""
        reach = 10 * max(self.scene.object_width, float(self.model.stat.extent))
        start, nearest, normal = centre + reach * outward, np.inf, -outward
        for geom in self.object_geoms:
            found = np.zeros(3)
            distance = self._ray(int(geom), start, -outward, found)
            if 0 <= distance < nearest:
                nearest, normal = distance, found
        if not np.isfinite(nearest):  # the ray passes through a gap between the parts
            raise SimulationError(
                f"{self.scene.object!r}: no surface from its centre towards "
                f"{outward.round(3).tolist()}"
            )
        return start - nearest * outward, normal

    def _ray(self, geom: int, start: Floats, direction: Floats, normal: Floats) -> float:
        model, data = self.model, self.data
        position, rotation = data.geom_xpos[geom], data.geom_xmat[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            return mujoco.mj_rayMesh(model, data, geom, start, direction, normal)
        size, kind = model.geom_size[geom], int(model.geom_type[geom])
        return mujoco.mju_rayGeom(position, rotation, size, start, direction, kind, normal)

    def reach(self, plan: GraspPlan, gap: float) -> Floats:
        """Joints ``(d,)`` that bring each fingertip's surface ``gap`` away from its point."""
        q = plan.q.copy()
        radius = np.full(len(plan.points), 0.01)
        for _ in range(4):
            target = plan.points + (radius + gap)[:, None] * plan.normals
            q = self._inverse_kinematics(q, target, plan)
            self.data.qpos[self.qpos_columns] = q
            set_followers(self.data.qpos, self.followers)
            mujoco.mj_kinematics(self.model, self.data)
            radius += gap - self._gaps()
        return q

    def _gaps(self) -> Floats:
        """Distance between each fingertip and the object, ``(m,)`` [m], negative inside."""
        return np.array(
            [
                min(
                    mujoco.mj_geomDistance(self.model, self.data, int(a), int(b), 0.3, None)
                    for a in geoms
                    for b in self.object_geoms
                )
                for geoms in self.tip_geoms
            ]
        )

    def _inverse_kinematics(self, q: Floats, target: Floats, plan: GraspPlan) -> Floats:
        """Damped least squares with the plan's posture for what is left free."""
        hand, damping = self.hand, 1e-4
        for _ in range(60):
            configuration = hand.configuration(q)
            tips = configuration.fingertip_position
            error = (target - tips).ravel()
            jacobian = configuration.contact_jacobian(tips).reshape(-1, hand.nq)
            if not plan.active.all():
                rows = np.repeat(plan.active, 3)
                error, jacobian = error * rows, jacobian * rows[:, None]
            inverse = jacobian.T @ np.linalg.inv(
                jacobian @ jacobian.T + damping * np.eye(len(error))
            )
            posture = 0.1 * (plan.q - q)
            free = posture - inverse @ (jacobian @ posture)
            step = inverse @ error + free
            q = np.clip(q + np.clip(step, -0.2, 0.2), self.scene.lower, self.scene.upper)
        return q

    def shares(self, plan: GraspPlan) -> Floats:
        """Normal forces ``(m,)`` near the grip that leave the least wrench on the object [N].

        Least squares of the wrench (torques over the mean lever) with a small pull towards equal
        forces, as in the thesis's stability QP. Fingers that are left out press with none.
        """
        lever = plan.points[plan.active] - self.scene.grasp_centre
        length = max(float(np.linalg.norm(lever, axis=1).mean()), 1e-3)
        inward = -plan.normals[plan.active]
        wrench = np.concatenate([inward.T, np.cross(lever, inward).T / length])
        pull = 0.1 * np.eye(len(lever))
        solution = lsq_linear(
            np.concatenate([wrench, pull]),
            np.concatenate([np.zeros(6), 0.1 * np.ones(len(lever))]),
            bounds=(_WEAKEST_SHARE, 1.0),
        )
        forces = np.zeros(len(plan.points))
        forces[plan.active] = self.scene.grip * solution.x / solution.x.mean()
        return forces

    def close(self, outside: Floats, touching: Floats, plan: GraspPlan) -> Floats:
        """Close the hand on the fixed object; returns the set-points ``(d,)`` that hold it."""
        scene, model, data = self.scene, self.model, self.data
        points, normals = plan.points, plan.normals
        mujoco.mj_resetData(model, data)
        data.qpos[self.qpos_columns] = outside
        set_followers(data.qpos, self.followers)
        goal = self.shares(plan)
        weight = -scene.object_mass * scene.gravity / int(plan.active.sum())
        press = -normals * goal[:, None] + weight * plan.active[:, None]
        steps = round(_CLOSING_TIME / model.opt.timestep)
        q_target = self._holding(touching, points, press)
        for i in range(steps):
            blend = (i + 1) / steps
            self._step((1 - blend) * outside + blend * q_target)
        interval = round(0.02 / model.opt.timestep)
        for _ in range(round(_PRESSING_TIME / 0.02)):
            for _ in range(interval):
                self._step(q_target)
            reading = self.sensors.read(data.sensordata[None, self.sensors.columns], 1e-3)
            felt, touch = reading.force[0], reading.in_contact[0]
            spot = np.where(touch[:, None], reading.position[0], points)
            inward = np.where(touch[:, None], reading.normal[0], -normals)
            correction = np.clip(goal - felt, -0.5, 0.5)[:, None] * inward
            jacobian = self.hand.contact_jacobian(data.qpos[self.qpos_columns], spot)
            torque = np.einsum("mkd,mk->d", jacobian, correction)
            q_target = np.clip(q_target + 0.3 * torque / scene.stiffness, scene.lower, scene.upper)
        return q_target

    def _holding(self, q: Floats, points: Floats, press: Floats) -> Floats:
        """Set-points whose servos press with ``press`` ``(m, 3)`` [N] and carry the fingers."""
        self.data.qpos[self.qpos_columns] = q
        self.data.qvel[:] = 0
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        carried = (self.data.qfrc_bias - self.data.qfrc_passive)[self.qvel_columns]
        torque = np.einsum("mkd,mk->d", self.hand.contact_jacobian(q, points), press) + carried
        return np.clip(q + torque / self.scene.stiffness, self.scene.lower, self.scene.upper)

    def attempt(self, how: str, reason: str, touching: Floats | None = None) -> SettleAttempt:
        """What came of it, with the hand in the posture ``touching`` that was to touch."""
        gaps = np.full(self.hand.n_fingers, np.nan)
        self.data.qpos[self.qpos_columns] = self.scene.open_q if touching is None else touching
        set_followers(self.data.qpos, self.followers)
        mujoco.mj_kinematics(self.model, self.data)
        if touching is not None:
            gaps = self._gaps()
        qpos = self.scene.model.qpos0.copy()
        qpos[np.delete(np.arange(len(qpos)), self.scene.object_qpos)] = self.data.qpos
        qpos[self.scene.object_qpos] = self.pose
        yaw = 2 * float(np.arctan2(self.pose[6], self.pose[3]))
        return SettleAttempt(how, yaw, reason, gaps, qpos)

    def _step(self, q_target: Floats) -> None:
        self.data.ctrl[self.scene.actuators] = q_target * self.scene.ctrl_per_radian
        mujoco.mj_step(self.model, self.data)


def _release(scene: Scene, held: _HeldObject, q_target: Floats) -> tuple[SettledGrasp | None, str]:
    """Free the object and let the grasp rest; None and the reason where it does not hold."""
    model, hand = scene.model, scene.hand
    data = mujoco.MjData(model)
    # the hand's joints, those that only follow others among them, are in the same order
    data.qpos[np.delete(np.arange(model.nq), scene.object_qpos)] = held.data.qpos
    data.qvel[np.delete(np.arange(model.nv), scene.object_qvel)] = held.data.qvel
    data.qpos[scene.object_qpos] = held.pose
    data.ctrl[scene.actuators] = q_target * scene.ctrl_per_radian
    steps = round(_SETTLING_TIME / model.opt.timestep)
    mujoco.mj_step(model, data, steps)
    if data.time < (steps - 0.5) * model.opt.timestep:
        return None, DIVERGED
    sensors = TouchSensors(model, hand.n_fingers)
    reading = sensors.read(data.sensordata[None, sensors.columns], 0.05)
    touching = int(reading.in_contact[0].sum())
    moved = float(np.linalg.norm(data.qpos[scene.object_qpos][:3] - scene.grasp_centre))
    speed = float(np.linalg.norm(data.qvel[scene.object_qvel][:3]))
    needed = min(3, hand.n_fingers)
    allowed = 0.15 * (scene.object_width or 0.1)
    if touching < needed:
        return None, f"{touching} fingertips touch it after {_SETTLING_TIME:g} s; needed {needed}"
    if moved > allowed:
        return None, f"it moves by {moved:.3f} m when let go; allowed {allowed:.3f} m"
    if speed > 0.02:
        return None, f"it still moves at {speed:.3f} m/s {_SETTLING_TIME:g} s after being let go"
    if reading.other_contact[0] > 0:
        return None, "it touches more of the hand than fingertips"
    yaw = 2 * float(np.arctan2(held.pose[6], held.pose[3]))
    return (
        SettledGrasp(data.qpos.copy(), data.qvel.copy(), q_target, data.sensordata.copy(), yaw),
        "",
    )
