"""One emulated servo: its model's control table, the rules for writing it, and its errors."""

from __future__ import annotations

import struct

from hardware import registers as R  # noqa: N812 (as short as a table of addresses wants it)
from hardware.emulator.dynamics import (
    STALL_TORQUE,
    UNLIMITED,
    Joints,
    servo_damping,
    servo_stiffness,
)
from hardware.models import XM430_W210, ServoModel
from hardware.registers import ALERT, HardwareError, OperatingMode, Register, StatusError

BOOT_TIME = 0.1  # s of silence after a reboot (ours: the manual gives none)
POWER_LOSS = 0.65  # share of the lowest supply below which the electronics go off (ours)
WATCHDOG_TRIPPED = -1
_GOALS = (R.GOAL_PWM, R.GOAL_CURRENT, R.GOAL_VELOCITY, R.GOAL_POSITION)
_GOAL_ADDRESSES = frozenset(register.address for register in _GOALS)
_PRESENT = struct.Struct("<HBBhhiiii")  # realtime tick (120) to position trajectory (140)
_LIMITED_BY = {
    R.GOAL_PWM.address: R.PWM_LIMIT,
    R.GOAL_CURRENT.address: R.CURRENT_LIMIT,
    R.GOAL_VELOCITY.address: R.VELOCITY_LIMIT,
}


