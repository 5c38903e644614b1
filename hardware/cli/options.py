"""What the hardware commands share: which hand on which port, and opening it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dexctl import HandModel, hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.limits import REAL_SPEED, REAL_TORQUE
from dexctl.state import Floats
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.emulated_touch import EmulatedTactile
from hardware.emulator import Emulator
from hardware.emulator.dynamics import LONGEST_LATENCY
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.run_report import RunReport
from hardware.state_machine import Event
from hardware.tactile import SerialTactile, TactileSource
from hardware.units import ServoGains, SimGains, to_servo

_TIMEOUT = 0.01  # beyond the time on the wire, until a servo counts as silent [s]
_LATE = (
    Event.READS_LOST, Event.COMMAND_STALE, Event.OVERRUNS, Event.WATCHDOG, Event.TACTILE_NEEDED
)  # fmt: skip
_EMULATED_TIMEOUT = 0.03  # the emulator is one more process, on a machine that may be busy [s]


class Session(NamedTuple):
    """A hand that is open.

    Attributes:
        model: the hand's kinematics.
        bus: open.
        hand: not armed.
        emulator: None on a real hand.
        tactile: what the fingertips feel, or None.
        grasp: set-points of a grasp around the object, ``(d,)`` [rad], or None.
    """

    model: HandModel
    bus: Bus
    hand: ServoHand
    emulator: Emulator | None
    tactile: TactileSource | None
    grasp: Floats | None


@dataclass(kw_only=True)
class HandOptions:
    """Which hand, where."""

    hand: str = "dex5"
    """Name of the hand (`dexctl hands` lists them)."""
    port: str | None = None
    """Serial port of the servos; none: the only one there is."""
    emulate: bool = False
    """Run against emulated servos instead of a hand."""
    calibration: Path | None = None
    """File that `dexctl hardware calibrate` wrote; none: servos 1 to d, mounted straight."""
    baudrate: int = 4_000_000
    """Speed of the bus [bit/s]."""
    stiffness: float = 3.0
    """Stiffness of the servos' position loop [N m/rad], by the conversion of `hardware.units`."""
    damping: float = 0.15
    """Damping of the servos' position loop [N m s/rad]."""
    action_latency: float = 0.0
    """Time from a set-point to its effect in emulated servos [s]; the thesis's hand has 0.05."""
    patience: float = 1.0
    """Allow so many times more silence, age and overruns, 1 to 10: to emulate on a busy machine."""

    def check(self) -> None:
        """Names and files first: they cost nothing.

        Raises:
            UnknownName, InvalidInput: an option is wrong.
        """
        hands.entry(self.hand)
        if self.emulate and self.port is not None:
            raise InvalidInput(f"--emulate and --port {self.port} are given; expected one of them")
        if not 0 <= self.action_latency <= LONGEST_LATENCY:
            raise InvalidInput(
                f"--action-latency is {self.action_latency}; expected 0 to {LONGEST_LATENCY:g} s"
            )
        if self.action_latency and not self.emulate:
            raise InvalidInput(
                f"--action-latency {self.action_latency} is of emulated servos; expected --emulate"
            )
        if self.calibration is not None:
            Calibration.load(self.calibration)
        self.gains(self.limits())

    def limits(self, speed_limit: float = REAL_SPEED, torque_limit: float = REAL_TORQUE) -> Limits:
        """Limits with these [rad/s], [N m] and the patience asked for.

        Raises:
            InvalidInput: out of range.
        """
        limits = Limits(speed_limit=speed_limit, torque_limit=torque_limit)
        return limits.patient(self.patience)

    def gains(self, limits: Limits) -> ServoGains:
        """Register values of stiffness and damping."""
        return to_servo(
            SimGains(self.stiffness, self.damping, limits.torque_limit, limits.speed_limit)
        )

    def load(self) -> tuple[HandModel, Calibration]:
        """The hand and how its joints lie on the servos."""
        model = hands.load(self.hand)
        if self.calibration is None:
            return model, Calibration.nominal(model)
        return model, Calibration.load(self.calibration).check(model)

    def find_port(self) -> str:
        """The port asked for, or the only one there is.

        Raises:
            InvalidInput: there are several, or none.
        """
        if self.port is not None:
            return self.port
        found = ports()
        if len(found) != 1:
            known = ", ".join(found) or "none"
            raise InvalidInput(f"--port is not given; expected one of the ports here: {known}")
        return found[0]

    @contextmanager
    def open(
        self,
        limits: Limits,
        control_period: float,
        *,
        dynamics: str = "first-order",
        object: str = "none",  # noqa: A002 (the field's name for it)
        gravity: str = "up",
        tactile: str | None = None,
    ) -> Iterator[Session]:
        """The hand, open and not armed; torque is off and the bus closed when the block ends.

        Args:
            limits: of the hand.
            control_period: [s].
            dynamics: of an emulated hand: "first-order" or "mujoco".
            object: what it holds; "none" for nothing.
            gravity: which way the palm looks, "up" or "down".
            tactile: serial port of the fingertips.
        """
        model, calibration = self.load()
        grasp = settled_grasp(model, object, gravity)
        with ExitStack() as stack:
            emulator, source = None, None
            if self.emulate:
                emulator = stack.enter_context(
                    emulate(self.hand, calibration, dynamics, object, gravity, self.action_latency)
                )
                source = EmulatedTactile(emulator) if dynamics == "mujoco" else None
            elif tactile is not None:
                source = SerialTactile(tactile, model.n_fingers)
                stack.callback(source.close)
            port = emulator.port if emulator is not None else self.find_port()
            timeout = self.patience * (_TIMEOUT if emulator is None else _EMULATED_TIMEOUT)
            ids = [int(servo) for servo in calibration.servo]
            bus = stack.enter_context(Bus(port, ids, baudrate=self.baudrate, timeout=timeout))
            hand = ServoHand(
                bus,
                model,
                calibration,
                limits=limits,
                gains=self.gains(limits),
                tactile=source,
                control_period=control_period,
            )
            yield Session(model, bus, hand, emulator, source, grasp)


