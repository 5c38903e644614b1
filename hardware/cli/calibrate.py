"""``dexctl hardware calibrate``: sign, zero and range of every joint, into a TOML file.

Three poses of every joint say all of it: zero, upper end and lower end. The servo angles are read
with the torque off, and taken modulo a turn, so neither a lost turn count nor a wrap point within
the travel matters.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from dexctl import HandModel
from dexctl.cli.output import notes, print_json, results, table
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.files import make_parent
from dexctl.rotations import shortest
from dexctl.settings import only
from dexctl.sim.scene_config import SceneConfig
from dexctl.state import Floats
from hardware import registers
from hardware.bus import Bus
from hardware.calibration import TURN, Calibration
from hardware.cli.options import HandOptions
from hardware.emulator import Emulator
from hardware.exceptions import ServoError
from hardware.scene import ASKED

_POSES = ("zero", "upper", "lower")
_LEAST_TRAVEL = 0.2  # less, and the two ends are one pose [rad]
_ODD = 0.3  # a travel that differs so much from the model's is another joint's [rad]


class Person(Protocol):
    """Who brings joints into poses: somebody at the hand, or the emulator."""

    def pose(self, name: str) -> Floats:
        """Servo angles ``(d,)`` [rad] with every joint at "zero", "upper" or "lower"."""
        ...


def from_poses(
    hand: HandModel,
    poses: dict[str, Floats],
    servo: NDArray[np.int64],
    torque_constant: Floats | float = np.nan,
) -> Calibration:
    """The calibration that three poses say.

    Args:
        hand: the model; ranges are kept within its own.
        poses: servo angles ``(d,)`` [rad] at "zero", "upper" and "lower".
        servo: IDs, ``(d,)``.
        torque_constant: of all servos, or of each [N m/A], [N m]; NaN: that of their models.

    Raises:
        InvalidInput: a joint has not been moved, or zero is not between its ends.
    """
    up, low = (shortest(poses[name] - poses["zero"]) for name in ("upper", "lower"))
    sign = np.where(up > low, 1, -1)
    upper, lower = np.minimum(sign * up, hand.upper), np.maximum(sign * low, hand.lower)
    for i, name in enumerate(hand.joint_names):
        if not abs(up[i] - low[i]) > _LEAST_TRAVEL:
            raise InvalidInput(
                f"{name} (servo {servo[i]}) moved by {abs(up[i] - low[i]):.3f} rad between its "
                f"ends; expected more than {_LEAST_TRAVEL}"
            )
        if not sign[i] * low[i] <= 0.05 or not sign[i] * up[i] >= -0.05:
            raise InvalidInput(f"zero of {name} (servo {servo[i]}) is not between its ends")
    return Calibration(
        hand=hand.name,
        joint_names=tuple(hand.joint_names),
        servo=np.asarray(servo, int),
        sign=sign,
        zero=np.mod(poses["zero"], TURN),
        lower=lower,
        upper=upper,
        torque_constant=np.broadcast_to(torque_constant, hand.nq).astype(float),
    )


def odd_travels(hand: HandModel, poses: dict[str, Floats]) -> list[str]:
    """Joints whose travel is not the model's: blocked, or with another joint's servo."""
    travel = np.abs(
        shortest(poses["upper"] - poses["zero"]) - shortest(poses["lower"] - poses["zero"])
    )
    expected = hand.upper - hand.lower
    return [
        f"{name} travels {travel[i]:.2f} rad; the model has {expected[i]:.2f}"
        for i, name in enumerate(hand.joint_names)
        if abs(travel[i] - expected[i]) > _ODD
    ]


@dataclass(kw_only=True)
class Calibrate(HandOptions):
    """Measure sign, zero and range of every joint; write them to a TOML file.

    Torque is off; you move the joints, and press Enter at each pose. With --emulate, emulated
    servos with signs and zeros unknown to the measurement are moved for you.
    """

    out: Path = Path("calibration.toml")
    """The file to write."""
    torque_constant: float | None = None
    """Torque per current of the servos [N m/A]; none: by their models' data sheets."""
    seed: int = 0
    """Seed of the emulated signs and zeros."""
    json: Switch = False
    """Print one JSON object instead of the summary."""
    scene: Annotated[SceneConfig, only(ASKED, "hand")] = ASKED

    def run(self) -> int:
        self.check()
        constant = np.nan if self.torque_constant is None else self.torque_constant
        if self.torque_constant is not None and not 0.01 <= constant <= 100:
            raise InvalidInput(f"--torque-constant is {constant}; expected 0.01 to 100")
        self.out = make_parent(self.out, "--out")  # before somebody has moved every joint
        self.discover()
        model, before = self.load()
        with self._person(model, before) as person:
            poses = {name: person.pose(name) for name in _POSES}
        found = from_poses(model, poses, before.servo, constant)
        odd = odd_travels(model, poses)
        found.save(self.out)
        if self.json:
            print_json({"command": "calibrate", "file": str(self.out), "problems": odd})
        else:
            results().print(_table(found))
            results().print(f"written: {self.out}; torque off")
        for problem in odd:
            notes().print(f"problem: {problem}")
        return 1 if odd else 0

    @contextmanager
    def _person(self, model: HandModel, before: Calibration) -> Iterator[Person]:
        ids = [int(servo) for servo in before.servo]
        if self.emulate:
            yield _EmulatedPerson(model, ids, self.seed)
            return
        assert self.port is not None
        assert self.baudrate is not None
        with Bus(self.port, ids, baudrate=self.baudrate) as bus:
            _release(bus)
            yield _RealPerson(model, bus)


