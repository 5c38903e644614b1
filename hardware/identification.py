"""What a log says of the joints' dynamics: gains, friction, latency and inertia of each.

A joint is taken for a mass behind a position servo,

    I a = k (r - q + o) - c v - f clip(v / s, -1, 1),

whose dry friction grows with the speed up to s and then stays, and whose reference r follows the
set-points ``latency`` later, as fast as the servo's profile lets it. The torque that the servo
measures tells k and the latency; how q follows the set-points tells the rest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from hardware.log import Log, limits_of, of_joints
from hardware.motions import CHIRP, Chirp

STEP = 0.002
"""Of the fit's simulation [s]."""
LONGEST = 0.3
"""Latency looked for [s]."""
EXPLAINED = 0.005
"""Greatest residual of a joint that moves as the model says [rad]; a chirp leaves under 0.001, and
joints that push at an object 0.01 and more."""
_LEAST_MOTION = 0.01  # rad that a joint's set-point must have moved for its dynamics to show
_TAIL = 0.5  # s after the last change of a set-point that still tell something
_LEAST_TORQUE = 1e-6  # N m
_OF_TORQUE = 0.8  # share of the torque's variance that the servo's law must explain
# of the search, per joint: log k/I [1/s^2], log c/k [s], log f/k [rad], latency [s], offset [rad],
# log s [rad/s]
_LOWER = np.array([np.log(1.0), np.log(1e-4), np.log(1e-5), 0.0, -1.0, np.log(1e-5)])
_UPPER = np.array([np.log(1e6), np.log(10.0), np.log(1.0), LONGEST, 1.0, np.log(0.1)])
_NUDGE = np.array([1e-3, 1e-3, 1e-2, 2e-4, 1e-5, 1e-2])  # of finite differences
_LAW, _LATENCY, _OFFSET, _CREEP = slice(0, 3), 3, 4, 5
_ROUNDS = 40
_FEWEST = 100  # samples


class JointDynamics(NamedTuple):
    """The dynamics of d joints ``(d,)``; NaN where a joint did not move.

    Attributes:
        stiffness: of the servo, k [N m/rad].
        servo_damping: what the servo's torque lessens with speed [N m s/rad].
        damping: c, the servo's and the joint's own [N m s/rad].
        friction: dry, of the gears, f [N m].
        inertia: I, links and rotor [kg m^2].
        latency: from a set-point to its effect [s].
        offset: o, of the reference, by gravity and calibration [rad].
        residual: joints measured less joints computed, RMS [rad].
        measured_torque: whether the measured torque gave the stiffness, ``(d,)``; elsewhere it is
            what the servo was told.
        cut_short: whether less than all of its motion was seen, ``(d,)``: of a chirp the slow part,
            which tells little of inertia.
    """

    stiffness: Floats
    servo_damping: Floats
    damping: Floats
    friction: Floats
    inertia: Floats
    latency: Floats
    offset: Floats
    residual: Floats
    measured_torque: Bools
    cut_short: Bools

    @property
    def explained(self) -> Bools:
        """Joints that moved as the model says, all the way: only there it tells more than the
        torque, ``(d,)``.

        What the measured torque gives, stiffness and latency, holds of the others too.
        """
        return (np.nan_to_num(self.residual, nan=np.inf) <= EXPLAINED) & ~self.cut_short


class Fit(NamedTuple):
    """What was fitted, and how well.

    Attributes:
        dynamics: of the joints.
        time: of the ticks, ``(T,)`` [s].
        q, computed: joints as measured and as computed, ``(T, d)`` [rad].
        moving: ticks that tell of each joint, ``(T, d)``.
    """

    dynamics: JointDynamics
    time: Floats
    q: Floats
    computed: Floats
    moving: Bools


def identify(log: Log) -> Fit:
    """Fit the joints' dynamics to the ticks in which a controller ran.

    The hand is best empty: what an object does to the fingers is no part of the model, so that of a
    gait only what the measured torque tells can be trusted (`JointDynamics.explained`).

    Raises:
        InvalidInput: the log holds no run, or no joint moved.
    """
    ticks = log.ticks
    if "state" not in ticks or "limits" not in log.run:
        raise InvalidInput(f"{log.path} holds no run of a hand")
    rows = ticks["state"] == "run"
    if rows.sum() < _FEWEST:
        raise InvalidInput(
            f"{log.path} holds {int(rows.sum())} ticks of a controller; expected {_FEWEST} or more"
        )
    told, speed, torque = (
        of_joints(log.run, ticks["q"].shape[1], "stiffness_nm_per_rad"),
        *(limits_of(log.run, ticks["q"].shape[1], f"{name}_limit") for name in ("speed", "torque")),
    )
    if told is None or speed is None or torque is None:
        raise InvalidInput(f"{log.path} does not say what stiffness and limits the servos had")
    return fit(
        ticks["time"][rows],
        ticks["q_target"][rows],
        ticks["q"][rows],
        ticks["velocity"][rows],
        ticks["torque"][rows],
        speed_limit=speed,
        torque_limit=torque,
        told=told,
        motion=Chirp.EACH - Chirp.FADING if log.run.get("controller") == CHIRP else 0.0,
    )


