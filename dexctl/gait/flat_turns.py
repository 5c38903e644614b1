"""FlatTurns: which turns bring an object from one flat position to a goal, and with which it ends.

An object that lies flat is known by its face that looks along the palm's axis and by its yaw. A
turn across the axis leads from one flat position to the next only where the object is square to it.
So the turns between flat positions are a small table, made once: from each face, about each line
of the object across the axis, by each number of steps and about each axis that can be turned about,
to which face and yaw.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.rotations import (
    cross,
    from_rotation_vector,
    inverse,
    multiply,
    rotate,
    rotation_vector,
    shortest,
    twist_angle,
)
from dexctl.state import Floats

Ints = NDArray[np.intp]


class Plan(NamedTuple):
    """What is to be done, for each of N objects; arrays ``(N,)``.

    Attributes:
        face: that looks along the axis at the end, but for a last turn.
        first: number of the axis of a turn that brings it there; -1: it is there.
        ready: yaw of the present face before that turn [rad].
        yaw: of the face, after a turn about the palm's axis [rad].
        last: number of the axis of a turn from there towards the goal; -1: none.
        way: of the turns about the axis, 1 or -1.
        cost: what it comes to, turns in rad and what they cannot make good.
    """

    face: Ints
    first: Ints
    ready: Floats
    yaw: Floats
    last: Ints
    way: Ints
    cost: Floats


class FlatTurns:
    """The turns of an object with ``faces`` flat positions in a full turn about each of two axes.

    All orientations are told as the turn, in the hand frame, since the object lay flat and square
    to the first axis of ``across``.

    Args:
        axis: of the palm, unit ``(3,)``.
        across: unit vectors at right angles to it, ``(k, 3)``, that the object can be turned about,
            each one way.
        ways: 1 or -1, ``(k,)``: which way the object is turned about ``axis`` before and after.
        faces: 4 for a cube.

    Attributes:
        directions: of the object, that look along the axis in flat positions, ``(f, 3)``.
    """

    def __init__(self, axis: Floats, across: Floats, ways: Ints, faces: int) -> None:
        self.axis, self.across, self.ways = axis, across, ways
        self.step = 2.0 * np.pi / faces
        beside = np.cross(axis, across[0])
        self.azimuth = np.arctan2(across @ beside, across @ across[0])  # (k,)
        yaws = np.arange(faces, dtype=float) * self.step
        lines = np.cos(yaws)[:, None] * across[0] + np.sin(yaws)[:, None] * beside
        # the turns that bring each direction to the axis: none, and one step after the other
        upright = [np.array([1.0, 0.0, 0.0, 0.0])]
        for line in lines:
            for count in range(1, faces):
                turn = from_rotation_vector(count * self.step * line)
                there = rotate(inverse(turn), axis)
                if all(rotate(inverse(one), axis) @ there < 1 - 1e-6 for one in upright):
                    upright.append(turn)
        self._upright = np.array(upright)  # (f, 4)
        self.directions = rotate(inverse(self._upright), axis)
        self._tabulate(yaws, faces)
        # flat positions that are square to each axis, (f, k, faces)
        square = np.asarray(self.azimuth[:, None] + yaws, float)
        self._square = np.tile(square, (len(upright), 1, 1))

    def _tabulate(self, yaws: Floats, faces: int) -> None:
        """Where turns across lead: from face i, about line j, by n steps, about axis k."""
        counts = np.arange(1, faces // 2 + 1)
        before = shortest(self.azimuth[None, :] - yaws[:, None])  # (j, k): yaw, whichever face
        turn = from_rotation_vector(self.step * counts[:, None, None] * self.across)  # (n, k, 4)
        about = from_rotation_vector(before[..., None] * self.axis)  # (j, k, 4)
        after = multiply(
            turn[None, None],
            multiply(about[None, :, None], self._upright[:, None, None, None]),
        )  # (i, j, n, k, 4)
        height = rotate(after[..., None, :], self.directions) @ self.axis
        self._before = np.broadcast_to(before[None, :, None], after.shape[:-1])
        self._face_after = height.argmax(axis=-1)
        self._yaw_after = self._yaw(after, self._face_after)
        self._turned = np.broadcast_to(self.step * counts[None, None, :, None], after.shape[:-1])

    def _yaw(self, turn: Floats, face: Ints) -> Floats:
        about = multiply(turn, inverse(self._upright[face]))
        return shortest(twist_angle(about, self.axis))

    def lies(self, turn: Floats) -> tuple[Ints, Floats, Floats]:
        """The face that looks most along the axis, its tilt and its yaw [rad], each ``(N,)``."""
        height = rotate(turn[:, None], self.directions) @ self.axis
        face = height.argmax(axis=1)
        tilt = np.arccos(np.clip(height.max(axis=1), -1.0, 1.0))
        return face, tilt, self._yaw(turn, face)

    def yaw_left(self, turn: Floats, face: Ints, yaw: Floats, way: Ints) -> Floats:
        """What is left to turn about the axis, 1 or -1 its way, in [-0.25, 2 pi - 0.25) [rad]."""
        return (way * (yaw - self._yaw(turn, face)) + _OVER) % (2.0 * np.pi) - _OVER

    def across_left(self, turn: Floats, face: Ints, k: Ints) -> Floats:
        """The turn about axis ``k`` that brings ``face`` nearest to the axis, in (-pi, pi]."""
        there, line = rotate(turn, self.directions[face]), self.across[k]
        return np.arctan2((there * cross(self.axis[None], line)).sum(axis=1), there @ self.axis)

    def flat(self, face: Ints, yaw: Floats) -> Floats:
        """The flat position, wxyz ``(N, 4)``."""
        return multiply(from_rotation_vector(yaw[:, None] * self.axis), self._upright[face])

    def back(self, turn: Floats, way: Ints) -> tuple[Ints, Ints]:
        """From where the object lies on an edge: face and axis of the turn to a flat position."""
        there = rotate(turn[:, None], self.directions)[:, :, None]  # (N, f, 1, 3)
        across = self.across
        beside = np.cross(self.axis, across)
        along, up = there @ beside.T, (there @ self.axis[:, None])  # (N, f, 1, k), (N, f, 1, 1)
        left = np.arctan2(along[:, :, 0], up[:, :, 0]) % (2.0 * np.pi)
        missed = np.arcsin(np.clip(np.abs(there @ across.T)[:, :, 0], 0.0, 1.0))
        barred = np.where(self.ways == way[:, None], 0.0, np.inf)[:, None]
        best = (left + _MISSED * missed + barred).reshape(len(turn), -1).argmin(axis=1)
        face, k = np.unravel_index(best, left.shape[1:])
        return face, k

    def plan(
        self, turn: Floats, goal: Floats, bound: Ints, most: float, near: float, square: float
    ) -> Plan:
        """From ``turn``, flat, to ``goal``, ``(N, 4)``.

        Args:
            turn: where the objects lie.
            goal: where they are to be.
            bound: 1 or -1 where objects have to go on that way about the axis, else 0, ``(N,)``.
            most: what is left at the end is made good up to this angle [rad].
            near: turns about the axis by less than this need not be made at the end, ...
            square: ... nor by less than this before a turn across it [rad].
        """
        now, _, yaw_now = self.lies(turn)
        faces, yaw, last, end = self._ends(goal, most)
        enough = np.where(last < 0, near, square)
        plans = [
            self._reached(now, yaw_now, faces, yaw, last, end, enough, square, way)
            for way in (1, -1)
            if (self.ways == way).any()
        ]
        cost = [np.where(bound * one.way < 0, np.inf, one.cost) for one in plans]
        best = np.argmin(cost, axis=0)
        return Plan(*(np.choose(best, values) for values in zip(*plans, strict=True)))

    def _ends(self, goal: Floats, most: float) -> tuple[Ints, Floats, Ints, Floats]:
        """Flat positions near the goal, ``(e,)``; their yaws, last axes and costs, ``(N, e)``."""
        n, f, k, steps = len(goal), *self._square.shape
        # without a last turn: each face, with the goal's yaw
        every = np.arange(f)
        tilt = np.arccos(np.clip(rotate(goal[:, None], self.directions) @ self.axis, -1.0, 1.0))
        yaw = self._yaw(goal[:, None], every)
        # with one: square to each axis
        square = self._square.reshape(-1)
        face = np.repeat(every, k * steps)
        axes = np.tile(np.repeat(np.arange(k), steps), f)
        left = multiply(goal[:, None], inverse(self.flat(face, square)))
        u = self.across[axes]
        angle = shortest(twist_angle(left, u))
        rest = multiply(left, inverse(from_rotation_vector(angle[..., None] * u)))
        missed = np.linalg.norm(rotation_vector(rest), axis=-1)
        too_far = np.where((angle < 0) | (angle > self.step), _UNREACHED, 0.0)
        ends = np.concatenate([tilt, angle + _STOP + missed + too_far], axis=1)
        ends += _UNREACHED * np.maximum(np.concatenate([tilt, missed], axis=1) - most, 0.0)
        return (
            np.concatenate([every, face]),
            np.concatenate([yaw, np.broadcast_to(square, (n, len(square)))], axis=1),
            np.concatenate([np.full(f, -1), axes]),
            ends,
        )

    def _reached(
        self,
        now: Ints,
        yaw_now: Floats,
        faces: Ints,
        yaw: Floats,
        last: Ints,
        end: Floats,
        enough: Floats,
        square: float,
        way: int,
    ) -> Plan:
        """The cheapest from where objects lie to one of the ends, one way about the axis."""
        n, usable = len(now), self.ways == way
        end = end + np.where((last < 0) | usable[last], 0.0, np.inf)
        direct = _cost(yaw - yaw_now[:, None], enough, way) + end
        best = np.where(faces == now[:, None], direct, np.inf)
        table = self._before[now].reshape(n, -1)
        axes = np.tile(np.arange(len(usable)), table.shape[1] // len(usable))
        readied = _cost(table - yaw_now[:, None], square, way) + self._turned[now].reshape(n, -1)
        readied += np.where(usable[axes], 0.0, np.inf)
        after, yaw_after = (one[now].reshape(n, -1) for one in (self._face_after, self._yaw_after))
        first = np.full(best.shape, -1)
        ready = np.zeros(best.shape)
        faced = range(len(self.directions)) if table.size else ()  # one face: no turn across
        for i in faced:  # the face at the end
            ends = np.flatnonzero(faces == i)
            cost = (
                readied[:, :, None]
                + _cost(yaw[:, None, ends] - yaw_after[:, :, None], enough[ends], way)
                + _STOP
            )
            cost = np.where((after == i)[:, :, None], cost, np.inf) + end[:, None, ends]
            chosen = cost.argmin(axis=1)  # (N, ends)
            least = np.take_along_axis(cost, chosen[:, None], axis=1)[:, 0]
            better = least < best[:, ends]
            best[:, ends] = np.where(better, least, best[:, ends])
            first[:, ends] = np.where(better, axes[chosen], -1)
            ready[:, ends] = np.take_along_axis(table, chosen, axis=1)
        at = best.argmin(axis=1)[:, None]

        def of(values: np.ndarray) -> np.ndarray:
            return np.take_along_axis(values, at, axis=1)[:, 0]

        return Plan(
            faces[at[:, 0]],
            of(first),
            of(ready),
            of(yaw),
            last[at[:, 0]],
            np.full(n, way),
            of(best),
        )


_STOP = 0.3  # what it counts to turn about another axis [rad]
_OVER = 0.25  # by how much a turn about the axis may have gone too far [rad]
_MISSED = 4.0  # what a rad of tilt that is left counts where the object is turned back flat
_UNREACHED = 100.0  # what a rad that nothing makes good counts


def _cost(angle: Floats, enough: float | Floats, way: int) -> Floats:
    """Of a turn about the axis [rad]; a little, either way, is left as it is."""
    size = np.abs(shortest(angle))
    return np.where(size < enough, 0.5 * size, (way * angle) % (2.0 * np.pi))
