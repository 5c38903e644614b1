"""Runner: a controller on a servo hand at a fixed rate, until it ends in a known state.

Each tick: signals, one read of all joints, one question about the servos' health, the controller's
command, one write, one log message. What may go wrong is told to the state machine of
`hardware.state_machine`, and what that says is done. Every path out of :meth:`Runner.run` has taken
the torque off and says what is known of it.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dexctl import Controller
from dexctl.controller import check_parts
from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from hardware.closing import Closing
from hardware.exceptions import BusError, PortLost, tell_torque
from hardware.hand import ServoHand
from hardware.log import LogWriter
from hardware.monitor import Monitor
from hardware.run_report import RunEvent, RunReport
from hardware.samples import JointSample, TorqueReport
from hardware.state_machine import COUNTED, Action, Event, State, transition
from hardware.ticker import Interrupts, Ticker, spread, undisturbed
from hardware.tracking import TrackedPose
from hardware.worker import Command, ControllerThread, warm_up

HOLD_SECONDS = 0.2
SETTLE_SECONDS = 1.0  # after an approach: time for the grasp to close


class Runner:
    """Runs a controller on a hand.

    Args:
        hand: not armed; the runner arms it.
        controller: of the same hand and control period.
        needs_tactile: whether stale tactile readings stop it (HOLD) or are only counted.
        log: where ticks and events go.
        extra: asked once a tick, goes into the log beside the rest.
        seed: the controller is reset with it.
        on_tick: told (time [s], q, q_target sent) of every tick in which the controller runs.
        on_event: told of every event that is new, for people.

    Attributes:
        state: where the run is.
        report: of the last run, one that an exception ended included.

    Raises:
        InvalidInput: controller and hand do not belong together.
    """

    def __init__(
        self,
        hand: ServoHand,
        controller: Controller,
        *,
        needs_tactile: bool = True,
        log: LogWriter | None = None,
        extra: Callable[[], Mapping[str, Any]] | None = None,
        seed: int | None = 0,
        on_tick: Callable[[float, Floats, Floats], None] | None = None,
        on_event: Callable[[RunEvent], None] | None = None,
    ) -> None:
        check_parts(hand.hand, {"the controller": controller}, hand.control_period)
        self._hand, self._controller, self._log = hand, controller, log
        self._needs_tactile, self._seed = needs_tactile, seed
        self._on_event, self._on_tick, self._extra = on_event, on_tick, extra
        self._interrupts = Interrupts()
        self.state = State.IDLE
        self.report = RunReport()

    def interrupt(self) -> None:
        """As Ctrl-C: hold for 0.2 s, then torque off; the second time, torque off at once."""
        self._interrupts.add()

    def run(self, seconds: float, approach: Floats | None = None) -> RunReport:
        """Arm, go to a posture, run the controller for ``seconds`` [s], take the torque off.

        Args:
            seconds: how long the controller is asked.
            approach: set-points ``(d,)`` [rad] to go to first, at the limits' speed, such as a
                grasp around an object that somebody holds in place; default: start where the
                joints stand. For a controller that goes by touch, fingers that do not press on
                the object there go on until they do (`hardware.closing`).

        Raises:
            InvalidInput: a bad argument, or a joint out of its range; the torque is off.
            BusError: the hand could not be armed.
            Whatever `extra`, `on_tick` or `on_event` raise.
            Each says what is known of the torque then: off, or unknown of which servos
            (`hardware.exceptions.tell_torque`); `report` has it, too.
        """
        if not (np.isfinite(seconds) and seconds > 0):
            raise InvalidInput(f"seconds is {seconds}; expected a finite number above 0")
        hand = self._hand
        if approach is not None:
            approach = np.asarray(approach, float)
            if approach.shape != (hand.hand.nq,) or not np.isfinite(approach).all():
                raise InvalidInput(f"approach is {approach}; expected {hand.hand.nq} finite angles")
        middle = 0.5 * (hand.calibration.lower + hand.calibration.upper)
        start = middle if approach is None else approach
        warm_up(
            self._controller, start, self._seed, hand.gravity,
            tracked=hand.tracker is not None, goal=hand.goal, spin=hand.spin,
        )  # fmt: skip
        worker = ControllerThread(self._controller)  # before real time: it must not inherit it
        run = _Run(self, worker, seconds, approach)
        self.report = run.report
        try:
            with self._interrupts, undisturbed() as real_time:
                run.report.real_time = real_time
                return run.go()
        finally:
            worker.close()
            self._interrupts = Interrupts()  # what ended this run does not end the next


class _Run:
    """One run, from arming to torque off."""

    def __init__(
        self, runner: Runner, worker: ControllerThread, seconds: float, approach: Floats | None
    ) -> None:
        self.runner, self.worker, self.hand = runner, worker, runner._hand
        self.log, self.seconds, self.approach = runner._log, seconds, approach
        self.interrupts = runner._interrupts
        self.report = RunReport()
        self.state = State.IDLE
        self.ticker = Ticker(self.hand.control_period)
        self.start = time.monotonic()
        self.run_until = np.inf
        self.arrived_at: float | None = None
        feels = runner._needs_tactile and approach is not None and self.hand.feels
        period = self.hand.control_period
        self.closing = Closing(self.hand.hand, control_period=period) if feels else None
        self.start_at: float | None = None
        self.release_at: float | None = None
        self.done = False
        self.monitor = Monitor(self.hand, self.happen)
        self.times: dict[str, list[float]] = {"lateness": [], "cycle": [], "controller": []}
        self.asked_interrupts = 0
        self.command: Command | None = None

    # the run

    def go(self) -> RunReport:
        try:
            self.hand.arm()
        except BaseException:  # which says what is known of the torque
            self.finish(self.hand.torque_report)
            raise
        try:
            self.ticker.restart()
            self.monitor.restart()
            self.start = time.monotonic()
            self.happen(Event.ARM, "set-points where the joints stand")
            while not self.done:
                self.tick()
        except BaseException as error:
            torque = self.hand.disarm()
            tell_torque(error, torque.message)
            self.finish(torque)
            raise
        self.finish(self.hand.disarm())
        return self.report

    def finish(self, torque: TorqueReport) -> None:
        report = self.report
        self.runner.state = State.FAULT if report.outcome is State.FAULT else State.IDLE
        report.torque, report.torque_message = torque
        report.figures = {name: spread(values) for name, values in self.times.items()}
        report.bus = self.hand.bus.statistics.as_dict()
        if self.log is not None:
            report.dropped = self.log.dropped
            self.log.write("/summary", report.as_dict())

    def tick(self) -> None:
        tick = self.ticker.wait()
        began = time.monotonic()
        self.report.ticks += 1
        self.report.skipped += tick.skipped
        self.times["lateness"].append(tick.lateness + tick.skipped * self.ticker.period)
        self.command = None
        try:
            self.look_at_signals()
            sample = self.hand.sample()
            self.monitor.at_joints(sample)
            self.monitor.at_health()
            if not self.done:
                self.drive(sample)
            if self.runner._on_tick is not None and self.state is State.RUN:
                self.runner._on_tick(sample.time - self.start, sample.q, self.hand.q_target)
            self.write_log(sample)
        except PortLost as error:
            self.happen(Event.UNPLUGGED, str(error))
        except BusError as error:
            self.happen(Event.READS_LOST, str(error))
        cycle = time.monotonic() - began
        self.times["cycle"].append(cycle)
        self.monitor.at_clock(cycle, tick.skipped)

    def drive(self, sample: JointSample) -> None:
        """Send what is to be sent in this state."""
        hand = self.hand
        if self.state is State.ARMED:
            hand.listen()
            there = self.approach is None or self.arrived_at is not None
            if not there and np.abs(self.approach - hand.q_target).max() < 1e-6:
                there, self.arrived_at = True, time.monotonic()
                self.start_at = self.arrived_at + SETTLE_SECONDS
            if there and self.close(sample):
                return
            if there and (self.start_at is None or time.monotonic() >= self.start_at):
                self.happen(Event.START, type(self.runner._controller).__name__)
                self.run_until = time.monotonic() + self.seconds
            elif there or self.approach is None:
                hand.hold()
            else:
                hand.write(self.approach)
                limited = hand.limited
                if limited is not None and limited.out_of_range.any():
                    # it would never get there
                    self.approach = np.where(limited.out_of_range, hand.q_target, self.approach)
                    self.monitor.at_limits()
            if self.state is State.ARMED:
                return
        if self.state is State.RUN:
            self.ask_controller(sample)
        if self.state is not State.RUN or self.command is None:
            hand.hold()

    def close(self, sample: JointSample) -> bool:
        """Let fingers that do not feel the object go on; whether any still does."""
        if self.closing is None or self.closing.done or self.arrived_at is None:
            return False
        if time.monotonic() < self.arrived_at + 0.5 * SETTLE_SECONDS:
            return False  # the servos are late: first they are to get there
        state = self.hand.state(sample)
        change = self.closing(state, self.hand.touch.stale)
        if self.closing.done:
            return False
        self.hand.write(self.hand.q_target + change)
        self.monitor.at_limits()
        self.start_at = time.monotonic() + SETTLE_SECONDS
        return True

    def ask_controller(self, sample: JointSample) -> None:
        state = self.hand.state(sample)
        self.monitor.at_touch(self.runner._needs_tactile)
        self.monitor.at_pose()
        if self.state is not State.RUN:
            return
        self.worker.ask(state)
        # leave time for the write, the log and waking up again
        self.command = command = self.worker.answer(0.6 * self.ticker.left)
        limits = self.hand.limits
        if command is None:
            if self.worker.waiting > limits.command_age:
                waiting = 1e3 * self.worker.waiting
                self.happen(Event.COMMAND_STALE, f"no command for {waiting:.0f} ms")
            return
        self.times["controller"].append(command.seconds)
        age = time.monotonic() - command.asked
        if command.change is None:
            self.happen(Event.CONTROLLER_FAILED, command.error)
        elif age > limits.command_age:
            self.happen(
                Event.COMMAND_STALE,
                f"the command was {1e3 * age:.0f} ms old, of which the controller took "
                f"{1e3 * command.seconds:.0f} ms; the rest is machine or bus",
            )
        elif not np.isfinite(command.change).all():
            self.happen(
                Event.GOAL_NOT_FINITE,
                f"{self.monitor.joints(~np.isfinite(command.change))}: NaN or infinity",
            )
        else:
            self.hand.write(self.hand.q_target + command.change)
            self.monitor.at_limits()
            return
        self.command = None

    def look_at_signals(self) -> None:
        new, self.asked_interrupts = (
            self.interrupts.count - self.asked_interrupts,
            self.interrupts.count,
        )
        if new and self.asked_interrupts >= 2:
            self.happen(Event.INTERRUPT_AGAIN, "")
        elif new:
            number = self.interrupts.signal
            self.report.signal = name = signal.Signals(number).name if number else None
            by = f"{name}: " if name else ""
            self.happen(Event.INTERRUPT, f"{by}holding for {HOLD_SECONDS} s; once more: at once")
        now = time.monotonic()
        if self.release_at is not None:
            self.done |= now >= self.release_at
        elif now >= self.run_until:
            if self.state is State.HOLD:  # nothing more to come: let go
                self.release_at = now
                self.done = True
            else:
                self.happen(Event.FINISHED, f"{self.seconds:g} s")

    # what follows

    def happen(self, event: Event, detail: str) -> None:
        """Tell the state machine, and do what it says."""
        found = transition(self.state, event)
        self.report.counts[event] += 1
        if found is None:
            if event in COUNTED and self.report.counts[event] == 1:
                self.tell(event, detail)
            return
        known = self.state is found.state and self.report.counts[event] > 1
        self.state = self.runner.state = found.state
        if found.final in (State.HOLD, State.FAULT) and _worse(found.final, self.report.outcome):
            self.report.outcome, self.report.cause = found.final, event
        now = time.monotonic()
        if found.action is Action.FREEZE:  # held for as long as the run would have taken
            self.run_until = min(self.run_until, now + self.seconds)
        if found.action is Action.FREEZE_THEN_RELEASE:
            self.release_at = now + HOLD_SECONDS if self.release_at is None else self.release_at
        if found.action in (Action.RELEASE, Action.RELEASE_BLIND):
            self.done = True
        if not known:
            self.tell(event, ". ".join(part for part in (detail, found.advice) if part))

    def tell(self, event: Event, detail: str) -> None:
        said = RunEvent(
            time=time.monotonic() - self.start, event=event, detail=detail, state=self.state
        )
        self.report.events.append(said)
        if self.log is not None:
            self.log.write("/event", {"time": said.time, "event": event.value, "detail": detail,
                                      "state": self.state.value})  # fmt: skip
        if self.runner._on_event is not None:
            self.runner._on_event(said)

    def write_log(self, sample: JointSample) -> None:
        if self.log is None:
            return
        touch, command = self.hand.touch, self.command
        kept = self.log.write(
            "/tick",
            {
                "time": sample.time - self.start,
                "state": self.state.value,
                "q": sample.q,
                "q_target": self.hand.q_target,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "fresh": sample.fresh,
                "age": sample.age,
                "in_contact": touch.in_contact,
                "contact_force": touch.force,
                "contact_position": touch.position,
                "tactile_stale": touch.stale,
                "lateness": self.times["lateness"][-1],
                "controller_seconds": command.seconds if command else None,
                "diagnostics": command.diagnostics if command else {},
                **_tracked(self.hand.pose),
                **(self.runner._extra() if self.runner._extra is not None else {}),
            },
        )
        if not kept:
            self.happen(Event.LOG_LOST, self.log.refused or "the queue is full")
        if self.report.ticks % 25 == 0:
            if trouble := self.log.trouble():
                self.happen(Event.LOG_LOST, trouble)
            health = self.hand.known_health
            self.log.write(
                "/health",
                {
                    "time": sample.time - self.start,
                    "voltage": health.voltage,
                    "temperature": health.temperature,
                    "error": health.error,
                },
            )


def _tracked(pose: TrackedPose | None) -> dict[str, Any]:
    """What the log has of a tracker: nothing where there is none."""
    if pose is None:
        return {}
    return {
        "tracked_position": pose.position,
        "tracked_quaternion": pose.quaternion,
        "tracked_age": time.monotonic() - pose.time,
    }


def _worse(a: State, b: State) -> bool:
    order = (State.IDLE, State.HOLD, State.FAULT)
    return order.index(a) > order.index(b)
