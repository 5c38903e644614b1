"""ServoHand: a hand of servos on a bus, as a `dexctl.Plant`.

Torque comes on in :meth:`ServoHand.arm` only, with the set-points where the joints stand; from
there on every set-point passes the limits. :meth:`ServoHand.disarm` always returns what is known
of the torque. One thread uses a hand at a time.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from dexctl import GraspState, HandModel, JointTouch
from dexctl.exceptions import InvalidInput
from dexctl.limits import LimitedGoal, limit_goal
from dexctl.sim.checks import gravity_vector
from dexctl.state import Floats
from hardware import registers
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.exceptions import BusError, PortLost, ServoError, tell_torque
from hardware.guarding import Guard
from hardware.limits import Limits
from hardware.models import XM430_W210, ServoModel
from hardware.readings import Readings
from hardware.registers import Register
from hardware.samples import Health, JointSample, TorqueReport
from hardware.state_machine import Torque
from hardware.tactile import NoTactile, TactileReading, TactileSource
from hardware.ticker import Interrupts, Ticker
from hardware.tracking import PoseSource, TrackedPose
from hardware.units import ServoGains, SimGains, to_servo

CONTROL_PERIOD = 0.02
_PATIENCE = 5  # how often a servo is asked, beyond the bus's own retries, before torque is on


class ServoHand:
    """A hand on a servo bus.

    Args:
        bus: with all servos of the calibration; stays the caller's to close.
        hand: the model.
        calibration: how joints lie on servos; default servos 1 to d, straight.
        limits: speed, torque and the rest; of a joint whose own speed or torque limit (those of
            the model) is lower, that one counts.
        gains: of the position loop: as registers, the same for all servos, or in SI units, which
            each model has registers of its own for, the same for all joints or d of them; default:
            as they are in the servos.
        tactile: what the fingertips feel; default nothing.
        joint_touch: tells touch from the torques that the servos measure, in place of what
            ``tactile`` feels; where there is a ``tactile``, that still says which fingertips touch.
        tracker: where the object is; default nobody knows.
        gravity: as the hand is mounted, for controllers that go by it: "up" or "down", which way
            the palm looks, or in the hand's frame ``(3,)`` [m/s^2]; None: nobody knows.
        control_period: time of one :meth:`step`, and what the speed limit reckons with [s].

    Attributes:
        torque: what is known of it.
        torque_report: what the last `disarm` found.
        q_target: the set-points sent last, ``(d,)`` [rad], before rounding to the servo's ticks
            of 1.5 mrad (a slow motion would be lost if the rounded value were built on); NaN
            until armed.
        gravity: ``(3,)`` [m/s^2], or None.
        goal: the orientation that states ask for, wxyz ``(4,)``, hand frame, or None.
        spin: the angular velocity that they ask for, ``(3,)`` [rad/s], hand frame, or None.
        speed_limit, torque_limit: of each joint, ``(d,)`` [rad/s], [N m].
        models: of the servos, d; XM430-W210 until `configure` has asked them.
        torque_constant: of the calibration, or the models, ``(d,)`` [N m/A], [N m].
        hot: from which temperature on is warned, ``(d,)`` [degC].
        voltage: lowest and highest supply, ``(2, d)`` [V].

    Raises:
        InvalidInput: hand, calibration and bus do not belong together, there are not d gains, or a
            joint's speed limit is less than its servo can hold.
    """

    def __init__(
        self,
        bus: Bus,
        hand: HandModel,
        calibration: Calibration | None = None,
        *,
        limits: Limits | None = None,
        gains: ServoGains | SimGains | Sequence[SimGains] | None = None,
        tactile: TactileSource | None = None,
        joint_touch: JointTouch | None = None,
        tracker: PoseSource | None = None,
        gravity: str | ArrayLike | None = None,
        control_period: float = CONTROL_PERIOD,
    ) -> None:
        self.bus = bus
        self.hand = hand
        self.calibration = (calibration or Calibration.nominal(hand)).check(hand)
        self.limits = limits or Limits()
        self.speed_limit, self.torque_limit = joint_limits(hand, self.limits)
        self._check_speeds()
        self._gains = _each(gains, hand.nq)
        self.tactile = tactile or NoTactile(hand.n_fingers)
        self.joint_touch, self._switches = joint_touch, tactile is not None
        self.tracker = tracker
        self._look()
        self.gravity = None if gravity is None else gravity_vector(gravity)
        self.goal: Floats | None = None
        self.spin: Floats | None = None
        self._ticker = Ticker(control_period)
        self.control_period = control_period
        self.torque = Torque.UNKNOWN
        self.torque_report = TorqueReport(Torque.UNKNOWN, "torque state UNKNOWN: never asked")
        self.q_target = np.full(hand.nq, np.nan)
        self._ids = [int(servo) for servo in self.calibration.servo]
        self._take_models([XM430_W210] * hand.nq)
        self._turns: Floats | None = None
        self._sample: JointSample | None = None
        self._touch: TactileReading = self.tactile.read()
        self._health, self._health_turn = _unknown(hand.nq), 0
        self._guard: Guard | None = None
        self._last_limited: LimitedGoal | None = None

    # arming

    def arm(self) -> None:
        """Torque on, with the set-points where the joints stand.

        In this order: torque off, models asked, mode and limits written and read back, turns
        resolved, set-points to the present position, speed and current limits, bus watchdog, torque
        on. From then on the bus must not be silent for longer than ``limits.watchdog``, and a guard
        takes the torque
        off if this process dies (`hardware.guard`).

        Raises:
            ServoError: a servo does not answer, has a hardware error, or does not keep a setting.
            InvalidInput: a joint stands out of its range.
            BusError: the hand is armed already; nothing is done.
            Each of the others says what is known of the torque then (see
            `hardware.exceptions.tell_torque`).
        """
        if self._guard is not None:  # a second one would outlive the first's disarm
            raise BusError("the hand is armed already; disarm() it first")
        self._sample, self._health, self._health_turn = None, _unknown(self.hand.nq), 0
        try:
            self._prepare()
            self._guard = self.bus.guard(self._ids)
            self._set(registers.BUS_WATCHDOG, self.limits.watchdog)
            self._set(registers.TORQUE_ENABLE, 1.0)
        except BaseException as error:
            tell_torque(error, self.disarm().message)
            raise
        self.torque = Torque.ON
        if self.joint_touch is not None:
            self.joint_touch.reset()
        self._ticker.restart()

    def _prepare(self) -> None:
        """All of arming but the watchdog and the torque."""
        self.configure()
        self.sample()
        position = self._must(registers.PRESENT_POSITION)
        self.q_target = self.calibration.joint_angle(position, self._turn_count)
        self._set(registers.GOAL_POSITION, position)
        self._set(registers.PROFILE_ACCELERATION, 0.0)
        self._set(registers.PROFILE_VELOCITY, self.speed_limit)
        if self._gains is not None:
            gains = [self._registers(joint, one) for joint, one in enumerate(self._gains)]
            self._set(registers.POSITION_P_GAIN, [float(gain.p) for gain in gains])
            self._set(registers.POSITION_D_GAIN, [float(gain.d) for gain in gains])
            self._set(registers.POSITION_I_GAIN, 0.0)
        self._set(registers.GOAL_CURRENT, self._most_drive)

    def _check_speeds(self) -> None:
        least = 0.5 * registers.PROFILE_VELOCITY.scale
        for joint in np.flatnonzero(~(self.speed_limit > least))[:1]:
            # it would be rounded to 0, which means no limit to a servo
            raise InvalidInput(
                f"the speed limit of {self.hand.joint_names[joint]} is "
                f"{self.speed_limit[joint]:g} rad/s; expected more than {least:.3g}"
            )

    def _registers(self, joint: int, gains: ServoGains | SimGains) -> ServoGains:
        if not isinstance(gains, SimGains):
            return gains
        model = self.models[joint]
        scale = replace(model.loop, torque_constant=float(self.torque_constant[joint]))
        return to_servo(gains, scale, model.register(registers.CURRENT_LIMIT))

    def _take_models(self, models: list[ServoModel]) -> None:
        limits, given = self.limits, self.calibration.torque_constant
        self.models = models
        own = np.array([model.torque_constant for model in models])
        self.torque_constant = np.where(np.isnan(given), own, given)
        most = [model.register(registers.CURRENT_LIMIT) for model in models]
        self._most_drive = np.minimum(
            self.torque_limit / self.torque_constant, [one.high * one.scale for one in most]
        )
        asked = limits.temperature
        self.hot = np.array([model.hot if asked is None else asked for model in models])
        self.voltage = np.array([limits.voltage or model.voltage for model in models]).T

    def configure(self) -> None:
        """Torque off, models asked, settings of the EEPROM written where they differ, turns.

        Raises:
            ServoError, InvalidInput: see :meth:`arm`.
        """
        self._set(registers.TORQUE_ENABLE, 0.0)
        self.torque = Torque.OFF
        self._take_models(self.bus.identify(self._ids))
        self._check_errors()
        # after a trip the goals are read-only until this is cleared
        self._set(registers.BUS_WATCHDOG, 0.0)
        for register, value in (
            (registers.OPERATING_MODE, [float(model.mode) for model in self.models]),
            (registers.DRIVE_MODE, 0.0),
            (registers.HOMING_OFFSET, 0.0),
            (registers.RETURN_DELAY, 0.0),
            (registers.CURRENT_LIMIT, self._most_drive),
        ):
            if not self._is_set(register, value):
                self._set(register, value)
        self._turns = self.calibration.turns(self._must(registers.PRESENT_POSITION))

    def _check_errors(self) -> None:
        found = self._must(registers.HARDWARE_ERROR).astype(int)
        for i in np.flatnonzero(found)[:1]:
            raise ServoError(
                f"servo {self._ids[i]} ({self.hand.joint_names[i]}) reports "
                f"{registers.describe_hardware_error(int(found[i]))}; remove the cause, then: "
                f"dexctl hardware check --reboot {self._ids[i]}",
                self._ids[i],
                alert=True,
            )

    def _must(self, register: Register) -> Floats:
        """The register of every servo in SI units; ServoError where one does not answer."""
        return self._answers(register).value

    def _answers(self, register: Register) -> Readings:
        readings = self.bus.read(register, self._ids)
        for _ in range(_PATIENCE):  # nothing moves yet, so there is time to ask again
            if readings.ok.all():
                return readings
            readings = self.bus.read(register, self._ids)
        silent = readings.missing or (self._ids[0],)
        raise ServoError(
            f"no answer from servo {', '.join(map(str, silent))} about {register.name}: check "
            "cable, power and ID",
            silent[0],
            answered=False,
        )

    def _is_set(self, register: Register, value: ArrayLike) -> bool:
        wanted, _, _ = self.bus.to_raw(register, value, self._ids)
        return bool((self._answers(register).raw == wanted).all())

    def _set(self, register: Register, value: ArrayLike) -> None:
        """Write a register of all servos, read it back and compare."""
        wanted, scale, own = self.bus.to_raw(register, value, self._ids)
        for _ in range(_PATIENCE):  # a sync write that got lost shows only here
            self.bus.write(register, value, self._ids)
            found = self._answers(register)
            if (found.raw == wanted).all():
                return
        for i in np.flatnonzero(found.raw != wanted)[:1]:
            raise ServoError(
                f"servo {self._ids[i]} keeps {own[i].name} at {found.value[i]:.6g} "
                f"{own[i].unit} instead of {wanted[i] * scale[i]:.6g}",
                self._ids[i],
            )

    @property
    def _turn_count(self) -> Floats:
        if self._turns is None:
            raise BusError("the hand is not configured: call arm() or configure() first")
        return self._turns

    # reading

    def sample(self) -> JointSample:
        """Ask all servos for current, velocity and position; feeds the bus watchdog.

        Raises:
            PortLost: the port is gone. Servos that do not answer raise nothing.
            BusError: not configured yet.
        """
        current, velocity, position = self.bus.read_many(
            [registers.PRESENT_CURRENT, registers.PRESENT_VELOCITY, registers.PRESENT_POSITION],
            self._ids,
        )
        now = time.monotonic()
        sign, last = self.calibration.sign, self._sample
        q = self.calibration.joint_angle(position.value, self._turn_count)
        fresh = position.ok & np.isfinite(q)
        torque = sign * self.torque_constant * current.value
        rate = sign * velocity.value
        if last is None:
            if not fresh.all():
                silent = [i for i, ok in zip(self._ids, fresh, strict=True) if not ok]
                raise ServoError(f"no answer from servo {silent}", silent[0], answered=False)
            missed, taken = np.zeros(len(q), int), np.full(len(q), now)
        else:
            q = np.where(fresh, q, last.q)
            rate = np.where(fresh, rate, last.velocity)
            torque = np.where(fresh, torque, last.torque)
            missed = np.where(fresh, 0, last.missed + 1)
            taken = np.where(fresh, now, last.taken)
        self._sample = JointSample(q, rate, torque, fresh, missed, position.alert, taken, now)
        return self._sample

    def read(self) -> GraspState:
        """The state now. ``age`` is that of the oldest joint; the object's pose is a tracker's."""
        return self.state(self.sample())

    def state(self, sample: JointSample) -> GraspState:
        """The state with the joints of ``sample`` and the touch of now."""
        touch = self._touch = self.tactile.read()
        self._look()
        known = None if self._pose is None or self._pose.stale else self._pose
        state = GraspState(
            q=sample.q.copy(),
            q_target=(self.q_target if np.isfinite(self.q_target).all() else sample.q).copy(),
            in_contact=touch.in_contact,
            contact_position=touch.position,
            contact_normal=touch.normal,
            contact_force=touch.force,
            object_position=None if known is None else known.position,
            object_quaternion=None if known is None else known.quaternion,
            goal_quaternion=None if self.goal is None else self.goal.copy(),
            goal_angular_velocity=None if self.spin is None else self.spin.copy(),
            gravity=None if self.gravity is None else self.gravity.copy(),
            time=sample.time,
            age=sample.age,
        )
        if self.joint_touch is None:
            return state
        switches = touch.in_contact if self._switches else None
        state = self.joint_touch(state, switches, torque=sample.torque)
        taken, stale = touch.time, touch.stale
        if not self._switches:  # as old as the joints, which are watched by themselves
            taken, stale = np.full_like(taken, sample.taken.min()), np.zeros_like(stale)
        self._touch = TactileReading(
            state.contact_position, state.contact_normal, state.contact_force, taken, stale,
            state.in_contact,
        )  # fmt: skip
        return state

    def listen(self) -> None:
        """Take in what fingertips and tracker have sent: what waits is dated when it is read."""
        self.tactile.read()
        self._look()

    def _look(self) -> None:
        self._pose = None if self.tracker is None else self.tracker.read()

    @property
    def feels(self) -> bool:
        """Whether anything tells of touch: fingertips, or the torques of the joints."""
        return self.joint_touch is not None or not isinstance(self.tactile, NoTactile)

    @property
    def touch(self) -> TactileReading:
        """What the last state had of the fingertips."""
        return self._touch

    @property
    def pose(self) -> TrackedPose | None:
        """What the tracker had said last; None: nothing yet, or nobody tracks."""
        return self._pose

    def health(self) -> Health:
        """How the servos are. One question per call, so it takes three calls to ask them all.

        Raises:
            PortLost: the port is gone.
        """
        turn, self._health_turn = self._health_turn, (self._health_turn + 1) % 3
        health = self._health
        if turn == 0:
            torque, found = self.bus.read_many(
                [registers.TORQUE_ENABLE, registers.HARDWARE_ERROR], self._ids
            )
            limp = torque.ok & (torque.raw == 0)
            self._health = health._replace(error=np.where(found.ok, found.raw, -1), limp=limp)
        elif turn == 1:
            found = self.bus.read(registers.BUS_WATCHDOG, self._ids)
            self._health = health._replace(watchdog=found.ok & (found.raw == -1))
        else:
            voltage, temperature = self.bus.read_many(
                [registers.PRESENT_VOLTAGE, registers.PRESENT_TEMPERATURE], self._ids
            )
            self._health = health._replace(voltage=voltage.value, temperature=temperature.value)
        return self._health

    @property
    def known_health(self) -> Health:
        """What the last calls of `health` found."""
        return self._health

    # writing

    def write(self, q_target: ArrayLike) -> Floats:
        """Send set-points ``(d,)`` [rad]; returns what was sent, after the limits.

        Joints that were asked for NaN or infinity stay where they are; `limited` tells.

        Raises:
            InvalidInput: wrong shape.
            BusError: not armed.
            PortLost: the port is gone.
        """
        asked = np.asarray(q_target, float)
        if asked.shape != self.q_target.shape:
            raise InvalidInput(f"q_target has shape {asked.shape}; expected {self.q_target.shape}")
        if self.torque is not Torque.ON:
            raise BusError(f"set-points go to an armed hand; the torque is {self.torque.value}")
        limited = limit_goal(
            asked,
            self.q_target,
            self.calibration.lower,
            self.calibration.upper,
            self.speed_limit * self.control_period,
        )
        self._send(limited.q_target)
        self._last_limited = limited
        return self.q_target.copy()

    def hold(self) -> None:
        """Send the last set-points once more; feeds the bus watchdog."""
        if self.torque is Torque.ON:
            self._send(self.q_target)

    def _send(self, q_target: Floats) -> None:
        goal = self.calibration.servo_angle(q_target, self._turn_count)
        self.bus.write(registers.GOAL_POSITION, goal, self._ids)
        self.q_target = q_target

    @property
    def limited(self) -> LimitedGoal | None:
        """What the limits did to the last write."""
        return self._last_limited

    def step(self) -> None:
        """Wait for the next multiple of the control period."""
        self._ticker.wait()

    # letting go

    def disarm(self, attempts: int = 10) -> TorqueReport:
        """Torque off, confirmed servo by servo; says what is known.

        Nothing ends it half-way: a Ctrl-C that comes meanwhile counts once the torque is off.
        """
        done = False
        with Interrupts() as meanwhile:
            try:
                self.torque_report = self._let_go(attempts)
                done = True
            finally:
                if self._guard is not None:
                    self._guard.close(done)
                    self._guard = None
        if meanwhile.signal:
            signal.raise_signal(meanwhile.signal)
        return self.torque_report

    def _let_go(self, attempts: int) -> TorqueReport:
        off = np.zeros(len(self._ids), bool)
        reason = ""
        for _ in range(attempts):
            try:
                self.bus.write(registers.TORQUE_ENABLE, np.zeros(len(off)), self._ids)
                found = self.bus.read(registers.TORQUE_ENABLE, self._ids)
            except PortLost as error:
                reason = f" ({error})"
                off[:] = False  # a servo that said so before the cable went is off, but say less
                continue
            except BusError as error:
                reason = f" ({error})"
                continue
            off |= found.ok & (found.raw == 0)
            if off.all():
                break
        if off.all():
            self.torque = Torque.OFF
            return TorqueReport(Torque.OFF, f"torque off, confirmed by all {len(off)} servos")
        self.torque = Torque.UNKNOWN
        unknown = [servo for servo, sure in zip(self._ids, off, strict=True) if not sure]
        ids = ", ".join(map(str, unknown))
        which = f"all servos ({ids})" if len(unknown) == len(off) > 1 else f"servo {ids}"
        return TorqueReport(Torque.UNKNOWN, f"torque state of {which} UNKNOWN: cut power{reason}")

    def __enter__(self) -> ServoHand:
        return self

    def __exit__(self, *_: object) -> None:
        self.disarm()


def _unknown(joints: int) -> Health:
    """Of servos that nobody has asked."""
    nan, no = np.full(joints, np.nan), np.zeros(joints, bool)
    return Health(nan, nan.copy(), np.full(joints, -1), no, no.copy())


def joint_limits(hand: HandModel, limits: Limits) -> tuple[Floats, Floats]:
    """Speed and torque limit of each joint, ``(d,)`` [rad/s], [N m].

    Those asked for, and where the joint's own are lower, its own.
    """
    return np.minimum(limits.speed_limit, hand.velocity), np.minimum(
        limits.torque_limit, hand.effort
    )


def _each(
    gains: ServoGains | SimGains | Sequence[SimGains] | None, count: int
) -> list[ServoGains | SimGains] | None:
    """Gains of each of ``count`` joints."""
    if gains is None:
        return None
    if isinstance(gains, ServoGains | SimGains):
        return [gains] * count
    if len(gains) != count:
        raise InvalidInput(f"{len(gains)} gains; expected one, or one for each of {count} joints")
    return list(gains)
