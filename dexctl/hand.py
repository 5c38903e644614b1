"""HandModel: the kinematics of a hand of serial fingers, on pinocchio.

This is pinocchio's only door into dexctl.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from math import hypot
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pinocchio
from numpy.lib.stride_tricks import as_strided
from numpy.typing import ArrayLike, NDArray

from dexctl.configuration import FingerJoints, HandConfiguration
from dexctl.description import Description, Joint, Mimic, read_mjcf, read_urdf
from dexctl.exceptions import HandModelError, InvalidInput, UnknownName
from dexctl.hand_config import HandConfig, Vector3
from dexctl.state import Bools, Floats
from dexctl.validation import check_seed, number, numbers, shown

Item = TypeVar("Item")
MOST_JOINTS = 256
"""On one finger, arm and wrist included."""
MAX_ANGLE = 1e6
"""Largest joint position [rad, m]: sine and cosine keep 10 digits."""
_MOST = float(np.finfo(float).max)


class HandModel:
    """A hand of m serial fingers with d joints, on a wrist or not.

    Built by :meth:`load`, :meth:`from_mjcf` or :meth:`from_urdf`. Joints are in the order of the
    fingertips given, base to tip; a joint shared by several fingers (a wrist) stands where it is
    met first, before theirs. Joints that follow another (mimic, equality) are not among the d:
    they move with their master. Joints that move no fingertip are left at their reference
    position and listed in ``ignored_joints``. One evaluation at a time: methods may be called
    from any thread, they take turns.

    Attributes:
        nq: d, number of joints.
        n_fingers: m, number of fingertips.
        joint_names: names of the d joints, in order.
        fingertip_names: body, site or link name of each fingertip, in order.
        fingertip_bodies: the body that each fingertip is on, in order.
        fingertip_offsets: where the tip is in its body's frame, ``(m, 3)`` [m].
        lower, upper: joint limits, ``(d,)`` [rad], infinite where the file gives none.
        effort: joint torque limits, ``(d,)`` [N m], infinite where the file gives none.
        velocity: joint speed limits, ``(d,)`` [rad/s], infinite where the file gives none.
        moves: which joints move which fingertip, ``(m, d)`` bool.
        finger_joints: the joints of each finger, ``(m, n)`` int, n the most that one has; rows
            of shorter fingers are filled up with zeros, which `moves` tells from joint 0.
        finger_joint_map: ``(m, n, d)``; one where joint d is the n-th of a finger, else zero.
        shares_joints: whether some joint moves more than one fingertip.
        couplings: the joints above a fingertip that are not among the d, by name, and what each
            follows in the end (held where ``master`` is None): by the file, and by `config`.
        ignored_joints: joints of the file that move no fingertip.
        description: the bodies and joints of the file, with the couplings of `config` among its.
        path: the description file that the hand came from.
        config: what is said of the hand beside that file.
        name: the hand's name, for people and files.
        base_rotation: from the description file's world frame into the hand's, which is dexctl's
            world frame, ``(3, 3)``: there the palm looks along z and the fingers point along x.
    """

    def __init__(self, description: Description, config: HandConfig) -> None:
        path = self.path = description.path
        self.config = config
        self.name = config.name
        self.base_rotation = config.palm.rotation
        self._arguments = (description, config)
        description = self.description = _coupled(description, config)
        joints = config.joints
        self._resolve_fingertips(description, config.fingertips)
        chains = [self._chain(description, body) for body in self._tip_body]
        used = _unique(joint.name for chain in chains for _, joint in chain)
        couplings = {name: description.resolve(name) for name in used}
        for chain, tip in zip(chains, self.fingertip_names, strict=True):
            if all(couplings[joint.name].master is None for _, joint in chain):
                raise HandModelError(f"{path}: every joint above the fingertip {tip!r} is held")
        self.couplings = {name: one for name, one in couplings.items() if one.master != name}
        # a master may sit on no finger (a drive): its slaves still need it
        masters = _unique(c.master for c in couplings.values() if c.master is not None)
        if joints is not None and sorted(joints) != sorted(masters):
            raise HandModelError(
                f"{path}: the joint order {list(joints)} is not an order of the joints that move "
                f"the fingertips: {', '.join(masters)}"
            )
        order = list(joints) if joints is not None else masters
        self._build(description, chains, couplings, order)

    @classmethod
    def load(cls, hand: str | Path, *, folder: str | Path | None = None) -> HandModel:
        """A hand by name, or from a file; see `dexctl.hands.load`."""
        from dexctl.hands.registry import load

        return load(hand, folder=folder)

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        fingertips: Sequence[str] | Mapping[str, ArrayLike],
        *,
        joints: Sequence[str] | None = None,
    ) -> HandModel:
        """A hand from an MJCF file, which may hold other bodies too.

        Args:
            path: the file.
            fingertips: one body or site name for each finger; a body stands for the origin of
                its frame unless a mapping gives the tip's offset in that frame [m].
            joints: the joints in the order wanted, if not the stated one.

        Raises:
            HandModelError: the file cannot be read or holds no such hand (a free or ball joint
                above a fingertip, a fingertip that no joint moves, nonlinear couplings).
            UnknownName: a fingertip is neither a body nor a site.
        """
        return cls._from_file(path, read_mjcf, fingertips, joints)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        fingertips: Sequence[str] | Mapping[str, ArrayLike],
        *,
        joints: Sequence[str] | None = None,
    ) -> HandModel:
        """A hand from a URDF file; fingertips are links. Arguments and errors: `from_mjcf`."""
        return cls._from_file(path, read_urdf, fingertips, joints)

    @classmethod
    def _from_file(
        cls,
        path: str | Path,
        reader: Callable[[Path], Description],
        fingertips: Sequence[str] | Mapping[str, ArrayLike],
        joints: Sequence[str] | None,
    ) -> HandModel:
        path = _file(path)
        tips = _offsets(path, fingertips)
        order = None if joints is None else _names(path, "joints", joints, "joint names")
        config = HandConfig(description=path, fingertips=tips, joints=order)
        return cls(reader(path), config)

    def configuration(self, q: ArrayLike) -> HandConfiguration:
        """Forward kinematics at ``q`` ``(..., d)`` [rad].

        Raises:
            InvalidInput: q has another number of joints, or is no array of real numbers within
                `MAX_ANGLE`.
        """
        q = self._joints(q)
        if not (q.ndim == 1 and hypot(*q.tolist()) <= MAX_ANGLE):  # told at once
            within = np.abs(q) <= MAX_ANGLE
            if not within.all():
                at = tuple(np.argwhere(~within.all(axis=-1))[0].tolist())
                where = str(list(at)) if at else ""
                raise InvalidInput(
                    f"q{where} is {shown(q[at])}; expected angles of at most {MAX_ANGLE:.0e} rad"
                )
        if q.ndim == 1:  # what a control loop asks, without the detour through a batch of one
            with self._lock:
                row = q @ self._expand
                row += self._expand_offset
                pinocchio.computeJointJacobians(self._model, self._data, row)
                chains = self._twist_view.T[self._chain_slots]
                tips = self._tip_view.copy()
            return HandConfiguration(self._fingers, tips, self._reduced(chains))
        batch = q.shape[:-1]
        rows = q.reshape(-1, self.nq) @ self._expand
        rows += self._expand_offset
        twist = np.empty((len(rows), *self._twist_view.shape))
        tips = np.empty((len(rows), self.n_fingers, 3))
        with self._lock:
            for i, row in enumerate(rows):
                pinocchio.computeJointJacobians(self._model, self._data, row)
                twist[i] = self._twist_view
                tips[i] = self._tip_view
        chains = self._reduced(twist.swapaxes(-1, -2)[:, self._chain_slots])
        return HandConfiguration(
            self._fingers,
            tips.reshape(*batch, *tips.shape[1:]),
            chains.reshape(*batch, *chains.shape[1:]),
        )

    def _reduced(self, chains: Floats) -> Floats:
        """Twists of each chain's joints ``(..., m, p, 6)`` to those of the joints they follow."""
        return chains if self._reduce is None else self._reduce @ chains

    def fingertip_positions(self, q: ArrayLike) -> Floats:
        """Fingertip positions ``(..., m, 3)`` [m], world frame, at ``q`` ``(..., d)``."""
        return self.configuration(q).fingertip_position

    def contact_jacobian(self, q: ArrayLike, contact_position: ArrayLike) -> Floats:
        """Jacobians ``(..., m, 3, d)`` of contact points fixed on the distal links.

        ``contact_position`` is ``(..., m, 3)`` [m], world frame; row i is a point of finger i's
        distal link, and is read for finger i alone. J dq is the velocity of those points (J_S of
        the thesis, chapter 4).

        Raises:
            InvalidInput: as `configuration`; points of another shape, or that are no real numbers.
        """
        points = numbers("contact_position", contact_position, "points [m]")
        q = self._joints(q)
        if points.shape != (*q.shape[:-1], self.n_fingers, 3):
            raise InvalidInput(
                f"contact_position has shape {points.shape}; expected "
                f"{(*q.shape[:-1], self.n_fingers, 3)}"
            )
        return self.configuration(q).contact_jacobian(points)

    def clip(self, q: ArrayLike) -> Floats:
        """``q`` ``(..., d)`` [rad] within the joint limits; infinite ones are at them.

        Raises:
            InvalidInput: q has another number of joints, or holds what is no real number.
        """
        within = np.minimum(np.maximum(self._joints(q), self.lower), self.upper)
        if np.isnan(within).any():
            raise InvalidInput(f"q is {shown(q)}; expected joint positions, none of them NaN")
        return within

    def _joints(self, q: ArrayLike) -> Floats:
        """``q`` as an array ``(..., d)``."""
        q = numbers("q", q, "joint positions [rad]")
        if q.ndim == 0 or q.shape[-1] != self.nq:
            raise InvalidInput(f"q has shape {q.shape}; expected (..., {self.nq})")
        return q

    def posture(self, angles: Mapping[str, float]) -> Floats:
        """Joints by name ``(d,)`` [rad], within their limits.

        One that ``angles`` leaves out is at the middle of its range, or 0 where it has none.

        Raises:
            UnknownName: the hand has no such joint.
            InvalidInput: an angle is no finite number, or ``angles`` no mapping.
        """
        if not isinstance(angles, Mapping):
            raise InvalidInput(f"angles is {shown(angles)}; expected angles by the joints' names")
        limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        q = np.zeros(self.nq)
        q[limited] = (self.lower[limited] + self.upper[limited]) / 2
        for joint, angle in angles.items():
            if joint not in self.joint_names:
                raise UnknownName("joint", joint, self.joint_names)
            q[self.joint_names.index(joint)] = number(
                f"the angle of joint {joint!r}", angle, -_MOST, _MOST, "a finite number [rad]"
            )
        return self.clip(q)

    @cached_property
    def digest(self) -> str:
        """SHA-256 over the hand's settings and files; see `dexctl.hands.identity`."""
        from dexctl.hands.identity import digest

        return digest(self.config, self.path)

    def __reduce__(self) -> tuple[type, tuple]:
        return type(self), self._arguments  # pinocchio's data is rebuilt, not pickled

    def __repr__(self) -> str:
        return f"HandModel({str(self.path)!r}, {self.n_fingers} fingers, {self.nq} joints)"

    def _resolve_fingertips(
        self, description: Description, fingertips: Mapping[str, Vector3]
    ) -> None:
        body_index = {body.name: i for i, body in enumerate(description.bodies)}
        self._tip_body, offsets = [], []
        for name, own in fingertips.items():
            if name in body_index:
                body, offset = body_index[name], np.zeros(3)
            elif name in description.sites:
                body, offset = description.sites[name]
            else:
                raise UnknownName("fingertip", name, [*body_index, *description.sites])
            self._tip_body.append(body)
            offsets.append(offset + own)
        self.fingertip_names = tuple(fingertips)
        self.fingertip_bodies = tuple(description.bodies[b].name for b in self._tip_body)
        self.fingertip_offsets = np.array(offsets)
        self.n_fingers = len(offsets)

    def _chain(self, description: Description, body: int) -> list[tuple[int, Joint]]:
        """The (body, joint) pairs from the world to ``body``."""
        tip, chain = description.bodies[body].name, []
        while body >= 0:
            chain += [(body, joint) for joint in reversed(description.bodies[body].joints)]
            body = description.bodies[body].parent
        chain.reverse()
        if len(chain) > MOST_JOINTS:
            raise HandModelError(
                f"{self.path}: {len(chain)} joints move the fingertip {tip!r}; a hand may have "
                f"{MOST_JOINTS} on a finger, and the rest fixed"
            )
        for _, joint in chain:
            if joint.kind not in ("hinge", "slide"):
                raise HandModelError(
                    f"{self.path}: joint {joint.name!r} above the fingertip {tip!r} is of kind "
                    f"{joint.kind!r}; the base must be fixed and fingers have hinge or slide "
                    "joints only"
                )
        if not chain:
            raise HandModelError(f"{self.path}: no joint moves the fingertip {tip!r}")
        return chain

    def _build(
        self,
        description: Description,
        chains: list[list[tuple[int, Joint]]],
        couplings: dict[str, Mimic],
        order: list[str],
    ) -> None:
        """Make the pinocchio model of the bodies on the chains, and the maps into it."""
        model = pinocchio.Model()
        # the pinocchio joint that carries each body, and the body's placement on it
        base = pinocchio.SE3(self.base_rotation, np.zeros(3))
        placed: dict[int, tuple[int, pinocchio.SE3]] = {-1: (0, base)}
        for body in _above(description, self._tip_body):
            item = description.bodies[body]
            parent, offset = placed[item.parent]
            offset = offset * pinocchio.SE3(item.rotation, item.translation)
            for joint in item.joints:
                anchor = pinocchio.SE3(np.eye(3), joint.anchor)
                if joint.kind == "hinge":
                    kind = pinocchio.JointModelRevoluteUnaligned(joint.axis)
                    turn = pinocchio.AngleAxis(-joint.reference, joint.axis).matrix()
                    back = pinocchio.SE3(turn, np.zeros(3))
                else:
                    kind = pinocchio.JointModelPrismaticUnaligned(joint.axis)
                    back = pinocchio.SE3(np.eye(3), -joint.reference * joint.axis)
                parent = model.addJoint(parent, kind, offset * anchor * back, joint.name)
                offset = anchor.inverse()
            placed[body] = (parent, offset)

        carriers = [placed[body] for body in self._tip_body]
        slots = list(model.names)[1:]
        # a joint that never moves sits at each fingertip, so that pinocchio places the tip too
        tips = []
        for (parent, offset), tip in zip(carriers, self.fingertip_offsets, strict=True):
            still = pinocchio.JointModelPrismaticUnaligned(np.array([1.0, 0.0, 0.0]))
            at_tip = offset * pinocchio.SE3(np.eye(3), tip)
            tips.append(model.addJoint(parent, still, at_tip, f"tip {len(tips)}"))
        self._model, self._data = model, model.createData()
        self._lock = threading.Lock()
        pinocchio.computeJointJacobians(model, self._data, np.zeros(model.nq))
        # pinocchio writes in place, so these views show every later evaluation
        self._twist_view = self._data.J.reshape(6, -1)
        self._tip_view = _stacked([self._data.oMi[joint].translation for joint in tips])

        # pinocchio numbers joints its own way: column k of its Jacobian is the joint in slot k
        self._expand = np.zeros((len(order), model.nq))
        self._expand_offset = np.zeros(model.nq)
        columns = {name: model.idx_vs[model.getJointId(name)] for name in slots}
        for name, column in columns.items():
            self._expand_offset[column] = couplings[name].offset
            master = couplings[name].master
            if master is not None:
                self._expand[order.index(master), column] = couplings[name].scale
        self._map_fingers([[columns[joint.name] for _, joint in chain] for chain in chains])
        self.joint_names = tuple(order)
        self.nq = len(order)
        found = [description.joints[name] for name in order]
        self.lower = np.array([joint.lower for joint in found])
        self.upper = np.array([joint.upper for joint in found])
        servos = self.config.servos
        self.effort = servos.of("effort", order, np.array([joint.effort for joint in found]))
        self.velocity = servos.of("velocity", order, np.array([joint.velocity for joint in found]))
        self.config.check_joints(order)
        self.couplings = {name: one for name, one in couplings.items() if name not in order}
        self.ignored_joints = tuple(
            name for name in description.joints if name not in couplings and name not in order
        )

    def _map_fingers(self, chains: list[list[int]]) -> None:
        """Which columns of pinocchio's Jacobian, and which of the d joints, belong to a finger."""
        m, d = self.n_fingers, len(self._expand)
        longest = max(map(len, chains))
        still = self._expand.shape[1] - 1  # a tip's joint: never moves, and is on no chain
        self._chain_slots = np.full((m, longest), still)
        joints: list[list[int]] = []
        for finger, chain in enumerate(chains):
            self._chain_slots[finger, : len(chain)] = chain
            joints.append(
                _unique(int(j) for c in chain for j in np.flatnonzero(self._expand[:, c]))
            )
        width = max(map(len, joints))
        self.finger_joints = np.zeros((m, width), int)
        self.finger_joint_map = np.zeros((m, width, d))
        reduce = np.zeros((m, width, longest))
        for finger, own in enumerate(joints):
            self.finger_joints[finger, : len(own)] = own
            self.finger_joint_map[finger, range(len(own)), own] = 1.0
            for place, column in enumerate(chains[finger]):
                reduce[finger, : len(own), place] = self._expand[own, column]
        plain = reduce.shape[1] == longest and bool((reduce == np.eye(longest)).all())
        self._reduce = None if plain else reduce
        self.moves: Bools = np.asarray(self.finger_joint_map.any(axis=1))
        self._fingers = FingerJoints(self.finger_joints, self.finger_joint_map, self.moves)
        self.shares_joints = bool((self.moves.sum(axis=0) > 1).any())


