"""Motions that are not about an object: for checking a hand, measuring its lag, replaying a log."""

from __future__ import annotations

from abc import abstractmethod
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from dexctl import Controller, GraspState, HandModel
from dexctl.controller import check_state
from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from dexctl.validation import check_numbers

CHIRP = "chirp"
"""The name of `Chirp` on the command line and in logs."""


class _Motion(Controller):
    """Follows a path that is known beforehand, from where the set-points are at the start."""

    goes_to_goals = turns_as_told = False

    def __init__(self, hand: HandModel, *, control_period: float) -> None:
        super().__init__(hand, control_period=control_period)
        self._asked = 0
        self._start: Floats | None = None

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._asked, self._start = 0, None

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        if self._start is None:
            self._start = state.q_target.copy()
        self._asked += 1
        return self._start + self.offset(self._asked * self.control_period) - state.q_target

    @abstractmethod
    def offset(self, time: float) -> Floats | float:
        """How far the set-points are from the start at ``time`` [s], ``(d,)`` [rad]."""


@final
class Sine(_Motion):
    """All joints to and fro.

    Args:
        hand: the hand.
        control_period: [s].
        amplitude: [rad].
        frequency: [Hz].
    """

    def __init__(
        self,
        hand: HandModel,
        *,
        control_period: float = 0.02,
        amplitude: float = 0.1,
        frequency: float = 0.5,
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.amplitude, self.frequency = amplitude, frequency
        check_numbers(self, positive=("amplitude", "frequency"))

    def offset(self, time: float) -> float:
        return self.amplitude * np.sin(2 * np.pi * self.frequency * time)


@final
class Chirp(_Motion):
    """Every joint to and fro, faster and faster at one speed: from which it can be identified.

    One joint of each finger moves at a time, the nearest to the palm first; after the last one all
    stand still. The swing is ``amplitude`` until the speed would be exceeded, and smaller then.

    Args:
        hand: the hand.
        control_period: [s].
        amplitude: largest swing [rad].
        speed: largest speed of a set-point [rad/s].
        seconds: of each joint [s].
        frequencies: at its start and end [Hz].
    """

    EACH = 8.0
    """Time of each joint, by default [s]."""
    FADING = 0.5
    """Time in which the swing fades at the end of a joint's motion [s]."""

    def __init__(
        self,
        hand: HandModel,
        *,
        control_period: float = 0.02,
        amplitude: float = 0.1,
        speed: float = 0.4,
        seconds: float = EACH,
        frequencies: tuple[float, float] = (0.3, 5.0),
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.amplitude, self.speed, self.each = amplitude, speed, seconds
        self.lowest, self.highest = frequencies
        check_numbers(self, positive=("amplitude", "speed", "each", "lowest", "highest"))

    @property
    def seconds(self) -> float:
        """How long the motion takes [s]."""
        return self.each * self.hand.finger_joints.shape[1]

    def offset(self, time: float) -> Floats:
        out = np.zeros(self.hand.nq)
        turn = int(time / self.each)
        if turn >= self.hand.finger_joints.shape[1]:
            return out
        t, growth = time - turn * self.each, np.log(self.highest / self.lowest)
        frequency = self.lowest * np.exp(growth * t / self.each)
        phase = 2 * np.pi * (frequency - self.lowest) * self.each / growth
        own = turn < self.hand.moves.sum(axis=1)  # a shorter finger repeats a joint of another
        swing = min(self.amplitude, self.speed / (2 * np.pi * frequency))
        swing *= min(1.0, (self.each - t) / self.FADING)
        out[self.hand.finger_joints[own, turn]] = swing * np.sin(phase)
        return out


@final
class StepAndChirp(_Motion):
    """One joint: a step, and 2 s later a sine of rising frequency.

    Args:
        hand: the hand.
        joint: which joint.
        control_period: [s].
        amplitude: of the chirp; the step is three times as far [rad].
        seconds: of the chirp [s].
        frequencies: at its start and end [Hz].
    """

    STEP_SECONDS = 2.0

    def __init__(
        self,
        hand: HandModel,
        joint: int,
        *,
        control_period: float = 0.02,
        amplitude: float = 0.03,
        seconds: float = 8.0,
        frequencies: tuple[float, float] = (0.3, 2.0),
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self._joint, self._amplitude, self._seconds = joint, amplitude, seconds
        self._frequencies = frequencies

    @property
    def seconds(self) -> float:
        """How long the motion takes [s]."""
        return self.STEP_SECONDS + self._seconds

    def offset(self, time: float) -> Floats:
        out = np.zeros(self.hand.nq)
        if time < self.STEP_SECONDS:
            out[self._joint] = 3 * self._amplitude * (0.2 < time < 1.2)
            return out
        t = min(time - self.STEP_SECONDS, self._seconds)
        low, high = self._frequencies
        phase = 2 * np.pi * (low * t + 0.5 * (high - low) * t * t / self._seconds)
        out[self._joint] = self._amplitude * np.sin(phase)
        return out


@final
class Replay(Controller):
    """Set-points that were sent once before.

    Args:
        hand: the hand.
        q_target: a row for each control period, ``(T, d)`` [rad]; the last one is kept.
        control_period: [s].
    """

    def __init__(self, hand: HandModel, q_target: Floats, *, control_period: float = 0.02) -> None:
        super().__init__(hand, control_period=control_period)
        q_target = np.asarray(q_target, float)
        if q_target.ndim != 2 or q_target.shape[1] != hand.nq or not len(q_target):
            raise InvalidInput(f"q_target has shape {q_target.shape}; expected (T, {hand.nq})")
        if not np.isfinite(q_target).all():
            raise InvalidInput("q_target is not finite")
        self._rows, self._asked = q_target, 0

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._asked = 0

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        row = self._rows[min(self._asked, len(self._rows) - 1)]
        self._asked += 1
        return row - state.q_target


def lag(sent: Floats, came: Floats, period: float, most: float = 0.5) -> float:
    """How much later ``came`` does what ``sent`` did [s], by cross-correlation of their changes.

    The peak is found between samples by a parabola through the three highest values. NaN where
    nothing moves.

    Args:
        sent, came: ``(T,)`` [rad], at the same times.
        period: between samples [s].
        most: longest lag looked for [s].
    """
    a, b = np.diff(sent), np.diff(came)
    a, b = a - a.mean(), b - b.mean()
    count = min(round(most / period), len(a) - 2)
    if count < 2 or not (a.any() and b.any()):
        return float("nan")
    # windows of one length, each by its own size: else short lags would seem to fit better
    window = len(a) - count
    first = a[:window]
    later = [b[k : k + window] for k in range(count + 1)]
    score = np.array([first @ part / max(np.linalg.norm(part), 1e-12) for part in later])
    k, shift = int(score.argmax()), 0.0
    if 0 < k < count:
        before, peak, after = score[k - 1 : k + 2]
        bend = before - 2 * peak + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return (k + shift) * period
