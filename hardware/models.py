"""The servo models that are known: how their control tables differ from the XM430-W210's.

All of them have the registers of `hardware.registers` at the same addresses; units, ranges and
defaults differ, and an XL430-W250 measures no current. Numbers are those of the maker's manual
(Robotis e-Manual, page of each model, "Specifications" and "Control Table"; docs/hardware.md names
the pages). A servo says by its model number which of them it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from dexctl.exceptions import InvalidInput, UnknownName
from hardware import registers as R  # noqa: N812 (a table of names)
from hardware.registers import OperatingMode, Register
from hardware.units import TORQUE_CONSTANT, LoopScale

MILLIAMPERE = 1e-3
RPM = 2 * math.pi / 60
_COOLER = 10.0  # degC below its shutdown at which a servo is warned of


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoModel:
    """A servo model.

    What drives the motor is its current, or, where the servo measures none, the share of the full
    voltage; both are called *drive* here, and `torque_constant` makes a torque of it.

    Attributes:
        name: as the maker writes it.
        number: what its model number register says.
        mode: operating mode for a hand: position over several turns, with a bounded drive.
        torque_constant: stall torque over the drive that it takes [N m/A], or [N m] at full drive.
        stall_torque: at the voltage recommended [N m].
        no_load_speed: at that voltage [rad/s].
        supply: the voltage recommended [V].
        voltage: lowest and highest supply [V].
        table: by the name of an XM430-W210's register, the one that is in its place.
    """

    name: str
    number: int
    mode: OperatingMode = OperatingMode.CURRENT_BASED_POSITION
    torque_constant: float
    stall_torque: float
    no_load_speed: float
    supply: float
    voltage: tuple[float, float]
    table: Mapping[str, Register]

    def register(self, register: Register) -> Register:
        """The register of this model that does what ``register`` does in an XM430-W210.

        Raises:
            InvalidInput: it has none.
        """
        found = self.table.get(register.name)
        if found is None:
            raise InvalidInput(f"an {self.name} has no register {register.name}")
        return found

    @property
    def registers(self) -> tuple[Register, ...]:
        """Its control table, by address."""
        return tuple(sorted(set(self.table.values()), key=lambda register: register.address))

    @property
    def loop(self) -> LoopScale:
        """What it makes of its gain registers, by the assumption of `hardware.units`."""
        unit = self.register(R.GOAL_CURRENT).scale
        return LoopScale(torque_constant=self.torque_constant, position=unit, speed=unit)

    @property
    def hot(self) -> float:
        """From which temperature on is warned [degC]: 10 below where a new one shuts down."""
        return self.register(R.TEMPERATURE_LIMIT).default - _COOLER


def _table(number: int, *changed: Register, **instead: Register) -> Mapping[str, Register]:
    """The XM430-W210's registers with some changed, and some in others' place."""
    table = {register.name: register for register in R.REGISTERS}
    table |= {register.name: register for register in changed}
    table[R.MODEL.name] = replace(R.MODEL, default=number)
    return MappingProxyType(table | instead)


def _both(register: Register, high: int, **more: float) -> Register:
    return replace(register, low=-high, high=high, **more)


def _default(register: Register, raw: int) -> Register:
    return replace(register, default=raw)


def _range(register: Register, low: int, high: int, default: int) -> Register:
    return replace(register, low=low, high=high, default=default)


def _x330(limit: int, velocity: int, volts: tuple[int, int, int], gains: tuple[int, int, int],
          shutdown: int, supply: float) -> tuple[Register, ...]:  # fmt: skip
    """What XC330 and XL330 have in common against the XM430: current in mA, faster, cooler.

    Args:
        limit: of the current [mA].
        velocity: default of the velocity limit.
        volts: lowest, highest, and default of the lower limit [0.1 V].
        gains: velocity I and P, position P.
        shutdown: default of that register.
        supply: what a new servo shows [V].
    """
    low, high, least = volts
    return (
        replace(R.BAUD_RATE, high=6),
        replace(R.DRIVE_MODE, high=5),
        _range(R.PROTOCOL_TYPE, 2, 22, 2),
        _default(R.TEMPERATURE_LIMIT, 70),
        _range(R.MAX_VOLTAGE_LIMIT, low, high, high),
        _range(R.MIN_VOLTAGE_LIMIT, low, high, least),
        replace(R.CURRENT_LIMIT, high=limit, default=limit, scale=MILLIAMPERE),
        replace(R.VELOCITY_LIMIT, high=2047, default=velocity),
        _default(R.SHUTDOWN, shutdown),
        _default(R.VELOCITY_I_GAIN, gains[0]),
        _default(R.VELOCITY_P_GAIN, gains[1]),
        _default(R.POSITION_P_GAIN, gains[2]),
        _both(R.GOAL_CURRENT, limit, scale=MILLIAMPERE),
        _both(R.GOAL_VELOCITY, 2047),
        replace(R.PRESENT_CURRENT, scale=MILLIAMPERE),
        _default(R.PRESENT_VOLTAGE, round(10 * supply)),
    )


PRESENT_LOAD = Register("present_load", 126, 2, True, 1e-3, "of full torque", False, -1000, 1000, 0)
"""Of an XL430-W250, at the address of the others' present current; inferred, not measured."""

