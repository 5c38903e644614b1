"""What the hardware commands share: which hand on which port, and opening it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from dexctl import HandModel, JointTouch, hands
from dexctl.cli.output import notes
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.settings import differing, only
from dexctl.sim.scene_config import SceneConfig
from dexctl.state import Floats
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.discovery import BAUD_RATES, Found, discover, find_baudrate
from hardware.emulated_touch import EmulatedTactile, EmulatedTracker
from hardware.emulator import Emulator
from hardware.emulator.dynamics import LONGEST_LATENCY
from hardware.hand import ServoHand, joint_limits
from hardware.limits import Limits
from hardware.models import XM430_W210, ServoModel
from hardware.models import model as servo_model
from hardware.registers import CURRENT_LIMIT
from hardware.run_report import RunEvent, RunReport
from hardware.scene import ASKED, HELP, HOLDING, NOTHING, OF_A_REAL_HAND
from hardware.state_machine import Event
from hardware.tactile import SerialTactile, TactileSource
from hardware.tracking import PoseSource, UdpTracker
from hardware.units import SimGains, to_servo

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
        tactile: what fingertips or an emulator say, or None.
        grasp: set-points of a grasp around the object, ``(d,)`` [rad], or None.
        object_pose: where the object is in that grasp, ``(3,)`` [m] and wxyz ``(4,)``, or None.
    """

    model: HandModel
    bus: Bus
    hand: ServoHand
    emulator: Emulator | None
    tactile: TactileSource | None
    grasp: Floats | None
    object_pose: tuple[Floats, Floats] | None


