"""ControllerMacros: this library's controllers as the actions that a tree is grown with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.gait import CoordinatedGaitConfig, Macro, MacroConfig
from dexctl.gait.selection import Choice, Grasps, choose
from dexctl.planning.expansion import Expander, Expansion, Problem
from dexctl.planning.nodes import Nodes
from dexctl.planning.simulated import Driven, SimulatedExpander
from dexctl.state import Bools, Floats, GraspState
from dexctl.switch.landing import Landing, azimuth, landing_at, split, turned
from dexctl.validation import check_kind, check_numbers, check_pair, check_whole

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator

_LONGEST = 4.0  # a macro that is not over by then is given up [s]


@dataclass(frozen=True, kw_only=True)
class ControllerMacros(Expansion):
    """Actions are pieces of a gait: a random twist for a random time, and at most one switch.

    In-grasp manipulation carries the twist out and holds the object to its pose at the root; a
    guarded switch moves at most one finger. What random changes of the set-points only find with
    luck, a finger that lets go and lands elsewhere while the others hold, is one action here.
    """

    candidates: int = 1
    """How many are tried from a node, of which the nearest to the target that holds is kept. One
    that holds nearly always gets on; to choose among two takes twice the steps of it."""
    speed: tuple[float, float] = (-0.2, 0.7)
    """Least and greatest speed of the rotation about the axis [rad/s]."""
    wobble: float = 0.1
    """Standard deviation of the rotation across it [rad/s]."""
    shift: float = 0.005
    """Standard deviation of the object's speed along each direction [m/s]."""
    seconds: tuple[float, float] = (0.2, 1.0)
    """Least and greatest time of the twist [s]; a switch that is under way is finished after it."""
    wind_down: float = 0.1
    """The object is held still for at least this long before an action is over [s]."""
    still: float = 0.2
    """Share of actions without a switch."""
    guided: float = 0.4
    """Share of actions that switch the finger which the coordinated gait would; the rest switch a
    random one."""
    random: float = 0.0
    """Share of actions that move the set-points at random instead, as `RandomActions` does."""
    random_scale: float = 0.15
    """Standard deviation of those [rad]."""
    landing: float = 0.6
    """Random landings lie within this about the axis of where the finger was at the root [rad]."""
    gait: CoordinatedGaitConfig = field(default_factory=CoordinatedGaitConfig)
    """Decides in guided actions which finger is switched, and how far back it lands."""
    macro: MacroConfig = field(default_factory=MacroConfig)
    """Of the controllers."""
    lazy: bool = True
    """As in `RandomActions`."""
    batch: int = 32
    """How many nodes are expanded at a time."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("landing", "random_scale"),
            not_negative=("wobble", "shift", "wind_down"),
            fractions=("still", "guided", "random"),
        )
        check_whole(self, candidates=1, batch=1)
        check_kind(self, macro=MacroConfig, gait=CoordinatedGaitConfig)
        for name in ("speed", "seconds"):
            low, high = check_pair(name, getattr(self, name), "(least, greatest)")
            if low > high:
                raise InvalidInput(f"{name} is {(low, high)}; expected (least, greatest)")
        if not 0 < self.seconds[0] <= self.seconds[1] <= _LONGEST:
            raise InvalidInput(f"seconds is {self.seconds}; expected times up to {_LONGEST:g} s")
        if self.still + self.guided + self.random > 1:
            raise InvalidInput(
                f"still, guided and random are {self.still}, {self.guided} and {self.random}; "
                "expected shares that add up to 1 at most"
            )

    def open(self, problem: Problem) -> Expander:
        return SimulatedExpander(
            problem,
            _MacroDrive(self, problem),
            batch=self.batch,
            candidates=self.candidates,
            lazy=self.lazy,
        )


class _Plan:
    """What N candidates are to do: drawn at random, guided by where the fingers are."""

    def __init__(
        self,
        config: ControllerMacros,
        axis: Floats,
        neutral: Floats,
        state: GraspState,
        tip: Floats,
        rng: np.random.Generator,
    ) -> None:
        count, fingers = state.in_contact.shape
        assert state.object_position is not None
        origin = state.object_position
        speed = rng.uniform(*config.speed, count)
        self.twist = np.zeros((count, 6))
        self.twist[:, :3] = config.shift * rng.normal(size=(count, 3))
        wobble = config.wobble * rng.normal(size=(count, 3))
        wobble -= (wobble @ axis)[:, None] * axis
        self.twist[:, 3:] = wobble + speed[:, None] * axis
        self.seconds = rng.uniform(*config.seconds, count)

        kind = rng.uniform(size=count)
        self.random: Bools = np.asarray(kind < config.random)
        still = ~self.random & (kind < config.random + config.still)
        guided = ~self.random & ~still & (kind < config.random + config.still + config.guided)
        flat = split(tip - origin[:, None], axis)[1]
        angle = azimuth(neutral, flat, axis)
        finger = rng.integers(fingers, size=count)
        where = rng.uniform(-config.landing, config.landing, count)
        if guided.any():
            rows = np.flatnonzero(guided)
            sense = np.where(speed[rows] < 0, -1.0, 1.0)
            travel = sense[:, None] * angle[rows] + config.gait.swing
            choice = _choice(config.gait, state[rows], tip[rows], travel)
            finger[rows] = np.where(choice.found, choice.finger, -1)
            where[rows] = -sense * config.gait.swing
        finger[still | self.random] = -1
        self.finger: NDArray[np.intp] = finger
        self.where = np.where(finger >= 0, where, 0.0)
        own = np.maximum(finger, 0)
        every = np.arange(count)
        direction = turned(neutral[every, own], self.where, axis)
        radius = np.linalg.norm(flat[every, own], axis=-1)
        self.landing: Landing = landing_at(origin, direction, radius)


def _choice(gait: CoordinatedGaitConfig, state: GraspState, tip: Floats, travel: Floats) -> Choice:
    touch = state.in_contact[..., None]
    grasps = Grasps(
        np.where(touch, state.contact_position, tip),
        np.where(touch, state.contact_normal, 0.0),
        state.in_contact,
        state.in_contact & (state.contact_force > gait.hold_force),
        np.asarray(state.object_position),
        gait.guarded(state),
    )
    return choose(
        grasps,
        travel,
        least_travel=gait.least_travel,
        residual_weight=gait.residual_weight,
        residual_limit=gait.residual_limit,
        push_friction=gait.in_grasp.friction,
    )


class _MacroDrive:
    action_names = (
        "twist_x", "twist_y", "twist_z", "twist_rx", "twist_ry", "twist_rz",
        "seconds", "finger", "landing", "random",
    )  # fmt: skip

    def __init__(self, config: ControllerMacros, problem: Problem) -> None:
        hand, frame = problem.scene.hand, problem.frame
        self._config, self._problem = config, problem
        period = problem.stepping.control_period
        self._macro = Macro(hand, config.macro, control_period=period, axis=frame.axis)
        tip = hand.fingertip_positions(problem.root.q[0])
        flat = split(tip - frame.position, frame.axis)[1]
        length = np.linalg.norm(flat, axis=-1, keepdims=True)
        self._neutral = flat / np.maximum(length, 1e-9)

    def __call__(self, sim: BatchSimulator, nodes: Nodes, rng: np.random.Generator) -> Driven:
        config, frame, macro = self._config, self._problem.frame, self._macro
        state, count = sim.read(), len(nodes)
        neutral = np.broadcast_to(self._neutral, (count, *self._neutral.shape))
        tip = sim.hand.fingertip_positions(state.q)
        plan = _Plan(config, frame.axis, neutral, state, tip, rng)
        macro.reset()
        macro.in_grasp.refer_to(
            np.tile(frame.position, (count, 1)), np.tile(frame.quaternion, (count, 1))
        )
        macro.begin(state, plan.twist, plan.finger, plan.landing)
        noise = config.random_scale * rng.normal(size=nodes.q_target.shape)
        period, steps = sim.control_period, 0
        plan.seconds[plan.random] = 2 * period
        ends = plan.seconds + np.where(plan.random, 0.0, config.wind_down)
        active, lost, seconds = np.ones(count, bool), np.zeros(count, bool), np.zeros(count)
        while active.any():
            change = macro.act(state)
            if steps == 0:
                change = np.where(plan.random[:, None], noise, change)
            else:
                change = np.where(plan.random[:, None], 0.0, change)
            sim.write(np.where(active[:, None], state.q_target + change, state.q_target))
            sim.step(active)
            seconds[active] += period
            steps += int(active.sum())
            state = sim.read()
            assert state.object_position is not None
            away = np.linalg.norm(frame.displacement(state.object_position), axis=-1)
            gone = active & ~(away <= 2 * self._problem.bounds.displacement)
            lost |= gone | (active & (seconds > _LONGEST))
            still = seconds >= plan.seconds - 1e-9
            macro.twist = np.where(still[:, None], 0.0, plan.twist)
            over = (seconds >= ends - 1e-9) & ~macro.busy
            active &= ~lost & ~over
        action = np.column_stack(
            [plan.twist, seconds, plan.finger.astype(float), plan.where, plan.random.astype(float)]
        )
        return Driven(action, seconds, lost, steps)
