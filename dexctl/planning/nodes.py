"""Nodes: grasps that a tree holds, as rows of arrays, and the frame that measures them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.rotations import cross, inverse, multiply, rotate, twist_angle
from dexctl.state import Bools, Floats
from dexctl.validation import unit_axis

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator, Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Nodes:
    """N grasps of one hand and object, everything that a simulation goes on from.

    Attributes:
        q, q_target: ``(N, d)`` [rad].
        object_position: ``(N, 3)`` [m].
        object_quaternion: wxyz, ``(N, 4)``.
        joint_velocity: ``(N, d)`` [rad/s].
        object_velocity: as `BatchSimulator.set_grasp` takes it, ``(N, 6)``.
        in_contact: which fingertips touch, ``(N, m)``.
        rotation: of the object about the axis since the root, unwrapped ``(N,)`` [rad].
        cost: time that the actions from the root on take ``(N,)`` [s].
    """

    q: Floats
    q_target: Floats
    object_position: Floats
    object_quaternion: Floats
    joint_velocity: Floats
    object_velocity: Floats
    in_contact: Bools
    rotation: Floats
    cost: Floats

    def __len__(self) -> int:
        return len(self.q)

    def take(self, index: ArrayLike) -> Nodes:
        """Some of them: indices, which may repeat, or a mask."""
        chosen = np.asarray(index)
        chosen = chosen if chosen.size else np.empty(0, int)
        return Nodes(**{name: getattr(self, name)[chosen] for name in NODE_FIELDS})

    @classmethod
    def concatenate(cls, parts: Sequence[Nodes]) -> Nodes:
        """All of ``parts``, one after the other."""
        return cls(
            **{name: np.concatenate([getattr(p, name) for p in parts]) for name in NODE_FIELDS}
        )


NODE_FIELDS = tuple(field.name for field in fields(Nodes))


@dataclass(frozen=True, eq=False)
class Frame:
    """What position, tilt and rotation of the object are measured from: the root's pose.

    Attributes:
        axis: of the wanted rotation, unit, ``(3,)``.
        position: of the object at the root, ``(3,)`` [m].
        quaternion: its orientation there, wxyz ``(4,)``.
    """

    axis: Floats
    position: Floats
    quaternion: Floats

    @classmethod
    def of(cls, axis: ArrayLike, root: Nodes) -> Frame:
        """The frame of a tree with this root, a row of one."""
        unit = np.asarray(unit_axis(axis), float)
        return cls(unit, root.object_position[0], root.object_quaternion[0])

    @cached_property
    def across(self) -> Floats:
        """Two unit vectors across the axis and each other, ``(2, 3)``."""
        first = cross(self.axis, np.eye(3)[np.argmin(np.abs(self.axis))])
        first = first / np.linalg.norm(first)
        return np.stack([first, cross(self.axis, first)])

    @cached_property
    def carried_axis(self) -> Floats:
        """The axis in the object's own frame, where it lies at the root, ``(3,)``."""
        return rotate(inverse(self.quaternion), self.axis)

    def displacement(self, position: Floats) -> Floats:
        """From where the object was at the root, ``(..., 3)`` [m]."""
        return position - self.position

    def tilt(self, quaternion: Floats) -> Floats:
        """How the carried axis leans, along the two directions across it, ``(..., 2)`` [rad]."""
        lean = rotate(quaternion, np.broadcast_to(self.carried_axis, (*quaternion.shape[:-1], 3)))
        flat, upright = lean @ self.across.T, (lean @ self.axis)[..., None]
        sine = np.sqrt((flat * flat).sum(axis=-1, keepdims=True))
        angle = np.arctan2(sine, upright)
        scale: Floats = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)
        # upside down, every direction is as far: one of them
        over = (sine <= 1e-9) & (upright < 0)
        return np.where(over, [np.pi, 0.0], np.multiply(flat, scale))

    def rotation(self, quaternion: Floats, near: Floats) -> Floats:
        """Angle about the axis since the root that is nearest to ``near``, ``(...)`` [rad].

        The twist of the swing-twist decomposition, as `dexctl.sim.rotation_about` has it; with the
        parent's as ``near`` it is unwrapped from node to node.
        """
        relative = multiply(quaternion, inverse(np.broadcast_to(self.quaternion, quaternion.shape)))
        angle = twist_angle(relative, self.axis)
        return angle + 2.0 * np.pi * np.round((near - angle) / (2.0 * np.pi))


def children(
    frame: Frame,
    sim: BatchSimulator,
    parents: Nodes,
    seconds: Floats,
    rows: NDArray[np.intp] | None = None,
) -> Nodes:
    """What the environments ``rows`` (None: all) hold now, ``seconds`` after ``parents``."""
    state, scene = sim.read(), sim.scene
    velocity = sim.qvel
    if rows is not None:
        state, velocity = state[rows], velocity[rows]
    assert state.object_position is not None
    assert state.object_quaternion is not None
    return Nodes(
        q=state.q,
        q_target=state.q_target,
        object_position=state.object_position,
        object_quaternion=state.object_quaternion,
        joint_velocity=velocity[:, scene.qvel_columns],
        object_velocity=velocity[:, scene.object_qvel],
        in_contact=state.in_contact,
        rotation=frame.rotation(state.object_quaternion, parents.rotation),
        cost=parents.cost + seconds,
    )


def put(sim: BatchSimulator, nodes: Nodes, mask: NDArray[np.bool_] | None = None) -> None:
    """Put nodes into a simulator, one for each environment."""
    sim.set_grasp(
        nodes.q,
        nodes.q_target,
        nodes.object_position,
        nodes.object_quaternion,
        mask,
        joint_velocity=nodes.joint_velocity,
        object_velocity=nodes.object_velocity,
    )


def root_of(scene: Scene) -> Nodes:
    """The settled grasp of a scene, a row of one.

    Raises:
        SimulationError: the object does not stay in the hand.
    """
    from dexctl.sim import BatchSimulator

    settled = scene.settled
    with BatchSimulator(scene, 1, disturbance=0.0, threads=1) as sim:
        touch = sim.read().in_contact
    pose = settled.qpos[scene.object_qpos]
    return Nodes(
        q=settled.qpos[None, scene.qpos_columns],
        q_target=settled.q_target[None],
        object_position=pose[None, :3],
        object_quaternion=pose[None, 3:],
        joint_velocity=settled.qvel[None, scene.qvel_columns],
        object_velocity=settled.qvel[None, scene.object_qvel],
        in_contact=touch,
        rotation=np.zeros(1),
        cost=np.zeros(1),
    )
