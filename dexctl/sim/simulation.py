"""Simulation: N hands with their objects, as a `SceneConfig` describes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.hand import HandModel
from dexctl.joint_touch import JointTouch
from dexctl.sim.grasp_states import GraspStates, StateSampler
from dexctl.sim.grouped import GroupedSimulator
from dexctl.sim.limited_hand import LimitedHand
from dexctl.sim.link_weights import LinkWeights
from dexctl.sim.pushes import Pusher
from dexctl.sim.randomisation import Drawn, Randomiser, nominal
from dexctl.sim.reckoning import Reckoning
from dexctl.sim.scene_config import SceneConfig
from dexctl.sim.sensing import Sensor
from dexctl.sim.sized_grasps import SizedGrasps
from dexctl.state import Bools, Floats, GraspState, merged
from dexctl.streams import Streams, StreamsState

# The streams of one environment must not repeat each other; the simulator's takes the seed itself.
_NOISE_SEED, _DRAW_SEED, _PUSH_SEED, _RANDOM_SEED = 1 << 40, 1 << 41, 1 << 43, 1 << 44
_TASK_SEED = 1 << 45


class Simulation:
    """A plant that is everything a `SceneConfig` says: physics, limits, pushes, sensors, starts.

    What controllers and policies may see is :meth:`read`; how things are is :attr:`state`.
    Environment i of a batch seeded with s has the numbers of a single one seeded with s + i.

    Args:
        config: what is simulated.
        num_envs: N, at least one for each object.
        seed: of the random streams, one or one for each environment.
        hand: in place of loading the one that is named.

    Attributes:
        config, hand, control_period, num_envs: as given.
        sim: the physics.
        randomiser: what holds in the episodes, where it is drawn for each.
        objects: name of the object in each environment.
        task_streams: random numbers for what the hands are to do, ``(N,)``.

    Raises:
        UnknownName, InvalidInput: a setting is wrong.
        SimulationError: the hand does not hold the object.
    """

    def __init__(
        self,
        config: SceneConfig,
        num_envs: int,
        seed: ArrayLike = 0,
        *,
        hand: HandModel | None = None,
    ) -> None:
        count = _check_count(config, num_envs)
        seeds = spread_seeds(seed, count)
        scenes = config.scenes(hand)
        least, more = divmod(count, len(scenes))
        self.config = config
        groups = [(scene, least + (i < more)) for i, scene in enumerate(scenes)]
        self.sim = GroupedSimulator(
            groups,
            control_period=config.control_period,
            substeps=config.substeps,
            threads=config.threads,
            touch_threshold=_weakest_touch(config),
            disturbance=config.disturbance,
            seed=seeds,
        )
        self.hand, self.num_envs, self.objects = self.sim.hand, count, self.sim.objects
        self.control_period, self.batch_shape = self.sim.control_period, (count,)
        self._plant: LimitedHand | GroupedSimulator = self.sim
        drawn = config.randomisation
        if config.limits or drawn.limits_hand:
            self._plant = LimitedHand(self.sim, config.limits, scenes[0].stiffness)
        usual = nominal(groups, config.sensing, config.limits, config.push)
        self.randomiser = Randomiser(drawn, usual, Streams(seeds + _RANDOM_SEED, (count,)))
        self._grasps = SizedGrasps.find(config, groups) if drawn else None
        self._sampler: StateSampler | None = None
        self.start_from(None)
        self._draws = Streams(seeds + _DRAW_SEED, (count,))
        self.task_streams = Streams(seeds + _TASK_SEED, (count,))
        self._pusher = Pusher(
            config.push, Streams(seeds + _PUSH_SEED, (count,)), self.control_period
        )
        noise = Streams(seeds + _NOISE_SEED, (count,))
        felt = None
        if config.sensing.touch != "full":
            servos, how = (scenes[0].stiffness, scenes[0].damping), config.sensing.joint_touch
            felt = JointTouch(
                self.hand, *servos, how, control_period=self.control_period,
                weights=LinkWeights(self.hand, scenes[0].model),
            )  # fmt: skip
        reckoning, pose = None, config.sensing.object_pose
        if pose in ("touch", "odometry"):
            reckoning = Reckoning(
                self.hand, groups, self.control_period, shapes_known=pose == "touch"
            )
        self._sensor = Sensor(config.sensing, noise, self.control_period, felt, reckoning)
        self._steps = np.zeros(count, np.int64)
        self._unseen: Bools | None = np.ones(count, bool)  # None: a control step has passed in all
        self._begin(np.ones(count, bool))
        self._seen = self._state

    @property
    def state(self) -> GraspState:
        """How things are, ``(N,)``; ``q_target`` is what was sent last."""
        return self._state

    @property
    def starts(self) -> GraspStates | None:
        """What episodes begin in; None: the settled grasp."""
        return None if self._sampler is None else self._sampler.states

    @property
    def diverged(self) -> Bools:
        """Whose simulation broke down, ``(N,)``, until it is reset; its last finite state stays."""
        return self.sim.diverged

    def reset(self, seed: ArrayLike | None = None, mask: Bools | None = None) -> None:
        """Begin anew in the environments chosen.

        Args:
            seed: environment i gets ``seed + i``, or ``seed[i]``; None: the streams go on.
            mask: which, ``(N,)`` bool; None is all.
        """
        chosen = np.ones(self.num_envs, bool) if mask is None else mask
        self.read()  # the step that has passed is sensed first
        if seed is None:
            self.sim.reset(None, chosen)
        else:
            seeds = spread_seeds(seed, self.num_envs)
            self._draws.reseed(seeds + _DRAW_SEED, chosen)
            self.task_streams.reseed(seeds + _TASK_SEED, chosen)
            self._pusher.streams.reseed(seeds + _PUSH_SEED, chosen)
            self._sensor.streams.reseed(seeds + _NOISE_SEED, chosen)
            self.randomiser.streams.reseed(seeds + _RANDOM_SEED, chosen)
            self.sim.reset(seeds, chosen)
        self._begin(chosen)

    def place(self, states: GraspStates, index: ArrayLike, mask: Bools | None = None) -> None:
        """Begin anew in given grasps, at rest and undisturbed.

        Args:
            states: of this hand, and of the object of each environment.
            index: which of them each environment gets, ``(N,)``.
            mask: in which environments, ``(N,)`` bool; None is all.

        Raises:
            InvalidInput: states of another hand, or of another object.
        """
        StateSampler(states, self.hand, self.objects)  # says what does not belong together
        chosen = np.ones(self.num_envs, bool) if mask is None else mask
        rows = np.asarray(index)
        wrong = chosen & (states.object[rows] != np.array(self.objects))
        if wrong.any():
            i = int(np.flatnonzero(wrong)[0])
            raise InvalidInput(
                f"state {rows[i]} is of the object {str(states.object[rows[i]])!r}; environment "
                f"{i} has {self.objects[i]!r}"
            )
        self.read()
        self._put(states, rows, 0.0, chosen)
        self._start(chosen)

    def start_from(self, states: GraspStates | None) -> None:
        """From now on, begin episodes in these states, each with its weight, at rest and disturbed.

        In place of ``initial_states``; None: as the configuration says again. `save` does not hold
        them: whoever gave them gives them again before `restore`.

        Raises:
            InvalidInput: states of another hand, an object without states, or sizes that are drawn.
        """
        file, sizes = self.config.initial_states, self.config.randomisation.size_range
        if sizes is not None and (states is not None or file is not None):
            what = file if states is None else "given"
            raise InvalidInput(
                f"size_range is {sizes} and initial_states is {what}, whose grasps are of one "
                "size; give one of them"
            )
        if states is None and file is not None:
            states = GraspStates.load(file)
        self._sampler = None if states is None else StateSampler(states, self.hand, self.objects)

    def scale_gravity(self, share: float) -> None:
        """Let this share of the scene's gravity act from now on, in every environment.

        Raises:
            InvalidInput: not a number from 0 on, or gravity is drawn for each episode.
        """
        if not (np.isfinite(share) and share >= 0):
            raise InvalidInput(f"share is {share}; expected a finite number, at least 0")
        if self.config.randomisation.draws_gravity:
            raise InvalidInput("gravity is drawn for each episode; it cannot be scaled besides")
        self.sim.set_parameters(gravity=share * self.randomiser.usual.gravity)

    @property
    def joint_offset(self) -> Floats:
        """What each encoder reads at zero in this episode, ``(N, d)`` [rad]."""
        return np.broadcast_to(self._sensor.offset, (self.num_envs, self.hand.nq))

    def read(self) -> GraspState:
        """What the sensors tell, ``(N,)``; the same however often it is asked within a step."""
        if self._unseen is None or self._unseen.any():
            seen = self._sensor(self._state, self._unseen)
            self._seen = seen if self._unseen is None else merged(self._unseen, seen, self._seen)
            self._unseen = np.zeros(self.num_envs, bool)
        return self._seen

    def write(self, q_target: ArrayLike) -> Floats:
        """Take set-points ``(N, d)`` [rad]; returns what the limits leave of them."""
        offset = self._sensor.offset  # what the encoders read is what the servos go by
        return self._plant.write(np.asarray(q_target, float) - offset) + offset

    def step(self) -> None:
        """Let one control period pass."""
        self.read()  # what nobody has asked for is sensed all the same, for the latency's sake
        if self.randomiser.turn(self.control_period):
            self.sim.set_parameters(gravity=self.randomiser.drawn.gravity)
        if self._pusher.size.any():
            self.sim.push(self._pusher(self._steps))
        self._plant.step()
        self._steps += 1
        now, broken = self._plant.read(), self.sim.diverged
        # where it broke down the last finite state stays, its touch included
        self._state = merged(~broken, now, self._state) if broken.any() else now
        self._unseen = None

    def save(self) -> dict[str, Any]:
        """All that decides the future, as arrays and plain values, to be given to `restore`."""
        seen = self.read()  # first: it may move the sensors on
        return {
            "simulator": self.sim.save(),
            "limits": self._plant.save() if isinstance(self._plant, LimitedHand) else None,
            "sensor": self._sensor.save(),
            "pushes": self._pusher.save(),
            "draws": self._draws.save()._asdict(),
            "task_streams": self.task_streams.save()._asdict(),
            "randomiser": self.randomiser.save(),
            "steps": self._steps.copy(),
            "state": self._state.arrays(),
            "seen": seen.arrays(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned: the same actions give the same bits.

        Raises:
            SimulationError: it was saved by another number or kind of environments.
        """
        limited = isinstance(self._plant, LimitedHand)
        if limited != (saved["limits"] is not None):
            raise SimulationError(
                "the saved state is of a hand with other limits: "
                f"{'without' if limited else 'with'} them"
            )
        self.sim.restore(saved["simulator"])
        self.randomiser.restore(saved["randomiser"])
        if self.config.randomisation:
            self._hold(self.randomiser.drawn)
        if isinstance(self._plant, LimitedHand):
            self._plant.restore(saved["limits"])
        self._sensor.restore(saved["sensor"])
        self._pusher.restore(saved["pushes"])
        self._draws.restore(StreamsState(**saved["draws"]))
        self.task_streams.restore(StreamsState(**saved["task_streams"]))
        self._steps = saved["steps"].copy()
        self._state, self._seen = GraspState(**saved["state"]), GraspState(**saved["seen"])
        self._unseen = np.zeros(self.num_envs, bool)

    def close(self) -> None:
        """Stop the physics' threads."""
        self.sim.close()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self, chosen: Bools) -> None:
        self._randomise(chosen)
        if self._sampler is not None:
            index = self._sampler(self._draws.uniform((), chosen))
            noise = self._draws.normal((self.hand.nq,), chosen)
            self._put(self._sampler.states, index, self.config.disturbance * noise, chosen)
        elif self._grasps is not None:  # placed again, with the parameters drawn
            noise = self.config.disturbance * self._draws.normal((self.hand.nq,), chosen)
            q, q_target, *pose = self._grasps.of(self.randomiser.drawn.object_size)
            self.sim.set_grasp(q, q_target + noise, *pose, mask=chosen)
        self._start(chosen)

    def _randomise(self, chosen: Bools) -> None:
        """Draw what holds in the episodes that begin."""
        if not self.config.randomisation:
            return
        self.randomiser.draw(chosen)
        drawn = self.randomiser.drawn
        physical = {name: getattr(drawn, name) for name in self.randomiser.physical}
        self.sim.set_parameters(mask=chosen, **physical)
        self._hold(drawn)

    def _hold(self, drawn: Drawn) -> None:
        """Make limits, sensors and pushes what was drawn."""
        if isinstance(self._plant, LimitedHand):
            self._plant.set_limits(
                drawn.speed_limit, drawn.torque_limit, drawn.action_latency, drawn.kp
            )
        self._sensor.set_errors(
            drawn.noise,
            drawn.sensor_latency,
            drawn.touch_threshold,
            drawn.touch_dropout,
            drawn.joint_offset,
        )
        self._pusher.size = drawn.push_force

    def _put(
        self, states: GraspStates, index: np.ndarray, disturbance: Floats | float, chosen: Bools
    ) -> None:
        self.sim.set_grasp(
            states.q[index],
            states.q_target[index] + disturbance,
            states.object_position[index],
            states.object_quaternion[index],
            mask=chosen,
        )

    def _start(self, chosen: Bools) -> None:
        """An episode begins with how the physics are now."""
        if isinstance(self._plant, LimitedHand):
            self._plant.restart(chosen)
        self._steps[chosen] = 0
        fresh = self._plant.read()
        self._state = fresh if chosen.all() else merged(chosen, fresh, self._state)
        assert self._unseen is not None
        self._unseen = self._unseen | chosen


