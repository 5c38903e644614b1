"""Monitor: watches joints, servos, fingertips and the clock, and tells as events what is wrong."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from dexctl.state import Bools
from hardware import registers
from hardware.hand import ServoHand
from hardware.samples import JointSample
from hardware.state_machine import Event
from hardware.tactile import NoTactile

LOST_AFTER = 3  # reads missed in a row
HEALTH_SECONDS = 1.0
WINDOW = 100  # ticks over which overruns are counted


class Monitor:
    """Watches one thing after the other, and tells what is wrong.

    Args:
        hand: the hand that is run.
        happen: told each event and, for people, servo or joint and value.
    """

    def __init__(self, hand: ServoHand, happen: Callable[[Event, str], None]) -> None:
        self._hand, self._happen = hand, happen
        self._unhealthy_since: float | None = None
        self._overruns: deque[bool] = deque(maxlen=WINDOW)
        self._looked = time.monotonic()
        self._silence = 0.0

    def restart(self) -> None:
        """Begin now: the time until here was no silence."""
        self._looked = time.monotonic()

    def at_joints(self, sample: JointSample) -> None:
        """Alerts, and servos that do not answer."""
        now = time.monotonic()
        self._silence, self._looked = max(0.9 * self._silence, now - self._looked), now
        if sample.alert.any():
            self._happen(Event.ALERT, self._causes(sample.alert))
            return
        if sample.fresh.all():
            return
        silent = self.servos(~sample.fresh)
        self._happen(Event.READ_MISSED, f"servo {silent}")
        missed = int(sample.missed.max())
        if missed >= LOST_AFTER or sample.age > self._hand.limits.state_age:
            self._happen(
                Event.READS_LOST,
                f"no answer from servo {silent}, {missed} times in a row, for "
                f"{1e3 * sample.age:.0f} ms",
            )

    def at_health(self) -> None:
        """Watchdog, hardware errors, temperature and voltage."""
        health = self._hand.health()
        if health.watchdog.any():
            self._happen(
                Event.WATCHDOG,
                f"bus silent {1e3 * self._silence:.0f} ms; servo {self.servos(health.watchdog)}",
            )
        if (health.error > 0).any():
            self._happen(Event.ALERT, self._causes(health.error > 0))
        elif health.limp.any():
            # a brown-out resets a servo, which then looks healthy and holds nothing
            self._happen(
                Event.ALERT, f"servo {self.servos(health.limp)} has lost its torque: reset"
            )
        hot = health.temperature >= self._hand.hot
        low, high = self._hand.voltage
        bad = hot | (health.voltage < low) | (health.voltage > high)
        if not bad.any():
            self._unhealthy_since = None
            return
        i, now = int(np.flatnonzero(bad)[0]), time.monotonic()
        value = f"{health.temperature[i]:.0f} C" if hot[i] else f"{health.voltage[i]:.1f} V"
        detail = f"servo {self._hand.calibration.servo[i]}: {value}"
        if self._unhealthy_since is None:
            self._unhealthy_since = now
        self._happen(Event.HEALTH_WARNING, detail)
        if now - self._unhealthy_since >= HEALTH_SECONDS:
            self._happen(Event.HEALTH_LASTS, detail)

    def at_touch(self, needed: bool) -> None:
        """Fingertips that have fallen silent; ``needed``: whether the controller goes by them."""
        touch = self._hand.touch
        if not touch.stale.any():
            return
        if not needed and isinstance(self._hand.tactile, NoTactile):
            return  # there is nothing that could have fallen silent
        age = time.monotonic() - touch.time[touch.stale].min()
        old = f"{1e3 * age:.0f} ms old" if np.isfinite(age) else "no reading yet"
        detail = f"finger {', '.join(str(i) for i in np.flatnonzero(touch.stale))}: {old}"
        self._happen(Event.TACTILE_STALE, detail)
        if needed:
            self._happen(Event.TACTILE_NEEDED, detail)

    def at_pose(self) -> None:
        """A tracker that has fallen silent: whoever is told poses goes by them."""
        if self._hand.tracker is None:
            return
        pose = self._hand.pose
        if pose is None:
            self._happen(Event.POSE_STALE, "the tracker has told none yet")
        elif pose.stale:
            age = time.monotonic() - pose.time
            self._happen(Event.POSE_STALE, f"{1e3 * age:.0f} ms old; does the tracker see it?")

    def at_clock(self, cycle: float, skipped: int) -> None:
        """Ticks whose work took longer than their period, or that were left out."""
        self._overruns.append(cycle > self._hand.control_period or skipped > 0)
        count = len(self._overruns)
        if count < WINDOW // 2:
            return
        share = sum(self._overruns) / count
        warn, hold = self._hand.limits.overruns
        if share > hold:
            self._happen(Event.OVERRUNS, f"{share:.0%} of the last {count} ticks")
        elif share > warn:
            self._happen(Event.OVERRUNS_WARNING, f"{share:.0%} of the last {count} ticks")

    def at_limits(self) -> None:
        """Joints that did not get what was asked."""
        limited = self._hand.limited
        if limited is None or not limited.clamped.any():
            return
        i = int(np.flatnonzero(limited.clamped)[0])
        why = "out of range" if limited.out_of_range[i] else "too fast"
        self._happen(
            Event.CLAMPED,
            f"{self.joints(limited.clamped)}: {why}, sent {limited.q_target[i]:.3f} rad",
        )

    def _causes(self, alert: Bools) -> str:
        ids = [int(servo) for servo in self._hand.calibration.servo[alert]]
        found = self._hand.bus.read(registers.HARDWARE_ERROR, ids)
        said = []
        for servo, raw, ok in zip(ids, found.raw, found.ok, strict=True):
            cause = registers.describe_hardware_error(int(raw)) if ok else "unreadable"
            said.append(f"servo {servo}: {cause or 'error already gone'}")
        return "; ".join(said)

    def joints(self, chosen: Bools) -> str:
        """Names of some joints, for people; four at most."""
        names = [self._hand.hand.joint_names[i] for i in np.flatnonzero(chosen)]
        return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")

    def servos(self, chosen: Bools) -> str:
        """IDs of some servos, for people."""
        return ", ".join(str(servo) for servo in self._hand.calibration.servo[chosen])
