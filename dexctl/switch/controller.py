"""ContactSwitch: switches one finger after the other by itself (psi_CS of the thesis)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_action, check_sound, check_state
from dexctl.exceptions import InvalidInput
from dexctl.grasp import is_force_closure
from dexctl.grasp.odometry import ContactOdometry
from dexctl.hand import HandModel
from dexctl.limits import SetPointLimits
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import LateStreams
from dexctl.switch.config import ContactSwitchChanges, ContactSwitchConfig
from dexctl.switch.guarded import GuardedSwitch, Indices, Phase
from dexctl.switch.landing import landing_at, split, turned, unit_across
from dexctl.switch.profile import SwitchProfile, random_contact
from dexctl.validation import check_mask, unit_axis, with_changes


class ContactSwitch(Controller):
    """Lets one random finger go of the object and touch it again elsewhere, over and over.

    The other fingers get no motion, so it holds the object only as well as their set-points do.

    Args:
        hand: the hand.
        config: the settings; keyword arguments change single ones.
        control_period: [s].
        axis: about which the object is to be turned, ``(3,)``, at the speed of the settings; None
            keeps their axis.
    """

    def __init__(
        self,
        hand: HandModel,
        config: ContactSwitchConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[ContactSwitchChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = config = with_changes(ContactSwitchConfig, config, changes, axis)
        turning = np.array(unit_axis(config.axis))
        self._part: _Profile | _Guarded
        if config.kind == "profile":
            self._part = _Profile(hand, config, turning, control_period)
        else:
            self._part = _Guarded(hand, config, turning, control_period)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._part.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(**{self.config.kind: self._part.state_dict()})

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        kind = self.config.kind
        self._part.load_state_dict(self._parts(saved, kind)[kind])

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        check_sound(self.hand, state)
        action, self._diagnostics = self._part.act(state)
        return check_action(action)


class _Profile:
    def __init__(
        self, hand: HandModel, config: ContactSwitchConfig, axis: Floats, control_period: float
    ) -> None:
        self._profile = SwitchProfile(
            hand,
            duration=config.duration,
            speed=config.speed,
            axis=axis,
            control_period=control_period,
        )
        self.reset = self._profile.reset
        self.state_dict = self._profile.state_dict
        self.load_state_dict = self._profile.load_state_dict

    def act(self, state: GraspState) -> tuple[Floats, dict[str, Any]]:
        self._profile.begin(state)
        finger = self._profile.finger
        return self._profile.act(state), {"finger": finger}


class _Guarded:
    def __init__(
        self, hand: HandModel, config: ContactSwitchConfig, axis: Floats, control_period: float
    ) -> None:
        self._hand = hand
        self._config = config
        self._axis = axis
        self._dt = control_period
        self._switch = GuardedSwitch(hand, axis, config.switch, control_period)
        self._limits = SetPointLimits(hand, config.max_joint_speed, config.max_lead, control_period)
        self._odometry = ContactOdometry(hand, control_period)
        self._streams = LateStreams()
        self._wait = np.zeros(0)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        if mask is None:
            self._streams.reset(seed)
            self._allocate(0)
            return
        if not len(self._wait):
            self._allocate(np.size(mask))
        chosen = check_mask(mask, self._wait.shape)
        self._switch.clear(chosen)
        self._odometry.forget(chosen)
        self._wait[chosen] = 0.0
        self._streams.reset(seed, chosen)

    def state_dict(self) -> dict[str, Any]:
        return {
            **copies({"wait": self._wait}),
            "switch": self._switch.state_dict(),
            "odometry": self._odometry.state_dict(),
            "streams": self._streams.state_dict(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        check_names("guarded switching", saved, ("wait", "switch", "odometry", "streams"))
        (count,) = batch_shape("guarded switching", saved, "wait") or (0,)
        self._meet(count)
        fill("guarded switching", {"wait": self._wait}, saved)
        self._switch.load_state_dict(saved["switch"])
        self._odometry.load_state_dict(saved["odometry"])
        self._streams.load_state_dict(saved["streams"])

    def _allocate(self, count: int) -> None:
        self._switch.start(count)
        self._odometry.start(count)
        self._wait = np.zeros(count)

    def _meet(self, count: int) -> None:
        """Make room for N hands, unless others are switching."""
        if len(self._wait) == count:
            return
        if self._switch.phase.any():
            raise InvalidInput(
                f"{len(self._wait)} hands are switching and the state has {count}; "
                "call reset() before the batch shape changes"
            )
        self._allocate(count)

    def act(self, state: GraspState) -> tuple[Floats, dict[str, Any]]:
        if state.batch_shape:
            return self._act(state)
        action, diagnostics = self._act(state[None])
        return action[0], {name: value[0] for name, value in diagnostics.items()}

    def _act(self, state: GraspState) -> tuple[Floats, dict[str, Any]]:
        self._meet(len(state.q))
        now = self._hand.configuration(state.q)
        tip = now.fingertip_position
        if state.object_position is None:
            state = self._odometry.track(state, now, state.in_contact & ~self._switch.released)
        else:
            self._odometry.follow(state.object_position, state.object_quaternion)
        origin = state.object_centre()
        self._begin(state, tip, origin)

        def may_lift(rows: Indices, finger: Indices) -> Bools:
            return self._holds_without(state, rows, finger, tip, origin)

        action = self._switch.command(state, now, origin, may_lift)
        action += self._force_control(state, now)
        action = self._limits(state.q, state.q_target, action)
        return action, {
            "finger": self._switch.finger.copy(),
            "phase": self._switch.phase.copy(),
        }

    def _begin(self, state: GraspState, tip: Floats, origin: Floats) -> None:
        busy = self._switch.phase != Phase.IDLE
        self._wait = np.where(busy, self._config.pause, self._wait - self._dt)
        ready = ~busy & (self._wait <= 0.5 * self._dt) & (state.in_contact.sum(axis=1) >= 4)
        draw = self._streams.of(ready.shape).uniform((), ready)
        if not ready.any():
            return
        finger = np.where(ready, random_contact(state.in_contact, draw), 0)
        rows = np.flatnonzero(ready)
        ready[rows] = self._holds_without(state, rows, finger[rows], tip, origin)
        lever = tip[np.arange(len(finger)), finger] - origin
        direction = turned(unit_across(lever, self._axis), -self._config.swing, self._axis)
        flat = split(lever, self._axis)[1]
        landing = landing_at(origin, direction, np.sqrt((flat * flat).sum(axis=-1)))
        self._switch.begin(ready, finger, origin, landing)

    def _holds_without(
        self, state: GraspState, rows: Indices, finger: Indices, tip: Floats, origin: Floats
    ) -> Bools:
        others = state.in_contact[rows].copy()
        others[np.arange(len(rows)), finger] = False
        point = np.where(others[..., None], state.contact_position[rows], tip[rows])
        return is_force_closure(
            point, state.contact_normal[rows], others, origin[rows], self._config.friction
        )

    def _force_control(self, state: GraspState, now: Any) -> Floats:
        """What a superposed in-grasp controller would do with the finger: unload it, load it."""
        change = np.zeros_like(state.q)
        switch, config = self._switch, self._config
        lead = state.q_target - state.q
        rows = np.flatnonzero(switch.phase == Phase.UNLOAD)
        own = switch.own_joints[switch.finger[rows]]
        change[rows] = np.where(own, np.expm1(-config.switch.yield_rate * self._dt) * lead[rows], 0)
        rows = np.flatnonzero(switch.phase == Phase.LOAD)
        if len(rows):
            finger = switch.finger[rows]
            touch = state.in_contact[rows, finger]
            error = config.hold_force * switch.max_force[rows, finger]
            error -= np.where(touch, state.contact_force[rows, finger], 0.0)
            normal = np.where(touch[:, None], state.contact_normal[rows, finger], 0.0)
            step = config.stability_gain * self._dt * np.maximum(error, 0.0)[:, None] * normal
            change[rows] = switch.tip_motion(rows, now, step)
        return change
