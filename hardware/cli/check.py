"""``dexctl hardware check``: is everything there, healthy, set and quick enough."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from dexctl.cli.checks import make_folder
from dexctl.cli.output import notes, print_json, results, table, to_json
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.files import write_text
from dexctl.state import Floats
from hardware import registers
from hardware.bus import Bus
from hardware.cli.options import HandOptions
from hardware.discovery import Found
from hardware.exceptions import ServoError
from hardware.hand import ServoHand
from hardware.models import BY_NUMBER, MODELS, XM430_W210, ServoModel, known_numbers
from hardware.registers import OperatingMode, describe_hardware_error
from hardware.state_machine import Torque
from hardware.ticker import Interrupts, spread
from hardware.tracking import MOST_AGE, UdpTracker, listen, silence

_CYCLES = 200
_LISTENED = 2.0  # to a tracker [s]
_MOVE = 0.12  # [rad]
_MOVE_SECONDS = 0.5
_SLOW = 0.005  # a cycle of more than this suggests a latency timer or return delay [s]
_HINT = "slow bus: set the USB adapter's latency timer to 1 ms and the servos' return delay to 0"


@dataclass(kw_only=True)
class Check(HandOptions):
    """Look at every servo; with --move, move one joint at a time.

    Port, speed, IDs and models are found by asking where they are not given. With --tracker, what
    it tells of the object for 2 s.
    Nothing moves and no torque is on unless --move is given. Exit code 1 where something is wrong.
    """

    move: Switch = False
    """Move each joint by 0.12 rad and back, so that a wrong joint map shows."""
    reboot: int | None = None
    """Restart this servo first: clears a hardware error once its cause is gone."""
    tracker: str | None = None
    """Where a tracker sends the object's pose: UDP port of this machine, or HOST:PORT to listen
    on."""
    out: Path | None = None
    """Folder for check.json."""
    json: Switch = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        self.check()
        if self.reboot is not None and not 0 <= self.reboot <= 252:
            raise InvalidInput(f"--reboot is {self.reboot}; expected an ID from 0 to 252")
        self.check_real("--tracker", self.tracker)
        folder = None if self.out is None else make_folder(self.out)
        with ExitStack() as stack:
            poses = None if self.tracker is None else UdpTracker(self.tracker)
            if poses is not None:
                stack.callback(poses.close)
            found = self.discover()
            session = stack.enter_context(self.open(self.limits(), 0.02))
            look = _Look(session.hand)
            if poses is not None:
                look.at_tracker(poses)
            if found is not None:
                look.at_chain(found)
            if self.reboot is not None:
                session.bus.reboot(self.reboot)
                notes().print(f"servo {self.reboot} restarted; it counts turns anew")
            look.at_servos(session.bus)
            if not look.silent:
                look.at_settings()
                look.at_cycle(session.bus)
                if self.move and not look.problems:
                    look.at_motion()
        if folder is not None:
            write_text(folder / "check.json", to_json(look.as_dict()) + "\n")
        if self.json:
            print_json(look.as_dict())
        else:
            look.print()
        return 1 if look.problems else 0


@dataclass
class _Look:
    """What has been found."""

    hand: ServoHand
    baudrate: int | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    silent: list[int] = field(default_factory=list)
    cycle: dict[str, float] = field(default_factory=dict)
    fast: bool | None = None
    moved: list[dict[str, Any]] = field(default_factory=list)
    torque: str = ""
    tracker: dict[str, Any] | None = None

    def at_tracker(self, poses: UdpTracker) -> None:
        """What a tracker tells."""
        heard = listen(poses, _LISTENED)
        self.tracker = {
            "poses": heard.poses,
            "rate_hz": heard.rate,
            "age_s": heard.age,
            "position_m": heard.position.tolist(),
            "spread_m": heard.spread.tolist(),
            "no_poses": poses.bad,
        }
        if not heard.poses:
            self.problems.append(silence(poses, _LISTENED))
        elif heard.age + 1.0 / heard.rate > MOST_AGE:
            self.problems.append(
                f"the tracker's poses are {1e3 * heard.age:.0f} ms old and come {heard.rate:.1f} "
                f"times a second; expected one that is at most {MOST_AGE:g} s old at any time"
            )
        elif poses.bad:
            self.problems.append(f"the tracker sent {poses.bad} datagrams that are no pose")

    def at_chain(self, found: Found) -> None:
        """Servos on the line that the hand has no joint for."""
        self.baudrate = found.baudrate
        mine = self.hand.calibration.servo.tolist()
        if extra := sorted(set(found.servos) - set(mine)):
            self.problems.append(
                f"servo {', '.join(map(str, extra))} on this line: the hand has no joint for it"
            )

    def at_servos(self, bus: Bus) -> None:
        """Ping each by itself, then ask those that are there."""
        calibration = self.hand.calibration
        for joint, servo in zip(calibration.joint_names, calibration.servo.tolist(), strict=True):
            row: dict[str, Any] = {"servo": servo, "joint": joint}
            self.rows.append(row)
            try:
                ping = bus.ping(servo)
            except ServoError:
                self.silent.append(servo)
                self.problems.append(f"servo {servo} ({joint}) does not answer")
                continue
            known = BY_NUMBER.get(ping.model)
            row |= {"model": ping.model, "firmware": ping.firmware}
            row["model_name"] = known.name if known else f"model {ping.model}"
            if known is None:
                self.problems.append(
                    f"servo {servo} ({joint}) has model {ping.model}; expected one of "
                    f"{known_numbers()}"
                )
            voltage, temperature, error = (
                bus.read(register, [servo])
                for register in (
                    registers.PRESENT_VOLTAGE,
                    registers.PRESENT_TEMPERATURE,
                    registers.HARDWARE_ERROR,
                )
            )
            row["voltage_v"] = float(voltage.value[0])
            row["temperature_c"] = float(temperature.value[0])
            row["error"] = describe_hardware_error(int(error.raw[0])) if error.ok[0] else "?"
            self._judge(row, known or XM430_W210)

    def _judge(self, row: dict[str, Any], model: ServoModel) -> None:
        limits, who = self.hand.limits, f"servo {row['servo']} ({row['joint']})"
        if row["error"]:
            self.problems.append(
                f"{who}: {row['error']}; remove the cause, then: dexctl hardware check --reboot "
                f"{row['servo']}"
            )
        low, high = limits.voltage or model.voltage
        if not low <= row["voltage_v"] <= high:
            self.problems.append(f"{who}: {row['voltage_v']:.1f} V; expected {low} to {high}")
        if not row["temperature_c"] < (limits.temperature or model.hot):
            self.problems.append(f"{who}: {row['temperature_c']:.0f} C")

    def at_settings(self) -> None:
        """Torque off, settings written and read back, turns resolved."""
        try:
            self.hand.configure()
            sample = self.hand.sample()
        except (ServoError, InvalidInput) as error:
            self.problems.append(str(error))
            return
        bus, ids = self.hand.bus, self.hand.calibration.servo.tolist()
        read = {
            "mode": registers.OPERATING_MODE,
            "drive_limit": registers.CURRENT_LIMIT,
            "temperature_limit_c": registers.TEMPERATURE_LIMIT,
            "least_voltage_v": registers.MIN_VOLTAGE_LIMIT,
            "most_voltage_v": registers.MAX_VOLTAGE_LIMIT,
            "return_delay_s": registers.RETURN_DELAY,
        }
        columns = {name: bus.read(register, ids).value for name, register in read.items()}
        constant = self.hand.torque_constant
        for i, row in enumerate(self.rows):
            row["position_rad"] = float(sample.q[i])
            row |= {name: float(values[i]) for name, values in columns.items()}
            row["torque_limit_nm"] = row["drive_limit"] * float(constant[i])
            if self.hand.models[i].mode is OperatingMode.CURRENT_BASED_POSITION:
                row["current_limit_a"] = row["drive_limit"]

    def at_cycle(self, bus: Bus) -> None:
        """Time of reading currents, velocities and positions of all servos and writing goals."""
        if self.problems:
            return
        ids = self.hand.calibration.servo.tolist()
        wanted = [
            registers.PRESENT_CURRENT,
            registers.PRESENT_VELOCITY,
            registers.PRESENT_POSITION,
        ]
        goal = bus.read(registers.PRESENT_POSITION, ids).value
        times = []
        for _ in range(_CYCLES):
            start = time.perf_counter()
            bus.read_many(wanted, ids)
            bus.write(registers.GOAL_POSITION, goal, ids)  # torque is off: nothing moves
            times.append(time.perf_counter() - start)
        self.cycle, self.fast = spread(times), bus.fast
        if self.cycle["p50"] > _SLOW:
            self.problems.append(f"{1e3 * self.cycle['p50']:.1f} ms a cycle: {_HINT}")

    def at_motion(self) -> None:
        """Move one joint at a time, and see which one moves."""
        hand = self.hand
        with Interrupts() as interrupts:
            try:
                hand.arm()
                start = hand.q_target.copy()
                for joint, name in enumerate(hand.hand.joint_names):
                    if interrupts.count:
                        self.problems.append("interrupted")
                        break
                    notes().print(f"moving {name}")
                    self._move(joint, name, start)
                    if trouble := self._trouble():
                        self.problems.append(f"stopped at {name}: {trouble}")
                        break
            finally:
                report = hand.disarm()
                self.torque = report.message
                if report.state is not Torque.OFF:
                    self.problems.append(report.message)

    def _move(self, joint: int, name: str, start: Floats) -> None:
        hand = self.hand
        # towards the middle of the range, where there is room
        middle = 0.5 * (hand.calibration.lower + hand.calibration.upper)
        goal = start.copy()
        goal[joint] += np.copysign(_MOVE, middle[joint] - start[joint])
        before = hand.sample().q
        self._go(goal)
        after = hand.sample().q
        self._go(start)
        change, asked = after - before, goal[joint] - start[joint]
        strayed = np.abs(change) > 0.25 * _MOVE
        strayed[joint] = False
        self.moved.append({"joint": name, "asked_rad": asked, "moved_rad": float(change[joint])})
        if abs(change[joint] - asked) > 0.25 * _MOVE:
            self.problems.append(
                f"{name} was asked to move by {asked:.2f} rad and moved by {change[joint]:.2f}: "
                "blocked, weak, or not on its servo"
            )
        for other in np.flatnonzero(strayed):
            self.problems.append(
                f"{hand.hand.joint_names[other]} moved by {change[other]:.2f} rad with {name}"
            )

    def _trouble(self) -> str:
        """Why no more joints should be moved, "" for nothing."""
        for _ in range(3):  # one question per call
            health = self.hand.health()
        if health.watchdog.any():
            return "the bus was silent for too long, its watchdog tripped"
        if (health.error > 0).any() or health.limp.any():
            return "a servo has let go"
        return ""

    def _go(self, goal: Floats) -> None:
        end = time.monotonic() + _MOVE / self.hand.speed_limit.min() + _MOVE_SECONDS
        while time.monotonic() < end:
            self.hand.sample()
            self.hand.write(goal)
            self.hand.step()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "command": "check",
            "port": self.hand.bus.port,
            "baudrate": self.baudrate,
            "latency_timer_s": self.hand.bus.latency_timer,
            "servos": self.rows,
            "cycle_s": self.cycle,
            "fast_sync_read": self.fast,
            "moved": self.moved,
            "tracker": self.tracker,
            "torque": self.torque,
            "problems": self.problems,
        }

    def print(self) -> None:
        """As a table."""
        console = results()
        timer = self.hand.bus.latency_timer
        known = "" if timer is None else f", latency timer {1e3 * timer:.0f} ms"
        if self.baudrate is not None:
            known = f", {self.baudrate} bit/s{known}"
        console.print(f"port {self.hand.bus.port}{known}", soft_wrap=True)
        numbers = ("model", "fw", "V", "C", "rad", "mode", "N m", "C max")
        right = ("servo", *numbers[1:])
        rows = table("servo", "joint", *numbers, "error", right=right)
        rows.columns[2].min_width = max(len(model.name) for model in MODELS)
        for row in self.rows:
            rows.add_row(
                str(row["servo"]),
                row["joint"],
                str(row.get("model_name", "silent")),
                str(row.get("firmware", "")),
                f"{row['voltage_v']:.1f}" if "voltage_v" in row else "",
                f"{row['temperature_c']:.0f}" if "temperature_c" in row else "",
                f"{row['position_rad']:.3f}" if "position_rad" in row else "",
                f"{row['mode']:.0f}" if "mode" in row else "",
                f"{row['torque_limit_nm']:.2f}" if "mode" in row else "",
                f"{row['temperature_limit_c']:.0f}" if "mode" in row else "",
                row.get("error", ""),
            )
        console.print(rows)
        if self.cycle:
            console.print(
                f"read and write of all: {1e3 * self.cycle['p50']:.2f} ms median, "
                f"{1e3 * self.cycle['p99']:.2f} ms p99 (fast sync read: "
                f"{'yes' if self.fast else 'no'})"
            )
        if self.tracker is not None and self.tracker["poses"]:
            told = self.tracker
            place, spread = (
                ", ".join(f"{1e3 * value:.1f}" for value in told[name])
                for name in ("position_m", "spread_m")
            )
            console.print(
                f"tracker: {told['rate_hz']:.0f} poses a second, {1e3 * told['age_s']:.0f} ms old; "
                f"object at {place} mm, standard deviation {spread} mm",
                soft_wrap=True,
            )
        for moved in self.moved:
            console.print(
                f"{moved['joint']}: asked {moved['asked_rad']:+.3f} rad, moved "
                f"{moved['moved_rad']:+.3f}"
            )
        if self.torque:
            console.print(self.torque)
        for problem in self.problems:
            console.print(Text.assemble(("problem:", "bold"), f" {problem}"), soft_wrap=True)
        if not self.problems:
            console.print("all is well")
