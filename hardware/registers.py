"""The control table of the Dynamixel XM430-W210 as typed registers with SI units.

Addresses, sizes, ranges and defaults are those of the maker's manual (Robotis e-Manual,
XM430-W210, "Control Table"). On the wire every register is a little-endian integer, its *raw*
value; `Register.to_si` and `Register.to_raw` convert between that and SI units.

Registers below address 64 lie in EEPROM: they keep their values without power and can be written
only while torque is off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.state import Floats

MODEL_NUMBER = 1030
FIRST_RAM_ADDRESS = 64
TICKS_PER_TURN = 4096
RADIANS_PER_TICK = 2 * math.pi / TICKS_PER_TURN  # 1.534 mrad
RADIANS_PER_SECOND = 0.229 * 2 * math.pi / 60  # of one velocity unit, 0.229 rpm: 0.024 rad/s
AMPERES = 2.69e-3  # of one current unit
MULTI_TURN = 1_048_575  # +-256 turns, the goal range of modes that count turns
ALERT = 0x80  # bit of a status packet's error byte: the hardware error register is not 0


class OperatingMode(IntEnum):
    """Values of the operating mode register."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


class HardwareError(IntFlag):
    """Bits of the hardware error register; the shutdown register uses the same ones."""

    INPUT_VOLTAGE = 1
    OVERHEATING = 4
    MOTOR_ENCODER = 8
    ELECTRICAL_SHOCK = 16
    OVERLOAD = 32


