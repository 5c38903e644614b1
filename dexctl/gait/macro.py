"""Macro: the object moved with a twist of one's own choice while at most one finger is switched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, check_action, check_sound, check_state
from dexctl.exceptions import InvalidInput
from dexctl.gait.selection import Grasps, holds_without
from dexctl.hand import HandModel
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig, Share
from dexctl.limits import SetPointLimits
from dexctl.saved import fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.switch.config import GuardedSwitchConfig
from dexctl.switch.guarded import GuardedSwitch, Phase
from dexctl.switch.landing import Landing
from dexctl.validation import check_kind, check_numbers


@dataclass(frozen=True, kw_only=True)
class MacroConfig:
    """Settings of `Macro`."""

    in_grasp: InGraspManipulationConfig = field(
        default_factory=InGraspManipulationConfig.for_switching
    )
    """Of in-grasp manipulation; its twist counts until `Macro.begin` gives another."""
    switch: GuardedSwitchConfig = field(default_factory=GuardedSwitchConfig)
    """Of the guarded switch."""
    friction: float = 0.8
    """Assumed by the force-closure guard."""

    def __post_init__(self) -> None:
        check_kind(self, in_grasp=InGraspManipulationConfig, switch=GuardedSwitchConfig)
        check_numbers(self, positive=("friction",))


class Macro(BatchController):
    """One piece of a gait: a twist, and a finger with its landing or none.

    `CoordinatedGait` decides by itself when to switch which finger; here the caller does, with
    `begin`: planners, which try pieces and keep those that hold. The finger is lifted only where
    the others are a force closure at that moment.

    Args:
        hand: the hand.
        config: the settings.
        control_period: [s].
        axis: fingers are carried round it, ``(3,)``; None: the axis of the settings' twist.

    Attributes:
        twist: of the object in each hand, ``(N, 6)``; it may be changed at any time, to hold the
            object still while a finger is still on its way, for one.
    """

    def __init__(
        self,
        hand: HandModel,
        config: MacroConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = config or MacroConfig()
        settings = self.config.in_grasp
        self.in_grasp = InGraspManipulation(
            hand, settings, control_period=control_period, axis=axis
        )
        self.axis = self.in_grasp.axis
        self.switch = GuardedSwitch(hand, self.axis, self.config.switch, control_period)
        self._limits = SetPointLimits(
            hand, settings.max_joint_speed, settings.max_lead, control_period
        )
        self.twist = np.array(self.in_grasp.config.twist, float)[None]

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.in_grasp.reset(seed, mask)
        if mask is None:
            self.switch.start(0)
        elif len(self.switch.phase):
            self.switch.clear(np.asarray(mask, bool))

    def begin(
        self,
        state: GraspState,
        twist: ArrayLike,
        finger: ArrayLike | None = None,
        landing: Landing | None = None,
        mask: Bools | None = None,
    ) -> None:
        """Begin a piece in every hand, or in those of ``mask``; what was under way is given up.

        Args:
            state: of N hands, tracked.
            twist: of the object, (linear [m/s], angular [rad/s]), ``(N, 6)``.
            finger: which one each hand switches, ``(N,)``, -1 for none; None: none at all.
            landing: where it comes down, N rows; those without a finger are not read.
            mask: ``(N,)``; the other hands go on with what they are at. None: every hand.

        Raises:
            InvalidInput: shapes that do not belong together, a finger that there is not, or an
                object that nothing tracks.
        """
        check_state(self.hand, state)
        check_sound(self.hand, state)
        count = len(state.q)
        wanted = np.asarray(twist, float)
        chosen = np.full(count, -1) if finger is None else np.asarray(finger)
        if wanted.shape != (count, 6) or chosen.shape != (count,):
            raise InvalidInput(
                f"twist and finger have shapes {wanted.shape} and {chosen.shape}; expected "
                f"{(count, 6)} and {(count,)}"
            )
        if ((chosen < -1) | (chosen >= self.hand.n_fingers)).any():
            raise InvalidInput(
                f"finger is {chosen.tolist()}; expected -1 or 0 to {self.hand.n_fingers - 1}"
            )
        if state.object_position is None:
            raise InvalidInput("the state has no pose of the object; expected a tracked object")
        if mask is None or len(self.switch.phase) != count:
            self.switch.start(count)
            self.twist = wanted
        else:
            self.switch.clear(mask)
            self.twist = np.where(mask[:, None], wanted, self.twist)
        begun = np.asarray(chosen >= 0)
        if landing is not None:
            self.switch.begin(
                begun if mask is None else begun & mask,
                chosen,
                np.asarray(state.object_position),
                landing,
            )

    def state_dict(self) -> dict[str, Any]:
        return self._signed(
            in_grasp=self.in_grasp.state_dict(),
            switch=self.switch.state_dict(),
            twist=self.twist.copy(),
        )

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "in_grasp", "switch", "twist")
        self.in_grasp.load_state_dict(parts["in_grasp"])
        self.switch.load_state_dict(parts["switch"])
        twist = np.zeros_like(self.twist, shape=(max(len(self.switch.phase), 1), 6))
        fill("a macro", {"twist": twist}, parts)
        self.twist = twist

    def aim(self, origin: Floats, landing: Landing) -> None:
        """Let switches under way come down elsewhere: `GuardedSwitch.aim`."""
        self.switch.aim(origin, landing)

    @property
    def busy(self) -> Bools:
        """Whose finger is still on its way, ``(N,)``."""
        return self.switch.phase != Phase.IDLE

    def act_batch(self, state: GraspState) -> Floats:
        now = self.hand.configuration(state.q)
        if not len(self.switch.phase):
            self.switch.start(len(state.q))
        origin = state.object_centre()
        touch = state.in_contact[..., None]
        grasps = Grasps(
            np.where(touch, state.contact_position, now.fingertip_position),
            np.where(touch, state.contact_normal, 0.0),
            state.in_contact,
            state.in_contact,
            origin,
            np.full(len(origin), self.config.friction),
        )

        def may_lift(rows: np.ndarray, finger: np.ndarray) -> Bools:
            return holds_without(grasps.of(rows), finger)

        switching = self.switch.command(state, now, origin, may_lift)
        switching = self._limits(state.q, state.q_target, switching)
        share = Share(
            released=self.switch.released,
            max_force=self.switch.max_force,
            twist=np.broadcast_to(self.twist, (len(state.q), 6)),
            yielding=self.switch.yielding,
        )
        holding = self.in_grasp.command(state, share, now)
        self._diagnostics = {
            **self.in_grasp.diagnostics,
            "phase": self.switch.phase.copy(),
            "finger": self.switch.finger.copy(),
        }
        return check_action(holding + switching)