XM430_W210 = ServoModel(
    name="XM430-W210",
    number=R.MODEL_NUMBER,
    torque_constant=TORQUE_CONSTANT,  # 3.0 N m at 2.3 A
    stall_torque=3.0,
    no_load_speed=77 * RPM,
    supply=12.0,
    voltage=(10.0, 14.8),
    table=_table(R.MODEL_NUMBER),
)
XM430_W350 = ServoModel(
    name="XM430-W350",
    number=1020,
    torque_constant=1.78,  # 4.1 N m at 2.3 A
    stall_torque=4.1,
    no_load_speed=46 * RPM,
    supply=12.0,
    voltage=(10.0, 14.8),
    table=_table(1020, _default(R.VELOCITY_LIMIT, 200)),
)
XC330_T288 = ServoModel(
    name="XC330-T288",
    number=1220,
    torque_constant=1.15,  # 0.92 N m at 0.80 A, measured at the supply, not at the motor
    stall_torque=0.92,
    no_load_speed=65 * RPM,
    supply=11.1,
    voltage=(6.5, 12.0),
    table=_table(1220, *_x330(910, 320, (55, 140, 55), (1200, 40, 900), 52, 11.1)),
)
XL330_M288 = ServoModel(
    name="XL330-M288",
    number=1200,
    torque_constant=0.354,  # 0.52 N m at 1.47 A
    stall_torque=0.52,
    no_load_speed=103 * RPM,
    supply=5.0,
    voltage=(3.7, 6.0),
    table=_table(1200, *_x330(1750, 445, (31, 70, 35), (1600, 180, 400), 53, 5.0)),
)
XL430_W250 = ServoModel(
    name="XL430-W250",
    number=1060,
    mode=OperatingMode.EXTENDED_POSITION,  # it has no current-based one
    torque_constant=1.4,  # N m at full voltage
    stall_torque=1.4,
    no_load_speed=57 * RPM,
    supply=11.1,
    voltage=(6.5, 12.0),
    table=_table(
        1060,
        _default(R.TEMPERATURE_LIMIT, 72),
        _range(R.MAX_VOLTAGE_LIMIT, 60, 140, 140),
        _range(R.MIN_VOLTAGE_LIMIT, 60, 140, 60),
        _default(R.VELOCITY_LIMIT, 265),
        _default(R.VELOCITY_I_GAIN, 1000),
        _default(R.POSITION_D_GAIN, 4000),
        _default(R.POSITION_P_GAIN, 640),
        _default(R.PRESENT_VOLTAGE, 111),
        present_load=PRESENT_LOAD,
        current_limit=R.PWM_LIMIT,
        goal_current=R.GOAL_PWM,
        present_current=PRESENT_LOAD,
    ),
)
MODELS = (XM430_W210, XM430_W350, XC330_T288, XL330_M288, XL430_W250)
BY_NUMBER: Mapping[int, ServoModel] = MappingProxyType({model.number: model for model in MODELS})


def model(name: str) -> ServoModel:
    """The model of that name.

    Raises:
        UnknownName: none of those that are known.
    """
    for known in MODELS:
        if known.name == name:
            return known
    raise UnknownName("servo model", name, [known.name for known in MODELS])


def known_numbers() -> str:
    """The models and their numbers, for people."""
    return ", ".join(f"{known.name} ({known.number})" for known in MODELS)