class StatusError(IntEnum):
    """Error numbers of a status packet, below the alert bit."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


_HARDWARE_TEXT = {
    HardwareError.INPUT_VOLTAGE: "input voltage out of range",
    HardwareError.OVERHEATING: "overheating",
    HardwareError.MOTOR_ENCODER: "motor encoder broken",
    HardwareError.ELECTRICAL_SHOCK: "electrical shock, or too little power for the motor",
    HardwareError.OVERLOAD: "overload: load above what the servo stands lasted too long",
}
_STATUS_TEXT = {
    StatusError.RESULT_FAIL: "the servo could not carry out the instruction",
    StatusError.INSTRUCTION: "unknown instruction",
    StatusError.CRC: "the servo received a damaged packet",
    StatusError.DATA_RANGE: "value out of the register's range, or goals locked by the watchdog",
    StatusError.DATA_LENGTH: "wrong number of bytes",
    StatusError.DATA_LIMIT: "value outside a limit register",
    StatusError.ACCESS: "register is read-only, or locked while torque is on",
}


def describe_hardware_error(raw: int) -> str:
    """The causes in a hardware error register, for people; empty for 0."""
    texts = [text for bit, text in _HARDWARE_TEXT.items() if raw & bit]
    unknown = raw & ~int(sum(HardwareError)) & 0xFF
    return "; ".join(texts + ([f"unknown bits 0x{unknown:02X}"] if unknown else []))


def describe_status_error(error: int) -> str:
    """The error byte of a status packet, for people; empty for 0."""
    number = error & ~ALERT
    texts = []
    if number:
        known = _STATUS_TEXT.get(StatusError(number)) if number <= 7 else None
        texts.append(known or f"unknown status error {number}")
    if error & ALERT:
        texts.append("the servo reports a hardware error (register 70)")
    return "; ".join(texts)


@dataclass(frozen=True)
class Register:
    """One entry of the control table.

    Attributes:
        name: in snake case, after the manual.
        address: of the first byte.
        size: bytes: 1, 2 or 4.
        signed: whether the raw value is two's complement.
        scale: SI units per raw unit.
        unit: that SI unit, for people; empty for counts, switches and bit fields.
        writable: whether the servo takes writes at all.
        low, high: range of raw values that the servo takes.
        default: raw value in a new servo (EEPROM), or after power-on (RAM).
    """

    name: str
    address: int
    size: int
    signed: bool
    scale: float
    unit: str
    writable: bool
    low: int
    high: int
    default: int

    @property
    def eeprom(self) -> bool:
        """Whether it is locked while torque is on."""
        return self.address < FIRST_RAM_ADDRESS

    @property
    def end(self) -> int:
        """The address after its last byte."""
        return self.address + self.size

    def to_si(self, raw: ArrayLike) -> Floats:
        """SI values of raw ones, ``(...)`` to ``(...)``."""
        return np.asarray(raw, np.float64) * self.scale

    def to_raw(self, value: ArrayLike) -> np.ndarray:
        """Raw values ``(...)`` int64, rounded to the nearest, of SI ones ``(...)``.

        Raises:
            InvalidInput: not finite, or out of the register's range.
        """
        si = np.asarray(value, np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            raw = np.rint(si / self.scale)
            good = (raw >= self.low) & (raw <= self.high)  # False for NaN
        if not good.all():
            bad = np.atleast_1d(si)[~np.atleast_1d(good)][0]
            unit = f" {self.unit}" if self.unit else ""
            low, high = self.low * self.scale, self.high * self.scale
            raise InvalidInput(
                f"{self.name} is {bad}; expected a number from {low:.6g} to {high:.6g}{unit}"
            )
        return raw.astype(np.int64)

    def encode(self, raw: int) -> bytes:
        """The bytes of a raw value on the wire."""
        return int(raw).to_bytes(self.size, "little", signed=raw < 0)

    def decode(self, data: bytes) -> int:
        """The raw value of ``size`` bytes from the wire."""
        return int.from_bytes(data, "little", signed=self.signed)


class _Quantity(NamedTuple):
    scale: float
    unit: str


_COUNT = _Quantity(1.0, "")


def _register(
    name: str,
    address: int,
    size: int,
    *,
    low: int = 0,
    high: int = 0,
    default: int = 0,
    signed: bool = False,
    quantity: _Quantity = _COUNT,
    writable: bool = True,
) -> Register:
    scale, unit = quantity
    return Register(name, address, size, signed, scale, unit, writable, low, high, default)


def _shown(
    name: str,
    address: int,
    size: int,
    default: int = 0,
    *,
    signed: bool = False,
    quantity: _Quantity = _COUNT,
) -> Register:
    """A read-only register: it may show whatever its bytes can hold."""
    bits = 8 * size
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    scale, unit = quantity
    return Register(name, address, size, signed, scale, unit, False, low, high, default)


_VELOCITY = _Quantity(RADIANS_PER_SECOND, "rad/s")
_POSITION = _Quantity(RADIANS_PER_TICK, "rad")
_CURRENT = _Quantity(AMPERES, "A")
_VOLTAGE = _Quantity(0.1, "V")
# 214.577 rev/min^2 per unit
_ACCELERATION = _Quantity(214.577 * 2 * math.pi / 3600, "rad/s^2")
_PWM = _Quantity(1 / 885, "of full voltage")

MODEL = _shown("model_number", 0, 2, MODEL_NUMBER)
MODEL_INFORMATION = _shown("model_information", 2, 4)
FIRMWARE = _shown("firmware_version", 6, 1, 48)
SERVO_ID = _register("id", 7, 1, high=252, default=1)
BAUD_RATE = _register("baud_rate", 8, 1, high=7, default=1)
RETURN_DELAY = _register(
    "return_delay_time", 9, 1, high=254, default=250, quantity=_Quantity(2e-6, "s")
)
DRIVE_MODE = _register("drive_mode", 10, 1, high=13)
OPERATING_MODE = _register("operating_mode", 11, 1, high=16, default=3)
SECONDARY_ID = _register("secondary_id", 12, 1, high=255, default=255)
PROTOCOL_TYPE = _register("protocol_type", 13, 1, low=1, high=2, default=2)
HOMING_OFFSET = _register(
    "homing_offset", 20, 4, low=-1_044_479, high=1_044_479, signed=True, quantity=_POSITION
)
MOVING_THRESHOLD = _register("moving_threshold", 24, 4, high=1023, default=10, quantity=_VELOCITY)
TEMPERATURE_LIMIT = _register(
    "temperature_limit", 31, 1, high=100, default=80, quantity=_Quantity(1.0, "C")
)
MAX_VOLTAGE_LIMIT = _register(
    "max_voltage_limit", 32, 2, low=95, high=160, default=160, quantity=_VOLTAGE
)
MIN_VOLTAGE_LIMIT = _register(
    "min_voltage_limit", 34, 2, low=95, high=160, default=95, quantity=_VOLTAGE
)
PWM_LIMIT = _register("pwm_limit", 36, 2, high=885, default=885, quantity=_PWM)
CURRENT_LIMIT = _register("current_limit", 38, 2, high=1193, default=1193, quantity=_CURRENT)
VELOCITY_LIMIT = _register("velocity_limit", 44, 4, high=1023, default=330, quantity=_VELOCITY)
MAX_POSITION_LIMIT = _register(
    "max_position_limit", 48, 4, high=4095, default=4095, quantity=_POSITION
)
MIN_POSITION_LIMIT = _register("min_position_limit", 52, 4, high=4095, quantity=_POSITION)
SHUTDOWN = _register("shutdown", 63, 1, high=255, default=52)
TORQUE_ENABLE = _register("torque_enable", 64, 1, high=1)
LED = _register("led", 65, 1, high=1)
STATUS_RETURN_LEVEL = _register("status_return_level", 68, 1, high=2, default=2)
REGISTERED_INSTRUCTION = _shown("registered_instruction", 69, 1)
HARDWARE_ERROR = _shown("hardware_error_status", 70, 1)
VELOCITY_I_GAIN = _register("velocity_i_gain", 76, 2, default=1920, high=16383)
VELOCITY_P_GAIN = _register("velocity_p_gain", 78, 2, default=100, high=16383)
POSITION_D_GAIN = _register("position_d_gain", 80, 2, high=16383)
POSITION_I_GAIN = _register("position_i_gain", 82, 2, high=16383)
POSITION_P_GAIN = _register("position_p_gain", 84, 2, default=800, high=16383)
FEEDFORWARD_2ND_GAIN = _register("feedforward_2nd_gain", 88, 2, high=16383)
FEEDFORWARD_1ST_GAIN = _register("feedforward_1st_gain", 90, 2, high=16383)
# reads -1 once it has tripped; only writing 0 clears it
BUS_WATCHDOG = _register(
    "bus_watchdog", 98, 1, high=127, signed=True, quantity=_Quantity(0.02, "s")
)
GOAL_PWM = _register("goal_pwm", 100, 2, low=-885, high=885, signed=True, quantity=_PWM)
GOAL_CURRENT = _register(
    "goal_current", 102, 2, low=-1193, high=1193, signed=True, quantity=_CURRENT
)
GOAL_VELOCITY = _register(
    "goal_velocity", 104, 4, low=-1023, high=1023, signed=True, quantity=_VELOCITY
)
PROFILE_ACCELERATION = _register("profile_acceleration", 108, 4, high=32767, quantity=_ACCELERATION)
PROFILE_VELOCITY = _register("profile_velocity", 112, 4, high=32767, quantity=_VELOCITY)
GOAL_POSITION = _register(
    "goal_position", 116, 4, low=-MULTI_TURN, high=MULTI_TURN, signed=True, quantity=_POSITION
)
REALTIME_TICK = _shown("realtime_tick", 120, 2, quantity=_Quantity(1e-3, "s"))
MOVING = _shown("moving", 122, 1)
MOVING_STATUS = _shown("moving_status", 123, 1)
PRESENT_PWM = _shown("present_pwm", 124, 2, signed=True, quantity=_PWM)
PRESENT_CURRENT = _shown("present_current", 126, 2, signed=True, quantity=_CURRENT)
PRESENT_VELOCITY = _shown("present_velocity", 128, 4, signed=True, quantity=_VELOCITY)
PRESENT_POSITION = _shown("present_position", 132, 4, signed=True, quantity=_POSITION)
VELOCITY_TRAJECTORY = _shown("velocity_trajectory", 136, 4, signed=True, quantity=_VELOCITY)
POSITION_TRAJECTORY = _shown("position_trajectory", 140, 4, signed=True, quantity=_POSITION)
PRESENT_VOLTAGE = _shown("present_input_voltage", 144, 2, 120, quantity=_VOLTAGE)
PRESENT_TEMPERATURE = _shown("present_temperature", 146, 1, 25, quantity=_Quantity(1.0, "C"))

REGISTERS: tuple[Register, ...] = tuple(
    sorted(
        (value for value in list(globals().values()) if isinstance(value, Register)),
        key=lambda register: register.address,
    )
)
TABLE_SIZE = REGISTERS[-1].end
BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
_BY_NAME = {register.name: register for register in REGISTERS}


def register(name: str) -> Register:
    """The register of that name.

    Raises:
        UnknownName: no such register.
    """
    if name not in _BY_NAME:
        raise UnknownName("register", name, _BY_NAME)
    return _BY_NAME[name]
