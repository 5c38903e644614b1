"""TouchTracking: where a held object of known shape is, and how it is turned, by touch alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypedDict, Unpack

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.enclosing import enclosing_centre
from dexctl.exceptions import InvalidInput
from dexctl.grasp.contacts import grasp_map
from dexctl.grasp.placed import placed
from dexctl.hand import HandModel
from dexctl.rotations import (
    from_rotation_vector,
    inverse,
    multiply,
    rotation_matrix,
    rotation_vector,
    skew,
)
from dexctl.saved import check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import (
    check_numbers,
    number,
    shown,
    with_changes,
)

_PROBE = 1e-5  # how far apart normals are compared for their change [m]
_OUTSIDE = 0.01  # contacts are looked at so far outside of the surface, or further [m]
_UNSURE = 3.0  # from so many standard deviations on, residuals count by their size (Huber)
_MOST = np.array([0.12] * 3 + [4.0] * 3)  # no object is carried faster than this [m/s, rad/s]


class Surface(Protocol):
    """What is touched, such as a `dexctl.sim.Shape`."""

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """How far points of the object's frame ``(..., 3)`` [m] are from it, and the normals there.

        Returns:
            Signed distances ``(...)`` [m], and the outward unit normals ``(..., 3)`` where the
            surface is nearest.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class TouchTrackingConfig:
    """Settings of `TouchTracking`: standard deviations, unless they say otherwise."""

    distance_noise: float = 0.001
    """Of contacts from the surface: how far fingertips press in, and the sensor's error [m]."""
    normal_noise: float = 0.1
    """Of contact normals from the surface's [rad]."""
    slip: float = 0.001
    """Of how far a contact slips in a control period [m], ..."""
    slip_share: float = 0.3
    """... and more by this share of the way that its fingertip has gone."""
    acceleration: float = 0.2
    """How far the object's velocity wanders in a second [m/s], with the square root of the
    time, ..."""
    angular_acceleration: float = 4.5
    """... and its angular velocity [rad/s]; ..."""
    memory: float = 0.5
    """... for so long it goes on where no contact says otherwise; a time constant [s]."""
    middle_noise: float = 0.05
    """Of the object's centre from that of the smallest ball around the contacts, taken anew in
    each control period [m]: what is left of a place along walls that all fingers press on."""

    def __post_init__(self) -> None:
        names = (
            "distance_noise", "normal_noise", "slip", "slip_share", "acceleration",
            "angular_acceleration", "memory", "middle_noise",
        )  # fmt: skip
        check_numbers(self, positive=names)


class TouchTrackingChanges(TypedDict, total=False):
    """`TouchTrackingConfig`'s fields as keywords, for type checkers."""

    distance_noise: float
    normal_noise: float
    slip: float
    slip_share: float
    acceleration: float
    angular_acceleration: float
    memory: float
    middle_noise: float


