"""The settled grasp: where the fingers of any hand go so that the object stays.

1. Each finger gets a point of the object's surface: on the horizontal ray through the object's
   centre towards where the open hand has its fingertip.
2. Inverse kinematics brings the tips to touch, from a little way out.
3. The fingers close while the object is fixed to the world; their set-points are corrected until
   each presses with its share of the grip, shares that balance on the object.
4. The object is let go and the grasp rests for a second.

Where the object slips, it is tried turned about the vertical.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from dexctl.exceptions import SimulationError
from dexctl.sim.tactile import TouchSensors
from dexctl.state import Floats

if TYPE_CHECKING:
    from dexctl.sim.scene import Scene

_APPROACH = 0.012  # the tips start closing this far from the surface [m]
_CLOSING_TIME = 0.2  # [s]
_PRESSING_TIME = 1.0  # [s]
_SETTLING_TIME = 1.0  # [s]
_YAWS = np.deg2rad([0.0, 9.0, 18.0, 30.0, 36.0, 45.0, 60.0, 90.0, 120.0, 150.0, 180.0])
_WEAKEST_SHARE = 0.4  # no finger presses with less than this part of the strongest


class SettledGrasp(NamedTuple):
    """A grasp at rest.

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


def settle(scene: Scene) -> SettledGrasp:
    """Find the settled grasp of a scene.

    Raises:
        SimulationError: the object does not stay in the hand, whichever way it is turned.
    """
    reasons = []
    for yaw in _YAWS:
        grasp, reason = _attempt(scene, float(yaw))
        if grasp is not None:
            return grasp
        reasons.append(f"turned by {np.rad2deg(yaw):.0f} deg: {reason}")
    raise SimulationError(
        f"{scene.hand.name} does not hold {scene.object!r} (width {scene.object_width:g} m, "
        f"{scene.object_mass:g} kg) at {scene.grasp_centre.tolist()}: {reasons[0]}"
    )


def _attempt(scene: Scene, yaw: float) -> tuple[SettledGrasp | None, str]:
    held = _HeldObject(scene, yaw)
    points, normals = held.surface_points()
    outside = held.reach(points, normals, _APPROACH)
    touching = held.reach(points, normals, 0.0)
    q_target = held.close(outside, touching, points, normals)
    return _release(scene, held, q_target)


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

    def surface_points(self) -> tuple[Floats, Floats]:
        """One point of the surface per finger and the outward normal there, ``(m, 3)`` each."""
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
        return points, normals

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

    def reach(self, points: Floats, normals: Floats, gap: float) -> Floats:
        """Joints ``(d,)`` that bring each fingertip's surface ``gap`` away from its point."""
        q = self.scene.open_q.copy()
        radius = np.full(len(points), 0.01)
        for _ in range(4):
            q = self._inverse_kinematics(q, points + (radius + gap)[:, None] * normals)
            self.data.qpos[self.qpos_columns] = q
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

    def _inverse_kinematics(self, q: Floats, target: Floats) -> Floats:
        """Damped least squares with the open hand as the posture of what is left free."""
        hand, damping = self.hand, 1e-4
        for _ in range(60):
            configuration = hand.configuration(q)
            tips = configuration.fingertip_position
            error = (target - tips).ravel()
            jacobian = configuration.contact_jacobian(tips).reshape(-1, hand.nq)
            inverse = jacobian.T @ np.linalg.inv(
                jacobian @ jacobian.T + damping * np.eye(len(error))
            )
            posture = 0.1 * (self.scene.open_q - q)
            free = posture - inverse @ (jacobian @ posture)
            step = inverse @ error + free
            q = np.clip(q + np.clip(step, -0.2, 0.2), self.scene.lower, self.scene.upper)
        return q

    def shares(self, points: Floats, normals: Floats) -> Floats:
        """Normal forces ``(m,)`` near the grip that leave the least wrench on the object [N].

        Least squares of the wrench (torques over the mean lever) with a small pull towards equal
        forces, as in the thesis's stability QP.
        """
        lever = points - self.scene.grasp_centre
        length = max(float(np.linalg.norm(lever, axis=1).mean()), 1e-3)
        inward = -normals
        wrench = np.concatenate([inward.T, np.cross(lever, inward).T / length])
        pull = 0.1 * np.eye(len(points))
        solution = lsq_linear(
            np.concatenate([wrench, pull]),
            np.concatenate([np.zeros(6), 0.1 * np.ones(len(points))]),
            bounds=(_WEAKEST_SHARE, 1.0),
        )
        return self.scene.grip * solution.x / solution.x.mean()

    def close(self, outside: Floats, touching: Floats, points: Floats, normals: Floats) -> Floats:
        """Close the hand on the fixed object; returns the set-points ``(d,)`` that hold it."""
        scene, model, data = self.scene, self.model, self.data
        mujoco.mj_resetData(model, data)
        data.qpos[self.qpos_columns] = outside
        goal = self.shares(points, normals)
        weight = -scene.object_mass * scene.gravity / self.hand.n_fingers
        press = -normals * goal[:, None] + weight
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

    def _step(self, q_target: Floats) -> None:
        self.data.ctrl[self.scene.actuators] = q_target * self.scene.ctrl_per_radian
        mujoco.mj_step(self.model, self.data)


def _release(scene: Scene, held: _HeldObject, q_target: Floats) -> tuple[SettledGrasp | None, str]:
    """Free the object and let the grasp rest; None and the reason where it does not hold."""
    model, hand = scene.model, scene.hand
    data = mujoco.MjData(model)
    data.qpos[scene.qpos_columns] = held.data.qpos[held.qpos_columns]
    data.qvel[scene.qvel_columns] = held.data.qvel[held.qvel_columns]
    data.qpos[scene.object_qpos] = held.pose
    data.ctrl[scene.actuators] = q_target * scene.ctrl_per_radian
    steps = round(_SETTLING_TIME / model.opt.timestep)
    mujoco.mj_step(model, data, steps)
    if data.time < (steps - 0.5) * model.opt.timestep:
        return None, "the simulation diverged"
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
