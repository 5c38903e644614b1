"""What the emulated servos move: the position loop of each servo, and a first-order joint.

The servo's law is the one of the manual's block diagram for the position modes: position error
times the P gain, less speed times the D gain, gives a current, which is limited; the goal is
approached along a profile of limited speed and acceleration. The manual leaves open in which unit
the P and D terms count; here they give current units, for error in ticks and speed in ticks per
millisecond (`hardware.units` states the same assumption and converts by it).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from hardware.registers import AMPERES, RADIANS_PER_TICK, OperatingMode

TORQUE_CONSTANT = 1.3  # N m/A, of the shaft: 3.0 N m at 2.3 A (manual, 12 V)
NO_LOAD_SPEED = 8.06  # rad/s, 77 rpm at 12 V (manual)
STALL_TORQUE = 3.0  # N m at 12 V (manual)
P_DIVISOR, D_DIVISOR = 128, 16  # register to gain (manual)
UNLIMITED = 1e9
LONGEST_LATENCY = 1.0  # s


@dataclass
class Commands:
    """What the registers of n servos ask for, ``(n,)`` each, in the servos' own direction.

    Attributes:
        torque_on: whether the motor is driven.
        mode: operating mode.
        goal: goal position [rad].
        goal_speed: in velocity mode [rad/s].
        goal_torque: in current mode [N m].
        duty: in PWM mode, as a fraction of full voltage.
        kp, kd: gains of the position loop [N m/rad], [N m s/rad].
        limit: largest torque [N m].
        speed, acceleration: of the profile, `UNLIMITED` for none [rad/s], [rad/s^2].
        stopped: the watchdog has stopped the profile.
    """

    torque_on: Bools
    mode: np.ndarray
    goal: Floats
    goal_speed: Floats
    goal_torque: Floats
    duty: Floats
    kp: Floats
    kd: Floats
    limit: Floats
    speed: Floats
    acceleration: Floats
    stopped: Bools

    @classmethod
    def idle(cls, count: int) -> Commands:
        """Torque off everywhere."""

        def zeros() -> Floats:
            return np.zeros(count)

        return cls(
            torque_on=np.zeros(count, bool),
            mode=np.full(count, int(OperatingMode.POSITION)),
            goal=zeros(),
            goal_speed=zeros(),
            goal_torque=zeros(),
            duty=zeros(),
            kp=zeros(),
            kd=zeros(),
            limit=zeros(),
            speed=np.full(count, UNLIMITED),
            acceleration=np.full(count, UNLIMITED),
            stopped=np.zeros(count, bool),
        )


def servo_stiffness(p_gain: float, unit: float = AMPERES * TORQUE_CONSTANT) -> float:
    """Torque per radian [N m/rad] of a P gain register; ``unit``: torque per count of the drive."""
    return p_gain / P_DIVISOR * unit / RADIANS_PER_TICK


def servo_damping(d_gain: float, unit: float = AMPERES * TORQUE_CONSTANT) -> float:
    """Torque per speed [N m s/rad] of a D gain register; ``unit`` as for the stiffness."""
    return d_gain / D_DIVISOR * unit / (RADIANS_PER_TICK * 1000)


class Joints(ABC):
    """n servo shafts in motion.

    Attributes:
        commands: what the servos ask for; read at every step.
        q, velocity, torque: of the shafts, ``(n,)`` [rad], [rad/s], [N m].
        reference: where the profile has got to, ``(n,)`` [rad].
        reference_speed: how fast it moves, ``(n,)`` [rad/s].
        timestep: [s].
        action_latency: from a goal's arrival to its effect [s], in whole timesteps; 0 until set.
    """

    def __init__(self, q: Floats, timestep: float) -> None:
        count = len(q)
        self.commands = Commands.idle(count)
        self.q = np.array(q, float)
        self.velocity = np.zeros(count)
        self.torque = np.zeros(count)
        self.reference = self.q.copy()
        self.reference_speed = np.zeros(count)
        self.timestep = timestep
        self.action_latency = 0.0
        self._late = np.zeros((0, count))  # goals on their way, the oldest first
        self._owed = 0.0

    def advance(self, seconds: float) -> bool:
        """Let time pass in whole timesteps; the remainder is kept. False if none was whole."""
        self._owed += seconds
        steps = int(self._owed / self.timestep + 1e-9)
        self._owed -= steps * self.timestep
        for _ in range(steps):
            self._move_reference(self.timestep)
            self._step(self.timestep)
        return steps > 0

    def set_action_latency(self, seconds: float) -> None:
        """Let goals take effect so much later [s], rounded to timesteps.

        Raises:
            InvalidInput: not between 0 and `LONGEST_LATENCY`.
        """
        if not 0 <= seconds <= LONGEST_LATENCY:
            raise InvalidInput(f"action_latency is {seconds}; expected 0 to {LONGEST_LATENCY:g} s")
        periods = round(seconds / self.timestep)
        self.action_latency = periods * self.timestep
        self._late = np.repeat(self.commands.goal[None], periods, axis=0)

    def _goal(self) -> Floats:
        """The goals that have taken effect, ``(n,)`` [rad]; call it once a timestep."""
        goal, late = self.commands.goal, self._late
        if not len(late):
            return goal
        free = ~self.commands.torque_on
        late[:, free] = goal[free]  # what was asked of a limp servo must not move it later
        due = late[0].copy()
        late[:-1], late[-1] = late[1:].copy(), goal
        return due

    @property
    def measured(self) -> Floats:
        """What the servos' encoders tell, ``(n,)`` [rad]."""
        return self.q

    def grasp(self) -> list[float] | None:
        """Set-points of the grasp that the joints start in [rad], if they hold anything."""
        return None

    def touch(self) -> dict[str, object] | None:
        """What the fingertips feel, if there are any."""
        return None

    def support(self, supported: bool) -> None:
        """Hold the object still, or let it go.

        Raises:
            InvalidInput: there is no object.
        """
        raise InvalidInput("support: first-order joints hold no object")

    def turn(self, q: Sequence[float]) -> None:
        """Turn limp shafts by hand, to ``(n,)`` [rad].

        Raises:
            InvalidInput: they cannot be turned.
        """
        raise InvalidInput("turn: only first-order joints can be turned by hand")

    def _move_reference(self, h: float) -> None:
        c = self.commands
        away = self._goal() - self.reference
        distance = np.abs(away)
        speed = np.minimum(c.speed, np.abs(self.reference_speed) + c.acceleration * h)
        speed = np.minimum(speed, np.sqrt(2 * c.acceleration * distance))
        move = np.copysign(np.minimum(distance, speed * h), away)
        if (c.mode == OperatingMode.VELOCITY).any():
            move = np.where(c.mode == OperatingMode.VELOCITY, c.goal_speed * h, move)
        move[c.stopped] = 0.0
        self.reference += move
        free = ~c.torque_on
        self.reference[free] = self.q[free]
        self.reference_speed = np.where(free, 0.0, move / h)

    @abstractmethod
    def _step(self, h: float) -> None:
        """Move the shafts by one timestep."""


