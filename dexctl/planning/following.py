"""PlannedGait: follows a tree of grasps with controllers, closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController
from dexctl.exceptions import InvalidInput
from dexctl.gait import Macro
from dexctl.grasp.odometry import ContactOdometry
from dexctl.hand import HandModel
from dexctl.planning.following_config import PlannedGaitChanges, PlannedGaitConfig
from dexctl.planning.route import Indices, Route
from dexctl.planning.tree import Tree
from dexctl.rotations import multiply, shortest
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.switch.landing import Landing
from dexctl.validation import check_mask, unit_axis, with_changes


class PlannedGait(BatchController):
    """Turns an object as a tree of grasps says that it can be turned.

    From the node that is nearest to the grasp it goes from node to node: the finger that the edge
    puts down anew is switched to its place on the object, guarded, while in-grasp manipulation,
    with forces of the stability QP, brings the object to the next node's pose. The places move
    with the object, so errors of one edge are made good by the next. At the end of a path it goes
    on from the nearest node a turn before; so it does where it has gone astray.

    Where nothing tracks the object its pose is summed up from the motion of the fingers that hold
    it (`ContactOdometry`), from that of the tree's root on.

    Args:
        hand: the hand.
        tree: what to follow: a `Tree`, or its file.
        config: the settings; None: `PlannedGaitConfig.suiting` the hand. Keyword arguments change
            single ones.
        control_period: [s].
        axis: the tree's; None: whichever that is.

    Raises:
        InvalidInput: no tree, one of another hand or axis, or whose actions name no finger.
    """

    def __init__(
        self,
        hand: HandModel,
        tree: Tree | str | Path,
        config: PlannedGaitConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[PlannedGaitChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        config = PlannedGaitConfig.suiting(hand) if config is None else config
        self.config = with_changes(PlannedGaitConfig, config, changes)
        if not isinstance(tree, Tree):
            tree = Tree.load(tree)
        self.route = Route(tree, hand, self.config.rotation)
        self.axis = self.route.frame.axis
        self.object, self.gravity = tree.header.object, tree.header.gravity
        if axis is not None and not np.allclose(unit_axis(axis), self.axis, atol=1e-6):
            raise InvalidInput(
                f"the tree turns about {tuple(self.axis.tolist())}; expected {unit_axis(axis)}"
            )
        self._macro = Macro(hand, self.config.macro, control_period=control_period, axis=self.axis)
        self._odometry = ContactOdometry(hand, control_period)
        self._fresh: Bools | None = None

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._macro.reset(seed, mask)
        if mask is None or self._fresh is None:
            self._fresh = None
        else:
            again = check_mask(mask, self._fresh.shape)
            self._fresh = self._fresh | again
            # nothing of the path, or of a repair, that was under way
            self._goal[again], self._clock[again], self._repairs[again] = 0, 0.0, 0

    def _allocate(self, count: int) -> Bools:
        self._fresh = np.ones(count, bool)
        self._goal = np.zeros(count, np.intp)
        self._clock = np.zeros(count)
        self._repairs = np.zeros(count, np.intp)
        self._odometry.start(count)
        self._macro.reset()
        return self._fresh

    def _check(self, count: int) -> None:
        if self._fresh is not None and len(self._fresh) != count:
            raise InvalidInput(
                f"the controller was reset for {len(self._fresh)} hands and got {count}; call "
                "reset() before the batch shape changes"
            )

    def _arrays(self) -> dict[str, np.ndarray]:
        assert self._fresh is not None
        return {
            "fresh": self._fresh, "goal": self._goal, "clock": self._clock,
            "repairs": self._repairs,
        }  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        if self._fresh is None:
            return self._signed(met=None)
        met = {
            **copies(self._arrays()),
            "macro": self._macro.state_dict(),
            "odometry": self._odometry.state_dict(),
        }
        return self._signed(met=met)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        met = self._parts(saved, "met")["met"]
        if met is None:
            self._fresh = None
            return
        own = type(self).__name__
        (count,) = batch_shape(own, met, "goal") or (0,)
        self._check(count)
        self._allocate(count)
        check_names(own, met, (*self._arrays(), "macro", "odometry"))
        fill(own, self._arrays(), met)
        if (self._goal < 0).any() or (self._goal >= len(self.route.node)).any():
            self._fresh = None
            raise InvalidInput(f"the saved state of {own} is of another tree")
        self._macro.load_state_dict(met["macro"])
        self._odometry.load_state_dict(met["odometry"])

    def follow(self, state: GraspState, goal: Indices) -> None:
        """Begin the edges to ``goal`` ``(N,)``, places on the route, in N tracked hands.

        What it does after them, where the hands are not stopped, it decides by itself again;
        ``arrived`` in the diagnostics says when they are over.
        """
        self._fresh = self._allocate(len(goal))
        self._fresh[:] = False
        self._begin(np.arange(len(goal)), state, goal, self.route.finger[goal])

    def act_batch(self, state: GraspState) -> Floats:
        count = len(state.q)
        self._check(count)
        if self._fresh is None:
            self._fresh = self._allocate(count)
        state = self._tracked(state)
        position, quaternion = np.asarray(state.object_position), state.object_quaternion
        assert quaternion is not None
        route, config, macro = self.route, self.config, self._macro
        angle = route.frame.rotation(quaternion, np.zeros(count))
        self._clock += self.control_period
        ahead = shortest(route.rotation[self._goal] - angle)
        idle = ~macro.busy if len(macro.busy) == count else np.ones(count, bool)
        there = (np.abs(ahead) < config.tolerance) | (self._clock > config.time_limit)
        due = self._fresh | (idle & there)
        if due.any():
            self._advance(np.flatnonzero(due), state, angle)
            self._fresh = np.zeros(count, bool)
            ahead = shortest(route.rotation[self._goal] - angle)
        macro.aim(position, self._landing(position, quaternion))
        speed = np.clip(config.gain * ahead, -config.speed, config.speed)
        macro.twist = np.concatenate([np.zeros((count, 3)), speed[:, None] * self.axis], axis=1)
        macro.in_grasp.refer_to(route.position[self._goal], route.quaternion[self._goal])
        action = macro.act(state)
        self._diagnostics = {
            **macro.diagnostics,
            "node": route.node[self._goal],
            "ahead": ahead,
            "arrived": due,
        }
        return action

    def _tracked(self, state: GraspState) -> GraspState:
        """``state`` with the object's pose, by dead reckoning where nothing tracks it."""
        odometry, frame = self._odometry, self.route.frame
        assert self._fresh is not None
        if state.object_position is not None and state.object_quaternion is not None:
            return state
        if self._fresh.any():
            odometry.place(self._fresh, np.tile(frame.position, (int(self._fresh.sum()), 1)))
        now = self.hand.configuration(state.q)
        held = (
            state.in_contact & ~self._macro.switch.released
            if len(self._macro.busy)
            else (state.in_contact)
        )
        odometry.update(state, now, held)
        turned = multiply(odometry.quaternion, np.broadcast_to(frame.quaternion, (len(held), 4)))
        return replace(state, object_position=odometry.position, object_quaternion=turned)

    def _landing(self, position: Floats, quaternion: Floats) -> Landing:
        """Where the switching fingers are to come down, in all hands."""
        finger = np.maximum(self._macro.switch.finger, 0)
        return self.route.landing(self._goal, finger, position, quaternion)

    def _advance(self, rows: np.ndarray, state: GraspState, angle: Floats) -> None:
        """Begin the next edge of the hands in ``rows``."""
        assert self._fresh is not None
        assert state.object_position is not None
        assert state.object_quaternion is not None
        route, config = self.route, self.config
        every = np.arange(len(rows))
        position, quaternion = state.object_position[rows], state.object_quaternion[rows]
        distance = route.distance(state.q[rows], position, quaternion, angle[rows])
        at, leads_on = self._goal[rows], route.following >= 0
        own, ended = distance[every, at], ~leads_on[at] & ~self._fresh[rows]
        distance[:, ~leads_on] = np.inf
        # a turn before, not just before the end
        late = route.rotation > route.rotation[at[ended], None] - np.pi
        distance[ended] = np.where(late, np.inf, distance[ended])
        # NaN of an object that has fallen anywhere: any node will do
        nearest = distance.argmin(axis=1)
        astray = (own > config.astray) & (distance[every, nearest] < 0.5 * own)
        lost = (self._fresh[rows] | ended | astray) & (self._repairs[rows] == 0)
        lost &= np.isfinite(distance[every, nearest])
        at = np.where(lost, nearest, at)
        tip = self.hand.fingertip_positions(state.q[rows])
        apart = np.linalg.norm(route.in_object(tip, position, quaternion) - route.tip[at], axis=-1)
        apart = np.where(route.touch[at], apart, 0.0)
        worst = apart.argmax(axis=1)
        repairing = lost | (self._repairs[rows] > 0)
        repair = repairing & (apart[every, worst] > config.misplaced)
        repair &= self._repairs[rows] < self.hand.n_fingers
        self._repairs[rows] = np.where(repair, self._repairs[rows] + 1, 0)
        stay = repair | ~leads_on[at]
        goal = np.where(stay, at, route.following[at])
        finger = np.where(repair, worst, np.where(stay, -1, route.finger[goal]))
        self._begin(rows, state, goal, finger)

    def _begin(self, rows: np.ndarray, state: GraspState, goal: Indices, finger: Indices) -> None:
        assert state.object_position is not None
        assert state.object_quaternion is not None
        route = self.route
        self._goal[rows], self._clock[rows] = goal, 0.0
        chosen = np.full(len(state.q), -1)
        chosen[rows] = finger
        mask = np.zeros(len(state.q), bool)
        mask[rows] = True
        landing = route.landing(
            self._goal, np.maximum(chosen, 0), state.object_position, state.object_quaternion
        )
        self._macro.begin(state, np.zeros((len(state.q), 6)), chosen, landing, mask)