@dataclass(kw_only=True)
class HandOptions:
    """Which hand, where."""

    port: str | None = None
    """Serial port of the servos; none: the only one there is."""
    emulate: Switch = False
    """Run against emulated servos instead of a hand."""
    calibration: Path | None = None
    """File that `dexctl hardware calibrate` wrote; none: servos 1 to d, mounted straight."""
    baudrate: int | None = None
    """Speed of the bus [bit/s]; none: the one at which the servos answer, 4 M first."""
    servo_model: tuple[str, ...] = (XM430_W210.name,)
    """Models of the emulated servos, one for all or one each; real ones say it themselves."""
    patience: float = 1.0
    """Allow so many times more silence, age and overruns, 1 to 10: to emulate on a busy machine."""
    scene: Annotated[
        SceneConfig, only(ASKED, "hand", "stiffness", "damping", "limits", texts=HELP)
    ] = ASKED
    _ids = None  # of the servos in the order of the joints, where they were discovered

    def check(self) -> None:
        """Names and files first: they cost nothing.

        Raises:
            UnknownName, InvalidInput: an option is wrong.
        """
        self.check_real("--port", self.port)
        models = self.emulated_models()
        if not self.emulate:
            if models != [XM430_W210]:
                raise InvalidInput(
                    "--servo-model: servos say themselves what they are; expected --emulate with it"
                )
            given = [path for path in self._given() if path not in OF_A_REAL_HAND]
            if given:
                raise InvalidInput(
                    f"{flags(given)}: a real hand cannot be told; expected --emulate with it"
                )
        latency = self.scene.limits.action_latency
        if latency > LONGEST_LATENCY:
            raise InvalidInput(
                f"--action-latency is {latency}; expected 0 to {LONGEST_LATENCY:g} s"
            )
        if self.calibration is not None:
            Calibration.load(self.calibration)
        self._check_gains(models)

    def check_real(self, option: str, value: str | None) -> None:
        """InvalidInput where something of a real hand is given beside an emulated one."""
        if self.emulate and value is not None:
            raise InvalidInput(f"--emulate and {option} {value} are given; expected one of them")

    def _check_gains(self, models: list[ServoModel]) -> None:
        """InvalidInput where a register cannot hold what was asked for, or what comes of it."""
        limits, hand = self.limits(), hands.load(self.scene.hand)
        asked = {"torque_limit": limits.torque_limit, "speed_limit": limits.speed_limit}
        each = models * hand.nq if len(models) == 1 else models
        # the emulator says it where there are not as many models as joints
        for joint, gains, model in zip(
            hand.joint_names, self.gains(limits, hand), each, strict=False
        ):
            try:
                for one in (gains._replace(**asked), gains):
                    to_servo(one, model.loop, model.register(CURRENT_LIMIT))
            except InvalidInput as error:
                raise InvalidInput(f"{joint}: {error}") from None

    def emulated_models(self) -> list[ServoModel]:
        """The models of the emulated servos.

        Raises:
            UnknownName: there is no such model.
        """
        return [servo_model(name) for name in self.servo_model]

    def _given(self) -> list[str]:
        """The settings of the scene that are not as the command has them by itself."""
        return differing(self.scene, type(self).__dataclass_fields__["scene"].default)

    def limits(self) -> Limits:
        """Speed and torque of the scene, and the patience asked for.

        Raises:
            InvalidInput: out of range, or without a limit.
        """
        speed, torque = self.scene.limits.speed_limit, self.scene.limits.torque_limit
        for name, value in (("speed_limit", speed), ("torque_limit", torque)):
            if value is None:
                raise InvalidInput(f"{flags([name])} is none; a servo hand is always limited")
        assert speed is not None
        assert torque is not None
        return Limits(speed_limit=speed, torque_limit=torque).patient(self.patience)

    def gains(self, limits: Limits, hand: HandModel) -> list[SimGains]:
        """Stiffness, damping and limits of each joint, of which its servo's registers are made.

        Gains that were typed are every joint's; else they are what the hand's toml says in
        ``[servos]``, and where that says nothing those of `hardware.scene.HOLDING`.
        """
        speed, torque = joint_limits(hand, limits)
        columns = [
            *(self._gain(name, hand) for name in ("stiffness", "damping")),
            torque.tolist(),
            speed.tolist(),
        ]
        return [SimGains(*row) for row in zip(*columns, strict=True)]

    def _gain(self, name: str, hand: HandModel) -> list[float]:
        """Stiffness or damping of each joint."""
        typed = getattr(self.scene, name)
        if typed is not None:
            return [typed] * hand.nq
        usual = getattr(HOLDING, name)
        return hand.config.servos.of(name, hand.joint_names, usual).tolist()

    def load(self) -> tuple[HandModel, Calibration]:
        """The hand and how its joints lie on the servos."""
        model = hands.load(self.scene.hand)
        if self.calibration is None:
            return model, Calibration.nominal(model, self._ids)
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

    def discover(self) -> Found | None:
        """Find port, speed and IDs, and go on with them; None where servos are emulated.

        Raises:
            InvalidInput: no servo answers anywhere.
        """
        if self.emulate:
            return None
        where = [self.port] if self.port is not None else ports()
        rates = BAUD_RATES if self.baudrate is None else (self.baudrate,)
        found = discover(where, rates, self.patience * _TIMEOUT)
        self.port, self.baudrate = found.port, found.baudrate
        if self.calibration is None and len(found.servos) == hands.load(self.scene.hand).nq:
            self._ids = sorted(found.servos)
        return found

    @contextmanager
    def open(
        self,
        limits: Limits,
        control_period: float,
        *,
        held: SceneConfig | None = None,
        tactile: str | None = None,
        tracker: str | None = None,
        pose_age: float = 0.0,
        seed: int = 0,
    ) -> Iterator[Session]:
        """The hand, open and not armed; torque is off and the bus closed when the block ends.

        Args:
            limits: of the hand.
            control_period: [s].
            held: the scene of a hand with its object, which MuJoCo emulates; None: the hand only
                moves, and is emulated by first-order joints.
            tactile: serial port of the fingertips.
            tracker: where a real hand's tracker sends poses, `[HOST:]PORT`.
            pose_age: how old they are to be when they are told [s].
            seed: of what is random in an emulated scene.
        """
        model, calibration = self.load()
        gains = self.gains(limits, model)
        trusted = self.scene.sensing.touch_threshold
        with ExitStack() as stack:
            emulator, source, grasp, pose = None, None, None, None
            poses: PoseSource | None = None
            sensing = (held or self.scene).sensing
            if self.emulate:
                emulator = stack.enter_context(
                    emulate(
                        calibration, held or self.scene, held is not None, seed, self.servo_model
                    )
                )
                found = emulator.grasp()
                grasp = None if found is None else np.array(found)
                if held is not None:
                    source = EmulatedTactile(emulator, trusted_force=trusted)
                    pose = source.object_pose()
                    if sensing.object_pose == "tracked":
                        late = sensing.sensor_latency + sensing.tracker_latency
                        poses = EmulatedTracker(emulator, late)
            elif held is not None and held.object != (NOTHING,):
                grasp, pose = _grasp(held, model, gains)
            if tactile is not None and not self.emulate:
                source = SerialTactile(tactile, model.n_fingers, trusted_force=trusted)
                stack.callback(source.close)
            if tracker is not None and not self.emulate:
                poses = UdpTracker(tracker, least_age=pose_age)
                stack.callback(poses.close)
            port = emulator.port if emulator is not None else self.find_port()
            timeout = self.patience * (_TIMEOUT if emulator is None else _EMULATED_TIMEOUT)
            ids = [int(servo) for servo in calibration.servo]
            baudrate = self.baudrate
            if baudrate is None:  # where nobody answers, the run will say who is silent
                found = None if self.emulate else find_baudrate(port, ids, timeout)
                baudrate = BAUD_RATES[0] if found is None else found
            bus = stack.enter_context(Bus(port, ids, baudrate=baudrate, timeout=timeout))
            how, felt = self.scene.sensing.touch, None
            if how != "full":
                from dexctl.sim import LinkWeights

                felt = JointTouch(
                    model,
                    np.array([one.kp for one in gains]),
                    np.array([one.kv for one in gains]),
                    self.scene.sensing.joint_touch,
                    control_period=control_period,
                    weights=LinkWeights(model),
                )
            hand = ServoHand(
                bus,
                model,
                calibration,
                limits=limits,
                gains=gains,
                tactile=None if how == "joint-torque" else source,
                joint_touch=felt,
                tracker=poses,
                gravity=None if held is None else held.gravity,
                control_period=control_period,
            )
            yield Session(model, bus, hand, emulator, source, grasp, pose)