class FirstOrderJoints(Joints):
    """Joints without inertia: speed is torque over a viscous coefficient.

    Args:
        q: where the shafts start, ``(n,)`` [rad].
        viscosity: [N m s/rad]; the default is stall torque over no-load speed.
        timestep: [s].

    Attributes:
        blocked: shafts that something holds fast, ``(n,)`` bool.
    """

    def __init__(
        self, q: Floats, viscosity: float = STALL_TORQUE / NO_LOAD_SPEED, timestep: float = 0.002
    ) -> None:
        super().__init__(q, timestep)
        self.viscosity = viscosity
        self.blocked = np.zeros(len(self.q), bool)

    def turn(self, q: Sequence[float]) -> None:
        angles = np.asarray(q, float)
        if angles.shape != (len(self.q),) or not np.isfinite(angles).all():
            raise InvalidInput(f"turn: {len(angles)} angles; expected {len(self.q)}, all finite")
        if self.commands.torque_on.any():
            raise InvalidInput("turn: the torque is on")
        self.q[:] = angles
        self.reference[:] = angles

    def _step(self, h: float) -> None:
        c, b = self.commands, self.viscosity
        error = self.reference - self.q
        # exact over the step for a reference that stands still
        position = error * -np.expm1(-h * c.kp / (b + c.kd)) / h
        speed = np.clip(position, -c.limit / b, c.limit / b)
        speed = np.where(c.mode == OperatingMode.CURRENT, c.goal_torque / b, speed)
        speed = np.where(c.mode == OperatingMode.PWM, c.duty * STALL_TORQUE / b, speed)
        speed = np.clip(speed, -NO_LOAD_SPEED, NO_LOAD_SPEED)
        speed[~c.torque_on | self.blocked] = 0.0
        self.q += speed * h
        self.velocity = speed
        drive = np.clip(c.kp * (self.reference - self.q) - c.kd * speed, -c.limit, c.limit)
        drive = np.where(c.mode == OperatingMode.CURRENT, c.goal_torque, drive)
        drive = np.where(c.mode == OperatingMode.PWM, c.duty * STALL_TORQUE - b * speed, drive)
        self.torque = np.where(c.torque_on, drive, 0.0)