def _file(path: object) -> Path:
    """``path`` where it names a file, and is not the text of one."""
    is_text = isinstance(path, str) and path.lstrip("\ufeff \t\r\n").startswith("<")
    if is_text or not isinstance(path, (str, Path)):
        raise HandModelError(
            f"path is {shown(path)}; expected the path of a file, not what is in it"
        )
    found = Path(path).expanduser()
    try:
        exists = found.is_file()
    except OSError:  # a name that is too long
        exists = False
    if not exists:
        raise HandModelError(f"{shown(path) if len(str(found)) > 400 else found}: no such file")
    return found


def _above(description: Description, bodies: Iterable[int]) -> list[int]:
    """``bodies`` and all that they hang on, parents first."""
    found: set[int] = set()
    for body in bodies:
        while body >= 0 and body not in found:
            found.add(body)
            body = description.bodies[body].parent
    return sorted(found)


def _coupled(description: Description, config: HandConfig) -> Description:
    """The description with the couplings that its owner adds."""
    if not config.couplings:
        return description
    known = description.joints
    for follower, coupling in config.couplings.items():
        for name in filter(None, (follower, coupling.joint)):
            if name not in known:
                raise UnknownName("joint in couplings", name, known)
    added = {
        follower: Mimic(coupling.joint or None, coupling.scale, coupling.offset)
        for follower, coupling in config.couplings.items()
    }
    return replace(description, mimics={**description.mimics, **added})


