"""Finger gaiting: in-grasp manipulation and contact switching superposed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_action
try:
    from dexctl.grasp import is_force_closure
except ImportError:
    is_force_closure = lambda p,n,t,o,f: t.sum(-1)>=3
from dexctl.hand import HandModel
from dexctl.igm.controller import InGraspManipulation, InGraspManipulationConfig, Share
from dexctl.limits import SetPointLimits
from dexctl.rotations import cross
from dexctl.state import Bools, Floats, GraspState
from dexctl.switch.guarded import GuardedSwitch, GuardedSwitchConfig, Landing, Phase


@dataclass(frozen=True, kw_only=True)
class CoordinatedGaitConfig:
    igm: InGraspManipulationConfig = field(
        default_factory=lambda: InGraspManipulationConfig(
            twist=(0, 0, 0, 0, 0, 0.2), closing_speed=0.03
        )
    )
    switch: GuardedSwitchConfig = field(default_factory=GuardedSwitchConfig)
    swing: float = 0.45
    """Landing azimuth, ahead of the finger's neutral one, against the rotation [rad]."""
    least_travel: float = 0.3
    """A finger must be this far from its landing azimuth to be switched [rad]."""
    settle_time: float = 0.4
    """Between two switches of a hand [s]."""
    friction: float = 0.8
    """Assumed by the force-closure guard."""
    hold_force: float = 0.3
    """The other fingers must press at least this hard before one may unload [N]."""
    most_travel: float = 0.5
    slow_down: float = 0.2
    relax: float = 8.0
    turn_while_switching: float = 1.0
    """Share of the wanted twist while a finger is away."""


class CoordinatedGait(Controller):
    def __init__(
        self,
        hand: HandModel,
        config: CoordinatedGaitConfig | None = None,
        *,
        control_period: float = 0.05,
        **changes: Any,
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = replace(config or CoordinatedGaitConfig(), **changes)
        self.igm = InGraspManipulation(hand, self.config.igm, control_period=control_period)
        twist = np.array(self.config.igm.twist)
        self.axis = twist[3:] / np.linalg.norm(twist[3:])
        self._twist = twist
        self.switch = GuardedSwitch(hand, self.axis, self.config.switch, control_period)
        self._limits = SetPointLimits(
            hand, self.config.igm.max_joint_speed, 10.0, control_period
        )
        self._neutral = None

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.igm.reset(seed, mask)
        if mask is None or self._neutral is None:
            self._neutral = None
        else:
            self._fresh |= np.asarray(mask, bool)

    def act(self, state: GraspState) -> Floats:
        batched = state if state.batch_shape else state[None]
        change = self._act(batched)
        return change if state.batch_shape else change[0]

    def _act(self, state: GraspState) -> Floats:
        now = self.hand.configuration(state.q)
        target = self.hand.configuration(state.q_target)
        tip = now.fingertip_position
        touch = state.in_contact
        point = np.where(touch[..., None], state.contact_position, tip)
        if state.object_position is not None:
            origin = state.object_position
        else:
            w = touch[..., None].astype(float)
            origin = (w * point).sum(1) / np.maximum(w.sum(1), 1)
        flat = tip - origin[:, None]
        height = flat @ self.axis
        flat = flat - height[..., None] * self.axis
        radius = np.linalg.norm(flat, axis=-1)
        # azimuths
        if self._neutral is None:
            n = len(state.q)
            self.switch.start(n)
            self._fresh = np.ones(n, bool)
            self._neutral = np.zeros((n, self.hand.n_fingers, 3))
            self._wait = np.zeros(n)
            self._radius0 = np.zeros((n, self.hand.n_fingers))
        if self._fresh.any():
            f = self._fresh
            self._neutral[f] = flat[f] / radius[f][..., None]
            self._radius0[f] = radius[f]
            self.switch.clear(f)
            self._wait[f] = 0
            self._fresh = np.zeros_like(f)
        n0 = self._neutral
        azimuth = np.arctan2(cross(n0, flat) @ self.axis, (n0 * flat).sum(-1))  # from neutral

        self._wait -= self.control_period
        self._start(state, point, tip, origin, azimuth, radius)

        switching = self.switch.command(state, now, target, origin)
        released = self.switch.released
        twist = np.broadcast_to(self._twist, (len(state.q), 6))
        share_turn = np.where(
            self.switch.phase > Phase.IDLE, self.config.turn_while_switching, 1.0
        )
        cfg = self.config
        ahead = np.where(touch & ~released, azimuth, -10.0).max(1)
        governor = np.clip((cfg.most_travel - ahead) / cfg.slow_down, 0.0, 1.0)
        twist = twist * (share_turn * governor)[:, None]
        relax = np.zeros(touch.shape)
        un = np.flatnonzero(self.switch.phase == Phase.UNLOAD)
        relax[un, self.switch.finger[un]] = cfg.relax
        deflection = target.fingertip_position - tip
        held = self.igm.command(
            state, Share(released=released, max_force=self.switch.max_force, twist=twist, relax=relax, deflection=deflection), now
        )
        done = (self.switch.phase == Phase.IDLE) & (self._wait < -1e6)
        self._diagnostics = dict(self.igm.diagnostics)
        self._diagnostics["phase"] = self.switch.phase.copy()
        self._diagnostics["finger"] = self.switch.finger.copy()
        self._diagnostics["azimuth"] = azimuth
        return check_action(held + self._limits(state, switching))

    def _start(self, state, point, tip, origin, azimuth, radius):
        cfg = self.config
        sw = self.switch
        busy = sw.phase != Phase.IDLE
        self._wait[busy] = cfg.settle_time
        idle = ~busy & (self._wait <= 0)
        if not idle.any():
            return
        touch = state.in_contact
        firm = touch & (state.contact_force > cfg.hold_force)
        travel = azimuth + cfg.swing
        score = np.where(touch, travel, -np.inf)
        finger = score.argmax(1)
        rows = np.arange(len(finger))
        others = firm.copy()
        others[rows, finger] = False
        ok = idle & (score[rows, finger] > cfg.least_travel) & (others.sum(1) >= 3)
        if not ok.any():
            return
        w = np.flatnonzero(ok)
        closed = is_force_closure(
            point[w], state.contact_normal[w], others[w], origin[w], cfg.friction
        )
        ok[w] = closed
        if not ok.any():
            return
        c, s = np.cos(-cfg.swing), np.sin(-cfg.swing)
        n0 = self._neutral[rows, finger]
        direction = c * n0 + s * cross(np.broadcast_to(self.axis, n0.shape), n0)
        landing = origin + radius[rows, finger][:, None] * direction
        sw.begin(ok, finger, origin, Landing(landing, -direction))
