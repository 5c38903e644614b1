"""Evaluation: what a policy, or a controller, does with an object in many episodes.

The protocol: N episodes of 60 s with seeds 0 to N-1, each from the settled grasp with set-points
disturbed by N(0, 0.02 rad); an object whose centre moves by more than 0.05 m is dropped, and
nothing counts after that. Episodes are independent, so intervals are over them; claims about a
method need several seeds of training (`learning.statistics`).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams
from learning.envs import reward as rewards
from learning.envs.noise import SensorNoise, observed
from learning.envs.pushes import Push, Pusher
from learning.files import aside
from learning.statistics import Estimate, bootstrap, wilson

if TYPE_CHECKING:
    from dexctl.sim import Scene, Trace

FULL_TURN = 2.0 * np.pi
# streams of their own, beside the simulator's and the controller's
_NOISE_SEED, _PUSH_SEED = 1 << 42, 1 << 43

# The levels of `robustness`: what the thesis's figure goes up to, in four steps.
LEVELS: Mapping[str, tuple[float, ...]] = {
    "joint": (0.025, 0.05, 0.075, 0.1),  # [rad]
    "position": (0.0025, 0.005, 0.0075, 0.01),  # [m]
    "normal": (0.125, 0.25, 0.375, 0.5),
    "force": (0.125, 0.25, 0.375, 0.5),
    "push": (0.5, 1.0, 1.5, 2.0),  # [N], on the object
}


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How it is evaluated.

    Attributes:
        episodes: N; episode i has the seed ``seed + i``.
        seconds: of each [s].
        seed: of the first.
        gravity: "up" (the palm looks up), "down", or a vector [m/s^2].
        noise: of the sensors; what the policy sees, while the figures are of what is.
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
    noise: SensorNoise = SensorNoise()  # noqa: RUF009 (frozen)
    push: Push = Push()  # noqa: RUF009 (frozen)
    substeps: int = 10
    threads: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.episodes, int) or self.episodes < 1:
            raise InvalidInput(f"episodes is {self.episodes!r}; expected a whole number above 0")
        if not (np.isfinite(self.seconds) and self.seconds > 0):
            raise InvalidInput(f"seconds is {self.seconds}; expected a finite number above 0")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What came of N episodes with one object; arrays are ``(N,)``.

    Attributes:
        object: its name.
        protocol: as evaluated.
        rotation: about the hand's z, up to the drop or the end [rad].
        time_held: until then [s].
        dropped: whether it was dropped; a simulation that broke down counts as dropped.
        diverged: whether the simulation broke down.
        returns: sum of the environments' reward up to the drop or the end [rad/s].
    """

    object: str
    protocol: Protocol
    rotation: Floats
    time_held: Floats
    dropped: Bools
    diverged: Bools
    returns: Floats

    @property
    def speed(self) -> Floats:
        """Mean angular velocity while held, ``(N,)`` [rad/s]; 0 where it was not held at all."""
        held = self.time_held > 0
        return np.where(held, self.rotation / np.where(held, self.time_held, 1.0), 0.0)

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


@final
class NoisySenses(Controller):
    """A controller that sees a batch of hands through noisy sensors.

    Args:
        controller: who sees.
        noise: how badly.
        count: N.
    """

    def __init__(self, controller: Controller, noise: SensorNoise, count: int) -> None:
        super().__init__(controller.hand, control_period=controller.control_period)
        self._controller, self._noise, self._count = controller, noise, count
        self._streams = Streams(_NOISE_SEED, (count,))

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._controller.reset(seed, mask)
        if seed is not None:
            chosen = None if mask is None else np.asarray(mask, bool)
            self._streams.reseed(np.asarray(seed, object) + _NOISE_SEED, chosen)

    def act(self, state: GraspState) -> Floats:
        action = self._controller.act(observed(state, self._noise, self._streams))
        self._diagnostics = dict(self._controller.diagnostics)
        return action


def evaluate(
    controller: Controller,
    object: str,  # noqa: A002 (the field's name for it)
    protocol: Protocol | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Evaluate a policy or a controller with one object.

    Args:
        controller: what is evaluated; it is reset first.
        object: name of the object.
        protocol: how; None is the standard one.
        progress: called after each control step with the simulated time so far [s].

    Raises:
        UnknownName: no such object.
        SimulationError: the hand does not hold it.
    """
    from dexctl.sim import BatchSimulator, Scene, object_names, run

    protocol = protocol if protocol is not None else Protocol()
    if object not in object_names():
        raise UnknownName("object", object, object_names())
    scene = Scene.build(controller.hand, object, protocol.gravity)
    if protocol.noise:
        controller = NoisySenses(controller, protocol.noise, protocol.episodes)
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
    return Evaluation(
        object=object,
        protocol=protocol,
        rotation=trace.final_rotation,
        time_held=trace.time_held,
        dropped=trace.dropped,
        diverged=trace.diverged[-1],
        returns=returns_of(trace, scene, controller.control_period),
    )


def returns_of(trace: Trace, scene: Scene, control_period: float) -> Floats:
    """The environments' return ``(N,)`` [rad/s] of the episodes in ``trace``, up to the drop."""
    axis = np.array([0.0, 0.0, 1.0])
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


def robustness(
    controller: Controller,
    object: str,  # noqa: A002
    protocol: Protocol | None = None,
    levels: Mapping[str, tuple[float, ...]] = LEVELS,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[Evaluation]:
    """Evaluations undisturbed, then with each kind of disturbance at each level.

    Args:
        controller, object, protocol: as `evaluate`'s; the protocol's own noise and push are
            replaced.
        levels: by field of `SensorNoise`, and "push" for the force on the object.
        progress: called after each evaluation with how many are done, and of how many.

    Raises:
        UnknownName: no such kind of disturbance.
    """
    kinds = [*SensorNoise.__dataclass_fields__, "push"]
    base = replace(protocol or Protocol(), noise=SensorNoise(), push=Push())
    protocols = [base]
    for kind, row in levels.items():
        if kind not in kinds:
            raise UnknownName("disturbance", kind, kinds)
        for level in row:
            changed = Push(force=level) if kind == "push" else SensorNoise(**{kind: level})
            protocols.append(replace(base, **{"push" if kind == "push" else "noise": changed}))
    found = []
    for one in protocols:
        found.append(evaluate(controller, object, one))
        if progress is not None:
            progress(len(found), len(protocols))
    return found


def write_csv(path: str | Path, evaluations: Iterable[Evaluation]) -> None:
    """One row for each episode, whole or not at all."""
    with aside(Path(path)) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        noise = list(SensorNoise.__dataclass_fields__)
        outcome = ["rotation_rad", "time_held_s", "dropped", "diverged", "return"]
        names = [*(f"{kind}_noise" for kind in noise), "push_force_N", "seed", *outcome]
        writer.writerow(["object", *names])
        for one in evaluations:
            sigma = [getattr(one.protocol.noise, kind) for kind in noise]
            sigma.append(one.protocol.push.force)
            columns = (one.rotation, one.time_held, one.dropped, one.diverged, one.returns)
            for i, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
                writer.writerow([one.object, *sigma, one.protocol.seed + i, *row])