class Servo:
    """Control table and rules of one servo; its shaft is one row of `Joints`.

    Not emulated: drive modes other than 0 (refused), the baud rate (a pseudo-terminal has none),
    indirect addresses, factory reset, the secondary ID.

    Args:
        number: its ID.
        joints: shafts of all servos.
        row: which of them is this servo's.
        zero: ticks that it shows where its shaft is at 0 rad.
        sign: +1 or -1: which way it is mounted.
        model: which servo it is.
    """

    def __init__(
        self,
        number: int,
        joints: Joints,
        row: int,
        zero: int,
        sign: int,
        model: ServoModel = XM430_W210,
    ) -> None:
        self.joints, self.row, self.sign = joints, row, sign
        self.model = model
        self._at = {register.address: register for register in model.registers}
        self._measures_current = R.CURRENT_LIMIT.address in self._at
        # torque per count of the drive, in full voltage's share where there is no current
        self._unit = model.torque_constant * model.register(R.GOAL_CURRENT).scale
        self._zero = zero
        self._turns = 0
        self.table = bytearray(model.registers[-1].end)
        for register in model.registers:
            self.put(register, register.default)
        self.put(R.SERVO_ID, number)
        self.put(R.BAUD_RATE, R.BAUD_RATES.index(4_000_000))
        self.pending: tuple[int, bytes] | None = None
        self.last_heard = 0.0
        self.silent_until = 0.0
        self._shutdown = False
        self._boot()

    # -- table ------------------------------------------------------------------------------

    def get(self, register: Register) -> int:
        """Raw value of a register."""
        at = register.address
        data = self.table[at : at + register.size]
        return int.from_bytes(data, "little", signed=register.signed)

    def put(self, register: Register, raw: int) -> None:
        """Set a raw value, whatever the rules for writing say."""
        self.table[register.address : register.end] = register.encode(raw)

    @property
    def number(self) -> int:
        """Its ID."""
        return self.table[R.SERVO_ID.address]

    @property
    def error(self) -> int:
        """The alert bit of its status packets."""
        return ALERT if self.table[R.HARDWARE_ERROR.address] else 0

    @property
    def return_level(self) -> int:
        """Which instructions it answers: 0 ping, 1 also reads, 2 all."""
        return self.table[R.STATUS_RETURN_LEVEL.address]

    def read(self, address: int, size: int, now: float) -> tuple[int, bytes]:
        """(error byte, data) of ``size`` bytes from ``address``."""
        if size == 0:
            return StatusError.DATA_LENGTH | self.error, b""
        if address + size > len(self.table):
            return StatusError.ACCESS | self.error, b""
        if address + size > R.REALTIME_TICK.address:
            self._show(now)
        return self.error, bytes(self.table[address : address + size])

    def write(self, address: int, data: bytes) -> int:
        """Write all of ``data``, or nothing of it; returns the error byte."""
        fields: list[tuple[Register, int]] = []
        at, end = address, address + len(data)
        if not data:
            return StatusError.DATA_LENGTH | self.error
        while at < end:
            register = self._at.get(at)
            if register is None:
                return StatusError.ACCESS | self.error
            if register.end > end:
                return StatusError.DATA_LENGTH | self.error
            raw = register.decode(data[at - address : register.end - address])
            error = self._refusal(register, raw)
            if error:
                return error | self.error
            fields.append((register, raw))
            at = register.end
        for register, raw in fields:
            self.put(register, raw)
            self._after_write(register, raw)
        if len(fields) == 1 and fields[0][0] == R.GOAL_POSITION:  # what every control step writes
            self.joints.commands.goal[self.row] = self._shaft(fields[0][1])
        else:
            self._command()
        return self.error

    def _refusal(self, register: Register, raw: int) -> int:
        if not register.writable:
            return StatusError.ACCESS
        if register.eeprom and self.table[R.TORQUE_ENABLE.address]:
            return StatusError.ACCESS
        at = register.address
        if at in _GOAL_ADDRESSES and self.get(R.BUS_WATCHDOG) == WATCHDOG_TRIPPED:
            return StatusError.DATA_RANGE
        if not register.low <= raw <= register.high:
            return StatusError.DATA_RANGE
        if at == R.OPERATING_MODE.address and raw not in self._modes:
            return StatusError.DATA_RANGE
        if at == R.DRIVE_MODE.address and raw != 0:
            return StatusError.DATA_RANGE
        if at == R.TORQUE_ENABLE.address and raw and self._shutdown:
            return StatusError.RESULT_FAIL
        if at == R.GOAL_POSITION.address and self.get(R.OPERATING_MODE) == OperatingMode.POSITION:
            low, high = self.get(R.MIN_POSITION_LIMIT), self.get(R.MAX_POSITION_LIMIT)
            return 0 if low <= raw <= high else StatusError.DATA_LIMIT
        bound = _LIMITED_BY.get(register.address)
        if bound is not None and abs(raw) > self.get(bound):
            return StatusError.DATA_LIMIT
        return 0

    def _after_write(self, register: Register, raw: int) -> None:
        if register.address == R.OPERATING_MODE.address:
            # the manual: goals and gains fall back to their defaults
            for other in (R.PROFILE_VELOCITY, R.PROFILE_ACCELERATION):
                self.put(other, other.default)
            self._default_goals()
        elif register.address == R.BUS_WATCHDOG.address:
            self.joints.commands.stopped[self.row] = False

    @property
    def _modes(self) -> tuple[OperatingMode, ...]:
        if self._measures_current:
            return tuple(OperatingMode)
        with_current = (OperatingMode.CURRENT, OperatingMode.CURRENT_BASED_POSITION)
        return tuple(mode for mode in OperatingMode if mode not in with_current)

    # -- the shaft --------------------------------------------------------------------------

    def ticks(self, shaft: float) -> int:
        """Present position [ticks] with the shaft at ``shaft`` [rad]."""
        raw = self._zero + self.sign * shaft / R.RADIANS_PER_TICK
        return round(raw) - R.TICKS_PER_TURN * self._turns + self.get(R.HOMING_OFFSET)

    def _shaft(self, ticks: float) -> float:
        raw = ticks + R.TICKS_PER_TURN * self._turns - self.get(R.HOMING_OFFSET) - self._zero
        return self.sign * raw * R.RADIANS_PER_TICK

    def _show(self, now: float) -> None:
        """Write what is measured into the table."""
        j, i, sign = self.joints, self.row, self.sign
        speed = round(sign * float(j.velocity[i]) / R.RADIANS_PER_SECOND)
        wanted = round(sign * float(j.reference_speed[i]) / R.RADIANS_PER_SECOND)
        drive = sign * float(j.torque[i]) / self.model.torque_constant
        present = self.model.register(R.PRESENT_CURRENT)
        current = min(max(round(drive / present.scale), -32768), 32767)
        moving = abs(speed) > self.table[R.MOVING_THRESHOLD.address]
        _PRESENT.pack_into(
            self.table,
            R.REALTIME_TICK.address,
            int(now * 1000) % 32768,
            moving,
            0,
            min(max(round(885 * float(sign * j.torque[i]) / self.model.stall_torque), -885), 885),
            current,
            _int32(speed),
            _int32(self.ticks(float(j.measured[i]))),
            _int32(wanted),
            _int32(self.ticks(float(j.reference[i]))),
        )

    def _command(self) -> None:
        """Hand what the registers ask for to the joints."""
        c, i = self.joints.commands, self.row
        mode = self.get(R.OPERATING_MODE)
        stopped = self.get(R.BUS_WATCHDOG) == WATCHDOG_TRIPPED
        unit, goal = self._unit, self.get(self.model.register(R.GOAL_CURRENT))
        # a negative goal current bounds the position loop like a positive one (its size counts);
        # what a servo without current control is bounded by in every mode is its goal PWM
        if mode == OperatingMode.CURRENT_BASED_POSITION or not self._measures_current:
            bound = abs(goal)
        else:
            bound = self.get(R.CURRENT_LIMIT)
        goal_current = 0 if stopped else goal
        speed, acceleration = self.get(R.PROFILE_VELOCITY), self.get(R.PROFILE_ACCELERATION)
        c.torque_on[i] = self.table[R.TORQUE_ENABLE.address] != 0
        c.mode[i] = mode
        c.goal[i] = self._shaft(self.get(R.GOAL_POSITION))
        c.goal_speed[i] = self.sign * self.get(R.GOAL_VELOCITY) * R.RADIANS_PER_SECOND
        c.goal_torque[i] = self.sign * goal_current * unit
        duty = 0 if stopped else self.sign * self.get(R.GOAL_PWM) / R.PWM_LIMIT.high
        c.duty[i] = duty * self.model.stall_torque / STALL_TORQUE
        c.kp[i] = servo_stiffness(self.get(R.POSITION_P_GAIN), unit)
        c.kd[i] = servo_damping(self.get(R.POSITION_D_GAIN), unit)
        c.limit[i] = min(bound * unit, self.model.stall_torque)
        c.speed[i] = speed * R.RADIANS_PER_SECOND or UNLIMITED
        c.acceleration[i] = acceleration * R.PROFILE_ACCELERATION.scale or UNLIMITED
        c.stopped[i] = stopped

    # -- errors, watchdog, power --------------------------------------------------------------

    def watch(self, now: float) -> None:
        """Trip the bus watchdog if the bus has been silent for too long."""
        limit = self.get(R.BUS_WATCHDOG)
        if limit <= 0 or not self.table[R.TORQUE_ENABLE.address]:
            return
        if now - self.last_heard > limit * R.BUS_WATCHDOG.scale:
            self.put(R.BUS_WATCHDOG, WATCHDOG_TRIPPED)
            self.put(R.PROFILE_VELOCITY, 0)
            self.put(R.PROFILE_ACCELERATION, 0)
            self._command()

    def fail(self, cause: HardwareError) -> None:
        """Raise a hardware error; torque goes off where the shutdown register says so."""
        self.table[R.HARDWARE_ERROR.address] |= cause
        if self.table[R.SHUTDOWN.address] & cause:
            self._shutdown = True
            self.put(R.TORQUE_ENABLE, 0)
            self._command()

    def set_temperature(self, celsius: int) -> None:
        """Let it measure that temperature; above its limit it overheats."""
        self.put(R.PRESENT_TEMPERATURE, celsius)
        if celsius > self.get(R.TEMPERATURE_LIMIT):
            self.fail(HardwareError.OVERHEATING)

    def set_voltage(self, volts: float, now: float) -> None:
        """Let it measure that voltage; out of its limits it reports it, without power it resets."""
        before = self.get(R.PRESENT_VOLTAGE)
        raw = round(volts / R.PRESENT_VOLTAGE.scale)
        self.put(R.PRESENT_VOLTAGE, raw)
        lost = POWER_LOSS * self.model.voltage[0]
        if volts < lost:
            self.silent_until = float("inf")
            self.put(R.TORQUE_ENABLE, 0)
            self._command()
        elif before * R.PRESENT_VOLTAGE.scale < lost:
            self.reboot(now)
        elif not self.get(R.MIN_VOLTAGE_LIMIT) <= raw <= self.get(R.MAX_VOLTAGE_LIMIT):
            self.fail(HardwareError.INPUT_VOLTAGE)

    def reboot(self, now: float) -> None:
        """Start anew: torque off, RAM at its defaults, turns forgotten."""
        self._boot()
        self.silent_until = now + BOOT_TIME
        self.last_heard = now

    def clear_turns(self) -> None:
        """Forget the turns: the present position becomes less than one."""
        shown = self.ticks(float(self.joints.q[self.row])) - self.get(R.HOMING_OFFSET)
        self._turns += shown // R.TICKS_PER_TURN
        self._default_goals()
        self._command()

    def _boot(self) -> None:
        keep = (R.PRESENT_VOLTAGE.name, R.PRESENT_TEMPERATURE.name)
        for register in self.model.registers:
            if not register.eeprom and register.name not in keep:
                self.put(register, register.default)
        self.pending = None
        self._shutdown = False
        self.clear_turns()
        if self.get(R.PRESENT_TEMPERATURE) > self.get(R.TEMPERATURE_LIMIT):
            self.fail(HardwareError.OVERHEATING)

    def _default_goals(self) -> None:
        self.put(R.GOAL_POSITION, _int32(self.ticks(float(self.joints.q[self.row]))))
        if self._measures_current:
            self.put(R.GOAL_CURRENT, self.get(R.CURRENT_LIMIT))
        self.put(R.GOAL_VELOCITY, self.get(R.VELOCITY_LIMIT))
        self.put(R.GOAL_PWM, self.get(R.PWM_LIMIT))


def _int32(value: int) -> int:
    return min(max(value, -(1 << 31)), (1 << 31) - 1)
