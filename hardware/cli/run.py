"""``dexctl hardware run``: a controller on the hand, with a log and a report."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexctl import Controller, HandModel, controllers
from dexctl.cli.checks import check_seconds, make_folder
from dexctl.cli.output import facts, notes, print_json, results
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.gait import TrackedByTouch
from dexctl.hands.identity import identity
from dexctl.rotations import multiply
from dexctl.settings import absolute, only, to_plain
from dexctl.sim.checks import gravity_vector
from dexctl.sim.scene_config import SceneConfig
from dexctl.sim.sensing import TRACKER
from dexctl.state import Floats
from dexctl.validation import check_name, check_vector, unit_quaternion
from hardware import report
from hardware.calibration import Calibration
from hardware.cli.options import HandOptions, Session, busy, flags, teller
from hardware.figures import figures_of_merit, in_full, in_words
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.motions import CHIRP, Chirp, Sine
from hardware.run_report import RunEvent, RunReport
from hardware.runner import Runner
from hardware.scene import ASKED, AUTO, CLOCK, HELP, HOLDING, NOTHING, OF_AN_OBJECT, POSES
from hardware.state_machine import Event, State
from hardware.tracking import MOST_AGE, parse_place, wait_for_pose

Quaternion = tuple[float, float, float, float]
Spin = tuple[float, float, float]
PERIOD = 0.02  # of controllers that leave it to the runner [s]
FIRST_POSE = 2.0  # how long a tracker may take to tell one [s]
_HELD = replace(ASKED, object=(AUTO,))
_SETTINGS = tuple(name for name in SceneConfig.__dataclass_fields__ if name not in CLOCK)
_MOTIONS = {"sine": Sine, CHIRP: Chirp}  # of an empty hand
_BLIND = ("hold", *_MOTIONS)  # controllers that do not go by touch
INTERRUPTED = 130
LOG, PAGE = "run.mcap", "report.html"


@dataclass(kw_only=True)
class Run(HandOptions):
    """Run a controller on the hand; log and report in a folder.

    The hand first goes to the grasp of the object named, at the speed limit, while somebody (or
    the emulator) holds the object in place; 1 s later the controller starts. --object is the
    object's name, none, or auto: the one that the controller is made for, as a tree is, else a
    cylinder, or none for sine and chirp. What a real hand cannot be
    told, pushes and noise for example, is for --emulate. Ctrl-C holds for 0.2 s and takes the
    torque off; a second one takes it off at once.
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    """igm, switch, gait, coordinated, planned:FILE, hold, sine, chirp; a policy's name, file or
    run; module:function."""
    seconds: float = 30.0
    """How long the controller runs [s]."""
    rate: float | None = None
    """Control rate [Hz]; none: 50, or the rate that a learned policy was trained at."""
    tactile: str | None = None
    """Serial port of the tactile fingertips; emulated ones need none, nor does --touch
    joint-torque. With --touch binary only whether they touch is taken from them."""
    tracker: str | None = None
    """Where a tracker sends the object's pose, with --object-pose tracked: UDP port of this
    machine, or HOST:PORT to listen on. An emulated hand has one of its own."""
    tracker_age: float | None = None
    """How old the poses are to be that the controller is told [s]: newer ones wait; none: as old
    as in a policy's training, where its tracker was late, else as new as they come."""
    seed: int = 0
    """Seed of the random numbers of the controller, and of an emulated scene."""
    goal: Quaternion | None = None
    """Turn from how the object is in the grasp to how it is wanted, in the hand's frame: a
    quaternion w x y z; none: no goal."""
    spin: Spin | None = None
    """Angular velocity that the object is wanted to have, in the hand's frame: x y z [rad/s], for
    those who turn it as they are told; none: as the controller does by itself."""
    out: Path = Path("out")
    """Folder for run.mcap and report.html; those of an earlier run are renamed, not replaced."""
    json: Switch = False
    """Print one JSON object instead of the summary."""
    scene: Annotated[SceneConfig, only(_HELD, *_SETTINGS, texts=HELP)] = _HELD

    def run(self) -> int:
        self.check()
        asked = self.rate
        if asked is not None and not (np.isfinite(asked) and 1.0 <= asked <= 500.0):
            raise InvalidInput(f"--rate is {asked}; expected 1 to 500 Hz")
        check_seconds(self.seconds, PERIOD if asked is None else 1.0 / asked)
        limits, held = self.limits(), self.held()
        blind, touch = self.controller in _BLIND, self.scene.sensing.touch
        if not (blind or self.emulate or self.tactile or touch == "joint-torque"):
            raise InvalidInput(
                f"{self.controller} goes by touch; expected --tactile PORT, --touch joint-torque "
                "(or --emulate)"
            )
        if touch == "joint-torque" and self.tactile:
            raise InvalidInput(
                f"--touch is joint-torque and --tactile {self.tactile}; expected one of them, or "
                "--touch binary"
            )
        pose = self.scene.sensing.object_pose
        check_name("object_pose", pose, POSES)
        empty = held.object == (NOTHING,)
        if (pose == "touch" and (blind or empty)) or (pose == "tracked" and empty):
            what = "the empty hand" if empty else self.controller
            done = "touched" if pose == "touch" else pose
            raise InvalidInput(f"--object-pose is {pose}; {what} has no object that is {done}")
        self._check_tracker(pose)
        if self.goal is not None:
            check_goal(self.controller, self.goal, pose)
        if self.spin is not None:
            check_spin(self.controller, self.spin, self.goal)
        model, calibration = self.load()
        controller = make_controller(self.controller, model, asked, tracked=pose != "unknown")
        if self.goal is not None and controller.goes_to_goals is False:
            raise goes_to_none(self.controller, self.goal)
        if self.goal is None and controller.goes_to_goals:
            raise InvalidInput(
                f"{self.controller} acts only where it has a goal; expected --goal W X Y Z and "
                "--object-pose touch or tracked"
            )
        if self.spin is not None and controller.turns_as_told is False:
            raise turns_as_made(self.controller, self.spin)
        if self.spin is not None:
            controller.check_told(self.spin)
        if self.spin is None and controller.turns_as_told:
            raise InvalidInput(
                f"{self.controller} acts only where it is told how to turn the object; expected "
                "--spin X Y Z [rad/s], such as 0 0 0.5"
            )
        if controller.object is not None and self.scene.object == (AUTO,):
            held = replace(held, object=(controller.object,))
        if held.object != (NOTHING,):
            gravity = gravity_vector(held.gravity)
            if remark := controllers.made_for_another(
                self.controller, controller, held.object, gravity
            ):
                notes().print(remark)
        held, age = self._aged(held, controller)
        period = controller.control_period
        folder = make_folder(self.out)
        keep_earlier(folder)
        with ExitStack() as stack:
            session = stack.enter_context(
                self.open(
                    limits, period, held=held, tactile=self.tactile, tracker=self.tracker,
                    pose_age=age, seed=self.seed,
                )
            )  # fmt: skip
            if session.hand.tracker is not None:
                wait_for_pose(session.hand.tracker, FIRST_POSE)
            log = stack.enter_context(LogWriter(folder / LOG))
            about_it = self._about(model, calibration, limits, held, period, age)
            if self.goal is not None and session.object_pose is not None:
                goal = multiply(unit_quaternion("goal", self.goal), session.object_pose[1])
                about_it["goal_quaternion"] = goal.tolist()
                session.hand.goal = goal
            if self.spin is not None:
                about_it["goal_angular_velocity"] = list(self.spin)
                session.hand.spin = np.array(self.spin)
            if pose == "touch" and session.object_pose is not None:
                controller = tracked_by_touch(controller, held, session.object_pose)
            log.write("/run", about_it)
            runner = Runner(
                session.hand,
                controller,
                needs_tactile=not blind,
                log=log,
                seed=self.seed,
                extra=lambda: truth(session),
                on_event=teller(_line),
            )
            found = runner.run(self.seconds, approach=session.grasp)
        console = notes()
        if not found.real_time:
            console.print("real-time scheduling was not permitted: expect late ticks")
        if hint := busy(self, found):
            console.print(hint)
        if log.error:
            console.print(f"the log is incomplete: {log.error}")
        return finish(found, folder, as_json=self.json)

    def _aged(self, held: SceneConfig, controller: Controller) -> tuple[SceneConfig, float]:
        """The scene with its tracker, and how old the poses are that are told [s]."""
        age = self.tracker_age
        if age is None:
            age = controller.pose_age or 0.0
        if held.sensing.object_pose != "tracked":
            return held, 0.0
        if not 0.0 <= age < MOST_AGE:
            raise InvalidInput(f"--tracker-age is {age}; expected 0 to less than {MOST_AGE} s")
        return replace(held, sensing=held.sensing.aged(age)), age

    def _check_tracker(self, pose: str) -> None:
        """InvalidInput where a real hand's tracker is missing, or there is one too many."""
        given = [path for path in self._given() if path.rpartition(".")[2] in TRACKER]
        if given and pose != "tracked":
            raise InvalidInput(f"{flags(given)}: --object-pose is {pose}; expected tracked with it")
        if self.tracker_age is not None and pose != "tracked":
            said = f"--tracker-age is {self.tracker_age} and --object-pose {pose}"
            raise InvalidInput(f"{said}; expected tracked with it")
        if self.tracker is None:
            if pose == "tracked" and not self.emulate:
                raise InvalidInput(
                    "--object-pose is tracked; expected --tracker [HOST:]PORT, where poses are "
                    "sent (or --emulate)"
                )
            return
        parse_place(self.tracker)
        if pose != "tracked":
            raise InvalidInput(
                f"--tracker is {self.tracker} and --object-pose {pose}; expected tracked with it"
            )
        self.check_real("--tracker", self.tracker)

    def held(self) -> SceneConfig:
        """The scene, with the object that auto stands for.

        Raises:
            UnknownName: no such object.
            InvalidInput: several objects, or settings of one in an empty hand.
        """
        if len(self.scene.object) != 1:
            raise InvalidInput(f"--object is {' '.join(self.scene.object)}; expected one object")
        (name,) = self.scene.object
        if name == AUTO:
            name = NOTHING if self.controller in _MOTIONS else HOLDING.object[0]
        if name == NOTHING:
            given = [path for path in self._given() if path in OF_AN_OBJECT]
            if given:
                raise InvalidInput(
                    f"{flags(given)}: the hand is empty; expected an --object with it"
                )
        else:
            from dexctl.sim.objects import MESH, object_names

            check_name("object", name, (NOTHING, AUTO, *object_names(), MESH))
        return replace(self.scene, object=(name,))

    def _about(
        self,
        model: HandModel,
        calibration: Calibration,
        limits: Limits,
        held: SceneConfig,
        period: float,
        age: float,
    ) -> dict[str, Any]:
        return about(self, self.controller, model, calibration, limits, held) | {
            "object": held.object[0],
            "palm": held.palm,
            "touch": held.sensing.touch,
            "tracker_age_s": age,
            "rate_hz": 1.0 / period,
            "seed": self.seed,
        }