def spread_seeds(seed: ArrayLike, count: int) -> np.ndarray:
    """The seed of each environment, ``(count,)`` of Python's integers, which do not overflow.

    Raises:
        InvalidInput: neither an integer nor one for each environment.
    """
    seeds = np.asarray(seed, object)
    whole = all(isinstance(one, (int, np.integer)) for one in seeds.flat)
    if not whole or seeds.shape not in ((), (count,)):
        raise InvalidInput(f"seed is {seed!r}; expected an integer, or {count} of them")
    numbers = np.array([int(one) for one in seeds.flat], object)
    return numbers[0] + np.arange(count).astype(object) if seeds.ndim == 0 else numbers


def _weakest_touch(config: SceneConfig) -> float:
    """Weakest force that any sensor of an episode may count as touch [N]."""
    usual, drawn = config.sensing.touch_threshold, config.randomisation.touch_threshold_range
    return usual if drawn is None else min(usual, drawn[0])


def _check_count(config: SceneConfig, num_envs: object) -> int:
    least = len(config.object)
    if not isinstance(num_envs, (int, np.integer)) or isinstance(num_envs, bool):
        raise InvalidInput(f"num_envs is {num_envs!r}; expected a whole number")
    if num_envs < least:
        raise InvalidInput(
            f"num_envs is {num_envs}; expected at least {least}, one for each of "
            f"{', '.join(config.object)}"
        )
    return int(num_envs)
