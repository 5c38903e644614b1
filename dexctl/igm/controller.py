"""InGraspManipulation: stability and rotation superposed (thesis chapter 4, Algorithm IGM)."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.configuration import HandConfiguration
from dexctl.controller import Controller, check_action, check_state
from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.grasp.odometry import ContactOdometry
from dexctl.hand import HandModel
from dexctl.igm.config import InGraspManipulationChanges, InGraspManipulationConfig
from dexctl.igm.plain import PlainStep
from dexctl.igm.regulation import Reference
from dexctl.igm.step import StepInput, StepResult
from dexctl.saved import batch_shape
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_mask, numbers, with_changes

_NO_ROWS = np.empty((0, 0))


class Share(NamedTuple):
    """What a superposed controller leaves to in-grasp manipulation (all None: everything).

    Attributes:
        released: fingers that belong to another controller, ``(..., m)`` bool; they get no motion.
        max_force: upper bound of each finger's force, as a fraction of the grip, ``(..., m)``.
        twist: object twist instead of the configured one, ``(..., 6)``.
        yielding: rate at which a finger's set-point goes back to where the finger is,
            ``(..., m)`` [1/s], beside force control.
    """

    released: Bools | None = None
    max_force: Floats | None = None
    twist: Floats | None = None
    yielding: Floats | None = None

    def row(self) -> Share:
        """The share of one hand ``()`` as one row of a batch."""
        return Share(
            None if self.released is None else self.released[None],
            None if self.max_force is None else self.max_force[None],
            None if self.twist is None else self.twist[None],
            None if self.yielding is None else self.yielding[None],
        )


_ALL = Share()


class InGraspManipulation(Controller):
    """Moves the object with the fingers that hold it, and keeps the hold.

    Two set-point changes are superposed (thesis chapter 4, Algorithm IGM): one drives the normal
    forces to the solution of the grasp-stability QP, one moves the contacts with the wanted
    object twist. Fingers out of contact get zero unless `closing_speed` is set.

    Args:
        hand: the hand.
        config: the settings; None: `InGraspManipulationConfig.suiting` the hand. Keyword arguments
            change single ones.
        control_period: [s].
        axis: about which the object is to be turned, ``(3,)``, at the speed of the settings; None
            keeps their axis.

    Raises:
        MissingExtra: the compiled engine is asked for by name, and numba is not installed.
        InvalidInput: it is asked for where it cannot be used.
    """

    def __init__(
        self,
        hand: HandModel,
        config: InGraspManipulationConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[InGraspManipulationChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        config = InGraspManipulationConfig.suiting(hand) if config is None else config
        self.config = with_changes(InGraspManipulationConfig, config, changes, axis)
        self._twist = np.array(self.config.twist, float)
        turn = np.linalg.norm(self._twist[3:])
        self.axis = self._twist[3:] / turn if turn > 0 else np.array([0.0, 0.0, 1.0])
        self._travels = bool(self._twist[:3].any())
        self._reference = Reference(self.axis)
        self._odometry = ContactOdometry(hand, control_period)
        self.engine = self._engine()
        if self.engine == "compiled":
            from dexctl.igm.compiled_step import CompiledStep

            self._step = CompiledStep(hand, self.config, self.axis, control_period)
        else:
            self._step = PlainStep(hand, self.config, self.axis, control_period)
        self._fill(0)

    def _engine(self) -> str:
        config, obstacle = self.config, ""
        if self.hand.shares_joints:
            obstacle = "the fingers of this hand share joints"
        elif config.regulariser == 0:
            obstacle = "the regulariser is 0"
        if config.engine == "compiled":
            if obstacle:
                raise InvalidInput(f"engine is 'compiled', but {obstacle}; expected 'plain'")
            if find_spec("numba") is None:
                raise MissingExtra("the compiled engine", "fast")
        usable = not obstacle and find_spec("numba") is not None
        return "compiled" if usable and config.engine != "plain" else "plain"

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._reference.reset(mask)
        if mask is None:
            self._odometry.start(0)
        elif len(self._odometry.position):
            self._odometry.forget(check_mask(mask, self._reference.known.shape))

    def refer_to(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Pull the object back to a given pose instead of to where the next `act` finds it.

        A planner holds every grasp of a tree to the pose at its root: references that moved on
        with each grasp would let height and tilt drift.

        Args:
            position: of the object, ``(N, 3)`` or, for one hand, ``(3,)`` [m].
            quaternion: wxyz, ``(N, 4)`` or ``(4,)``; what counts is where it carries the axis.

        Raises:
            InvalidInput: another number of hands than it is at work with.
        """
        place = numbers("position", position, "(N, 3) or (3,) [m]")
        pose = numbers("quaternion", quaternion, "(N, 4) or (4,), wxyz")
        if place.shape[-1:] != (3,) or pose.shape != (*place.shape[:-1], 4) or place.ndim > 2:
            raise InvalidInput(
                f"position and quaternion have shapes {place.shape} and {pose.shape}; expected "
                "(N, 3) and (N, 4), or (3,) and (4,)"
            )
        self._reference.give(place.reshape(-1, 3), pose.reshape(-1, 4))

    def state_dict(self) -> dict[str, Any]:
        return self._signed(
            reference=self._reference.state_dict(), odometry=self._odometry.state_dict()
        )

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "reference", "odometry")
        (count,) = batch_shape("odometry", parts["odometry"], "placed") or (0,)
        odometry = ContactOdometry(self.hand, self.control_period)
        odometry.start(count)
        odometry.load_state_dict(parts["odometry"])
        self._reference.load_state_dict(parts["reference"])
        self._odometry = odometry

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        self._step.check(state)
        return self.command(state, _ALL)

    def command(
        self, state: GraspState, share: Share, hand_now: HandConfiguration | None = None
    ) -> Floats:
        """As `act`, with part of the hand left to another controller, which has checked ``state``.

        ``hand_now`` is the hand's configuration at ``state.q``, where the caller has it already.
        """
        single = not state.batch_shape
        count = 1 if single else len(state.q)
        self._reference.meet(count)
        if len(self._ones) != count:
            self._fill(count)
        if hand_now is None:
            hand_now = self.hand.configuration(state.q)
        if single:
            share = share.row()
        touch = state.in_contact[None] if single else state.in_contact
        if share.released is None:
            free = ~touch
        else:
            free = ~(touch | share.released)
            touch = touch & ~share.released
        tracked = (state.object_position, state.object_quaternion)
        position, quaternion = (_NO_ROWS if a is None else a for a in tracked)
        arrays = (
            state.q,
            state.q_target,
            state.contact_position,
            state.contact_normal,
            state.contact_force,
            position,
            quaternion,
        )
        if single:
            hand_now = hand_now[None]
            arrays = tuple(a if a is _NO_ROWS else a[None] for a in arrays)
        q, q_target, point, normal, force, position, quaternion = arrays
        if self.config.odometry:
            if len(self._odometry.position) != count:
                self._odometry.start(count)
            if position is _NO_ROWS:
                whole = state[None] if single else state
                self._odometry.track(whole, hand_now, touch)
                position, quaternion = self._odometry.position, self._odometry.quaternion
            else:
                self._odometry.follow(position, None if quaternion is _NO_ROWS else quaternion)
        result = self._step(
            StepInput(
                hand_now=hand_now,
                q=q,
                q_target=q_target,
                touch=touch,
                closing=free if self.config.closing_speed else self._none,
                position=point,
                normal=normal,
                force=force,
                object_position=position,
                object_quaternion=quaternion,
                reference=self._reference,
                twist=self._wanted if share.twist is None else share.twist,
                max_force=self._ones if share.max_force is None else share.max_force,
                yielding=self._zeros if share.yielding is None else share.yielding,
            )
        )
        check_action(result.change)
        if not self._reference.complete:
            self._reference.learn(result.origin, quaternion)
        if share.twist is not None or self._travels:
            wanted = self._wanted if share.twist is None else share.twist
            paced = self.control_period * result.reach[:, None] * wanted
            self._reference.carry(paced, quaternion)
        if single:
            result = StepResult(*(part[0] for part in result))
        self._diagnostics = {
            "desired_force": result.desired,
            "residual": result.residual,
            "held": result.held,
            "origin": result.origin,
            "reach": result.reach,
        }
        return result.change

    def _fill(self, count: int) -> None:
        """Constants for N hands that a `Share` may stand in for."""
        shape = (count, self.hand.n_fingers)
        self._ones, self._zeros, self._none = np.ones(shape), np.zeros(shape), np.zeros(shape, bool)
        self._wanted = np.tile(self._twist, (count, 1))
