"""How sound the grasp was at each moment of a trace: closure, margin, residual, tilt, slip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.grasp import epsilon_quality, is_force_closure, stability_forces
from dexctl.hand import HandModel
from dexctl.rotations import cross, inverse, multiply, rotation_vector
from dexctl.state import Bools, Floats
from learning.envs.turning import tilt, upright_of

if TYPE_CHECKING:
    from dexctl.sim import Scene, Trace

MARGIN_EDGES = 8
"""Edges of the margin's friction pyramids: inscribed, so that it is a lower bound; 16 edges give a
few per cent more and take eight times as long."""
_ROWS = 100  # control steps examined at a time
_GRASPS = 20  # margins between two calls of progress


@dataclass(frozen=True, eq=False)
class Grasps:
    """The grasps of a trace of T control steps, N episodes and m fingers.

    Attributes:
        closure: force closure, ``(T+1, N)`` bool.
        residual: wrench that the stability QP leaves, in units of the grip force, ``(T+1, N)``;
            NaN where nothing touches.
        tilt: of the object since the settled grasp, ``(T+1, N)`` [rad].
        slip: how far each touching fingertip slid over the object in each step, ``(T, N, m)`` [m];
            rolling does not count.
        advance: how far each touching fingertip's set-point went along its contact normal in each
            step, into the object, ``(T, N, m)`` [m]; below 0 it is taken back.
        at_limit: fingers with a joint whose set-point is at the end of its range,
            ``(T+1, N, m)`` bool.
        margin: epsilon quality (Ferrari-Canny, L1), NaN at the rows not sampled, ``(T+1, N)``.
        friction: coefficient that closure and margin are for.
    """

    closure: Bools
    residual: Floats
    tilt: Floats
    slip: Floats
    advance: Floats
    at_limit: Bools
    margin: Floats
    friction: float


def examine(
    trace: Trace,
    scene: Scene,
    *,
    friction: float = 1.0,
    at_limit: float = 0.01,
    progress: Callable[[float], None] | None = None,
) -> Grasps:
    """Examine the grasps of a trace of N episodes.

    Args:
        trace: the states.
        scene: that they are of.
        friction: between fingertips and object.
        at_limit: a set-point this close to the end of its joint's range is at it [rad].
        progress: called with the share that is done.
    """
    hand = scene.hand
    shape = trace.held.shape
    closure, residual = np.zeros(shape, bool), np.full(shape, np.nan)
    slip = np.zeros((shape[0] - 1, *trace.in_contact.shape[1:]))
    advance = np.zeros_like(slip)
    for start in range(0, shape[0], _ROWS):
        rows = slice(start, min(start + _ROWS, shape[0]))
        contacts = _contacts(trace, rows)
        closure[rows] = is_force_closure(*contacts, friction)
        touched = trace.in_contact[rows].any(axis=-1)
        residual[rows] = np.where(touched, stability_forces(*contacts).residual, np.nan)
        steps = slice(start, min(start + _ROWS, shape[0] - 1))
        if steps.stop > steps.start:
            slip[steps], advance[steps] = _motion(hand, trace, steps)
        if progress is not None:
            progress(rows.stop / shape[0])
    near = (trace.q_target <= hand.lower + at_limit) | (trace.q_target >= hand.upper - at_limit)
    return Grasps(
        closure=closure,
        residual=residual,
        tilt=tilt_of(trace, scene),
        slip=slip,
        advance=advance,
        at_limit=np.asarray((near[..., None, :] & hand.moves).any(axis=-1)),
        margin=np.full(shape, np.nan),
        friction=friction,
    )


def with_margin(
    grasps: Grasps,
    trace: Trace,
    wanted: Bools,
    *,
    progress: Callable[[float], None] | None = None,
) -> Grasps:
    """The same grasps with the margin sampled at more rows.

    Args:
        grasps, trace: as of `examine`.
        wanted: where, ``(T+1, N)`` bool; each costs about 10 ms. After a drop there is none.
        progress: called with the share that is done.
    """
    margin = grasps.margin.copy()
    rows, episodes = np.nonzero(wanted & trace.held & np.isnan(margin))
    for start in range(0, len(rows), _GRASPS):
        some = (rows[start : start + _GRASPS], episodes[start : start + _GRASPS])
        margin[some] = epsilon_quality(*_contacts(trace, some), grasps.friction, edges=MARGIN_EDGES)
        if progress is not None:
            progress(min(start + _GRASPS, len(rows)) / len(rows))
    return replace(grasps, margin=margin)


def _contacts(trace: Trace, index: Any) -> tuple[Floats, Floats, Bools, Floats]:
    """What the functions of `dexctl.grasp` take, of some rows."""
    return (
        trace.contact_position[index],
        trace.contact_normal[index],
        trace.in_contact[index],
        trace.object_position[index],
    )


def tilt_of(trace: Trace, scene: Scene) -> Floats:
    """Tilt of the object from the trace's axis, as in the environments' reward, [rad]."""
    quaternion = trace.object_quaternion
    return tilt(quaternion, np.broadcast_to(upright_of(scene), quaternion.shape), trace.axis)


def _motion(hand: HandModel, trace: Trace, steps: slice) -> tuple[Floats, Floats]:
    """Slip and advance in ``steps``: of the point fixed on each fingertip that touches."""
    after = slice(steps.start + 1, steps.stop + 1)
    touching, point = trace.in_contact[steps], trace.contact_position[steps]
    jacobian = hand.contact_jacobian(trace.q[steps], point)  # (t, N, m, 3, d)

    def moved(change: Floats) -> Floats:
        return np.einsum("...mij,...j->...mi", jacobian, change)

    tip = moved(trace.q[after] - trace.q[steps])
    turn = rotation_vector(
        multiply(trace.object_quaternion[after], inverse(trace.object_quaternion[steps]))
    )
    arm = point - trace.object_position[steps][..., None, :]
    carried = (trace.object_position[after] - trace.object_position[steps])[..., None, :] + cross(
        np.broadcast_to(turn[..., None, :], arm.shape), arm
    )
    normal = trace.contact_normal[steps]
    over = tip - carried
    along = (over * normal).sum(axis=-1, keepdims=True)
    slid = np.linalg.norm(over - along * normal, axis=-1)
    push = (moved(trace.q_target[after] - trace.q_target[steps]) * normal).sum(axis=-1)
    return np.where(touching, slid, 0.0), np.where(touching, push, 0.0)
