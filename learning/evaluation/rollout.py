"""The one rollout of this package: somebody acts as a protocol says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING
from typing import Protocol as Interface

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from learning.evaluation.figures import Evaluation
from learning.evaluation.judged import Judged
from learning.evaluation.protocol import Protocol
from learning.evaluation.subject import Subject

if TYPE_CHECKING:
    from dexctl.sim import Scene, Trace
    from dexctl.sim.trial import Observer

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Rollout:
    """N episodes.

    Attributes:
        trace: what happened, as it was, whatever the sensors told.
        scene: hand and object.
        evaluation: what it came to.
        wanted: of the objects at rows 0 to T, ``(T+1, N, ...)``, by `GraspState`'s names.
    """

    trace: Trace
    scene: Scene
    evaluation: Evaluation
    wanted: Mapping[str, Floats] = field(default_factory=dict)


class Run(Interface):
    """`evaluate`, or what does the same and remembers."""

    def __call__(
        self,
        who: Subject | Controller,
        protocol: Protocol | None = None,
        *,
        object: str | None = None,  # noqa: A002
        progress: Progress | None = None,
    ) -> Evaluation:
        """See `evaluate`."""
        ...


def rollout(
    who: Subject | Controller,
    protocol: Protocol | None = None,
    observers: Sequence[Observer] = (),
    *,
    object: str | None = None,  # noqa: A002 (the setting's name)
    progress: Progress | None = None,
) -> Rollout:
    """Let somebody act in N episodes.

    Args:
        who: a subject, whose controller is made for the protocol's hand, axis and control period;
            or a controller, which acts as it is, with its own hand and control period.
        protocol: how; None is the standard one, for a subject as in its training, undisturbed.
        observers: each is called with the physics at the start and after each step.
        object: name of the object; None is the protocol's, which then has one only.
        progress: called after each control step with the simulated time so far [s].

    Raises:
        UnknownName: no such object.
        InvalidInput: several objects, the subject does not fit the protocol, or the goal is where
            the episodes begin.
        SimulationError: the hand does not hold the object.
    """
    from dexctl.sim import Simulation, run

    if protocol is None:
        protocol = who.protocol() if isinstance(who, Subject) else Protocol()
    name = one_object(protocol) if object is None else object
    controller = who.acting(protocol) if isinstance(who, Subject) else who
    protocol.task.check_starts(protocol.scene.initial_states is not None)
    config = replace(
        protocol.scene, object=(name,), control_period=float(controller.control_period)
    )
    with Simulation(config, protocol.episodes, protocol.seed, hand=controller.hand) as simulation:
        controller.reset(protocol.seed)
        judged = Judged(simulation, protocol.task)
        trace = run(
            controller,
            simulation,
            protocol.seconds,
            plant=judged,
            axis=protocol.task.axis,
            observers=observers,
            drop_distance=protocol.task.holding.drop_distance,
            progress=progress,
        )
        scene = simulation.sim.groups[0].scene
    return Rollout(trace, scene, Evaluation.of(trace, scene, protocol, judged), judged.wanted)


def evaluate(
    who: Subject | Controller,
    protocol: Protocol | None = None,
    *,
    object: str | None = None,  # noqa: A002 (the setting's name)
    progress: Progress | None = None,
) -> Evaluation:
    """What comes of a `rollout`, in figures."""
    return rollout(who, protocol, object=object, progress=progress).evaluation


def one_object(protocol: Protocol) -> str:
    """The object of a protocol that has one only.

    Raises:
        InvalidInput: it has several.
    """
    name, *others = protocol.scene.object
    if others:
        raise InvalidInput(f"object is {', '.join(protocol.scene.object)}; expected one")
    return name
