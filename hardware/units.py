"""Between MuJoCo's position actuators and the position loop of the servos, both ways.

MuJoCo: torque = kp (q_target - q) - kv q', clipped to a force range, in SI units. Servo: in
current-based position mode,

    current = P/128 (goal - present) - D/16 speed,      |current| <= goal current

with P and D from the gain registers (divisors from the maker's manual). The manual does not say in
which units the two terms count. Assumed here: error in ticks, speed in ticks per millisecond,
result in the servo's current units, 2.69 mA for an XM430 (in PWM units where a servo measures no
current). `LoopScale` holds this assumption as two numbers, so that a
step response on a real servo can correct them; P = 1139 and P = 3600 then mean what they mean on
that servo, not on another one's table of defaults.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dexctl.exceptions import InvalidInput
from dexctl.validation import check_numbers
from hardware import registers as R  # noqa: N812 (a table of names)

P_DIVISOR = 128
D_DIVISOR = 16
TORQUE_CONSTANT = 1.3  # N m/A: 3.0 N m stall torque at 2.3 A, 12 V
MILLISECOND = 1e-3


@dataclass(frozen=True, kw_only=True)
class LoopScale:
    """What a servo makes of its gain registers.

    The drive is a current [A], or the share of full voltage where a servo measures no current.

    Attributes:
        torque_constant: torque per drive, a field of the calibration [N m/A], [N m].
        position: drive per tick of error at a proportional gain of one.
        speed: drive per tick/ms of speed at a derivative gain of one.
    """

    torque_constant: float = TORQUE_CONSTANT
    position: float = R.AMPERES
    speed: float = R.AMPERES

    def __post_init__(self) -> None:
        check_numbers(self, positive=("torque_constant", "position", "speed"))

    @property
    def stiffness(self) -> float:
        """Torque per radian of error, for each count of the P register [N m/rad]."""
        return self.torque_constant * self.position / R.RADIANS_PER_TICK / P_DIVISOR

    @property
    def damping(self) -> float:
        """Torque per rad/s, for each count of the D register [N m s/rad]."""
        return self.torque_constant * self.speed * MILLISECOND / R.RADIANS_PER_TICK / D_DIVISOR


class SimGains(NamedTuple):
    """A MuJoCo position actuator, and how fast its set-point may move.

    Attributes:
        kp: [N m/rad].
        kv: [N m s/rad].
        torque_limit: [N m].
        speed_limit: [rad/s]; 0 is none.
    """

    kp: float
    kv: float
    torque_limit: float
    speed_limit: float


class ServoGains(NamedTuple):
    """Raw register values of a servo in current-based position mode.

    Attributes:
        p: position P gain.
        d: position D gain.
        current: what bounds the drive: goal current, or goal PWM.
        profile_velocity: 0 is unlimited.
    """

    p: int
    d: int
    current: int
    profile_velocity: int


def to_servo(
    gains: SimGains, scale: LoopScale | None = None, limit: R.Register = R.CURRENT_LIMIT
) -> ServoGains:
    """Register values that make a servo behave like a MuJoCo actuator, each rounded to the nearest.

    Args:
        gains: of the actuator.
        scale: of the servo; default: the assumption at the head of this module.
        limit: the register that bounds the servo's drive.

    Raises:
        InvalidInput: a number that is not finite, is negative, or that no register can hold.
    """
    scale = scale if scale is not None else LoopScale()
    unit = scale.torque_constant * limit.scale
    return ServoGains(
        p=_register("kp", gains.kp, scale.stiffness, R.POSITION_P_GAIN, "N m/rad"),
        d=_register("kv", gains.kv, scale.damping, R.POSITION_D_GAIN, "N m s/rad"),
        current=_register("torque_limit", gains.torque_limit, unit, limit, "N m"),
        profile_velocity=_register(
            "speed_limit", gains.speed_limit, R.RADIANS_PER_SECOND, R.PROFILE_VELOCITY, "rad/s"
        ),
    )


def to_sim(registers: ServoGains, scale: LoopScale | None = None) -> SimGains:
    """The MuJoCo actuator that behaves like a servo with these register values."""
    scale = scale if scale is not None else LoopScale()
    return SimGains(
        kp=registers.p * scale.stiffness,
        kv=registers.d * scale.damping,
        torque_limit=abs(registers.current) * R.AMPERES * scale.torque_constant,
        speed_limit=registers.profile_velocity * R.RADIANS_PER_SECOND,
    )


def _register(name: str, value: float, unit: float, register: R.Register, si: str) -> int:
    most = register.high * unit
    if not 0 <= value <= most:  # False for NaN
        raise InvalidInput(f"{name} is {value}; expected 0 to {most:.4g} {si} ({register.name})")
    raw = round(value / unit)
    if value > 0 and raw == 0:
        raise InvalidInput(
            f"{name} is {value}; the least that {register.name} can hold is {unit:.2g} {si}"
        )
    return raw
