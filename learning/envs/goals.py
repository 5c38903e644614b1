"""Goals: which orientations an object is wanted in."""

from __future__ import annotations

from itertools import permutations, product
from typing import Literal, get_args

import numpy as np

from dexctl.rotations import angle_between, from_rotation_vector, inverse, multiply
from dexctl.state import Bools, Floats
from dexctl.streams import Streams

Goals = Literal["root", "yaw", "cube", "uniform"]
GOALS: tuple[str, ...] = get_args(Goals)


def cube_rotations() -> Floats:
    """The 24 turns that bring a cube to itself, wxyz ``(24, 4)``, the first of them none."""
    half = np.sqrt(0.5)
    found: list[tuple[float, ...]] = []
    for values in ((1.0, 0.0, 0.0, 0.0), (half, half, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5)):
        for order in dict.fromkeys(permutations(values)):
            found += [tuple(np.multiply(order, signs)) for signs in product((1.0, -1.0), repeat=4)]
    every = np.array(sorted(found, reverse=True))
    # one of q and -q, each once
    leading = every[np.arange(len(every)), (every != 0).argmax(axis=1)]
    return np.unique(every[leading > 0] + 0.0, axis=0)[::-1]


CUBE = cube_rotations()


def draw(
    goals: Goals,
    streams: Streams,
    chosen: Bools,
    *,
    now: Floats,
    upright: Floats,
    axis: Floats,
    least_angle: float,
) -> Floats:
    """A goal for each environment, wxyz ``(N, 4)``; those that are not chosen count for nothing.

    Args:
        goals: "root", ``upright``; "yaw", that turned about ``axis`` by any angle; "cube", one of
            the 24 orientations in which a cube looks as it does there; "uniform", any orientation
            (Shoemake, Uniform random rotations, 1992).
        streams: of the environments; they move on where ``chosen``.
        chosen: ``(N,)``.
        now: orientation of the object, ``(N, 4)``.
        upright: its orientation in the settled grasp, ``(N, 4)``.
        axis: unit, ``(3,)``.
        least_angle: goals of "yaw" and "cube" are at least so far from ``now`` [rad].
    """
    number = streams.uniform((3,), chosen)
    if goals == "root":
        return upright.copy()
    if goals == "yaw":
        away = multiply(now, inverse(upright))
        turned = 2.0 * np.arctan2(away[:, 1:] @ axis, away[:, 0])
        angle = turned + least_angle + number[:, 0] * (2.0 * np.pi - 2.0 * least_angle)
        return multiply(from_rotation_vector(angle[:, None] * axis), upright)
    if goals == "cube":
        every = multiply(upright[:, None], np.broadcast_to(CUBE, (len(now), *CUBE.shape)))
        far = angle_between(every, now[:, None]) >= least_angle
        which = np.floor(number[:, 0] * far.sum(axis=1)).astype(int)
        index = (far.cumsum(axis=1) > which[:, None]).argmax(axis=1)
        return every[np.arange(len(now)), index]
    radius = np.stack([np.sqrt(1.0 - number[:, 0]), np.sqrt(number[:, 0])])
    a, b = 2.0 * np.pi * number[:, 1], 2.0 * np.pi * number[:, 2]
    return np.stack(
        [
            radius[1] * np.cos(b),
            radius[0] * np.sin(a),
            radius[0] * np.cos(a),
            radius[1] * np.sin(b),
        ],
        axis=1,
    )