def emulate(
    hand: str,
    calibration: Calibration,
    dynamics: str,
    object: str,  # noqa: A002 (the field's name for it)
    gravity: str,
    action_latency: float = 0.0,
) -> Emulator:
    """Emulated servos that are mounted as ``calibration`` says."""
    zeros = np.round(calibration.zero / (2 * np.pi / 4096)).astype(int) % 4096
    middle = np.clip(0.0, calibration.lower, calibration.upper)
    return Emulator(
        len(zeros),
        ids=calibration.servo.tolist(),
        zeros=zeros.tolist(),
        signs=calibration.sign.tolist(),
        start=None if dynamics == "mujoco" else middle.tolist(),
        dynamics=dynamics,
        hand=hand,
        object=object,
        gravity=gravity,
        action_latency=action_latency,
    )


def settled_grasp(model: HandModel, object: str, gravity: str) -> Floats | None:  # noqa: A002
    """Set-points of the simulated grasp of an object, ``(d,)`` [rad]; None for "none".

    Raises:
        UnknownName: no such object.
        SimulationError: the hand cannot hold it.
    """
    if object == "none":
        return None
    from dexctl.sim import Scene, object_names

    if object not in object_names():
        raise UnknownName("object", object, ("none", *object_names()))
    return Scene.build(model, object, gravity).settled.q_target.copy()


def busy(options: HandOptions, found: RunReport) -> str:
    """Advice for an emulated run that a busy machine made late; "" where it was not that."""
    if not (options.emulate and found.cause in _LATE and hasattr(os, "getloadavg")):
        return ""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load <= cores:
        return ""
    return (
        f"the machine is busy (load {load:.1f} on {cores} cores), and emulated servos answer late "
        "then: wait, or allow for it with --patience 5"
    )


def ports() -> list[str]:
    """Serial ports of USB adapters on this machine."""
    by_id = sorted(Path("/dev/serial/by-id").glob("*"))
    if by_id:
        return [str(path) for path in by_id]
    device = Path("/dev")
    names = (*device.glob("ttyUSB*"), *device.glob("ttyACM*"), *device.glob("cu.usb*"))
    return sorted(str(path) for path in names)
