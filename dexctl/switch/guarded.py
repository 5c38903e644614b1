"""GuardedSwitch: unloads, lifts, carries, places and loads one finger of each hand.

The finger moves in Cartesian space: away from the object along the normal it touched, round the
axis of the wanted rotation at a clearance, and in again until it touches. Nothing is known of the
object's shape but the tangent planes that were touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from dexctl.hand import HandConfiguration, HandModel
from dexctl.rotations import cross
from dexctl.state import Bools, Floats, GraspState


class Phase(IntEnum):
    """Where a switch stands. The finger belongs to the switch in LIFT, CARRY and PLACE."""

    IDLE = 0
    UNLOAD = 1
    LIFT = 2
    CARRY = 3
    PLACE = 4
    LOAD = 5


@dataclass(frozen=True, kw_only=True)
class GuardedSwitchConfig:
    """Settings of `GuardedSwitch`; speeds are per second.

    Attributes:
        unload_time: over which the finger's share of the grip goes to zero [s].
        unloaded_force: normal force below which the finger may lift [N].
        clearance: distance from the touched surface while the finger is carried [m].
        lift_speed, carry_speed, place_speed: of the fingertip [m/s].
        place_depth: how far beyond the expected surface to look for touch [m].
        time_limit: a phase that takes longer gives up: the finger goes back to whoever
            closes in on the object [s].
        load_time: over which the finger's share of the grip comes back [s].
        touch_force: normal force that counts as touch while placing [N].
    """

    unload_time: float = 0.4
    unloaded_force: float = 0.2
    clearance: float = 0.018
    lift_speed: float = 0.10
    carry_speed: float = 0.12
    place_speed: float = 0.06
    place_depth: float = 0.03
    time_limit: float = 2.0
    load_time: float = 0.3
    touch_force: float = 0.05


class Landing(NamedTuple):
    """Where fingers are to be put down, one for each hand.

    Attributes:
        point: expected contact point ``(N, 3)`` [m].
        normal: expected unit normal there, from the fingertip into the object ``(N, 3)``.
    """

    point: Floats
    normal: Floats


class GuardedSwitch:
    """One switching finger in each of N hands; the state machine and the finger's motion.

    Args:
        hand: the hand.
        axis: the axis that fingers are carried round, unit vector.
        config: the settings.
        control_period: [s].
    """

    def __init__(
        self, hand: HandModel, axis: Floats, config: GuardedSwitchConfig, control_period: float
    ) -> None:
        self.hand = hand
        self.config = config
        self.axis = axis
        self._dt = control_period
        self._own = hand.moves & (hand.moves.sum(axis=0) == 1)
        self.start(0)

    def start(self, count: int) -> None:
        """All idle, for ``count`` hands."""
        self.phase = np.zeros(count, int)
        self.finger = np.full(count, -1)
        self.clock = np.zeros(count)
        self._outward = np.zeros((count, 3))
        self._lift_point = np.zeros((count, 3))
        self._landing = Landing(np.zeros((count, 3)), np.zeros((count, 3)))
        self._anchor = np.zeros((count, 3))

    def clear(self, mask: Bools) -> None:
        """Idle again in the hands in ``mask``."""
        self.phase[mask] = Phase.IDLE
        self.finger[mask] = -1
        self.clock[mask] = 0.0

    @property
    def released(self) -> Bools:
        """Fingers that belong to the switch, ``(N, m)``."""
        owned = (self.phase >= Phase.LIFT) & (self.phase <= Phase.PLACE)
        return self._one_hot(owned)

    @property
    def max_force(self) -> Floats:
        """Share of the grip that each finger may take, ``(N, m)``: ramps of unloading, loading."""
        config = self.config
        ramp = np.ones(len(self.phase))
        falling, rising = self.phase == Phase.UNLOAD, self.phase == Phase.LOAD
        ramp[falling] = 1.0 - self.clock[falling] / config.unload_time
        ramp[rising] = self.clock[rising] / config.load_time
        share = np.ones((len(self.phase), self.hand.n_fingers))
        busy = falling | rising
        share[busy, self.finger[busy]] = np.clip(ramp[busy], 0.0, 1.0)
        return share

    def begin(self, mask: Bools, finger: np.ndarray, origin: Floats, landing: Landing) -> None:
        """Start a switch of ``finger`` ``(N,)`` in the idle hands in ``mask``.

        ``landing`` is where it shall come down, ``origin`` ``(N, 3)`` the object's centre now:
        both move on with the object until the finger lands.
        """
        self.phase[mask] = Phase.UNLOAD
        self.finger[mask] = finger[mask]
        self.clock[mask] = 0.0
        self._landing.point[mask] = landing.point[mask]
        self._landing.normal[mask] = landing.normal[mask]
        self._anchor[mask] = origin[mask]

    def command(
        self, state: GraspState, now: HandConfiguration, target: HandConfiguration, origin: Floats
    ) -> Floats:
        """Advance the phases by one control period; the set-point change ``(N, d)``.

        ``now`` and ``target`` are the hand at ``q`` and at ``q_target``.
        """
        self._advance(state, now, origin)
        change = np.zeros_like(state.q)
        moving = np.flatnonzero((self.phase >= Phase.LIFT) & (self.phase <= Phase.PLACE))
        if len(moving):
            finger = self.finger[moving]
            setpoint = target.fingertip_position[moving, finger]
            measured = now.fingertip_position[moving, finger]
            step = self._tip_step(moving, setpoint, measured, origin[moving])
            change[moving] = self._joint_step(moving, finger, target, step)
        return change

    # -- phases -----------------------------------------------------------------------------

    def _advance(self, state: GraspState, now: HandConfiguration, origin: Floats) -> None:
        config = self.config
        self.clock += self._dt
        busy = np.flatnonzero(self.phase)
        finger = self.finger[busy]
        touch = state.in_contact[busy, finger]
        force = np.where(touch, state.contact_force[busy, finger], 0.0)
        tip = now.fingertip_position[busy, finger]
        phase, clock = self.phase[busy], self.clock[busy]

        free = (force < config.unloaded_force) & (clock >= config.unload_time)
        lift = (phase == Phase.UNLOAD) & (free | (clock >= config.time_limit))
        where = busy[lift]
        self._outward[where] = np.where(
            touch[lift, None], -state.contact_normal[where, self.finger[where]], 0.0
        )
        lost = ~touch[lift]
        self._outward[where[lost]] = _across(tip[lift][lost] - origin[where[lost]], self.axis)
        self._lift_point[where] = tip[lift]
        # the landing was chosen before unloading: it has moved with the object since
        self._landing.point[where] += origin[where] - self._anchor[where]

        risen = ((tip - self._lift_point[busy]) * self._outward[busy]).sum(axis=-1)
        carry = (phase == Phase.LIFT) & ((risen > 0.7 * config.clearance) | (clock > 0.5))
        above = self._landing.point[busy] - config.clearance * self._landing.normal[busy]
        near = np.linalg.norm(tip - above, axis=-1) < 0.008
        place = (phase == Phase.CARRY) & (near | (clock > config.time_limit))
        land = (phase == Phase.PLACE) & touch & (force >= config.touch_force)
        give_up = (phase == Phase.PLACE) & ~land & (clock > config.time_limit)
        loaded = (phase == Phase.LOAD) & (clock >= config.load_time)
        for moved, following in (
            (lift, Phase.LIFT),
            (carry, Phase.CARRY),
            (place, Phase.PLACE),
            (land, Phase.LOAD),
            (give_up | loaded, Phase.IDLE),
        ):
            self.phase[busy[moved]] = following
            self.clock[busy[moved]] = 0.0
        self.finger[busy[give_up | loaded]] = -1

    # -- motion -----------------------------------------------------------------------------

    def _tip_step(
        self, moving: np.ndarray, setpoint: Floats, measured: Floats, origin: Floats
    ) -> Floats:
        """How far each moving finger's tip set-point shall go in this period, ``(M, 3)``."""
        config = self.config
        phase = self.phase[moving]
        landing, normal = self._landing.point[moving], self._landing.normal[moving]
        above = landing - config.clearance * normal
        goal = np.empty_like(setpoint)
        speed = np.empty(len(moving))

        lift = phase == Phase.LIFT
        goal[lift] = (self._lift_point[moving] + config.clearance * self._outward[moving])[lift]
        speed[lift] = config.lift_speed
        carry = phase == Phase.CARRY
        goal[carry] = self._round_the_axis(measured, above, origin)[carry]
        speed[carry] = config.carry_speed
        place = phase == Phase.PLACE
        goal[place] = (landing + config.place_depth * normal)[place]
        speed[place] = config.place_speed

        # the set-point leads the tip, but not by more than the tip covers in a few periods
        lead = np.maximum(2.0 * speed * self._dt, 0.008)
        step = goal - measured
        distance = np.linalg.norm(step, axis=-1)
        aim = measured + step * np.minimum(1.0, lead / np.maximum(distance, 1e-9))[:, None]
        step = aim - setpoint
        distance = np.linalg.norm(step, axis=-1)
        # the first step after unloading takes the pressed-in set-point back to the tip at once
        limit = np.maximum(speed * self._dt, 0.0)
        return step * np.minimum(1.0, limit / np.maximum(distance, 1e-9))[:, None]

    def _round_the_axis(self, tip: Floats, goal: Floats, origin: Floats) -> Floats:
        """A goal a little way along the arc from ``tip`` to ``goal`` round the object's axis."""
        axis = self.axis
        a, b = tip - origin, goal - origin
        height_a, height_b = a @ axis, b @ axis
        flat_a, flat_b = a - height_a[:, None] * axis, b - height_b[:, None] * axis
        radius_a, radius_b = np.linalg.norm(flat_a, axis=-1), np.linalg.norm(flat_b, axis=-1)
        angle = np.arctan2(cross(flat_a, flat_b) @ axis, (flat_a * flat_b).sum(axis=-1))
        part = np.clip(0.25 / np.maximum(np.abs(angle), 1e-9), 0.0, 1.0)
        turn = part * angle
        unit = flat_a / np.maximum(radius_a, 1e-9)[:, None]
        side = cross(np.broadcast_to(axis, unit.shape), unit)
        direction = np.cos(turn)[:, None] * unit + np.sin(turn)[:, None] * side
        # outside both ends until the last piece of the arc: corners stick out between faces
        outer = np.maximum(radius_a, radius_b)
        radius = np.where(part < 1.0, outer, radius_b)
        height = height_a + part * (height_b - height_a)
        return origin + radius[:, None] * direction + height[:, None] * axis

    def _joint_step(
        self, moving: np.ndarray, finger: np.ndarray, target: HandConfiguration, step: Floats
    ) -> Floats:
        """Joint change ``(M, d)`` of the finger's own joints that moves its tip by ``step``."""
        tips = target.fingertip_position[moving]
        moved = HandConfiguration(tips, target.joint_twist[moving], target.moves)
        rows = np.arange(len(moving))
        jacobian = moved.contact_jacobian(tips)[rows, finger] * self._own[finger][:, None, :]
        gram = jacobian @ jacobian.swapaxes(-1, -2) + 0.01**2 * np.eye(3)
        return (jacobian.swapaxes(-1, -2) @ np.linalg.solve(gram, step[..., None]))[..., 0]

    def _one_hot(self, mask: Bools) -> Bools:
        out = np.zeros((len(self.phase), self.hand.n_fingers), bool)
        out[mask, self.finger[mask]] = True
        return out


def _across(vector: Floats, axis: Floats) -> Floats:
    """The unit part of ``vector`` ``(..., 3)`` across ``axis``."""
    flat = vector - (vector @ axis)[..., None] * axis
    return flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
