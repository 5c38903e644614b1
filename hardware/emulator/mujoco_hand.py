"""The servos' shafts as the joints of a simulated hand that holds an object.

The physics is `dexctl.sim`'s: the scene, timestep and actuators of the bare simulator. Its
position actuators get the gains of their servos, so that the stiff part is integrated implicitly,
as in the bare simulator; whatever else a servo asks for (less torque, other modes) becomes the
set-point at which the actuator makes that torque.

At power-on torque is off and nothing would hold the object. So somebody holds it still, as a
person does at a real hand, until every finger has pressed on it for a while.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.sim import Push, SceneConfig, Sensing, Simulation
from dexctl.sim.file_settings import TIMESTEP
from dexctl.state import Floats
from hardware.emulator.dynamics import STALL_TORQUE, Joints
from hardware.registers import OperatingMode
from hardware.scene import HOLDING, NOTHING

FAR = 10.0  # m from the hand: where the object of an empty hand starts its fall
GEAR_FRICTION = 0.1  # N m that holds a joint while its torque is off (ours)
PRESSING_FORCE = 1.0  # N by every finger, or less where it presses less in the settled grasp,
PRESSING_SHARE = 0.7  # then this share of it, over
PRESSING_TIME = 0.3  # s, and the object is let go,
FINGERS, FINGERS_TIME = 3, 1.0  # or so many fingers that long [s]: no more of them may reach it


class MujocoHand(Joints):
    """A simulated hand, one servo per joint, in the order of its joints.

    It starts in the settled grasp or in one of the given states, or open where it holds nothing.

    Args:
        scene: the hand and its one object, or "none". Gains and limits are the servos', but that
            ranges of stiffness and damping make them other than they are told; and the fingertips
            tell of the weakest touch: what counts is for whoever reads them.
        seed: of the scene's random streams.

    Attributes:
        supported: whether somebody holds the object still.
        drawn: what the ranges of the scene made of the joints, which nobody tells who runs them.
        kp_share, kv_share: what they made of the servos' gains, as shares of those that they are
            told, ``(d,)``.

    Raises:
        UnknownName: no such object.
        InvalidInput: several objects.
        SimulationError: the hand does not hold the object.
    """

    def __init__(self, scene: SceneConfig = HOLDING, seed: int = 0) -> None:
        if len(scene.object) != 1:
            raise InvalidInput(f"object is {', '.join(scene.object)}; expected one")
        self._empty = scene.object == (NOTHING,)
        self._sim = Simulation(_bare(scene, self._empty), 1, seed)
        physics = self._sim.sim.groups[0].scene
        if self._empty:
            far = physics.grasp_centre + FAR * physics.gravity / np.linalg.norm(physics.gravity)
            there = (physics.open_q, physics.open_q, far, np.array([1.0, 0.0, 0.0, 0.0]))
            self._sim.sim.set_grasp(*(value[None] for value in there))
        self._state = self._seen = self._sim.sim.read()[0]
        super().__init__(self._state.q, TIMESTEP)
        self._grasp = None if self._empty else self._state.q_target.tolist()
        self._anchor = self.q.copy()
        self._gains = np.zeros((2, len(self.q)))  # that the actuators have; 0: none were told
        # what ranges made of the gains in this run, as shares of those that servos are told
        draws = self._sim.randomiser
        self.drawn = draws.drawn
        self.kp_share, self.kv_share = (
            np.where(usual > 0, drawn / np.where(usual > 0, usual, 1.0), 1.0)
            for drawn, usual in (
                (draws.drawn.kp[0], draws.usual.kp[0]),
                (draws.drawn.kv[0], draws.usual.kv[0]),
            )
        )
        self._kp, self._kv = draws.drawn.kp[0].copy(), draws.drawn.kv[0].copy()
        self.supported = not self._empty
        self._held_at = self._object_pose()
        self._pressed = self._grasped = 0.0
        settled = PRESSING_SHARE * self._state.contact_force
        self._enough = np.minimum(PRESSING_FORCE, settled)

    @property
    def measured(self) -> Floats:
        return self._seen.q

    def grasp(self) -> list[float] | None:
        return self._grasp

    def touch(self) -> dict[str, object]:
        s, truth = self._seen, self._state
        return {
            "time": float(s.time),
            "age": float(s.age),
            "in_contact": s.in_contact.tolist(),
            "position": s.contact_position.tolist(),
            "normal": s.contact_normal.tolist(),
            "force": s.contact_force.tolist(),
            "supported": self.supported,
            "object_position": None if self._empty else _list(truth.object_position),
            "object_quaternion": None if self._empty else _list(truth.object_quaternion),
            "tracked_position": None if self._empty else _list(s.object_position),
            "tracked_quaternion": None if self._empty else _list(s.object_quaternion),
        }

    def support(self, supported: bool) -> None:
        """Hold the object still where it is now, or let it go at once."""
        self.supported = bool(supported) and not self._empty
        self._pressed = self._grasped = 0.0
        self._held_at = self._object_pose()

    def _step(self, h: float) -> None:
        self._take_gains()
        wanted = self._set_points()
        self._sim.write(wanted[None])
        self._sim.step()
        self._seen = self._sim.read()[0]
        self._hold_object(h)
        self._state = self._sim.sim.read()[0]
        self.velocity = (self._state.q - self.q) / h
        self.q = self._state.q
        force = self._kp * (wanted - self.q) - self._kv * self.velocity
        limit = np.minimum(self.commands.limit, STALL_TORQUE)
        self.torque = np.where(self.commands.torque_on, np.clip(force, -limit, limit), 0.0)

    def _take_gains(self) -> None:
        """Give the actuators of driven servos the gains that those have."""
        c = self.commands
        told = np.where(c.torque_on & (c.kp > 0), [c.kp, c.kd], self._gains)
        if (told == self._gains).all():
            return
        new = (told != self._gains).any(axis=0)
        self._gains = told
        self._kp = np.where(new, told[0] * self.kp_share, self._kp)
        self._kv = np.where(new, told[1] * self.kv_share, self._kv)
        self._sim.sim.set_parameters(kp=self._kp[None], kv=self._kv[None])

    def _set_points(self) -> Floats:
        """Set-points ``(d,)`` [rad] at which the actuators make the torques of the servos."""
        c, q, v, kp, kv = self.commands, self.q, self.velocity, self._kp, self._kv
        own_kp, own_kd = c.kp * self.kp_share, c.kd * self.kv_share
        torque = np.clip(own_kp * (self.reference - q) - own_kd * v, -c.limit, c.limit)
        torque = np.where(c.mode == OperatingMode.CURRENT, c.goal_torque, torque)
        torque = np.where(c.mode == OperatingMode.PWM, c.duty * STALL_TORQUE, torque)
        asked = q + (torque + kv * v) / kp
        position = (c.mode != OperatingMode.CURRENT) & (c.mode != OperatingMode.PWM)
        within = np.abs(kp * (self.reference - q) - kv * v) <= c.limit
        plain = position & within & (own_kp == kp) & (own_kd == kv)
        # dry friction of the gears: the anchor follows only a joint that is pulled hard enough
        room = GEAR_FRICTION / kp
        self._anchor = np.where(c.torque_on, q, np.clip(self._anchor, q - room, q + room))
        return np.where(c.torque_on, np.where(plain, self.reference, asked), self._anchor)

    def _hold_object(self, h: float) -> None:
        """Keep a supported object still until fingers have pressed on it for long enough."""
        if not self.supported:
            return
        position, quaternion = self._held_at
        self._sim.sim.place_object(position[None], quaternion[None])
        pressing = self._state.contact_force >= self._enough
        driven = self.commands.torque_on.all()
        self._pressed = self._pressed + h if pressing.all() and driven else 0.0
        self._grasped = self._grasped + h if pressing.sum() >= FINGERS and driven else 0.0
        self.supported = self._pressed < PRESSING_TIME and self._grasped < FINGERS_TIME

    def _object_pose(self) -> tuple[Floats, Floats]:
        state = self._state
        assert state.object_position is not None
        assert state.object_quaternion is not None
        return state.object_position.copy(), state.object_quaternion.copy()


def _bare(scene: SceneConfig, empty: bool) -> SceneConfig:
    """``scene`` without what the servos do, at the emulator's timestep."""
    bare = replace(
        scene,
        stiffness=None,
        damping=None,
        control_period=TIMESTEP,
        substeps=1,
        # what is made of joints and switches is for whoever reads them
        sensing=replace(scene.sensing, touch="full", touch_threshold=Sensing().touch_threshold),
        limits=HandLimits(),
    )
    if not empty:
        return bare
    nothing = {"object_size": None, "object_mesh": None, "initial_states": None, "push": Push()}
    return replace(bare, object=("cube",), **nothing)


def _list(vector: Floats | None) -> list[float] | None:
    return None if vector is None else vector.tolist()