def fit(
    time: Floats,
    q_target: Floats,
    q: Floats,
    velocity: Floats,
    torque: Floats,
    *,
    speed_limit: Floats | float,
    torque_limit: Floats | float,
    told: Floats | float,
    motion: float = 0.0,
) -> Fit:
    """Fit the joints' dynamics to samples.

    Args:
        time: of the samples, rising, ``(T,)`` [s].
        q_target: set-points sent at those times, ``(T, d)`` [rad].
        q, velocity, torque: as measured, ``(T, d)`` [rad], [rad/s], [N m].
        speed_limit: of the servos' profiles, of all or each ``(d,)`` [rad/s].
        torque_limit: of the servos, as well [N m]; samples at it do not count.
        told: the stiffness that the servos were told, as well [N m/rad].
        motion: how long a joint moves that shows all that it is to show [s].

    Raises:
        InvalidInput: no joint moved.
    """
    time = time - time[0]
    change = np.abs(q_target - q_target[0])
    moved = change.max(axis=0) > _LEAST_MOTION
    if not moved.any():
        raise InvalidInput(
            f"no set-point moved by more than {_LEAST_MOTION:g} rad; expected a chirp, or a gait"
        )
    moving = _moving(time, q_target) & moved & np.isfinite(q)
    moving &= ~(np.abs(torque) >= torque_limit)  # what is not measured counts
    speed, told = (np.broadcast_to(one, moved.shape)[moved] for one in (speed_limit, told))
    samples = _Samples(time, q_target[:, moved], q[:, moved], moving[:, moved], speed)
    laws = _servo_laws(samples, velocity[:, moved], torque[:, moved])
    parameters = _search(samples, laws.latency)
    cut_short = _moved_for(time, q_target)[moved] < motion
    dynamics = _scaled(samples, parameters, laws, told)._replace(cut_short=cut_short)
    whole = np.full(q.shape, np.nan)
    whole[:, moved] = samples.simulate(parameters[None])[:, 0]
    return Fit(_spread(dynamics, moved), time, q, whole, moving)


def _moving(time: Floats, q_target: Floats) -> Bools:
    """Ticks between a joint's first motion and a while after its last, ``(T, d)``."""
    first, last = _motion(time, q_target)
    return (time[:, None] >= first) & (time[:, None] <= last + _TAIL)


def _moved_for(time: Floats, q_target: Floats) -> Floats:
    """From a joint's first motion to its last, ``(d,)`` [s]; below 0 where it did not move."""
    first, last = _motion(time, q_target)
    return last - first


def _motion(time: Floats, q_target: Floats) -> tuple[Floats, Floats]:
    """When each set-point moved first and last, ``(d,)`` [s]."""
    changed = np.zeros(q_target.shape, bool)
    changed[1:] = np.diff(q_target, axis=0) != 0.0
    stamped = np.broadcast_to(time[:, None], q_target.shape)
    return (
        np.where(changed, stamped, np.inf).min(axis=0),
        np.where(changed, stamped, -np.inf).max(axis=0),
    )


