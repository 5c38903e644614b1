"""CoordinatedGait: turns an object without end, one guarded finger switch after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, check_action, check_sound, check_state
from dexctl.exceptions import InvalidInput
from dexctl.gait.selection import Grasps, choose, holds_without
from dexctl.grasp.odometry import ContactOdometry
from dexctl.hand import HandModel
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig, Share
from dexctl.igm.config import FEW, few_fingers
from dexctl.limits import SetPointLimits
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.switch.config import GuardedSwitchConfig
from dexctl.switch.guarded import GuardedSwitch, Phase
from dexctl.switch.landing import azimuth, landing_at, split, turned
from dexctl.validation import check_kind, check_mask, check_numbers, with_changes


def _turning(**changes: Any) -> InGraspManipulationConfig:
    # a finger that nears its end is switched, and `most_travel` stops the object till then
    plain = InGraspManipulationConfig.for_switching(
        twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.35),
        # with 0.15 two opposite fingers come to carry a dodecahedron, and it falls when one lifts
        min_force=0.25,
        height_gain=2.0,
        centring_gain=2.0,
        reach_distance=0.0,
    )
    return replace(plain, **changes)


@dataclass(frozen=True, kw_only=True)
class CoordinatedGaitConfig:
    """Settings of `CoordinatedGait`; angles are about the axis of the wanted rotation."""

    in_grasp: InGraspManipulationConfig = field(default_factory=_turning)
    """Of in-grasp manipulation; its twist is the wanted motion."""
    switch: GuardedSwitchConfig = field(default_factory=GuardedSwitchConfig)
    """Of the guarded switch."""
    swing: float = 0.45
    """Fingers land this far, against the rotation, from where they were at the reset [rad]."""
    least_travel: float = 0.3
    """Fingers that have come less than this from their landing stay down [rad]."""
    most_travel: float = 0.5
    """The object stops before a finger is this far past where it was at the reset [rad]."""
    unfelt_travel: float | None = None
    """In place of `most_travel` where normals are guessed (`GraspState.normals_felt` is False)
    [rad]; None: no other."""
    slow_down: float = 0.2
    """And slows down over the last so much before it [rad]."""
    spacing: float = 0.036
    """Fingers land at least this far, round the object, from the one behind them [m]: one that
    comes down on its neighbour touches nothing else and pushes it off the object. Suiting a hand:
    1.4 of its ``config.finger_width``."""
    follow: bool = True
    """Whether landings follow the object until the tip touches, not only until it lifts. They keep
    `spacing` from the finger behind, which comes on with the object, in any case."""
    level: float = 0.0
    """Share of the height by which a finger touched above or below the object's centre that is
    made up where it next lands: fingertips that are not round do not touch at their tip point."""
    cradle: float = 0.01
    """Where neither a tracker nor normals that are felt tell it, fingers land this far below the
    object's centre, along gravity if a state has that [m]: the object rests in them. From faces
    that lean, unseen, it would slip down a little with every switch."""
    pause: float = 0.1
    """Between two switches of a hand [s]."""
    lost_after: float = 2.5
    """A finger that has closed in for so long and touches nothing, while all others do, is put down
    anew [s]: its link lies on the object, or another finger is in its way."""
    friction: float = 0.8
    """Assumed by the force-closure guard."""
    resting_friction: float | None = None
    """In its place where the object's weight goes straight into the palm, and between the two as
    far as it does: an object that slips there comes to rest in the hand, and is not lost. None: no
    other. What the state does not tell gravity of is guarded by `friction`."""
    hold_force: float = 0.3
    """Fingers count as holding from this normal force on [N]."""
    residual_weight: float = 2.0
    """What a wrench left by the others counts against a finger's travel [rad]: a finger whose
    neighbours hold by friction alone is lifted last, or the object slips while it is away."""
    residual_limit: float = 0.6
    """No finger is lifted that leaves more than this, as a share of the grip."""

    def __post_init__(self) -> None:
        check_kind(
            self, in_grasp=InGraspManipulationConfig, switch=GuardedSwitchConfig, follow=bool
        )
        check_numbers(
            self,
            positive=("most_travel", "slow_down", "friction", "residual_limit"),
            not_negative=(
                "swing",
                "least_travel",
                "spacing",
                "cradle",
                "pause",
                "lost_after",
                "hold_force",
                "residual_weight",
            ),
            fractions=("level",),
            optional=("unfelt_travel", "resting_friction"),
        )
        if not any(self.in_grasp.twist[3:]):
            raise InvalidInput(
                f"in_grasp.twist is {self.in_grasp.twist}; a gait needs a rotation (last three)"
            )

    @classmethod
    def suiting(cls, hand: HandModel) -> CoordinatedGaitConfig:
        """What suits a hand: these defaults where five fingers hold; less speed and short swings
        where four do, since three remain while one is lifted, and never further than
        ``hand.config.object.reach``, or ``travel`` where the hand's toml says that; landings a
        finger's width apart, and some more.
        """
        reach = hand.config.object.reach or np.inf
        found = cls(**_FEW) if few_fingers(hand) else cls()
        usual = min(found.most_travel, 1.1 * reach)
        return replace(
            found,
            spacing=_ROOM * hand.config.finger_width or found.spacing,
            swing=min(found.swing, reach),
            most_travel=hand.config.object.travel or usual,
            unfelt_travel=usual if hand.config.object.travel else None,
            least_travel=min(found.least_travel, 0.65 * reach),
            slow_down=min(found.slow_down, 0.35 * reach),
        )

    def guarded(self, state: GraspState) -> Floats:
        """The friction that the guard assumes of each hand of a batch, ``(N,)``."""
        usual, resting, gravity = self.friction, self.resting_friction, state.gravity
        if resting is None or gravity is None:
            return np.full(len(state.q), usual)
        size = np.sqrt((gravity * gravity).sum(axis=-1))
        # z of the hand's frame is where the palm looks
        into = np.clip(-gravity[:, 2] / np.maximum(size, 1e-9), 0.0, 1.0)
        return usual + into * (resting - usual)

    def about(self, axis: object) -> CoordinatedGaitConfig:
        """The same with the rotation about ``axis`` ``(3,)``, of any length, at the same speed."""
        return replace(self, in_grasp=self.in_grasp.about(axis))


_ROOM = 1.4  # finger widths between landings (docs/what-helped.md)
_MOST_HEIGHT = 0.02  # between fingertip and contact [m]
# measured on the Allegro and the LEAP hand (docs/what-helped.md)
_FEW: dict[str, Any] = {
    "in_grasp": _turning(
        **FEW,
        grip_force=3.0,
        min_force=0.15,  # with 0.3 the Allegro's cube turns a fifth less far
        height_gain=1.0,
        centring_gain=1.0,
    ),
    "switch": GuardedSwitchConfig(
        unload_time=0.2, load_time=0.1, unloaded_force=0.3, clearance=0.012, place_speed=0.08
    ),
    "swing": 0.25,
    "least_travel": 0.16,
    "most_travel": 0.33,
    "slow_down": 0.1,
    "pause": 0.05,
    "lost_after": 1.0,
    "cradle": 0.0,  # it presses spheres out of four fingers
    "follow": False,  # following it lost cubes: 4 of 16 more on the LEAP, 5 on the Shadow hand
    "level": 0.5,
    "hold_force": 0.15,
    "friction": 0.65,
    "resting_friction": 0.8,
    "residual_weight": 1.0,  # three on a sphere always leave some; 2 was not measured here
    "residual_limit": 1.0,  # closure alone decides: a limit leaves the object waiting for good
}


class CoordinatedGaitChanges(TypedDict, total=False):
    """`CoordinatedGaitConfig`'s fields as keywords, for type checkers."""

    in_grasp: InGraspManipulationConfig
    switch: GuardedSwitchConfig
    swing: float
    least_travel: float
    most_travel: float
    unfelt_travel: float | None
    slow_down: float
    spacing: float
    follow: bool
    level: float
    cradle: float
    pause: float
    lost_after: float
    friction: float
    resting_friction: float | None
    hold_force: float
    residual_weight: float
    residual_limit: float


