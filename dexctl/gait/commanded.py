"""CommandedTurning: turns an object about any axis it is told, by controllers for one axis each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.controller import BatchController, Controller, axis_of, check_parts
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState, merged
from dexctl.symmetry import HandSymmetry, symmetries
from dexctl.validation import check_mask, unit_axis


class CommandedTurning(BatchController):
    """Has the object turned about the axis that it is told, by the controller made for the nearest.

    Each of the ``turners`` turns an object about one axis, and so do its images by the hand's
    symmetries: a policy for x turns about ten axes across the palm of dex5. What is told is
    ``goal_angular_velocity``; how fast it turns is the turner's own matter, and where it is zero
    the set-points stay. A turner begins anew when another axis is told. (The axis-specific
    controllers of the thesis, chapter 3.)

    Args:
        hand: the hand.
        turners: controllers with an attribute ``axis``, ``(3,)``: policies that were trained for
            one, in-grasp manipulation, gaits; of one control period.
        axis: ``(3,)``, turned about where a state tells none (turners are then told 0.5 rad/s);
            None: the first turner's.
        images: whether the images by the hand's symmetries are used, or the turners' own axes only.

    Attributes:
        turners: as given.
        axes: that the object can be turned about, ``(k, 3)``.
        images: of each, the number of the turner and the symmetry that makes that of it.
        ways: 1 where that is as a turner turns it, -1 where it is in a mirror image, ``(k,)``.

    Raises:
        InvalidInput: no turners, one that has no axis, or of another hand or period.
    """

    def __init__(
        self,
        hand: HandModel,
        turners: Sequence[Controller],
        *,
        axis: ArrayLike | None = None,
        images: bool = True,
    ) -> None:
        if not turners:
            raise InvalidInput("CommandedTurning got no turners; expected at least one")
        period = check_parts(hand, {f"turner {i}": one for i, one in enumerate(turners)})
        about = [axis_of(one) for one in turners]
        super().__init__(hand, control_period=period)
        self.turners = tuple(turners)
        self.object, self.gravity = turners[0].object, turners[0].gravity
        self.tracks = any(one.tracks for one in turners)
        found: list[tuple[int, HandSymmetry]] = []
        axes: list[Floats] = []
        for symmetry in symmetries(hand) if images else symmetries(hand)[:1]:
            for i, turned in enumerate(about):
                image = symmetry.of_turnings(turned)
                if not any(np.allclose(image, other, atol=1e-6) for other in axes):
                    axes.append(image)
                    found.append((i, symmetry))
        self.images = tuple(found)
        self.axes = np.array(axes)
        self.ways = np.array([-1 if symmetry.mirrors else 1 for _, symmetry in self.images])
        self._told = _SPEED * np.array(self.axes[0] if axis is None else unit_axis(axis))
        self._turner = np.array([i for i, _ in self.images])
        self._choice = np.zeros(0, np.intp)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        for one in self.turners:
            one.reset(seed, mask)
        if mask is None or not len(self._choice):
            self._choice = np.zeros(0, np.intp)
        else:
            self._choice[check_mask(mask, self._choice.shape)] = 0

    def state_dict(self) -> dict[str, Any]:
        parts = {str(i): one.state_dict() for i, one in enumerate(self.turners)}
        return self._signed(**parts, commanded=copies({"choice": self._choice}))

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        names = [str(i) for i in range(len(self.turners))]
        parts, own = self._parts(saved, *names, "commanded"), type(self).__name__
        check_names(own, parts["commanded"], ("choice",))
        (count,) = batch_shape(own, parts["commanded"], "choice") or (0,)
        for name, one in zip(names, self.turners, strict=True):
            one.load_state_dict(parts[name])
        self._choice = np.zeros(count, np.intp)
        fill(own, {"choice": self._choice}, parts["commanded"])

    def act_batch(self, state: GraspState) -> Floats:
        if state.goal_angular_velocity is None:  # turners may have to be told, too
            told = np.tile(self._told, (len(state.q), 1))
            state = replace(state, goal_angular_velocity=told)
        choice, off = self._chosen(state)
        if len(self._choice) != len(choice):
            self._choice = choice
        told_another = choice != self._choice
        self._choice = choice
        if told_another.any():
            for one in self.turners:
                one.reset(None, told_another)
        used = [(choice == k, self.images[k][1]) for k in np.unique(choice) if k > 0]
        seen = state  # the first image is the first turner as it is
        for rows, symmetry in used:
            seen = merged(rows, symmetry.inverse.of_state(state), seen)
        turner = self._turner[choice]
        action = np.zeros((len(choice), self.hand.nq))
        for i, one in enumerate(self.turners):  # all see all hands: some remember them
            action = np.where((turner == i)[:, None], one.act(seen), action)
        for rows, symmetry in used:
            action[rows] = symmetry.of_joints(action[rows])
        assert state.goal_angular_velocity is not None
        action[~state.goal_angular_velocity.any(axis=1)] = 0.0
        self._diagnostics = {"turner": turner, "image": choice, "off": off}
        return action

    def _chosen(self, state: GraspState) -> tuple[NDArray[np.intp], Floats]:
        """The image for each hand, and how far its axis is from the one told, ``(N,)`` [rad]."""
        spin, count = state.goal_angular_velocity, len(state.q)
        assert spin is not None
        length = np.linalg.norm(spin, axis=1)
        along = spin @ self.axes.T
        best = along.argmax(axis=1)
        cosine = along.max(axis=1) / np.maximum(length, _SLOW)
        off = np.where(length > 0, np.arccos(np.clip(cosine, -1.0, 1.0)), 0.0)
        stays = self._choice if len(self._choice) == count else np.zeros(count, np.intp)
        return np.where(length > 0, best, stays), off


_SLOW = 1e-12  # [rad/s]
_SPEED = 0.5  # what is told where a state tells nothing [rad/s]
