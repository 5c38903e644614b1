"""Calibration: how the joints of a hand lie on its servos, kept in a TOML file.

Joint angle q and servo angle s (as the register reads, multi-turn) are related by::

    s = zero + sign * q + 2 pi * turns

``sign`` and ``zero`` belong to how the horn is mounted; ``turns`` is found anew at each start,
because a servo that lost power counts from its first turn again.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexctl import HandModel
from dexctl.exceptions import InvalidInput
from dexctl.state import Floats

TURN = 2.0 * np.pi
_COLUMNS = ("name", "servo", "sign", "zero", "lower", "upper", "torque_constant")


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """The servos of a hand's d joints, in the order of the joints.

    Attributes:
        hand: name of the hand.
        joint_names: d names.
        servo: ID on the bus, ``(d,)`` int, 0 to 252.
        sign: +1 where the joint turns with its servo, -1 where against it, ``(d,)`` int.
        zero: servo angle at joint angle 0, ``(d,)`` [rad].
        lower, upper: joint range that set-points stay in, ``(d,)`` [rad].
        torque_constant: torque per current, ``(d,)`` [N m/A]; torque at full voltage [N m] where a
            servo measures no current; NaN: that of the servo's model, by its data sheet.
        date: when it was measured.

    Raises:
        InvalidInput: a value out of range; names the joint.
    """

    hand: str
    joint_names: tuple[str, ...]
    servo: NDArray[np.int64]
    sign: NDArray[np.int64]
    zero: Floats
    lower: Floats
    upper: Floats
    torque_constant: Floats
    date: datetime = field(default_factory=lambda: datetime.now(UTC).replace(microsecond=0))

    def __post_init__(self) -> None:
        count = len(self.joint_names)
        if len(set(self.joint_names)) != count or not count:
            raise InvalidInput(f"joint_names is {self.joint_names}; expected different names")
        for name, kind in (("servo", int), ("sign", int), ("zero", float), ("lower", float),
                           ("upper", float), ("torque_constant", float)):  # fmt: skip
            value = np.asarray(getattr(self, name))
            if value.shape != (count,) or value.dtype.kind not in ("i" if kind is int else "if"):
                raise InvalidInput(f"{name} is {value}; expected {count} {kind.__name__} values")
            object.__setattr__(self, name, value.astype(kind))
        for name, good, wanted in (
            ("servo", (self.servo >= 0) & (self.servo <= 252), "an ID from 0 to 252"),
            ("sign", np.abs(self.sign) == 1, "1 or -1"),
            ("zero", np.isfinite(self.zero), "a finite angle [rad]"),
            ("lower", np.isfinite(self.lower), "a finite angle [rad]"),
            ("upper", np.isfinite(self.upper) & (self.upper > self.lower), "above lower"),
            ("upper", self.upper - self.lower < TURN, "less than a turn above lower"),
            ("torque_constant", ~(self.torque_constant <= 0) & ~np.isinf(self.torque_constant),
             "above 0, or nan for that of the servo's model"),
        ):  # fmt: skip
            for i in np.flatnonzero(~good)[:1]:
                raise InvalidInput(
                    f"{name} of joint {self.joint_names[i]} is {getattr(self, name)[i]}; "
                    f"expected {wanted}"
                )
        servos, uses = np.unique(self.servo, return_counts=True)
        if (uses > 1).any():
            raise InvalidInput(f"servo {servos[uses > 1][0]} has several joints; expected one each")

    @classmethod
    def nominal(cls, hand: HandModel, servo: Sequence[int] | None = None) -> Calibration:
        """Servos mounted so that joint angle 0 is the middle of a turn (2048 ticks).

        Args:
            hand: the model.
            servo: IDs of its joints, d of them; default 1 to d.
        """
        ones = np.ones(hand.nq)
        return cls(
            hand=hand.name,
            joint_names=tuple(hand.joint_names),
            servo=np.arange(1, hand.nq + 1) if servo is None else np.asarray(servo, int),
            sign=ones.astype(int),
            zero=np.pi * ones,
            lower=hand.lower,
            upper=hand.upper,
            torque_constant=np.nan * ones,
        )

    def check(self, hand: HandModel) -> Calibration:
        """Itself, if it is of ``hand``: the same joints, ranges within the hand's.

        Raises:
            InvalidInput: it is not.
        """
        if self.joint_names != tuple(hand.joint_names):
            raise InvalidInput(
                f"the calibration has the joints {', '.join(self.joint_names)}; the hand has "
                f"{', '.join(hand.joint_names)}"
            )
        outside = (self.lower < hand.lower - 1e-9) | (self.upper > hand.upper + 1e-9)
        for i in np.flatnonzero(outside)[:1]:
            raise InvalidInput(
                f"the range of {self.joint_names[i]} is {self.lower[i]:.3f} to "
                f"{self.upper[i]:.3f} rad; the hand allows {hand.lower[i]:.3f} to "
                f"{hand.upper[i]:.3f}"
            )
        return self

    def turns(self, servo_angle: Floats, tolerance: float = 0.1) -> Floats:
        """The turn that each servo is in, ``(d,)`` whole numbers.

        Of the turns possible the one that puts the joint nearest to the middle of its range: so
        it does not matter where in the travel the servo's count wraps.

        Raises:
            InvalidInput: a joint would then still be out of its range by more than ``tolerance``
                [rad]: the zero is wrong, or the joint was pushed beyond its range.
        """
        middle = 0.5 * (self.lower + self.upper)
        turns = np.round((servo_angle - self.zero - self.sign * middle) / TURN)
        q = self.joint_angle(servo_angle, turns)
        wrong = ~((q >= self.lower - tolerance) & (q <= self.upper + tolerance))
        for i in np.flatnonzero(wrong)[:1]:
            raise InvalidInput(
                f"{self.joint_names[i]} (servo {self.servo[i]}) stands at {q[i]:.3f} rad, out of "
                f"its range {self.lower[i]:.3f} to {self.upper[i]:.3f}: move it by hand, or "
                "calibrate again"
            )
        return turns

    def joint_angle(self, servo_angle: Floats, turns: Floats) -> Floats:
        """Joint angles ``(d,)`` [rad] of servo angles."""
        return self.sign * (servo_angle - self.zero - TURN * turns)

    def servo_angle(self, q: Floats, turns: Floats) -> Floats:
        """Servo angles ``(d,)`` [rad] of joint angles; the inverse of `joint_angle`."""
        return self.zero + self.sign * q + TURN * turns

    def save(self, path: str | Path) -> None:
        """Write the TOML file, whole or not at all."""
        from dexctl.files import write_text

        lines = [
            "# Joint angle 0 is at servo angle `zero` [rad]; `sign` is -1 where they turn against",
            "# each other; range [rad] of the joint; torque_constant [N m/A], nan: the model's.",
            f'hand = "{self.hand}"',
            f"date = {self.date.isoformat()}",
        ]
        for i, name in enumerate(self.joint_names):
            lines += ["", "[[joint]]", f'name = "{name}"']
            lines += [f"{key} = {getattr(self, key)[i].item()!r}" for key in _COLUMNS[1:]]
        write_text(Path(path).expanduser(), "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a file that :meth:`save` wrote.

        Raises:
            InvalidInput: there is none, or it says something that cannot be.
        """
        path = Path(path).expanduser()
        try:
            content = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise InvalidInput(f"{path} is no calibration file: {error}") from None
        try:
            return cls(**_columns(content))
        except InvalidInput as error:
            raise InvalidInput(f"{path}: {error}") from None

    def with_joint(self, joint: int, **values: float) -> Calibration:
        """A copy dated now, with ``sign``, ``zero``, ``lower``... of one joint changed."""
        changed: dict[str, Any] = {}
        for name, value in values.items():
            column = getattr(self, name).copy()
            column[joint] = value
            changed[name] = column
        return replace(self, **changed, date=datetime.now(UTC).replace(microsecond=0))