class _Samples:
    """Samples of d joints that moved, and the model of them.

    Args:
        time, q_target, q, moving, speed_limit: see `fit` and `Fit`.
    """

    def __init__(
        self, time: Floats, q_target: Floats, q: Floats, moving: Bools, speed_limit: Floats
    ) -> None:
        self.time, self.q, self.moving = time, q, moving
        self._speed, self._target = speed_limit, q_target
        # set-points stay until the next: their integral is straight from one to the next
        self._area = np.concatenate(
            [np.zeros((1, q.shape[1])), np.cumsum(np.diff(time)[:, None] * q_target[:-1], axis=0)]
        )
        # each joint is computed from where it begins to move
        joints = np.arange(q.shape[1])
        first = moving.argmax(axis=0)
        last = len(time) - 1 - moving[::-1].argmax(axis=0)
        self._begin = time[first]
        self._start, self._held = q[first, joints], q_target[np.maximum(first - 1, 0), joints]
        self._steps = int((time[last] - self._begin).max() / STEP) + 2
        place = np.clip((time[:, None] - self._begin) / STEP, 0.0, self._steps - 1.0)
        self._before = np.minimum(place.astype(int), self._steps - 2)
        self._after = place - self._before

    def references(self, latency: Floats) -> Floats:
        """Where the servos' profiles are ``latency`` ``(L, d)`` later, ``(steps, L, d)`` [rad]."""
        found = np.empty((self._steps, *latency.shape))
        for place in np.ndindex(latency.shape):
            j = place[-1]
            at = self._begin[j] - latency[place] + STEP * np.arange(-1, self._steps)
            area = np.interp(at, self.time, self._area[:, j])
            area += np.minimum(at - self.time[0], 0.0) * self._target[0, j]
            area += np.maximum(at - self.time[-1], 0.0) * self._target[-1, j]
            found[(slice(None), *place)] = np.diff(area) / STEP
        most = self._speed * STEP
        reference = np.broadcast_to(self._held, latency.shape).copy()
        for step in range(self._steps):
            reference += np.clip(found[step] - reference, -most, most)
            found[step] = reference
        return found

    def simulate(self, parameters: Floats) -> Floats:
        """Joints at the samples' times, ``(T, L, d)`` [rad], for parameters ``(L, d, 6)``."""
        lanes = parameters.shape[:2]
        k, ratio, dead = np.exp(np.moveaxis(parameters[..., _LAW], -1, 0))
        slow = np.exp(parameters[..., _CREEP])
        stiff = STEP * k
        mass = 1.0 + k * STEP * (ratio + STEP)
        lost = STEP * k * dead / mass
        give, creeping = 1.0 / mass, 1.0 / (mass + STEP * k * dead / slow)
        q, v = np.broadcast_to(self._start, lanes).copy(), np.zeros(lanes)
        path = np.empty((self._steps, *lanes))
        wanted = self.references(parameters[..., _LATENCY]) + parameters[..., _OFFSET]
        for i in range(self._steps):
            push = v + stiff * (wanted[i] - q)
            sliding = give * push - np.copysign(lost, push)
            v = np.where(np.abs(push) * creeping < slow, creeping * push, sliding)
            q += STEP * v
            path[i] = q
        return self.sampled(path)

    def sampled(self, path: Floats) -> Floats:
        """What goes on at every step ``(steps, L, d)``, at the samples' times ``(T, L, d)``."""
        joints = np.arange(path.shape[2])
        low, high = (path[self._before + one, :, joints] for one in (0, 1))
        return np.moveaxis(low + self._after[..., None] * (high - low), 2, 1)

    def errors(self, parameters: Floats) -> Floats:
        """Joints computed less joints measured, zero where nothing tells, ``(T, L, d)`` [rad]."""
        computed = self.simulate(parameters)
        return np.where(self.moving[:, None], computed - self.q[:, None], 0.0)


class _ServoLaws(NamedTuple):
    """What the measured torque tells of d joints' servos ``(d,)``; NaN where it tells nothing.

    Attributes:
        stiffness, damping: k and d of torque = k (r - q) - d v + constant.
        latency: with which that holds best [s].
    """

    stiffness: Floats
    damping: Floats
    latency: Floats


def _servo_laws(samples: _Samples, velocity: Floats, torque: Floats) -> _ServoLaws:
    """Fit the servos' law to the torque they measured, whatever moved the joints."""
    count = torque.shape[1]
    laws = _ServoLaws(*np.full((3, count), np.nan))
    stiffness, damping, latency = laws
    for tried in (np.arange(0.0, LONGEST, 0.01), np.arange(-0.01, 0.01, 0.001)):
        around = np.nan_to_num(latency)  # nothing at first, then what the coarse search found
        lanes = np.maximum(tried[:, None] + around, 0.0)
        reference = samples.sampled(samples.references(lanes))
        for j in range(count):
            good = samples.moving[:, j] & np.isfinite(torque[:, j] + velocity[:, j])
            wanted = torque[good, j]
            if len(wanted) < _FEWEST or wanted.std() < _LEAST_TORQUE:
                continue
            best = (1.0 - _OF_TORQUE) * wanted.var()
            for lane, late in enumerate(lanes[:, j]):
                behind = reference[good, lane, j] - samples.q[good, j]
                columns = np.stack([behind, -velocity[good, j], np.ones(len(behind))], axis=1)
                law, *_ = np.linalg.lstsq(columns, wanted, rcond=None)
                left = (wanted - columns @ law).var()
                if left < best and law[0] > 0:
                    best, latency[j] = left, late
                    stiffness[j], damping[j] = law[0], max(law[1], 0.0)
    return laws


