"""GuardedSwitch: unloads, lifts, carries, places and loads one finger of each hand.

The finger moves in Cartesian space: away from the object along the normal it touched, round the
axis of the wanted rotation at a clearance, and in again until it touches. Nothing is known of the
object's shape but the planes that were touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexctl.configuration import HandConfiguration
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.switch.config import GuardedSwitchConfig
from dexctl.switch.landing import Landing, round_the_axis, split, unit_across
from dexctl.switch.paths import JointPath, SwingPaths
from dexctl.validation import shown

Indices = NDArray[np.intp]

_MARGIN = 0.004  # by which a carried tip stays outside where tips have touched [m]


class Phase(IntEnum):
    """Where a switch stands. The finger belongs to the switch in LIFT, CARRY and PLACE."""

    IDLE = 0
    UNLOAD = 1
    LIFT = 2
    CARRY = 3
    PLACE = 4
    LOAD = 5


class GuardedSwitch:
    """One switching finger in each of N hands: the phases, and the finger's motion.

    While a finger unloads and loads it still belongs to whoever holds the object, who is told by
    `max_force` and `yielding` what share of the grip it may take. From lift to touch it is moved
    by `command`. Touch ends placing. Time limits give up safely: a finger that cannot be
    unloaded, or that `may_lift` refuses, is loaded again; one that finds nothing to touch is
    handed back in the air, for its holder to close in with.

    Args:
        hand: the hand.
        axis: unit vector; fingers are carried round it.
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
        self.own_joints: Bools = hand.moves & (hand.moves.sum(axis=0) == 1)
        # a wrist's joints stay out of it: only the finger's own rows of its Jacobian count
        own_rows = np.take_along_axis(self.own_joints, hand.finger_joints, axis=1)
        self._own_rows = own_rows[..., None]
        self._swings = SwingPaths(hand, axis, config.clearance, config.carry_speed)
        if config.path == "planned":
            self._swings.prepare()
        self.start(0)

    def start(self, count: int) -> None:
        """All idle, for ``count`` hands."""
        self.phase = np.zeros(count, int)
        self.finger = np.full(count, -1)
        self.clock = np.zeros(count)
        self._outward = np.zeros((count, 3))
        self._lift_tip = np.zeros((count, 3))
        self._landing = Landing(np.zeros((count, 3)), np.zeros((count, 3)))
        self._anchor = np.zeros((count, 3))
        self._furthest = np.zeros(count)
        self._paths: dict[int, JointPath] = {}

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "phase": self.phase,
            "finger": self.finger,
            "clock": self.clock,
            "outward": self._outward,
            "lift_tip": self._lift_tip,
            "landing_tip": self._landing.tip,
            "landing_normal": self._landing.normal,
            "anchor": self._anchor,
            "furthest": self._furthest,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that decides the switches under way, to be given to `load_state_dict`."""
        paths = {str(row): copies(path._asdict()) for row, path in self._paths.items()}
        return {**copies(self._arrays()), "paths": paths}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with saved switches, of as many hands as they are of.

        Raises:
            InvalidInput: they are none.
        """
        check_names("a guarded switch", saved, (*self._arrays(), "paths"))
        (count,) = batch_shape("a guarded switch", saved, "phase") or (0,)
        self.start(count)
        fill("a guarded switch", self._arrays(), saved)
        paths = saved["paths"]
        rows = {str(row): row for row in range(count)}
        if not isinstance(paths, Mapping) or not rows.keys() >= paths.keys():
            raise InvalidInput(
                f"paths in the saved state of a guarded switch is {shown(paths)}; expected paths "
                f"by the numbers of {count} hands"
            )
        for row, path in paths.items():
            self._paths[rows[row]] = JointPath.loaded(path)

    def clear(self, mask: Bools) -> None:
        """Idle again in the hands in ``mask``; their objects may be others."""
        self.phase[mask] = Phase.IDLE
        self.finger[mask] = -1
        self.clock[mask] = 0.0
        self._furthest[mask] = 0.0
        for row in np.flatnonzero(mask) if self._paths else ():
            self._paths.pop(int(row), None)

    @property
    def released(self) -> Bools:
        """Fingers that belong to the switch, ``(N, m)``."""
        return self._one_hot((self.phase >= Phase.LIFT) & (self.phase <= Phase.PLACE))

    @property
    def yielding(self) -> Floats:
        """Rate at which set-points go back to their fingers, ``(N, m)`` [1/s]."""
        return np.where(self._one_hot(self.phase == Phase.UNLOAD), self.config.yield_rate, 0.0)

    @property
    def max_force(self) -> Floats:
        """Share of the grip that each finger may take, ``(N, m)``: ramps of unloading, loading."""
        share = np.ones((len(self.phase), self.hand.n_fingers))
        falling, rising = self.phase == Phase.UNLOAD, self.phase == Phase.LOAD
        for rows, ramp in (
            (falling, 1.0 - self.clock[falling] / self.config.unload_time),
            (rising, self.clock[rising] / self.config.load_time),
        ):
            share[rows, self.finger[rows]] = np.clip(ramp, 0.0, 1.0)
        return share

    def begin(self, mask: Bools, finger: Indices, origin: Floats, landing: Landing) -> None:
        """Start a switch of ``finger`` ``(N,)`` in the idle hands in ``mask``.

        ``landing`` is where it shall come down, ``origin`` ``(N, 3)`` the object's centre now:
        the landing moves on with the object until the finger lifts.
        """
        self.phase[mask] = Phase.UNLOAD
        self.finger[mask] = finger[mask]
        self.clock[mask] = 0.0
        self._landing.tip[mask] = landing.tip[mask]
        self._landing.normal[mask] = landing.normal[mask]
        self._anchor[mask] = origin[mask]

    def aim(self, origin: Floats, landing: Landing, mask: Bools | None = None) -> None:
        """Let the switches under way come down elsewhere than `begin` said, N rows each.

        Landings that turn with the object are given anew at each step; `origin` as in `begin`,
        ``mask`` the hands that are meant, ``(N,)``; None: all.
        """
        mask = (self.phase != Phase.IDLE) & (True if mask is None else mask)
        self._landing.tip[mask] = landing.tip[mask]
        self._landing.normal[mask] = landing.normal[mask]
        self._anchor[mask] = origin[mask]

    def command(
        self,
        state: GraspState,
        now: HandConfiguration,
        origin: Floats,
        may_lift: Callable[[Indices, Indices], Bools] | None = None,
    ) -> Floats:
        """Advance the phases by one control period; the set-point change ``(N, d)``.

        Args:
            state: of N hands.
            now: the hands at ``state.q``.
            origin: the objects' centres, ``(N, 3)`` [m].
            may_lift: asked at the moment of lifting with the hands and their fingers; the last
                word on whether the others can hold the object. None: always.
        """
        self._feel(state, now.fingertip_position, origin)
        self._advance(state, now, origin, may_lift)
        change = np.zeros_like(state.q)
        moving = np.flatnonzero((self.phase >= Phase.LIFT) & (self.phase <= Phase.PLACE))
        if self._paths:
            on_path = np.array([row in self._paths for row in moving], bool)
            for row in moving[on_path]:
                path = self._paths[row]
                change[row, path.joints] = (
                    path.at(float(self.clock[row])) - state.q_target[row, path.joints]
                )
            moving = moving[~on_path]
        if len(moving):
            self._follow(moving, state, now, origin, change)
        return change

    def _feel(self, state: GraspState, tip: Floats, origin: Floats) -> None:
        """Note how far from the axis tips have touched the objects since `clear`."""
        flat = split(tip - origin[:, None], self.axis)[1]
        held = state.in_contact & ~self.released
        radius = np.where(held, _length(flat), 0.0).max(axis=1)
        self._furthest = np.maximum(self._furthest, radius)

    # -- phases -----------------------------------------------------------------------------

    def _advance(
        self,
        state: GraspState,
        now: HandConfiguration,
        origin: Floats,
        may_lift: Callable[[Indices, Indices], Bools] | None,
    ) -> None:
        config = self.config
        self.clock += self._dt
        busy = np.flatnonzero(self.phase)
        if not len(busy):
            return
        finger = self.finger[busy]
        touch = state.in_contact[busy, finger]
        force = np.where(touch, state.contact_force[busy, finger], 0.0)
        tip = now.fingertip_position[busy, finger]
        phase, clock = self.phase[busy], self.clock[busy]
        late = clock > config.time_limit

        lift = (phase == Phase.UNLOAD) & (force < config.unloaded_force)
        lift &= clock >= config.unload_time
        refused = (phase == Phase.UNLOAD) & late & ~lift
        if may_lift is not None and lift.any():
            asked = np.flatnonzero(lift)
            lift[asked] = may_lift(busy[asked], finger[asked])
            refused[asked] |= ~lift[asked]
        risen = ((tip - self._lift_tip[busy]) * self._outward[busy]).sum(axis=-1)
        carry = (phase == Phase.LIFT) & ((risen > 0.7 * config.clearance) | (clock > 0.5))
        above = self._above(busy)
        near = np.sqrt(((tip - above) ** 2).sum(axis=-1)) < 0.008
        place = (phase == Phase.CARRY) & (near | late)
        for i in np.flatnonzero(carry | (phase == Phase.CARRY)) if self._paths else ():
            path = self._paths.get(int(busy[i]))
            if path is not None:  # a path spans lifting and carrying
                place[i] = clock[i] >= path.time[-1] + 2 * self._dt
                carry[i] = False
        land = (phase == Phase.PLACE) & touch & (force >= config.touch_force)
        lost = (phase == Phase.PLACE) & ~land & late
        loaded = (phase == Phase.LOAD) & (clock >= config.load_time)
        for moved, following in (
            (lift, Phase.LIFT),
            (carry, Phase.CARRY),
            (place, Phase.PLACE),
            (land | refused, Phase.LOAD),
            (lost | loaded, Phase.IDLE),
        ):
            self.phase[busy[moved]] = following
            self.clock[busy[moved]] = 0.0
        self.finger[busy[lost | loaded]] = -1
        if lift.any():
            self._leave(busy[lift], touch[lift], tip[lift], state, origin)
        if carry.any():
            distance = np.sqrt(((tip - above) ** 2).sum(axis=-1))
            for i in np.flatnonzero(carry & (distance > config.far_distance)):
                row = int(busy[i])
                path = self._swings.far(
                    state.q[row],
                    int(finger[i]),
                    tip[i],
                    above[i],
                    origin[row],
                    self._furthest[row] + _MARGIN,
                )
                if path is not None:
                    self._paths[row] = path
        for row in busy[place | lost] if self._paths else ():
            self._paths.pop(int(row), None)

    def _leave(
        self, rows: Indices, touch: Bools, tip: Floats, state: GraspState, origin: Floats
    ) -> None:
        """Note where fingers lift, and plan their swings where that is wanted."""
        finger = self.finger[rows]
        normal = state.contact_normal[rows, finger]
        inward = np.where(touch[:, None], normal, unit_across(origin[rows] - tip, self.axis))
        self._outward[rows] = -inward
        self._lift_tip[rows] = tip
        # the landing was chosen before unloading: it has moved with the object since
        self._landing.tip[rows] += origin[rows] - self._anchor[rows]
        if self.config.path != "planned":
            return
        for i, row in enumerate(rows):
            landing = Landing(self._landing.tip[row], self._landing.normal[row])
            contact = state.contact_position[row, finger[i]] if touch[i] else tip[i]
            path = self._swings.planned(
                state.q[row], int(finger[i]), tip[i], contact, inward[i], landing
            )
            if path is not None:
                self._paths[int(row)] = path
                self.phase[row] = Phase.CARRY

    # -- motion -----------------------------------------------------------------------------

    def _above(self, rows: Indices) -> Floats:
        """Where the tips are before they come down, ``(M, 3)``."""
        return self._landing.tip[rows] - self.config.clearance * self._landing.normal[rows]

    def _follow(
        self,
        rows: Indices,
        state: GraspState,
        now: HandConfiguration,
        origin: Floats,
        change: Floats,
    ) -> None:
        """Move the tips of the fingers in ``rows`` along their paths with their Jacobians."""
        config = self.config
        finger = self.finger[rows]
        tip = now.fingertip_position[rows, finger]
        jacobian = self._tip_jacobian(rows, now)
        joints = self.hand.finger_joints[finger]
        lead = np.take_along_axis(state.q_target[rows] - state.q[rows], joints, axis=1)
        setpoint = tip + (lead[:, None] @ jacobian)[:, 0]

        phase = self.phase[rows]
        lift, place = phase == Phase.LIFT, phase == Phase.PLACE
        # outside whatever has been touched: a corner may be on the way
        outside = self._furthest[rows] + _MARGIN
        goal = round_the_axis(tip, self._above(rows), origin[rows], self.axis, outside)
        # a carried finger that meets the object keeps off it
        bump = (phase == Phase.CARRY) & state.in_contact[rows, finger]
        goal[bump] -= config.clearance * state.contact_normal[rows, finger][bump]
        goal[lift] = (self._lift_tip[rows] + config.clearance * self._outward[rows])[lift]
        # along the line of descent, which a carried tip joins from wherever it was let in
        normal = self._landing.normal[rows]
        sunk = ((tip - self._landing.tip[rows]) * normal).sum(axis=-1)
        sunk = np.minimum(sunk + 0.03, config.place_depth)
        goal[place] = (self._landing.tip[rows] + sunk[:, None] * normal)[place]
        speed = np.where(lift, config.lift_speed, config.carry_speed)
        speed[place] = config.place_speed

        # the set-point leads the tip, but by no more than the tip covers in a tenth of a second
        step = goal - tip
        reach = np.maximum(0.1 * speed, 0.008)
        aim = tip + step * np.minimum(1.0, reach / _length(step))[:, None]
        step = aim - setpoint
        step *= np.minimum(1.0, speed * self._dt / _length(step))[:, None]
        change[rows] = self._joint_motion(finger, jacobian, step)

    def tip_motion(self, rows: Indices, now: HandConfiguration, step: Floats) -> Floats:
        """Change of joints ``(M, d)`` that moves the switching tips of ``rows`` by ``step`` [m]."""
        finger = self.finger[rows]
        return self._joint_motion(finger, self._tip_jacobian(rows, now), step)

    def _tip_jacobian(self, rows: Indices, now: HandConfiguration) -> Floats:
        """Of the switching fingertips in ``rows``, by the fingers' own joints, ``(M, n, 3)``."""
        finger = self.finger[rows]
        jacobian = now[rows].finger_jacobian(now.fingertip_position[rows])
        return jacobian[np.arange(len(rows)), finger] * self._own_rows[finger]

    def _joint_motion(self, finger: Indices, jacobian: Floats, step: Floats) -> Floats:
        gram = jacobian.swapaxes(-1, -2) @ jacobian + self.config.damping**2 * np.eye(3)
        motion = (jacobian @ np.linalg.solve(gram, step[..., None]))[..., 0]
        return (motion[:, None] @ self.hand.finger_joint_map[finger])[:, 0]

    def _one_hot(self, mask: Bools) -> Bools:
        out = np.zeros((len(self.phase), self.hand.n_fingers), bool)
        out[mask, self.finger[mask]] = True
        return out


def _length(vectors: Floats) -> Floats:
    return np.maximum(np.sqrt((vectors * vectors).sum(axis=-1)), 1e-9)