class CoordinatedGait(BatchController):
    """In-grasp manipulation and the guarded switch, coordinated.

    The finger that has gone furthest with the object is switched back, when the others hold:
    they press firmly, what wrench they leave is small, and they are a force closure, which is
    checked when the finger starts to unload and again when it is about to lift. The object turns
    all the while and slows down where the furthest finger nears its end, so that no finger runs
    out of reach while it waits for its turn.

    A finger belongs to in-grasp manipulation until it lifts and to the switch from then until it
    touches: the two actions are in the diagnostics, and their inner product is zero.

    Where nothing tracks the object, its pose is summed up from the motion of the fingers that hold
    it (`ContactOdometry`), from the middle of the contacts at the reset on.

    Args:
        hand: the hand, of four fingers or more of which any but one can hold the object.
        config: the settings; None: `CoordinatedGaitConfig.suiting` the hand. Keyword arguments
            change single ones.
        control_period: [s].
        axis: about which the object is to be turned, ``(3,)``, at the speed of the settings; None
            keeps their axis.
    """

    def __init__(
        self,
        hand: HandModel,
        config: CoordinatedGaitConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[CoordinatedGaitChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        config = CoordinatedGaitConfig.suiting(hand) if config is None else config
        self.config = with_changes(CoordinatedGaitConfig, config, changes, axis)
        self.in_grasp = InGraspManipulation(
            hand, self.config.in_grasp, control_period=control_period
        )
        self._twist = np.array(self.config.in_grasp.twist, float)
        self.axis = self._twist[3:] / np.linalg.norm(self._twist[3:])
        self.switch = GuardedSwitch(hand, self.axis, self.config.switch, control_period)
        speed = self.config.in_grasp.max_joint_speed
        self._limits = SetPointLimits(hand, speed, self.config.in_grasp.max_lead, control_period)
        self._odometry = ContactOdometry(hand, control_period)
        self._fresh: np.ndarray | None = None

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.in_grasp.reset(seed, mask)
        if mask is None or self._fresh is None:
            self._fresh = None
        else:
            self._fresh = self._fresh | check_mask(mask, self._fresh.shape)

    def refer_to(self, state: GraspState) -> None:
        """Take the grasp in ``state``, which is tracked, for that of the reset, in all hands.

        Where the object was then, and the azimuths that the fingers are put back to, are otherwise
        those that the first `act` after a reset finds.

        Raises:
            InvalidInput: nothing tracks the object, or another number of hands is at work.
        """
        check_state(self.hand, state)
        check_sound(self.hand, state)
        if state.object_position is None or state.object_quaternion is None:
            raise InvalidInput("the state has no pose of the object; expected a tracked object")
        self.in_grasp.refer_to(state.object_position, state.object_quaternion)
        rows = state if state.batch_shape else state[None]
        if self._fresh is not None:
            self._fresh = np.ones_like(self._fresh)
        self._meet(rows, self.hand.configuration(rows.q).fingertip_position)

    def _arrays(self) -> dict[str, np.ndarray]:
        assert self._fresh is not None
        return {
            "fresh": self._fresh,
            "neutral": self._neutral,
            "height": self._height,
            "wait": self._wait,
            "lost": self._lost,
            "aim": self._aim,
            "radius": self._radius,
            "direction": self._direction,
        }

    def state_dict(self) -> dict[str, Any]:
        met = (
            None
            if self._fresh is None
            else {
                **copies(self._arrays()),
                "switch": self.switch.state_dict(),
                "odometry": self._odometry.state_dict(),
            }
        )
        return self._signed(in_grasp=self.in_grasp.state_dict(), met=met)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "in_grasp", "met")
        self.in_grasp.load_state_dict(parts["in_grasp"])
        met = parts["met"]
        if met is None:
            self._fresh = None
            return
        own = type(self).__name__
        (count,) = batch_shape(own, met, "wait") or (0,)
        self._allocate(count)
        check_names(own, met, (*self._arrays(), "switch", "odometry"))
        fill(own, self._arrays(), met)
        self.switch.load_state_dict(met["switch"])
        self._odometry.load_state_dict(met["odometry"])

    def act_batch(self, state: GraspState) -> Floats:
        return self.command(state)

    def command(self, state: GraspState, twist: Floats | None = None) -> Floats:
        """As `act`, for a batch ``(N,)`` that is sound, with a twist of its own for each hand.

        Args:
            state: of N hands.
            twist: wanted object velocity ``(N, 6)`` [m/s, rad/s]; fingers are switched for its part
                about the axis of the settings, either way round, the rest is left to the grasp.
                None: that of the settings.
        """
        wanted = np.tile(self._twist, (len(state.q), 1)) if twist is None else twist
        now = self.hand.configuration(state.q)
        tip = now.fingertip_position
        self._meet(state, tip)
        below = self._below(state)
        if state.object_position is None:
            odometry = self._odometry
            odometry.update(state, now, state.in_contact & ~self.switch.released)
            state = replace(
                state, object_position=odometry.position, object_quaternion=odometry.quaternion
            )
        else:
            self._odometry.follow(state.object_position, state.object_quaternion)
        origin = np.asarray(state.object_position)
        flat = split(tip - origin[:, None], self.axis)[1]
        along = wanted[:, 3:] @ self.axis
        self._direction = np.where(along == 0.0, self._direction, np.sign(along))
        # how far each finger has come with the rotation, whichever way that goes
        angle = self._direction[:, None] * azimuth(self._neutral, flat, self.axis)

        normal = np.where(state.in_contact[..., None], state.contact_normal, 0.0)
        point = np.where(state.in_contact[..., None], state.contact_position, tip)
        firm = state.in_contact & (state.contact_force > self.config.hold_force)
        grasps = Grasps(point, normal, state.in_contact, firm, origin, self.config.guarded(state))
        self._begin_and_aim(grasps, angle, flat, below)

        def may_lift(rows: np.ndarray, finger: np.ndarray) -> np.ndarray:
            return holds_without(grasps.of(rows), finger)

        placing = self.switch.phase == Phase.PLACE
        switching = self.switch.command(state, now, origin, may_lift)
        self._level(placing & (self.switch.phase == Phase.LOAD), point - origin[:, None], below)
        switching = self._limits(state.q, state.q_target, switching)
        released = self.switch.released
        furthest = np.where(state.in_contact & ~released, angle, -np.inf).max(axis=1)
        most = self.config.most_travel
        if self.config.unfelt_travel is not None:
            most = np.where(state.normals_felt, most, self.config.unfelt_travel)
        pace = np.clip((most - furthest) / self.config.slow_down, 0.0, 1.0)
        paced = pace[:, None] * wanted
        if twist is not None:  # what no finger has to be switched for goes on
            paced = wanted - ((1.0 - pace) * along)[:, None] * np.append(np.zeros(3), self.axis)
        share = Share(
            released=released,
            max_force=self.switch.max_force,
            twist=paced,
            yielding=self.switch.yielding,
        )
        holding = self.in_grasp.command(state, share, now)
        self._diagnostics = {
            **self.in_grasp.diagnostics,
            "phase": self.switch.phase.copy(),
            "finger": self.switch.finger.copy(),
            "azimuth": angle,
            "pace": pace,
            "in_grasp_action": holding,
            "switch_action": switching,
        }
        return check_action(holding + switching)

    def _meet(self, state: GraspState, tip: Floats) -> None:
        """Allocate for a batch met for the first time; take references of those just reset."""
        count = len(state.q)
        if self._fresh is None:
            self._fresh = self._allocate(count)
        if len(self._fresh) != count:
            raise InvalidInput(
                f"the controller was reset for {len(self._fresh)} hands and got {count}; call "
                "reset() before the batch shape changes"
            )
        if not self._fresh.any():
            return
        fresh = self._fresh
        touch = state.in_contact[fresh, :, None]
        point = np.where(touch, state.contact_position[fresh], tip[fresh])
        # without any touch the tips themselves stand round the place where an object would be
        weight = np.where(touch.any(axis=1, keepdims=True), touch, True).astype(float)
        centre = (weight * point).sum(axis=1) / weight.sum(axis=1)
        if state.object_position is not None:
            centre = state.object_position[fresh]
        self._odometry.place(fresh, centre)
        flat = split(tip[fresh] - centre[:, None], self.axis)[1]
        length = np.sqrt((flat * flat).sum(axis=-1, keepdims=True))
        self._neutral[fresh] = flat / np.maximum(length, 1e-9)
        self._height[fresh] = 0.0
        self._wait[fresh] = 0.0
        self._lost[fresh] = 0.0
        self._direction[fresh] = 1.0
        self.switch.clear(fresh)
        self._fresh = np.zeros(count, bool)

    def _allocate(self, count: int) -> np.ndarray:
        """Everything for ``count`` hands that have just been reset: all of them."""
        self.switch.start(count)
        self._odometry.start(count)
        self._fresh = np.ones(count, bool)
        self._neutral = np.zeros((count, self.hand.n_fingers, 3))
        self._height = np.zeros((count, self.hand.n_fingers))
        self._wait = np.zeros(count)
        self._lost = np.zeros((count, self.hand.n_fingers))
        # of the landing under way: where round the axis, as `azimuth`, and how far from it
        self._aim, self._radius = np.zeros(count), np.zeros(count)
        self._direction = np.ones(count)
        return self._fresh

    def _below(self, state: GraspState) -> Floats:
        """Height along the axis, from the object's centre, of where fingers land, ``(N,)`` [m].

        Below it where nothing tells where the object is, or how its faces lean.
        """
        gravity = state.gravity
        if gravity is None or state.object_position is not None:
            return np.zeros(len(state.q))
        size = np.sqrt((gravity * gravity).sum(axis=-1))
        down = (gravity @ self.axis) / np.maximum(size, 1e-9)
        return np.where(state.normals_felt, 0.0, self.config.cradle * down)

    def _begin_and_aim(self, grasps: Grasps, angle: Floats, flat: Floats, below: Floats) -> None:
        """Begin switches of fingers that can be spared, or are lost; keep all landings off the
        fingers behind.

        Those come on with the object while a finger is in the air: a landing that stayed where it
        was would be on the neighbour's tip by the time it is reached.
        """
        begin, chosen = self._spared(grasps, angle, flat)
        finger = np.where(begin, chosen, self.switch.finger)
        if (finger < 0).all():
            return
        across = flat[begin, chosen[begin]]
        self._radius[begin] = np.sqrt((across * across).sum(axis=-1))
        rows = np.arange(len(finger))
        place = self._landings(angle, flat, self._direction)[rows, finger]
        aimed = ~begin & (self.config.follow | (place > self._aim))
        self._aim = np.where(begin | aimed, place, self._aim)
        direction = turned(self._neutral[rows, finger], self._direction * self._aim, self.axis)
        height = below + self._height[rows, finger]
        middle = grasps.origin + height[:, None] * self.axis
        landing = landing_at(middle, direction, self._radius)
        self.switch.aim(grasps.origin, landing, aimed)
        self.switch.begin(begin, finger, grasps.origin, landing)

    def _spared(self, grasps: Grasps, angle: Floats, flat: Floats) -> tuple[np.ndarray, np.ndarray]:
        """In which hands a switch is to begin ``(N,)``, and of which finger ``(N,)``."""
        config = self.config
        busy = self.switch.phase != Phase.IDLE
        begin, finger = np.zeros(len(busy), bool), np.zeros(len(busy), int)
        self._wait = np.where(busy, config.pause, self._wait - self.control_period)
        lost = ~grasps.touch & ~self.switch.released
        self._lost = np.where(lost, self._lost + self.control_period, 0.0)
        ready = np.flatnonzero(~busy & (self._wait <= 0.5 * self.control_period))
        if len(ready):
            landing = self._landings(angle[ready], flat[ready], self._direction[ready])
            choice = choose(
                grasps.of(ready),
                angle[ready] - landing,
                least_travel=config.least_travel,
                residual_weight=config.residual_weight,
                residual_limit=config.residual_limit,
                push_friction=config.in_grasp.friction,
            )
            begin[ready], finger[ready] = choice.found, choice.finger
            alone = grasps.touch[ready].sum(axis=1) == self.hand.n_fingers - 1
            longest = self._lost[ready].argmax(axis=1)
            anew = alone & (self._lost[ready, longest] > config.lost_after)
            begin[ready] |= anew
            finger[ready] = np.where(anew, longest, finger[ready])
        return begin, finger

    def _level(self, landed: np.ndarray, lever: Floats, below: Floats) -> None:
        """Have fingers that just landed come down nearer to the wanted height the next time."""
        rows = np.flatnonzero(landed)
        finger = self.switch.finger[rows]
        missed = lever[rows, finger] @ self.axis - below[rows]
        height = self._height[rows, finger] - self.config.level * missed
        self._height[rows, finger] = np.clip(height, -_MOST_HEIGHT, _MOST_HEIGHT)

    def _landings(self, angle: Floats, flat: Floats, direction: Floats) -> Floats:
        """Where round the axis each finger of K hands would land, ``(K, m)`` [rad]."""
        radius = np.sqrt((flat * flat).sum(axis=-1))
        # how far behind each finger, against the rotation, each other one is
        apart = azimuth(flat[:, None, :], flat[:, :, None], self.axis)
        behind = direction[:, None, None] * apart % (2 * np.pi)
        behind[:, *np.diag_indices(flat.shape[1])] = np.inf
        nearest = behind.min(axis=2)
        room = angle - nearest + self.config.spacing / np.maximum(radius, 1e-9)
        return np.maximum(-self.config.swing, np.where(nearest < np.pi, room, -np.inf))