def _columns(content: Mapping[str, Any]) -> dict[str, Any]:
    joints, date, hand = (content.get(name) for name in ("joint", "date", "hand"))
    for key in content.keys() - {"joint", "date", "hand"}:
        raise InvalidInput(f"unknown entry {key!r}; known: hand, date, joint")
    if not (isinstance(joints, list) and joints and all(isinstance(j, dict) for j in joints)):
        raise InvalidInput("no [[joint]] tables")
    if not (isinstance(hand, str) and isinstance(date, datetime)):
        raise InvalidInput("expected `hand`, a string, and `date`, a date and time")
    for i, joint in enumerate(joints):
        if set(joint) != set(_COLUMNS):
            raise InvalidInput(
                f"[[joint]] number {i + 1} has {', '.join(joint)}; expected {', '.join(_COLUMNS)}"
            )
        if not isinstance(joint["name"], str):
            raise InvalidInput(f"name of [[joint]] number {i + 1} is {joint['name']!r}")
        for key in _COLUMNS[1:]:
            if isinstance(joint[key], bool) or not isinstance(joint[key], int | float):
                raise InvalidInput(f"{key} of {joint['name']} is {joint[key]!r}; expected a number")
    columns = {key: [joint[key] for joint in joints] for key in _COLUMNS}
    names = columns.pop("name")
    return {"hand": hand, "date": date, "joint_names": tuple(names), **columns}