def about(
    options: HandOptions,
    controller: str,
    model: HandModel,
    calibration: Calibration,
    limits: Limits,
    scene: SceneConfig,
) -> dict[str, Any]:
    """What a log says first; files by their absolute paths, so that it can be read anywhere."""
    from dexctl.report.machine import machine

    gains = options.gains(limits, model)
    said = to_plain(absolute(scene, Path.cwd()))
    return {
        "controller": controller,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "hand": model.name,
        "hand_files": identity(model),
        "emulated": options.emulate,
        "joints": list(calibration.joint_names),
        "joint_fingers": fingers_of(model),
        "servos": calibration.servo.tolist(),
        "calibration_date": None if options.calibration is None else calibration.date.isoformat(),
        "stiffness_nm_per_rad": _one_or_each([one.kp for one in gains]),
        "damping_nms_per_rad": _one_or_each([one.kv for one in gains]),
        "action_latency_s": options.scene.limits.action_latency,
        "limits": asdict(limits),
        "joint_limits": {
            "speed_limit": _one_or_each([one.speed_limit for one in gains]),
            "torque_limit": _one_or_each([one.torque_limit for one in gains]),
        },
        "scene": {name: value for name, value in said.items() if name not in CLOCK},
        "machine": machine(),
    }


def _one_or_each(values: list[float]) -> float | list[float]:
    """One number where all joints have the same, else that of each."""
    return values[0] if len(set(values)) == 1 else values


