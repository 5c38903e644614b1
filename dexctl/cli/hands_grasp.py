"""The grasp that ``dexctl hands add`` proposes: of those that hold, the one turned furthest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dexctl.cli.hand_checks import check_holding
from dexctl.cli.output import notes, progress
from dexctl.exceptions import SimulationError
from dexctl.hand_config import HandConfig
from dexctl.validation import check_numbers, check_whole

if TYPE_CHECKING:
    from dexctl.hand import HandModel
    from dexctl.sim import SuggestedGrasp

LEAST_FINGERS = 4
"""A gait lifts one finger while three hold."""
_STAYS = 0.02  # how far from where it was grasped an object counts as held [m]
_COUNTS = {"up": 1.0, "down": 0.5}  # what a turn counts, by palm
FURTHER = 0.45
"""`HeldObject.travel` that is tried beside the usual one [rad]; it suits the LEAP hand."""
_HALF = 0.5  # of the value of those whose surroundings are searched, palm up alone
_WORTH = 1.1  # of the value without it, from which on it is taken


@dataclass(frozen=True, kw_only=True)
class Turning:
    """How suggested grasps are tried with the coordinated gait: all in short, the best longer."""

    grasps: int = 5
    """Of each object; 0: none is tried, and the one of the highest score is taken."""
    screening: float = 12.0
    """Simulated, each trial of every grasp [s]."""
    screening_trials: int = 4
    """Of every grasp there, palm up, and where it is turned so, palm down."""
    rounds: int = 4
    """How often the surroundings of those turned furthest are searched for better ones, which are
    tried as those before; 0: not."""
    around: int = 4
    """Grasps whose surroundings are searched in each round, and grasps that are taken of each."""
    finalists: int = 3
    """Of all objects together, which are tried again, longer; of those that plain holding holds,
    as ``dexctl hands check`` wants it, where there are so many."""
    seconds: float = 60.0
    """Simulated, each trial of these [s]: many a drop comes late."""
    trials: int = 16
    """Of each of these, each way up."""

    def __post_init__(self) -> None:
        check_whole(self, grasps=0, rounds=0, around=1, finalists=1, trials=1, screening_trials=1)
        check_numbers(self, positive=("screening", "seconds"))

    def screened(self, grasps: int) -> float:
        """Simulated with so many and with those around the best; all trials at once [s]."""
        return len(_COUNTS) * self.screening * (grasps + self.rounds * self.around**2)


class Turned(NamedTuple):
    """What the gait made of a grasp.

    Attributes:
        held: share of the trials that still hold the object, by palm.
        rotation: median rotation up to the end or the drop, by palm [rad].
        clear: share of the time in which nothing but fingertips touches, by palm.
        trials: of each palm.
        seconds: of each [s].
    """

    held: dict[str, float]
    rotation: dict[str, float]
    clear: dict[str, float]
    trials: int
    seconds: float

    @property
    def value(self) -> float:
        """What grasps are compared by: turns that are held to the end, palm up before palm down.

        Links that touch count against them as drops do: they are what the next drop comes from.
        """
        return sum(
            _COUNTS[palm] * (held * self.clear[palm]) ** 2 * max(self.rotation[palm], 0.0)
            for palm, held in self.held.items()
        )

    @property
    def note(self) -> str:
        """What came of it, in one line."""
        parts = [
            f"palm {palm} {self.rotation[palm]:.1f} rad, {round(self.held[palm] * self.trials)} of "
            f"{self.trials} hold"
            for palm in self.held
        ]
        return f"the coordinated gait, {self.seconds:g} s each: {'; '.join(parts)}"


def suggestions(
    hand: HandModel,
    objects: Sequence[str],
    *,
    size: float | None,
    seed: int,
    count: int,
    say: Callable[[str], None],
) -> list[SuggestedGrasp]:
    """Grasps of some objects, best scores first; those that hold both ways before others.

    Raises:
        SettleFailure, SimulationError: none of the objects is held.
    """
    from dexctl.sim import Scene

    found: list[SuggestedGrasp] = []
    failure: SimulationError | None = None
    for name in objects:
        say(f"searching how to hold a {name}")
        try:
            some = Scene.suggest_grasp(hand, name, object_size=size, seed=seed, count=count)
        except SimulationError as error:
            failure = failure or error
            continue
        found += some[:count]
    if not found:
        assert failure is not None
        raise failure
    return sorted(found, key=lambda one: (-min(one.time_up, one.time_down), -one.score.total))


def turned(
    config: HandConfig, name: str, palms: Sequence[str], trials: int, seconds: float, seed: int
) -> Turned:
    """Trials of the coordinated gait with the object as a hand's configuration says it."""
    from dexctl.gait import CoordinatedGait
    from dexctl.sim import SceneConfig, Simulation, run

    hand = config.build()
    held, rotation, clear = (dict.fromkeys(palms, 0.0) for _ in range(3))
    for palm in palms:
        scene = SceneConfig(hand=str(config.description), object=(name,), gravity=palm)
        try:
            sim = Simulation(scene, trials, seed, hand=hand)
        except SimulationError:  # with the digits of a toml, it does not settle
            continue
        with sim:
            gait = CoordinatedGait(hand, control_period=scene.control_period)
            sim.reset(seed)
            gait.reset(seed)
            trace = run(gait, sim, seconds, until_dropped=True)
        away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
        stays = trace.held[-1] & (away.max(axis=0) < _STAYS)  # does not lie on the palm
        held[palm] = float(stays.mean())
        rotation[palm] = float(np.median(trace.final_rotation))
        clear[palm] = 1.0 - float((trace.other_contact > 0)[trace.held].mean())
    return Turned(held, rotation, clear, trials, seconds)


