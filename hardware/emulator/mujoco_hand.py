"""The servos' shafts as the joints of a simulated hand that holds an object.

The physics is `dexctl.sim`'s: the scene, timestep and actuators of the bare simulator. Its
position actuators get the gains of the servos where all servos agree, so that the stiff part is
integrated implicitly, as in the bare simulator; whatever else a servo asks for (less torque, other
modes, gains of its own) becomes the set-point at which the actuator makes that torque.

At power-on torque is off and nothing would hold the object. So somebody holds it still, as a
person does at a real hand, until every finger has pressed on it for a while.
"""

from __future__ import annotations

import numpy as np

from dexctl.exceptions import UnknownName
from dexctl.sim import BatchSimulator, Scene, object_names
from dexctl.state import Floats
from hardware.emulator.dynamics import STALL_TORQUE, Joints
from hardware.registers import OperatingMode

NOTHING = "none"
FAR = 10.0  # m from the hand: where the object of an empty hand starts its fall
GEAR_FRICTION = 0.1  # N m that holds a joint while its torque is off (ours)
PRESSING_FORCE = 1.0  # N by every finger, over
PRESSING_TIME = 0.3  # s, and the object is let go


class MujocoHand(Joints):
    """A hand of `dexctl.hands` in MuJoCo, one servo per joint, in the order of its joints.

    It starts in the settled grasp, or open where it holds nothing.

    Args:
        hand: its name.
        object: what it holds, one of `dexctl.sim.object_names`, or "none".
        gravity: "up" or "down", which way the palm looks.
        seed: of the simulator's random streams.

    Attributes:
        supported: whether somebody holds the object still.

    Raises:
        UnknownName: no such hand, object or gravity.
    """

    def __init__(
        self,
        hand: str = "dex5",
        object: str = "cylinder",  # noqa: A002 (the field's name for it)
        gravity: str = "up",
        seed: int = 0,
    ) -> None:
        self._empty = object == NOTHING
        if not self._empty and object not in object_names():
            raise UnknownName("object", object, [*object_names(), NOTHING])
        scene = Scene.build(hand, "cube" if self._empty else object, gravity)
        timestep = float(scene.model.opt.timestep)
        self._sim = BatchSimulator(
            scene, control_period=timestep, substeps=1, threads=1, disturbance=0.0, seed=seed
        )
        if self._empty:
            far = scene.grasp_centre + FAR * scene.gravity / np.linalg.norm(scene.gravity)
            self._sim.set_grasp(scene.open_q, scene.open_q, far, [1.0, 0.0, 0.0, 0.0])
        self._state = self._sim.read()
        super().__init__(self._state.q, timestep)
        self._anchor = self.q.copy()
        self._kp = np.full(len(self.q), float(scene.stiffness[0]))
        self._kv = np.zeros(len(self.q))
        self._gains: tuple[float, float] | None = None
        self.supported = not self._empty
        self._held_at = self._object_pose()
        self._pressed = 0.0

    def touch(self) -> dict[str, object]:
        s = self._state
        return {
            "time": float(s.time),
            "age": float(s.age),
            "in_contact": s.in_contact.tolist(),
            "position": s.contact_position.tolist(),
            "normal": s.contact_normal.tolist(),
            "force": s.contact_force.tolist(),
            "supported": self.supported,
            "object_position": None if self._empty else _list(s.object_position),
            "object_quaternion": None if self._empty else _list(s.object_quaternion),
        }

    def support(self, supported: bool) -> None:
        """Hold the object still where it is now, or let it go at once."""
        self.supported = bool(supported) and not self._empty
        self._pressed = 0.0
        self._held_at = self._object_pose()

    def _step(self, h: float) -> None:
        self._take_gains()
        wanted = self._set_points()
        self._sim.write(wanted)
        self._sim.step()
        self._hold_object(h)
        self._state = self._sim.read()
        self.velocity = (self._state.q - self.q) / h
        self.q = self._state.q
        force = self._kp * (wanted - self.q) - self._kv * self.velocity
        limit = np.minimum(self.commands.limit, STALL_TORQUE)
        self.torque = np.where(self.commands.torque_on, np.clip(force, -limit, limit), 0.0)

    def _take_gains(self) -> None:
        """Give the actuators the gains of the driven servos, where those have the same ones."""
        c = self.commands
        driven = np.flatnonzero(c.torque_on)
        if not len(driven):
            return
        kp, kd = float(c.kp[driven[0]]), float(c.kd[driven[0]])
        same = (c.kp[driven] == kp).all() and (c.kd[driven] == kd).all()
        if same and kp > 0 and (kp, kd) != self._gains:
            self._gains = (kp, kd)
            self._sim.set_parameters(kp=kp, kv=kd)
            self._kp[:], self._kv[:] = kp, kd

    def _set_points(self) -> Floats:
        """Set-points ``(d,)`` [rad] at which the actuators make the torques of the servos."""
        c, q, v, kp, kv = self.commands, self.q, self.velocity, self._kp, self._kv
        torque = np.clip(c.kp * (self.reference - q) - c.kd * v, -c.limit, c.limit)
        torque = np.where(c.mode == OperatingMode.CURRENT, c.goal_torque, torque)
        torque = np.where(c.mode == OperatingMode.PWM, c.duty * STALL_TORQUE, torque)
        asked = q + (torque + kv * v) / kp
        position = (c.mode != OperatingMode.CURRENT) & (c.mode != OperatingMode.PWM)
        within = np.abs(kp * (self.reference - q) - kv * v) <= c.limit
        plain = position & within & (c.kp == kp) & (c.kd == kv)
        # dry friction of the gears: the anchor follows only a joint that is pulled hard enough
        room = GEAR_FRICTION / kp
        self._anchor = np.where(c.torque_on, q, np.clip(self._anchor, q - room, q + room))
        return np.where(c.torque_on, np.where(plain, self.reference, asked), self._anchor)

    def _hold_object(self, h: float) -> None:
        """Keep a supported object still until every finger has pressed on it for long enough."""
        if not self.supported:
            return
        self._sim.place_object(*self._held_at)
        pressing = (self._state.contact_force >= PRESSING_FORCE).all()
        driven = self.commands.torque_on.all()
        self._pressed = self._pressed + h if pressing and driven else 0.0
        self.supported = self._pressed < PRESSING_TIME

    def _object_pose(self) -> tuple[Floats, Floats]:
        state = self._sim.read()
        assert state.object_position is not None
        assert state.object_quaternion is not None
        return state.object_position, state.object_quaternion


def _list(vector: Floats | None) -> list[float] | None:
    return None if vector is None else vector.tolist()