def fingers_of(model: HandModel) -> list[int]:
    """The finger that each joint moves (of several, the first), for pictures."""
    return model.moves.argmax(axis=0).tolist()


def check_goal(name: str, goal: Quaternion, pose: str) -> None:
    """Raise InvalidInput where a goal is none, or nobody goes to it or knows how far it is."""
    unit_quaternion("goal", goal)
    if pose == "unknown":
        raise InvalidInput(
            f"--goal is {goal} and --object-pose {pose}; expected touch or tracked with it"
        )
    if controllers.ignores(name, "goal_quaternion"):
        raise goes_to_none(name, goal)


def goes_to_none(name: str, goal: Quaternion) -> InvalidInput:
    """Where who was named does nothing about goals."""
    return InvalidInput(
        f"--goal is {goal}; {name} goes to none, expected goal, steered:NAME, "
        "sequence:ABOUT,ACROSS or a policy for goals, such as dex5-cube-goals-touch"
    )


def check_spin(name: str, spin: Spin, goal: Quaternion | None) -> None:
    """Raise InvalidInput where an angular velocity is none, or nobody turns as it says."""
    check_vector("spin", spin, 3, "three finite numbers [rad/s]")
    if goal is not None:
        raise InvalidInput(f"--spin is {spin} and --goal {goal}; expected one of them")
    if controllers.ignores(name, "goal_angular_velocity"):
        raise turns_as_made(name, spin)


def turns_as_made(name: str, spin: Spin) -> InvalidInput:
    """Where who was named turns objects its own way, whatever it is told."""
    return InvalidInput(
        f"--spin is {spin}; {name} turns nothing as it is told, expected goal, commanded:NAME,... "
        "or a policy for commands, such as dex5-axes"
    )