def _offsets(path: Path, fingertips: Sequence[str] | Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Fingertips with their offsets, those of a list at the origins of their frames."""
    names = _names(path, "fingertips", fingertips, "a list of body or site names")
    if isinstance(fingertips, Mapping):
        return dict(fingertips)
    if len(set(names)) != len(names):
        raise HandModelError(f"{path}: a fingertip is named twice in {list(names)}")
    return dict.fromkeys(names, (0.0, 0.0, 0.0))


def _names(path: Path, what: str, given: Any, expected: str) -> tuple[str, ...]:
    """``given`` as names, one and more."""
    try:
        names: tuple[Any, ...] = () if isinstance(given, (str, bytes)) else tuple(given)
    except TypeError:
        names = ()
    if not names or not all(isinstance(name, str) for name in names):
        raise HandModelError(f"{path}: {what} is {shown(given)}; expected {expected}")
    return names


def _stacked(views: list[Floats]) -> Floats:
    """One view ``(m, 3)`` of the vectors that ``views`` show.

    They are neighbours in pinocchio's vector of placements, so one stride leads from each to the
    next; copying them one by one took half the time of forward kinematics.
    """
    addresses = [view.ctypes.data for view in views]
    stride = addresses[1] - addresses[0] if len(views) > 1 else 0
    if any(b - a != stride for a, b in pairwise(addresses)):
        raise RuntimeError("pinocchio's placements are not evenly spaced; its layout has changed")
    return as_strided(views[0], (len(views), 3), (stride, views[0].strides[0]), writeable=False)


def _unique(items: Iterable[Item]) -> list[Item]:
    return list(dict.fromkeys(items))


def random_configurations(hand: HandModel, count: int, seed: int) -> NDArray[np.float64]:
    """``count`` joint vectors ``(count, d)``, uniform within the limits (pi where infinite).

    Raises:
        InvalidInput: ``seed`` is no whole number from 0 on.
    """
    lower, upper = np.maximum(hand.lower, -np.pi), np.minimum(hand.upper, np.pi)
    rng = np.random.default_rng(check_seed(seed, 0))
    return rng.uniform(lower, upper, (count, hand.nq))