def _table(found: Calibration) -> Table:
    numbers = ("servo", "sign", "zero", "lower", "upper [rad]")
    rows = table("joint", *numbers, right=numbers)
    for i, name in enumerate(found.joint_names):
        angles = (f"{angles[i]:.3f}" for angles in (found.zero, found.lower, found.upper))
        rows.add_row(name, str(found.servo[i]), f"{found.sign[i]:+d}", *angles)
    return rows


def _release(bus: Bus) -> None:
    """Torque off, and the offset that the servos may add themselves off too."""
    for servo in bus.ids:
        bus.write_checked(registers.TORQUE_ENABLE, 0.0, servo)
        bus.write_checked(registers.HOMING_OFFSET, 0.0, servo)
        bus.write_checked(registers.DRIVE_MODE, 0.0, servo)


def _angles(bus: Bus) -> Floats:
    found = bus.read(registers.PRESENT_POSITION)
    if found.missing:
        raise ServoError(
            f"no answer from servo {', '.join(map(str, found.missing))}: check cable and power",
            found.missing[0],
            answered=False,
        )
    return found.value


class _RealPerson:
    """Somebody at the hand, asked on the terminal."""

    def __init__(self, model: HandModel, bus: Bus) -> None:
        self._model, self._bus = model, bus

    def pose(self, name: str) -> Floats:
        if name == "zero":
            self._ask("put all joints at zero, as the model draws them")
            return _angles(self._bus)
        angles = np.empty(self._model.nq)
        for i, joint in enumerate(self._model.joint_names):
            self._ask(f"turn {joint} to its {name} end")
            angles[i] = _angles(self._bus)[i]
        return angles

    def _ask(self, what: str) -> None:
        try:
            input(f"{what}, and press Enter ")
        except EOFError:
            raise InvalidInput("calibrating asks on the terminal; there is none") from None


class _EmulatedPerson:
    """Starts the emulator anew in each pose, as if somebody had moved it while it was off."""

    def __init__(self, model: HandModel, ids: list[int], seed: int) -> None:
        random = np.random.default_rng(seed)
        self._model, self._ids = model, ids
        self.zeros = random.integers(0, registers.TICKS_PER_TURN, model.nq)
        self.signs = random.choice([-1, 1], model.nq)

    def pose(self, name: str) -> Floats:
        at = {"zero": np.zeros(self._model.nq), "upper": self._model.upper,
              "lower": self._model.lower}[name]  # fmt: skip
        with (
            Emulator(
                self._model.nq,
                ids=self._ids,
                zeros=self.zeros.tolist(),
                signs=self.signs.tolist(),
                start=at.tolist(),
            ) as emulator,
            Bus(emulator.port, self._ids, timeout=0.05) as bus,
        ):
            _release(bus)
            return _angles(bus)