def tracked_by_touch(
    controller: Controller, held: SceneConfig, pose: tuple[Floats, Floats]
) -> TrackedByTouch:
    """The controller, told where the object of ``held`` is from ``pose`` on."""
    from dexctl.sim.shapes import Shape

    hand = controller.hand
    (scene,) = replace(held, stiffness=None, damping=None).scenes(hand)
    shape = Shape.of_body(scene.model, scene.object_body)
    return TrackedByTouch(hand, controller, shape, position=pose[0], quaternion=pose[1])


def make_controller(
    name: str, model: HandModel, rate: float | None = None, *, tracked: bool = False
) -> Controller:
    """The controller ``name``, and with it the rate of the run.

    Args:
        name: what `dexctl.controllers.resolve` takes, "sine" or "chirp".
        model: the hand.
        rate: [Hz]; None is 50, and for a controller that was made for another rate, that one.
        tracked: whether the object's pose is known.

    Raises:
        UnknownName: no such controller.
        InvalidInput: it cannot be made, or not for this rate.
    """
    if name in _MOTIONS:
        return _MOTIONS[name](model, control_period=PERIOD if rate is None else 1.0 / rate)
    period = _usual_period(name) if rate is None else 1.0 / rate
    made = controllers.resolve(name, model, control_period=period)
    if made.tracks and not tracked:
        raise InvalidInput(
            f"{name} needs the object's pose, and nothing tracks it here; expected --object-pose "
            "touch or tracked, or a controller that does without"
        )
    if rate is not None and not np.isclose(made.control_period * rate, 1.0):
        raise InvalidInput(f"--rate is {rate:g}; {name} runs at {1.0 / made.control_period:g} Hz")
    return made


def _usual_period(name: str) -> float | None:
    """None for who may have a rate of their own, but for functions, which are told one."""
    function = ":" in name and not controllers.is_named(name)
    return PERIOD if function or not controllers.keeps_period(name) else None


def truth(session: Session) -> Mapping[str, Any]:
    """The object's pose where an emulator knows it."""
    source = session.tactile
    if source is not None and source is not session.hand.tactile:
        source.read()  # the hand does not feel it
    return getattr(source, "truth", {})


def keep_earlier(folder: Path) -> None:
    """Rename the log and report of an earlier run in ``folder``, and say so: nothing is lost."""
    earlier = [folder / name for name in (LOG, PAGE) if (folder / name).exists()]
    if not earlier:
        return
    number = next(
        n for n in count(1)
        if not any((folder / f"{Path(name).stem}-{n}{Path(name).suffix}").exists()
                   for name in (LOG, PAGE))
    )  # fmt: skip
    for path in earlier:
        kept = path.with_name(f"{path.stem}-{number}{path.suffix}")
        path.rename(kept)
        notes().print(f"{path} of an earlier run is kept as {kept.name}", soft_wrap=True)


def finish(found: RunReport, folder: Path, *, as_json: bool) -> int:
    """Report, summary and exit code of a run: 0 as wanted, 1 held or failed, 130 interrupted.

    What is known of the torque is said first, whatever has become of the log.
    """
    if not as_json:
        cause = f" ({found.cause.value})" if found.cause else ""
        ended = in_full(found.outcome.value, found.signal)
        results().print(f"outcome: {ended}{cause}; {found.torque_message}")
    figures, written = _report(folder)
    if as_json:
        print_json({"command": "run", **found.as_dict(), "figures": figures, "folder": str(folder)})
    else:
        console = results()
        console.print(facts(in_words(figures)))
        console.print(f"in {folder}: {' and '.join(written) or 'nothing'}", soft_wrap=True)
    if found.outcome is not State.IDLE or LOG not in written:
        return 1
    interrupted = found.counts[Event.INTERRUPT] + found.counts[Event.INTERRUPT_AGAIN]
    return INTERRUPTED if interrupted else 0


def _report(folder: Path) -> tuple[dict[str, float], list[str]]:
    """Figures of the log in ``folder``, and what there is to read there."""
    try:
        log = read_log(folder / LOG)
        figures = figures_of_merit(log)
    except InvalidInput as error:
        notes().print(f"the log is lost: {error}", soft_wrap=True)
        return {}, []
    try:
        report.write(log, folder / PAGE)
    except ImportError as error:  # no matplotlib: MissingExtra says so
        notes().print(f"no report: {error}")
        return figures, [LOG]
    except OSError as error:
        notes().print(f"no report: {error}", soft_wrap=True)
        return figures, [LOG]
    return figures, [LOG, PAGE]


def _line(said: RunEvent) -> str:
    detail = f": {said.detail}" if said.detail else ""
    return f"{said.time:7.2f} s  {said.state.value:<5}  {said.event.value}{detail}"
