"""Evaluation: what a policy, or a controller, does with an object in many episodes.

The protocol: N episodes of 60 s with seeds 0 to N-1, each from the settled grasp with set-points
disturbed by N(0, 0.02 rad); an object whose centre moves by more than 0.05 m is dropped, and
nothing counts after that. Episodes are independent, so intervals are over them; claims about a
method need several seeds of training (`dexctl.statistics`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from typing import Protocol as Interface

import numpy as np

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.state import Bools, Floats
from dexctl.statistics import Estimate, bootstrap, wilson
from dexctl.streams import Streams
from dexctl.validation import check_numbers
from learning.envs import reward as rewards
from learning.envs.config import unit_axis
from learning.envs.noise import SensorNoise
from learning.envs.pushes import Push, Pusher
from learning.senses import Senses

if TYPE_CHECKING:
    from dexctl.sim import Scene, Trace

FULL_TURN = 2.0 * np.pi
# a stream of its own, beside the simulator's, the sensors' and the controller's
_PUSH_SEED = 1 << 43
# rotation over time is kept at no more moments than this, so that many evaluations stay small
_MOMENTS = 120


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How it is evaluated.

    Attributes:
        episodes: N; episode i has the seed ``seed + i``.
        seconds: of each [s].
        seed: of the first.
        gravity: "up" (the palm looks up), "down", or a vector [m/s^2].
        axis: that rotation is counted about, hand frame: "x", "y", "z" or a vector.
        object_size: width of the object [m]; None is what suits the hand.
        object_mass: [kg].
        noise: of the sensors; what the policy sees, while the figures are of what is.
        latency: of the sensors, rounded to control steps [s].
        push: forces on the object.
        substeps: physics steps in a control period.
        threads: of the physics; None is every core.

    Raises:
        InvalidInput: a number out of range.
    """

    episodes: int = 100
    seconds: float = 60.0
    seed: int = 0
    gravity: str | tuple[float, ...] = "up"
    axis: str | tuple[float, ...] = "z"
    object_size: float | None = None
    object_mass: float = 0.1
    noise: SensorNoise = SensorNoise()
    latency: float = 0.0
    push: Push = Push()
    substeps: int = 10
    threads: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.episodes, int) or self.episodes < 1:
            raise InvalidInput(f"episodes is {self.episodes!r}; expected a whole number above 0")
        if not (np.isfinite(self.seconds) and self.seconds > 0):
            raise InvalidInput(f"seconds is {self.seconds}; expected a finite number above 0")
        check_numbers(self, positive=("object_mass",), not_negative=("latency",))
        self.direction  # noqa: B018 (raises where the axis is wrong)

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return unit_axis(self.axis)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What came of N episodes with one object; arrays are ``(N,)``.

    Attributes:
        object: its name.
        protocol: as evaluated.
        rotation: about the protocol's axis, up to the drop or the end [rad].
        time_held: until then [s].
        dropped: whether it was dropped; a simulation that broke down counts as dropped.
        diverged: whether the simulation broke down.
        returns: sum of the environments' reward up to the drop or the end [rad/s].
        moments: times ``(K,)`` [s], from 0 to the end.
        rotations: at these moments, standing still from the drop on, ``(K, N)`` [rad].
    """

    object: str
    protocol: Protocol
    rotation: Floats
    time_held: Floats
    dropped: Bools
    diverged: Bools
    returns: Floats
    moments: Floats = field(default_factory=lambda: np.zeros(0))
    rotations: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def speed(self) -> Floats:
        """Mean angular velocity while held, ``(N,)`` [rad/s]; 0 where it was not held at all."""
        held = self.time_held > 0
        return np.where(held, self.rotation / np.where(held, self.time_held, 1.0), 0.0)

    def held(self, moments: Floats) -> Floats:
        """How many episodes still hold the object, ``(K,)``, at times ``(K,)`` [s]."""
        gone = np.where(self.dropped, self.time_held, np.inf)
        return (gone >= moments[:, None]).sum(axis=1)

    def figures(self) -> dict[str, Estimate]:
        """Medians and means with 95 % bootstrap intervals, shares with Wilson's."""
        count = len(self.rotation)
        return {
            "rotation_median_rad": bootstrap(self.rotation, "median"),
            "revolutions_median": bootstrap(self.rotation / FULL_TURN, "median"),
            "speed_mean_rad_s": bootstrap(self.speed, "mean"),
            "time_held_median_s": bootstrap(self.time_held, "median"),
            "return_mean": bootstrap(self.returns, "mean"),
            "share_dropped": wilson(int(self.dropped.sum()), count),
            "share_full_turn": wilson(int((self.rotation >= FULL_TURN).sum()), count),
        }

    def to_dict(self) -> dict[str, Any]:
        """The figures, as JSON can hold them."""
        found: dict[str, Any] = {name: one.to_dict() for name, one in self.figures().items()}
        return found | {"diverged": int(self.diverged.sum())}


