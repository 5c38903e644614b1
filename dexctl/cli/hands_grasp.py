"""The grasp that ``dexctl hands add`` proposes: of those that hold, the one turned furthest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING

from dexctl.cli.hands_trials import COUNTS, Turned, Turning, holds, turned
from dexctl.cli.output import notes, progress
from dexctl.exceptions import SimulationError
from dexctl.hand_config import HandConfig

if TYPE_CHECKING:
    from dexctl.hand import HandModel
    from dexctl.sim import SuggestedGrasp

LEAST_FINGERS = 4
"""A gait lifts one finger while three hold."""
FURTHER = 0.45
"""`HeldObject.travel` that is tried beside the usual one [rad]; it suits the LEAP hand."""
_HALF = 0.5  # of the value of those whose surroundings are searched, palm up alone
_WORTH = 1.1  # of the value without it, from which on it is taken


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
    best: tuple[SuggestedGrasp, Turned] | None = None
    able = [one for one in grasps if len(one.fingers) >= LEAST_FINGERS] if how.grasps else []
    climb = _Climb(hand, config, how, seed, size)
    if able:
        say(f"turning {len(able)} grasps with the coordinated gait, and grasps around the best")
        first, each = how.screened(len(able)), len(COUNTS) * how.seconds
        with progress(notes()) as bar:
            task = bar.add_task("turning", total=first + each * how.finalists)
            climb.advance = lambda seconds: bar.update(task, advance=seconds)
            order = climb.furthest(able)
            held = list(islice(filter(climb.keeps, order), how.finalists))
            finals = held or order[: how.finalists]
            bar.update(task, completed=first, total=first + each * len(finals))
            for grasp in finals:
                found = climb.trial(grasp, tuple(COUNTS), how.trials, how.seconds)
                say(f"{grasp.note}; {found.note}")
                if found.value > (best[1].value if best else 0.0):
                    best = grasp, found
    return best or (next(filter(climb.keeps, grasps), grasps[0]), None)


@dataclass
class _Climb:
    """From grasps to others around them that the gait turns further; settings as `chosen` has."""

    hand: HandModel
    config: HandConfig
    how: Turning
    seed: int
    size: float | None
    advance: Callable[[float], None] = field(default=lambda _: None)
    """Told how much has been simulated [s]."""

    def furthest(self, grasps: Sequence[SuggestedGrasp]) -> list[SuggestedGrasp]:
        """Those of ``grasps``, and of what is around the best, that are turned; furthest first."""
        tried = _ordered(self._screened(grasps, 0.0))
        for k in range(self.how.rounds):
            parents = tried[: self.how.around]
            for _, grasp in parents:
                around = nearby(
                    self.hand, grasp, size=self.size, seed=self.seed + 1 + k, count=self.how.around
                )
                tried = [*tried, *self._screened(around, _HALF * parents[-1][0])]
            tried = _ordered(tried)
        return [grasp for _, grasp in tried]

    def _screened(
        self, grasps: Sequence[SuggestedGrasp], least: float
    ) -> list[tuple[float, SuggestedGrasp]]:
        """Those that are turned, a little at least, and not let go, with their values.

        What comes to less than ``least`` palm up is not tried palm down, where turns count less.
        """
        found = []
        for grasp in grasps:
            if len(grasp.fingers) < LEAST_FINGERS:
                continue
            short = self.how.screening_trials, self.how.screening
            value = self.trial(grasp, ("up",), *short).value
            if value > least:
                value += self.trial(grasp, ("down",), *short).value
            if value > 0:
                found.append((value, grasp))
        return found

    def keeps(self, grasp: SuggestedGrasp) -> bool:
        """Whether plain holding holds it, by other disturbances than `dexctl hands check` has."""
        found = grasp.applied(self.config, self.hand.joint_names)
        return holds(found, grasp.object, self.seed + 1)

    def trial(
        self, grasp: SuggestedGrasp, palms: Sequence[str], trials: int, seconds: float
    ) -> Turned:
        """What the gait makes of it."""
        found = grasp.applied(self.config, self.hand.joint_names)
        made = turned(found, grasp.object, palms, trials, seconds, self.seed)
        self.advance(len(palms) * seconds)
        return made


def _ordered(
    tried: Sequence[tuple[float, SuggestedGrasp]],
) -> list[tuple[float, SuggestedGrasp]]:
    return sorted(tried, key=lambda one: -one[0])


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