def _grasp(
    held: SceneConfig, model: HandModel, gains: list[SimGains]
) -> tuple[Floats, tuple[Floats, Floats]]:
    """The grasp that servos with these gains settle in; see `Session`."""
    from dexctl.sim.parameters import set_on

    (scene,) = replace(held, stiffness=None, damping=None).scenes(model)
    set_on(scene, {"kp": [[one.kp for one in gains]], "kv": [[one.kv for one in gains]]})
    pose = scene.settled.qpos[scene.object_qpos].copy()
    return scene.settled.q_target.copy(), (pose[:3], pose[3:])


def flags(settings: Iterable[str]) -> str:
    """Settings by their dotted paths as they are typed, ``--push-force, --joint-noise``."""
    names = (path.rpartition(".")[2].replace("_", "-") for path in settings)
    return ", ".join(f"--{name}" for name in names)


def emulate(
    calibration: Calibration,
    scene: SceneConfig,
    mujoco: bool,
    seed: int,
    models: tuple[str, ...] = (XM430_W210.name,),
) -> Emulator:
    """Emulated servos of these models that are mounted as ``calibration`` says."""
    # its tracker is asked where somebody wants to be told; `Sensing` knows how well it does
    scene = replace(scene, sensing=replace(scene.sensing, object_pose="tracked"))
    zeros = np.round(calibration.zero / (2 * np.pi / 4096)).astype(int) % 4096
    middle = np.clip(0.0, calibration.lower, calibration.upper)
    return Emulator(
        len(zeros),
        ids=calibration.servo.tolist(),
        zeros=zeros.tolist(),
        signs=calibration.sign.tolist(),
        start=None if mujoco else middle.tolist(),
        dynamics="mujoco" if mujoco else "first-order",
        scene=scene,
        seed=seed,
        models=models,
    )


def teller(line: Callable[[RunEvent], str]) -> Callable[[RunEvent], None]:
    """For `Runner(on_event=...)`: prints ``line`` of each event on stderr, and never raises.

    A terminal that is gone or cannot show a letter must not take the torque off at once, in place
    of what the event asks for.
    """
    console = notes()

    def tell(said: RunEvent) -> None:
        with suppress(Exception, SystemExit):  # rich makes SystemExit of a pipe that is closed
            console.print(line(said))

    return tell


def in_a_line(said: RunEvent) -> str:
    """An event, for people."""
    return f"{said.event.value}: {said.detail}"


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