class Run(Interface):
    """`evaluate`, or what does the same and remembers."""

    def __call__(
        self,
        controller: Controller,
        object: str,  # noqa: A002
        protocol: Protocol | None = None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Evaluation:
        """See `evaluate`."""
        ...


def evaluate(
    controller: Controller,
    object: str,  # noqa: A002 (the field's name for it)
    protocol: Protocol | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Evaluate a policy or a controller with one object.

    Args:
        controller: what is evaluated; it is reset first. It must turn the object about the
            protocol's axis of its own accord (`controllers.make` has an ``axis``).
        object: name of the object.
        protocol: how; None is the standard one.
        progress: called after each control step with the simulated time so far [s].

    Raises:
        UnknownName: no such object.
        SimulationError: the hand does not hold it.
    """
    from dexctl.sim import BatchSimulator, Scene, object_names, run
    from dexctl.sim.trial import rotation_about

    protocol = protocol if protocol is not None else Protocol()
    if object not in object_names():
        raise UnknownName("object", object, object_names())
    scene = Scene.build(
        controller.hand,
        object,
        protocol.gravity,
        object_size=protocol.object_size,
        object_mass=protocol.object_mass,
    )
    late = round(protocol.latency / controller.control_period)
    if protocol.noise or late:
        controller = Senses(controller, protocol.episodes, protocol.noise, late)
    with BatchSimulator(
        scene,
        protocol.episodes,
        control_period=controller.control_period,
        substeps=protocol.substeps,
        threads=protocol.threads,
        seed=protocol.seed,
    ) as sim:
        controller.reset(protocol.seed)
        pusher = Pusher(
            protocol.push,
            Streams(protocol.seed + _PUSH_SEED, (protocol.episodes,)),
            controller.control_period,
        )

        def push(now: BatchSimulator) -> None:
            now.push(pusher(np.round(now.time / now.control_period).astype(int)))

        trace = run(
            controller,
            sim,
            protocol.seconds,
            record=push if protocol.push else None,
            progress=progress,
        )
    axis = np.array(protocol.direction)
    rotation = rotation_about(trace.object_quaternion, axis, trace.held)
    steps = len(trace.time) - 1
    moments = np.unique(np.linspace(0, steps, min(_MOMENTS, steps) + 1).round().astype(int))
    return Evaluation(
        object=object,
        protocol=protocol,
        rotation=rotation[-1],
        time_held=trace.time_held,
        dropped=trace.dropped,
        diverged=trace.diverged[-1],
        returns=returns_of(trace, scene, controller.control_period, axis),
        moments=trace.time[moments],
        rotations=rotation[moments],
    )


def returns_of(trace: Trace, scene: Scene, control_period: float, axis: Floats) -> Floats:
    """The environments' return ``(N,)`` [rad/s] of the episodes in ``trace``, up to the drop."""
    quaternion = trace.object_quaternion
    turn = rotation_vector(multiply(quaternion[1:], inverse(quaternion[:-1])))
    upright = np.asarray(scene.settled.qpos[scene.object_qpos][3:])
    turning = rewards.Turning(
        speed=turn @ axis / control_period,
        tilt=rewards.tilt(quaternion[1:], np.broadcast_to(upright, quaternion[1:].shape), axis),
        fingertips=trace.in_contact[1:].sum(axis=-1),
        fingertips_only=trace.other_contact[1:] == 0.0,
    )
    earned = rewards.reward(turning, 0.5, 0.5, 3)
    # the step that drops the object counts still; one that breaks down does not
    return np.where(trace.held[:-1] & ~trace.diverged[1:], earned, 0.0).sum(axis=0)