def _search(samples: _Samples, latency: Floats) -> Floats:
    """The parameters ``(d, 6)`` that follow the joints best, by Levenberg and Marquardt.

    All joints at once, each with its own damping: a simulation costs as much for one as for all.

    Args:
        samples: what to follow.
        latency: where it is known, ``(d,)`` [s]; elsewhere NaN.
    """
    known = np.isfinite(latency)
    grid = [
        [2 * np.log(rate), np.log(1.4 / rate), np.log(0.01), late, 0.0, np.log(2e-3)]
        for rate in (8.0, 20.0, 50.0)
        for late in (0.005, 0.03, 0.08)
    ]
    tried = np.repeat(np.array(grid)[:, None], len(latency), axis=1)
    tried[..., _LATENCY] = np.where(known, latency, tried[..., _LATENCY])
    cost = (samples.errors(tried) ** 2).sum(axis=0)
    here = tried[cost.argmin(axis=0), np.arange(len(latency))]
    nudges = np.diag(_NUDGE)[:, None]
    free = np.ones(here.shape, bool)
    free[known, _LATENCY] = False

    def around(point: Floats) -> tuple[Floats, Floats]:
        found = samples.errors(np.concatenate([point[None], point + nudges]))
        slopes = np.moveaxis(found[:, 1:] - found[:, :1], 1, -1) / _NUDGE
        return found[:, 0], np.where(free, slopes, 0.0)

    error, slopes = around(here)
    cost, damping = (error**2).sum(axis=0), np.full(len(latency), 1e-2)
    for _ in range(_ROUNDS):
        curvature = np.einsum("tja,tjb->jab", slopes, slopes)
        scale = np.einsum("jaa->ja", curvature) + 1e-12
        ridge = np.einsum("ja,ab->jab", damping[:, None] * scale, np.eye(len(_NUDGE)))
        fall = np.einsum("tja,tj->ja", slopes, error)
        step = np.linalg.solve(curvature + ridge, fall[..., None])[..., 0]
        there = np.clip(here - np.where(free, step, 0.0), _LOWER, _UPPER)
        error_there, slopes_there = around(there)
        cost_there = (error_there**2).sum(axis=0)
        better = cost_there < cost
        done = (better & (cost_there > 0.9999 * cost)) | (damping > 1e6)
        here = np.where(better[:, None], there, here)
        error, slopes = (
            np.where(better, error_there, error),
            np.where(better[:, None], slopes_there, slopes),
        )
        cost = np.minimum(cost, cost_there)
        damping = np.where(better, damping / 4, damping * 5)
        if done.all():
            break
    return here


def _scaled(samples: _Samples, parameters: Floats, laws: _ServoLaws, told: Floats) -> JointDynamics:
    """With units: what the measured torque, or else what the servos were told, makes of them."""
    rate, ratio, dead = np.exp(parameters[:, _LAW].T)
    measured = np.isfinite(laws.stiffness)
    stiffness = np.where(measured, laws.stiffness, told)
    error = samples.errors(parameters[None])[:, 0]
    count = np.maximum(samples.moving.sum(axis=0), 1)
    return JointDynamics(
        stiffness=stiffness,
        servo_damping=laws.damping,
        damping=stiffness * ratio,
        friction=stiffness * dead,
        inertia=stiffness / rate,
        latency=parameters[:, _LATENCY],
        offset=parameters[:, _OFFSET],
        residual=np.sqrt((error * error).sum(axis=0) / count),
        measured_torque=measured,
        cut_short=np.zeros(len(measured), bool),
    )


def _spread(found: JointDynamics, moved: NDArray[np.bool_]) -> JointDynamics:
    """The same of all joints: NaN where one did not move."""

    def widen(value: np.ndarray) -> np.ndarray:
        fill = False if value.dtype == bool else np.nan
        out = np.full((len(moved), *value.shape[1:]), fill, value.dtype)
        out[moved] = value
        return out

    return JointDynamics(*(widen(value) for value in found))