def holds(config: HandConfig, name: str, seed: int) -> bool:
    """Whether plain holding holds an object, palm up and down, as ``dexctl hands check`` wants."""
    hand = config.build()
    return all(bool(check_holding(hand, name, palm, seed=seed).good) for palm in ("up", "down"))


def nearby(
    hand: HandModel, grasp: SuggestedGrasp, *, size: float | None, seed: int, count: int
) -> list[SuggestedGrasp]:
    """Grasps of the same object in the surroundings of one, that hold both ways; maybe none."""
    from dexctl.sim import Scene

    try:
        found = Scene.suggest_grasp(
            hand, grasp.object, object_size=size, seed=seed, count=count, tries=2 * count,
            near=grasp,
        )  # fmt: skip
    except SimulationError:
        return []
    return [one for one in found[:count] if one.held_up and one.held_down]


def chosen(
    hand: HandModel,
    config: HandConfig,
    grasps: Sequence[SuggestedGrasp],
    how: Turning,
    seed: int,
    say: Callable[[str], None],
    size: float | None = None,
) -> tuple[SuggestedGrasp, Turned | None]:
    """Of the grasps that hold, and of those around them, the one that the gait turns furthest.

    Without trials of the gait, or where none turns, it is the first that holds; where none holds,
    they are compared all the same.

    Args:
        hand: the hand.
        config: its configuration, without a grasp.
        grasps: suggested ones.
        how: they are tried.
        seed: of the trials and of the searches around the best.
        say: told what is going on.
        size: width of the object that is asked for [m]; None: any.
    """

    def keeps(grasp: SuggestedGrasp) -> bool:
        # by other disturbances than those of `dexctl hands check`, which has this seed unless told
        return holds(grasp.applied(config, hand.joint_names), grasp.object, seed + 1)

    def trial(grasp: SuggestedGrasp, palms: Sequence[str], trials: int, seconds: float) -> Turned:
        found = grasp.applied(config, hand.joint_names)
        made = turned(found, grasp.object, palms, trials, seconds, seed)
        bar.update(task, advance=len(palms) * seconds)
        return made

    def screened(
        some: Sequence[SuggestedGrasp], least: float
    ) -> list[tuple[float, SuggestedGrasp]]:
        """Those that are turned, a little at least, and not let go, with their values.

        What comes to less than ``least`` palm up is not tried palm down, where turns count less.
        """
        found = []
        for grasp in some:
            if len(grasp.fingers) >= LEAST_FINGERS:
                up, down = (((palm,), how.screening_trials, how.screening) for palm in _COUNTS)
                value = trial(grasp, *up).value
                if value > least:
                    value += trial(grasp, *down).value
                if value:
                    found.append((value, grasp))
        return found

    def furthest(tried: list[tuple[float, SuggestedGrasp]]) -> list[tuple[float, SuggestedGrasp]]:
        return sorted(tried, key=lambda one: -one[0])

    best: tuple[SuggestedGrasp, Turned] | None = None
    able = [one for one in grasps if len(one.fingers) >= LEAST_FINGERS] if how.grasps else []
    if able:
        say(f"turning {len(able)} grasps with the coordinated gait, and grasps around the best")
        first = how.screened(len(able))
        with progress(notes()) as bar:
            task = bar.add_task("turning", total=first + len(_COUNTS) * how.seconds * how.finalists)
            turning = furthest(screened(able, 0.0))
            for k in range(how.rounds):
                parents = turning[: how.around]
                for _, grasp in parents:
                    more = nearby(hand, grasp, size=size, seed=seed + 1 + k, count=how.around)
                    turning = [*turning, *screened(more, _HALF * parents[-1][0])]
                turning = furthest(turning)
            order = [grasp for _, grasp in turning]
            held = list(islice(filter(keeps, order), how.finalists))
            finals = held or order[: how.finalists]
            bar.update(
                task, completed=first, total=first + len(_COUNTS) * how.seconds * len(finals)
            )
            for grasp in finals:
                found = trial(grasp, tuple(_COUNTS), how.trials, how.seconds)
                say(f"{grasp.note}; {found.note}")
                if found.value > (best[1].value if best else 0.0):
                    best = grasp, found
    return best or (next(filter(keeps, grasps), grasps[0]), None)


def further(
    config: HandConfig, name: str, usual: Turned, how: Turning, seed: int
) -> tuple[HandConfig, Turned]:
    """``config``, with fingers that go further before the object waits, where that is worth it.

    It is where the gait turns the object a tenth further than ``usual``, what it made of
    ``config``, and drops it no oftener. No four-fingered hand tells by its kinematics whether it
    is one of these: the LEAP hand gains a third by it, and the Allegro drops its sphere
    (docs/what-helped.md).
    """
    longer = replace(config, object=replace(config.object, travel=FURTHER))
    with progress(notes()) as bar:
        bar.add_task("turning with longer strides", total=None)
        found = turned(longer, name, tuple(usual.held), how.trials, how.seconds, seed)
    holds = all(found.held[palm] >= usual.held[palm] for palm in usual.held)
    if holds and found.value > _WORTH * usual.value:
        return longer, found
    return config, usual