class TouchTracking:
    """Tracks N objects whose shapes are known by what the fingers feel.

    An extended Kalman filter of the pose. Between two control periods the object moves as the
    fingers that hold it do, as by `dexctl.grasp.odometry.ContactOdometry`, and where few do, as it
    moved before. Then contacts have to lie on its surface, with its normals. They are looked at a
    fingertip's radius outside (1 cm at least), where a round fingertip has its centre: there
    distance and normal change smoothly over edges. Residuals of more than three standard deviations
    count less (Huber). Normals that nobody felt (`GraspState.normals_felt`) do not count; then only
    round fingertips tell the truth.

    What contacts cannot tell is reckoned, and drifts: a cylinder's turn about its axis, a sphere's
    about any, how high an object is that all fingers press on from the sides. A shape that looks
    the same in many orientations, as an icosahedron does, is sooner or later taken for the next.

    Others localise touched objects by particle filters: C. Corcoran and R. Platt, "A measurement
    model for tracking hand-object state during dexterous manipulation" (ICRA 2010); G. Vezzani et
    al., "Memory unscented particle filter for 6-DOF tactile localization" (arXiv 1607.02757). Here
    it is known where the object is to begin with, so that one hypothesis is enough.

    Args:
        hand: the hand.
        surface: of the object, or one for each of N hands.
        config: the settings; None: `TouchTrackingConfig`'s own. Keyword arguments change single
            ones.
        control_period: time between two calls [s].

    Attributes:
        position: ``(N, 3)`` [m].
        quaternion: wxyz, ``(N, 4)``.
        covariance: of position [m] and of a small turn in the hand's frame [rad], ``(N, 6, 6)``.

    Raises:
        InvalidInput: a setting is wrong.
    """

    def __init__(
        self,
        hand: HandModel,
        surface: Surface | Sequence[Surface],
        config: TouchTrackingConfig | None = None,
        *,
        control_period: float = 0.05,
        **changes: Unpack[TouchTrackingChanges],
    ) -> None:
        self.config = with_changes(TouchTrackingConfig, config, changes)
        if not isinstance(hand, HandModel):
            raise InvalidInput(f"hand is {shown(hand)}; expected a HandModel")
        self._hand = hand
        self._dt = number("control_period", control_period, 0.0, 1e3, "seconds above 0", above=True)
        self._outside = max(hand.config.fingertip_radius, _OUTSIDE)
        self._surfaces: list[Any] = [surface]
        if isinstance(surface, Sequence) and not isinstance(surface, str):
            self._surfaces = list(surface)
        for one in self._surfaces:
            if not callable(getattr(one, "closest", None)):
                raise InvalidInput(
                    f"surface is {shown(one)}; expected a shape, such as "
                    "dexctl.sim.Shape.of_object('cube', 0.1)"
                )
        self.start(len(self._surfaces))

    def start(self, count: int) -> None:
        """Nothing known, for ``count`` hands.

        Raises:
            InvalidInput: there are surfaces of another number of hands.
        """
        if len(self._surfaces) not in (1, count):
            raise InvalidInput(
                f"there are {len(self._surfaces)} surfaces for {count} hands; expected one, or one "
                "for each"
            )
        rows: dict[int, list[int]] = {}
        for i, one in enumerate(self._surfaces):
            rows.setdefault(id(one), []).append(i)
        self._groups = [(self._surfaces[own[0]], np.array(own)) for own in rows.values()]
        m, joints = self._hand.finger_joints.shape
        self.position = np.zeros((count, 3))
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self.covariance = np.tile(self._unsure, (count, 1, 1))
        self._step = np.zeros((count, 6))  # of the control period before
        self._fresh = np.zeros(count, bool)  # placed since
        self._q = np.zeros((count, self._hand.nq))
        self._holding = np.zeros((count, m), bool)
        self._point = np.zeros((count, m, 3))
        self._jacobian = np.zeros((count, m, joints, 3))

    @property
    def _unsure(self) -> Floats:
        """The covariance of a pose that is told."""
        config = self.config
        return np.diag([config.distance_noise**2] * 3 + [(0.2 * config.normal_noise) ** 2] * 3)

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "position": self.position,
            "quaternion": self.quaternion,
            "covariance": self.covariance,
            "step": self._step,
            "fresh": self._fresh,
            "q": self._q,
            "holding": self._holding,
            "point": self._point,
            "jacobian": self._jacobian,
        }

    def state_dict(self) -> dict[str, Any]:
        """Poses and what the next of them follow from, to be given to `load_state_dict`."""
        return copies(self._arrays())

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with saved poses of as many hands as there are now.

        Raises:
            InvalidInput: they are none, or of another hand or number of hands.
        """
        check_names("tracking by touch", saved, self._arrays())
        self.start(len(self.position))
        fill("tracking by touch", self._arrays(), saved)

    def place(self, rows: Bools, position: Floats, quaternion: Floats) -> None:
        """The objects in ``rows`` are there, at rest.

        Args:
            rows: ``(N,)`` bool, K of them true.
            position: ``(K, 3)`` [m], or one ``(3,)`` for all.
            quaternion: wxyz, ``(K, 4)``, or one ``(4,)`` for all.

        Raises:
            InvalidInput: wrong shapes, numbers not finite, or no unit quaternions.
        """
        chosen, place, turn = placed(rows, len(self._fresh), position, quaternion)
        self.position[chosen], self.quaternion[chosen] = place, turn
        self.covariance[chosen], self._step[chosen] = self._unsure, 0.0
        self._holding[chosen], self._fresh[chosen] = False, True

    def track(self, state: GraspState) -> GraspState:
        """``state``, of one hand or of N, with the objects' poses by touch.

        To be called once every control period; `place` says where the objects are to begin with.
        """
        batch = state if state.q.ndim == 2 else state[None]
        self.update(batch, self._hand.configuration(batch.q), batch.in_contact)
        pose = self.position.copy(), self.quaternion.copy()
        place, turn = pose if batch is state else (pose[0][0], pose[1][0])
        return replace(state, object_position=place, object_quaternion=turn)

    def update(self, state: GraspState, now: HandConfiguration, holding: Bools) -> None:
        """Take in one control period; ``holding`` ``(N, m)`` are the fingers on the object."""
        if len(state.q) != len(self.position):
            raise InvalidInput(
                f"the state is of {len(state.q)} hands; expected {len(self.position)}"
            )
        before = self.position, self.quaternion
        point = np.where(holding[..., None], state.contact_position, now.fingertip_position)
        self._predict(state.q, holding)
        self._correct(state, point, holding)
        turn = rotation_vector(multiply(self.quaternion, inverse(before[1])))
        most = _MOST * self._dt
        step = np.concatenate([self.position - before[0], turn], axis=1).clip(-most, most)
        self._step = np.where(self._fresh[:, None], 0.0, step)
        self._fresh = np.zeros_like(self._fresh)
        self._q, self._holding, self._point = state.q.copy(), holding.copy(), point
        self._jacobian = now.finger_jacobian(point)

    def _predict(self, q: Floats, holding: Bools) -> None:
        """Move the objects with the fingers that held them before and after."""
        config = self.config
        moved = (q - self._q)[:, self._hand.finger_joints]
        motion = (moved[:, :, None, :] @ self._jacobian)[:, :, 0]  # of the contacts [m]
        transmission = grasp_map(self._point, self.position, holding & self._holding)
        slip = config.slip + config.slip_share * _length(motion)
        weighed = transmission * np.repeat(1.0 / slip**2, 3, axis=1)[:, None]
        # what it did before, and by how much it may have changed
        last = np.exp(-self._dt / config.memory) * self._step
        wander = self._dt**1.5 * np.array([config.acceleration, config.angular_acceleration])
        changed = wander + config.slip_share * _length(last.reshape(-1, 2, 3))
        prior = np.repeat(1.0 / changed**2, 3, axis=1)
        information = weighed @ transmission.swapaxes(1, 2) + prior[..., None] * np.eye(6)
        right = (weighed @ motion.reshape(len(q), -1, 1))[..., 0] + prior * last
        spread = np.linalg.inv(information)
        self._move((spread @ right[..., None])[..., 0])
        self.covariance = self.covariance + spread

    def _correct(self, state: GraspState, point: Floats, holding: Bools) -> None:
        """Bring the objects' surfaces to the contacts."""
        config, count = self.config, len(point)
        normal = np.where(holding[..., None], state.contact_normal, 0.0)
        arm = point - self._outside * normal - self.position[:, None]
        distance, facing = self._surface(arm)
        short = (distance - self._outside) / config.distance_noise
        aslant = (facing + normal) / config.normal_noise
        # how these change as the object moves, (N, m, 6) and (N, m, 3, 6)
        crossed, bent = skew(arm), self._curvature(arm)
        turned = (facing[:, :, None] @ crossed)[:, :, 0]
        by_distance = np.concatenate([-facing, turned], axis=-1) / config.distance_noise
        by_normal = np.concatenate([-bent, bent @ crossed - skew(facing)], axis=-1)
        by_normal = by_normal.reshape(count, -1, 6) / config.normal_noise
        felt = np.broadcast_to(state.normals_felt, (count,))[:, None] & holding
        near, upright = holding * _huber(np.abs(short)), felt * _huber(_length(aslant))
        weighed = by_distance * near[..., None]
        leaning = by_normal * np.repeat(upright, 3, axis=1)[..., None]
        information = np.linalg.inv(self.covariance)
        information = information + weighed.swapaxes(1, 2) @ by_distance
        information += leaning.swapaxes(1, 2) @ by_normal
        right = -(weighed * short[..., None]).sum(axis=1)
        right -= (leaning * aslant.reshape(count, -1, 1)).sum(axis=1)
        # whatever three fingers hold is between them
        held = (holding.sum(axis=1) >= 3)[:, None] / config.middle_noise**2
        middle = enclosing_centre(point, holding | ~holding.any(axis=1, keepdims=True))
        information[:, range(3), range(3)] += held
        right[:, :3] += held * (middle - self.position)
        self.covariance = np.linalg.inv(information)
        self._move((self.covariance @ right[..., None])[..., 0])

    def _surface(self, arm: Floats) -> tuple[Floats, Floats]:
        """Distances and normals of places from the objects' centres, in the hand's frame.

        Places are ``(N, ..., m, 3)``, distances ``(N, ..., m)``, normals as places.
        """
        turn = rotation_matrix(self.quaternion)
        turn = turn.reshape(len(turn), *(1,) * (arm.ndim - 3), 3, 3)
        local = arm @ turn
        if len(self._groups) == 1:
            distance, normal = self._groups[0][0].closest(local)
        else:
            distance, normal = np.empty(local.shape[:-1]), np.empty_like(local)
            for surface, rows in self._groups:
                distance[rows], normal[rows] = surface.closest(local[rows])
        return distance, normal @ turn.swapaxes(-1, -2)

    def _curvature(self, arm: Floats) -> Floats:
        """How normals change along each axis [1/m], ``(N, m, 3, 3)``; see `_surface`."""
        normal = self._surface(arm[:, None] + _PROBE * _BESIDE)[1]
        change = (normal[:, 1:] - normal[:, :1]).transpose(0, 2, 3, 1) / _PROBE
        most = 2.0 / self._outside  # more is a step to another part
        return change.clip(-most, most)

    def _move(self, step: Floats) -> None:
        """By translations [m] and turns [rad] ``(N, 6)``."""
        self.position = self.position + step[:, :3]
        turned = multiply(from_rotation_vector(step[:, 3:]), self.quaternion)
        self.quaternion = turned / np.sqrt((turned * turned).sum(axis=1, keepdims=True))


_BESIDE = np.concatenate([np.zeros((1, 3)), np.eye(3)])[:, None]  # (4, 1, 3)


def _length(vectors: Floats) -> Floats:
    return np.sqrt((vectors * vectors).sum(axis=-1))


def _huber(size: Floats) -> Floats:
    """The weight of residuals of so many standard deviations."""
    return _UNSURE / np.maximum(size, _UNSURE)
