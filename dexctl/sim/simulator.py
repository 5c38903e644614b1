"""BatchSimulator: N hands, each with its object, stepped together by MuJoCo's rollout threads."""

from __future__ import annotations

import os

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.rotations import inverse, multiply, rotate, rotation_vector
from dexctl.sim import checks
from dexctl.sim.moving_base import REST, BaseMotion
from dexctl.sim.parameters import ParameterSet
from dexctl.sim.physics_state import INPUT, PhysicsLayout, SimulatorState
from dexctl.sim.scene import Scene
from dexctl.sim.state_rows import StateRows
from dexctl.sim.tactile import TouchReading, TouchSensors
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams, StreamsState

_SAVED = (
    "physics", "q_target", "ctrl", "steps", "diverged", "angular_velocity", "start_position"
)  # fmt: skip


_ELSEWHERE: list[Rollout] = []
"""Pools of the parent process; to delete one would wait for threads that are not here."""


class BatchSimulator:
    """N scenes of one hand and object behind the `Plant` interface.

    ``num_envs=None`` is one hand: states without batch dimension ``()``; N gives ``(N,)``, and
    environment i then behaves as a single one seeded with seed + i.

    Contact readings belong to the beginning of the last physics step, one timestep before the
    joints and the object's pose (MuJoCo computes forces before it integrates); `GraspState.age`
    says so. Each control step starts the contact solver cold, so a step depends on nothing but
    what :meth:`save` returns.

    An environment whose simulation diverges (MuJoCo resets such a one silently) stays as it was
    before that step, time included, and is marked in ``diverged`` until it is reset; MuJoCo's own
    warning of it is left out.

    Args:
        scene: hand and object.
        num_envs: N, or None.
        control_period: time of one :meth:`step` [s].
        substeps: physics steps in it.
        threads: how many; default all processor cores.
        touch_threshold: weakest normal force that counts as touch [N].
        disturbance: standard deviation of the set-points after a reset [rad].
        seed: of the random streams.

    Attributes:
        hand, scene, control_period, substeps, touch_threshold: as given.
        num_envs: N, or None.
        diverged: ``(N,)`` bool, latched until reset.
        other_contact: force between the object and everything but fingertips, ``(N,)`` [N].
        object_angular_velocity: ``(N, 3)`` [rad/s], hand's frame, from the difference of poses over
            the last control period (the simulation's own velocity carries its vibrations).
        object_velocity: the simulation's own, of the centre of mass, linear [m/s] and angular
            [rad/s], ``(N, 6)``, world frame.
        fingertip_force: with which each fingertip acts on the object, friction included,
            ``(N, m, 3)`` [N], world frame.
        start_position: the object's centre after the last reset, ``(N, 3)`` [m].

    The last six have no leading dimension where ``num_envs`` is None.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int | None = None,
        control_period: float = 0.05,
        substeps: int = 10,
        threads: int | None = None,
        touch_threshold: float = 0.05,
        disturbance: float = 0.02,
        seed: ArrayLike = 0,
    ) -> None:
        if not (np.isfinite(disturbance) and disturbance >= 0):
            raise InvalidInput(f"disturbance is {disturbance}; expected radians >= 0")
        self.scene = scene
        self.hand = scene.hand
        self.num_envs = num_envs
        self.control_period = checks.positive("control_period", control_period)
        self.substeps = checks.count("substeps", substeps)
        self.disturbance = float(disturbance)
        if not (np.isfinite(touch_threshold) and touch_threshold >= 0):
            raise InvalidInput(f"touch_threshold is {touch_threshold}; expected newtons >= 0")
        self.touch_threshold = float(touch_threshold)
        self._count = 1 if num_envs is None else checks.count("num_envs", num_envs)
        self.batch_shape = () if num_envs is None else (self._count,)
        self._parameters = ParameterSet(scene, self._count, self.control_period / self.substeps)
        self._sensors = TouchSensors(scene.model, self.hand.n_fingers)
        self._start_pool(threads)
        self._allocate()
        # one stream per environment in arrays of N rows, whether or not the batch shape shows N
        seeds = np.asarray(seed)
        self._streams = Streams(seeds.reshape(1) if num_envs is None else seeds, (self._count,))
        self.reset()

    def _start_pool(self, threads: int | None) -> None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        wanted = checks.count(
            "threads", min(cores or 1, self._count) if threads is None else threads
        )
        self._pool_process = os.getpid() if wanted > 1 else None
        # one thread: no pool, the caller's thread steps
        self._rollout: Rollout | None = Rollout(nthread=wanted if wanted > 1 else 0)
        self._data = [mujoco.MjData(self.scene.model) for _ in range(wanted)]

    def _pool(self) -> Rollout:
        if self._rollout is None:
            raise SimulationError("the simulator is closed")
        if self._forked():
            raise SimulationError(
                f"the simulator's threads are in process {self._pool_process}, of which this one "
                f"({os.getpid()}) is a fork; make a simulator here, or start processes by spawn"
            )
        return self._rollout

    def _allocate(self) -> None:
        model, count = self.scene.model, self._count
        self._layout = PhysicsLayout(self.scene)
        size = self._layout.size
        self._timestep = self.control_period / self.substeps
        self._physics = np.zeros((count, size))
        self._next = np.zeros((count, self.substeps, size))
        self._ctrl = np.zeros((count, self._layout.inputs))
        self._ctrl_steps = np.zeros((count, self.substeps, self._layout.inputs))
        self._sensordata = np.zeros((count, self.substeps, model.nsensordata))
        self._q_target = np.zeros((count, self.hand.nq))
        self._steps = np.zeros(count, np.int64)
        self._diverged = np.zeros(count, bool)
        self._angular_velocity = np.zeros((count, 3))
        self._start_position = np.zeros((count, 3))
        width = self._sensors.columns.stop - self._sensors.columns.start
        self._touch = self._sensors.read(np.zeros((count, width)), self.touch_threshold)
        settled = self.scene.settled
        self._settled_physics = self._layout.state(settled.qpos, settled.qvel)
        self._settled_ctrl = np.zeros(self._layout.inputs)
        self._settled_ctrl[self.scene.actuators] = settled.q_target * self.scene.ctrl_per_radian
        if self._layout.base is not None:
            self._settled_ctrl[self._layout.base.input] = REST
            self._base = np.tile(REST, (count, 1))  # where the last step ended

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Back to the settled grasp, with set-points disturbed.

        Args:
            seed: restarts the random streams; environment i gets ``seed + i``, or seed[i]. None:
                the streams go on.
            mask: which environments, ``(N,)`` bool; None is all.
        """
        chosen = self._mask(mask)
        if seed is not None:
            seeds = np.asarray(seed)
            self._streams.reseed(seeds.reshape(1) if self.num_envs is None else seeds, chosen)
        settled = self.scene.settled
        noise = self._streams.normal((self.hand.nq,), chosen)[chosen]
        rows = int(chosen.sum())
        touch = settled.sensordata[self._sensors.columns]
        self._place(
            chosen,
            self._with_centre_of_mass(np.tile(self._settled_physics, (self._count, 1)))[chosen],
            settled.q_target + self.disturbance * noise,
            np.broadcast_to(touch, (rows, len(touch))),
        )

    def set_grasp(
        self,
        q: ArrayLike,
        q_target: ArrayLike,
        object_position: ArrayLike,
        object_quaternion: ArrayLike,
        mask: ArrayLike | None = None,
        *,
        joint_velocity: ArrayLike | None = None,
        object_velocity: ArrayLike | None = None,
    ) -> None:
        """Put environments into given grasps: a planned one, a state to be checked.

        Args:
            q: joint positions ``(..., d)`` [rad].
            q_target: set-points ``(..., d)`` [rad].
            object_position: ``(..., 3)`` [m].
            object_quaternion: wxyz, unit, ``(..., 4)``.
            mask: which environments; the arrays have one row for every environment all the same.
            joint_velocity: ``(..., d)`` [rad/s]; None: at rest.
            object_velocity: as MuJoCo has it, ``(..., 6)``: linear in the world's frame [m/s],
                angular in the object's [rad/s]; None: at rest.
        """
        chosen, count, d = self._mask(mask), self._count, self.hand.nq
        qpos = np.tile(self.scene.settled.qpos, (count, 1))
        qpos[:, self.scene.qpos_columns] = self._rows("q", q, d)
        qpos[:, self.scene.object_qpos] = self._poses(object_position, object_quaternion)
        qvel = np.zeros((count, self.scene.model.nv))
        if joint_velocity is not None:
            qvel[:, self.scene.qvel_columns] = self._rows("joint_velocity", joint_velocity, d)
        if object_velocity is not None:
            qvel[:, self.scene.object_qvel] = self._rows("object_velocity", object_velocity, 6)
        target = self._rows("q_target", q_target, d)
        physics = self._with_centre_of_mass(self._layout.state(qpos, qvel))
        self._place_fresh(chosen, physics[chosen], target[chosen])

    def rows(self, index: ArrayLike | None = None) -> StateRows:
        """The states of the environments ``index`` (indices, or a mask; None: all), to be kept.

        `place` puts them back, here or into a simulator of the same scene with another number of
        environments. `save` and `restore` are for all of one simulator, random streams included.
        """
        found = StateRows(physics=self._physics, q_target=self._q_target)
        return found.take(np.arange(self._count) if index is None else np.asarray(index))

    def place(self, rows: StateRows, mask: ArrayLike | None = None) -> None:
        """Go on from states that were kept, at time 0, with what the fingertips feel there.

        Args:
            rows: of this scene, one for each environment chosen, in their order.
            mask: which environments, ``(N,)`` bool; None is all.

        Raises:
            SimulationError: they are of another scene, or too many or too few.
        """
        chosen = self._mask(mask)
        expected = (int(chosen.sum()), self._layout.size), self.hand.nq
        if (rows.physics.shape, rows.q_target.shape[1]) != expected:
            raise SimulationError(
                f"the rows have {rows.physics.shape} numbers of physics and "
                f"{rows.q_target.shape[1]} set-points; expected {expected[0]} and {expected[1]}"
            )
        physics = rows.physics.copy()
        physics[:, 0] = 0.0
        self._place_fresh(chosen, physics, rows.q_target)

    def place_object(
        self, position: ArrayLike, quaternion: ArrayLike, mask: ArrayLike | None = None
    ) -> None:
        """Put objects somewhere at rest; hands, time and what was felt stay as they are.

        Args:
            position, quaternion, mask: as those of the object in `set_grasp`.
        """
        chosen, placed = self._mask(mask), self._physics.copy()
        placed[:, self._layout.pose] = self._poses(position, quaternion)
        self._physics[chosen] = self._with_centre_of_mass(placed)[chosen]
        self._physics[chosen, self._layout.object_velocity] = 0.0
        self._angular_velocity[chosen] = 0.0

    def _poses(self, position: ArrayLike, quaternion: ArrayLike) -> Floats:
        unit = checks.unit("object_quaternion", self._rows("object_quaternion", quaternion, 4))
        return np.hstack([self._rows("object_position", position, 3), unit])

    def _with_centre_of_mass(self, physics: Floats) -> Floats:
        """States ``(N, size)`` from ones in which the body stands for the shape's centre."""
        physics[:, self._layout.position] += self._centre_of_mass(physics)
        return physics

    def _centre_of_mass(self, physics: Floats) -> Floats | float:
        """From the shape's centre to the centre of mass, ``(N, 3)`` [m], world frame."""
        if not self._parameters.has("centre_of_mass"):
            return 0.0
        shift = self._parameters.value("centre_of_mass", np.zeros(3))
        return rotate(physics[:, self._layout.quaternion], shift)

    def _place_fresh(self, chosen: Bools, physics: Floats, q_target: Floats) -> None:
        """Put the environments chosen into states, and feel the contacts there.

        One physics step, thrown away, tells what the fingertips feel.
        """
        where = np.flatnonzero(chosen)
        if not len(where):
            return
        ctrl = self._ctrl[where]
        ctrl[:, self.scene.actuators] = self._clip(q_target) * self.scene.ctrl_per_radian
        models = [self._parameters.models[i] for i in where]
        _, sensordata = self._pool().rollout(
            models, self._data, physics, ctrl[:, None], control_spec=INPUT
        )
        self._place(chosen, physics, q_target, sensordata[:, 0, self._sensors.columns])

    def _place(self, chosen: Bools, physics: Floats, q_target: Floats, touch: Floats) -> None:
        self._physics[chosen] = physics
        self._q_target[chosen] = self._clip(q_target)
        if self._layout.base is not None:
            self._base[chosen] = self._ctrl[chosen, self._layout.base.input] = (
                self._layout.base.pose(self._physics[chosen])
            )
        self._ctrl[:, self.scene.actuators] = self._q_target * self.scene.ctrl_per_radian
        self._ctrl[chosen, self._layout.push] = 0.0
        self._steps[chosen] = 0
        self._diverged[chosen] = False
        self._angular_velocity[chosen] = 0.0
        self._start_position[chosen] = self._object_pose()[chosen, :3]
        self._touch = self._touch.placed(chosen, self._sensors.read(touch, self.touch_threshold))

    def read(self, *, in_world: bool = False) -> GraspState:
        """The state now: joints, set-points, touch and the object's pose (all copies).

        Args:
            in_world: of a moving hand, as seen from the world; controllers want it as it is
                without, in the hand's frame.
        """
        touch, batch = self._touch, self.batch_shape
        if self._layout.base is not None and not in_world:
            world = self.read(in_world=True)
            return world.in_frame(*self.base_pose)
        state = GraspState(
            q=self._physics[:, self._layout.q],
            q_target=self._q_target.copy(),
            in_contact=touch.in_contact,
            contact_position=touch.position,
            contact_normal=touch.normal,
            contact_force=touch.force,
            object_position=self._object_position(),
            object_quaternion=self._physics[:, self._layout.quaternion].copy(),
            gravity=self._parameters.value("gravity", self.scene.gravity),
            time=self._clock(),
            age=np.full(self._count, self._timestep),
            normals_felt=np.ones(self._count, bool),
        )
        return state if batch else state[0]

    def _object_position(self) -> Floats:
        """Centres of the objects' shapes in the world, ``(N, 3)`` [m]."""
        return self._physics[:, self._layout.position] - self._centre_of_mass(self._physics)

    def write(self, q_target: ArrayLike) -> Floats:
        """Take set-points ``(..., d)`` [rad]; returns them within the limits of joints and servos.

        Raises:
            InvalidInput: wrong shape, or not finite.
        """
        self._q_target = self._clip(self._rows("q_target", q_target, self.hand.nq))
        self._ctrl[:, self.scene.actuators] = self._q_target * self.scene.ctrl_per_radian
        return self._out(self._q_target.copy())

    def push(self, force: ArrayLike) -> None:
        """Pull at the object's centre with ``force`` ``(..., 3)`` [N] until the next or a reset."""
        self._ctrl[:, self._layout.push] = self._rows("force", force, 3)

    def move_base(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Carry the hand to where its frame is to be at the end of the next step.

        From there it stays. On the way it moves evenly; it lags behind by the few milliseconds
        of a stiff arm, `base_pose` says where it is.

        Args:
            position: of the hand's frame in the world ``(..., 3)`` [m].
            quaternion: its orientation, wxyz, unit, ``(..., 4)``.

        Raises:
            SimulationError: the scene was built without ``moving_base=True``.
        """
        pose = [self._rows("position", position, 3), self._rows("quaternion", quaternion, 4)]
        pose[1] = checks.unit("quaternion", pose[1])
        self._ctrl[:, self._moving().input] = np.hstack(pose)

    @property
    def base_pose(self) -> tuple[Floats, Floats]:
        """The hand's frame in the world now: position ``(..., 3)``, quaternion ``(..., 4)``.

        Raises:
            SimulationError: the scene was built without ``moving_base=True``.
        """
        pose = self._moving().pose(self._physics)
        return self._out(pose[:, :3].copy()), self._out(pose[:, 3:].copy())

    def _moving(self) -> BaseMotion:
        if self._layout.base is None:
            raise SimulationError("the hand's base is fixed; Scene.build(..., moving_base=True)")
        return self._layout.base

    def _object_pose(self) -> Floats:
        """The object in the hand's frame, ``(N, 7)``."""
        place, turn = self._object_position(), self._physics[:, self._layout.quaternion]
        if self._layout.base is not None:
            base = self._layout.base.pose(self._physics)
            back = inverse(base[:, 3:])
            place, turn = rotate(back, place - base[:, :3]), multiply(back, turn)
        return np.concatenate([place, turn], axis=1)

    def step(self, mask: ArrayLike | None = None) -> None:
        """Let one control period pass in every environment, or in those of ``mask`` ``(N,)``."""
        chosen = self._mask(mask)
        some = mask is not None and not chosen.all()
        where = np.flatnonzero(chosen) if some else slice(None)
        count = int(chosen.sum())
        if not count:
            return
        models = self._parameters.models
        # a contiguous part of what is allocated for all of them
        ctrl, after_steps = self._ctrl_steps[:count], self._next[:count]
        sensordata = self._sensordata[:count]
        ctrl[:] = self._ctrl[where, None]
        if self._layout.base is not None:
            carried = self._layout.base.input
            ctrl[..., carried] = BaseMotion.between(
                self._base[where], self._ctrl[where, carried], self.substeps
            )
            self._base[where] = self._ctrl[where, carried]
        seen = self._object_pose()[where, 3:]
        before, start = self._physics[where], self._physics[where]
        lost = self._diverged[where]
        if lost.any():  # step something harmless in their place
            start = np.where(lost[:, None], self._settled_physics, start)
            ctrl[lost] = self._settled_ctrl
        self._pool().rollout(
            [models[i] for i in where] if isinstance(where, np.ndarray) else models,
            self._data,
            control_spec=INPUT,
            skip_checks=True,
            nstep=self.substeps,
            initial_state=start,
            control=ctrl,
            state=after_steps,
            sensordata=sensordata,
        )
        after = after_steps[:, -1]
        expected = before[:, 0] + self.control_period
        gravity = float(np.linalg.norm(self.scene.gravity))
        bad = self._layout.broken(after, expected, self._timestep, gravity) | lost
        if bad.any():
            after[bad] = before[bad]
            sensordata[bad] = 0.0
        touch = self._sensors.read(sensordata[:, -1, self._sensors.columns], self.touch_threshold)
        self._physics[where] = after
        turn = multiply(self._object_pose()[where, 3:], inverse(seen))
        self._angular_velocity[where] = rotation_vector(turn) / self.control_period
        self._diverged[where] |= bad
        self._steps[where] += ~bad
        self._touch = self._touch.placed(chosen, touch) if some else touch

    def set_parameters(self, mask: ArrayLike | None = None, **parameters: ArrayLike) -> None:
        """Give every environment its own physical parameters; they hold from the next step on.

        An object's size and centre of mass are to be set before the `reset` or `set_grasp` that
        places it.

        Args:
            mask: in which environments, ``(N,)`` bool; None is all. The arrays have a row for
                every environment all the same.
            parameters: by name. One number for all or ``(N,)``: ``friction`` (sliding, of object
                and fingertips), ``link_friction`` (a share of what palm, links and whatever else
                meets the object have with it otherwise), ``object_mass`` [kg] (inertia scales with
                it), ``object_size`` (a factor). Also ``(N, m)``: ``tip_friction`` (the same share,
                of each fingertip). Also ``(N, d)``: ``kp`` [N m/rad] and ``kv`` [N m s/rad] of the
                servos, ``damping`` [N m s/rad], ``gear_friction`` [N m] and ``armature`` [kg m^2]
                of the hand's joints.
                ``(N, 3)``: ``gravity`` [m/s^2], ``centre_of_mass`` of the object, from the centre
                of its shape, in its own frame [m] (its inertia stays as it was).

        Raises:
            UnknownName: no such parameter.
            InvalidInput: a value out of range, or the wrong number of them.
        """
        self._parameters.set(parameters, None if mask is None else self._mask(mask))

    @property
    def parameters(self) -> dict[str, Floats]:
        """What `set_parameters` was given, a row or number for each; NaN: as the scene has it."""
        return self._parameters.values

    @property
    def friction(self) -> Floats:
        """Sliding friction coefficient between object and fingertips, ``(...)``."""
        return self._out(np.array([self.scene.friction(m) for m in self._parameters.models]))

    def save(self) -> SimulatorState:
        """All that decides the future, to be given to :meth:`restore`.

        MuJoCo's full physics state has no warm start of the solver, because each control step
        starts without one: that is what makes replays bitwise.
        """
        return {
            **{name: getattr(self, f"_{name}").copy() for name in self._saved},
            "touch": {name: value.copy() for name, value in self._touch._asdict().items()},
            "streams": self._streams.save()._asdict(),
            "parameters": self._parameters.values,
        }

    def restore(self, saved: SimulatorState) -> None:
        """Continue from a saved state: the same writes and steps give the same bits.

        Raises:
            SimulationError: it was saved by a simulator of another size.
        """
        if saved["physics"].shape != self._physics.shape:
            raise SimulationError(
                f"the saved state has shape {saved['physics'].shape}; this simulator has "
                f"{self._physics.shape}"
            )
        for name in self._saved:
            setattr(self, f"_{name}", saved[name].copy())
        self._touch = TouchReading(**{k: v.copy() for k, v in saved["touch"].items()})
        self._streams.restore(StreamsState(**saved["streams"]))
        self._parameters.restore(saved["parameters"])

    @property
    def _saved(self) -> tuple[str, ...]:
        return _SAVED if self._layout.base is None else (*_SAVED, "base")

    @property
    def time(self) -> Floats:
        """Simulated time since the last reset, ``(...)`` [s]."""
        return self._out(self._clock())

    @property
    def diverged(self) -> Bools:
        return self._out(self._diverged.copy())

    @property
    def other_contact(self) -> Floats:
        return self._out(self._touch.other_contact.copy())

    @property
    def object_angular_velocity(self) -> Floats:
        return self._out(self._angular_velocity.copy())

    @property
    def object_velocity(self) -> Floats:
        found = self._physics[:, self._layout.object_velocity].copy()
        # MuJoCo has the angular part in the object's frame
        found[:, 3:] = rotate(self._physics[:, self._layout.quaternion], found[:, 3:])
        return self._out(found)

    @property
    def fingertip_force(self) -> Floats:
        return self._out(self._touch.net_force.copy())

    @property
    def start_position(self) -> Floats:
        return self._out(self._start_position.copy())

    @property
    def qpos(self) -> Floats:
        """MuJoCo's generalised positions ``(..., nq)``, for drawing."""
        qpos = self._physics[:, self._layout.qpos].copy()
        qpos[:, self.scene.object_qpos][:, :3] = self._object_position()
        return self._out(qpos)

    @property
    def qvel(self) -> Floats:
        """MuJoCo's generalised velocities ``(..., nv)``."""
        return self._out(self._physics[:, self._layout.qvel].copy())

    def close(self) -> None:
        """Stop the threads; the simulator cannot be stepped any more."""
        if self._rollout is not None:
            if self._forked():  # nobody here could end the threads, nor wait for them
                _ELSEWHERE.append(self._rollout)
            else:
                self._rollout.close()
            self._rollout = None

    def _forked(self) -> bool:
        """Whether the pool's threads stayed in the process that this one was forked from."""
        return self._pool_process not in (None, os.getpid())

    def __enter__(self) -> BatchSimulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _clock(self) -> Floats:
        return np.asarray(self._steps * self.control_period, float)

    def _clip(self, q_target: Floats) -> Floats:
        return np.minimum(np.maximum(q_target, self.scene.lower), self.scene.upper)

    def _rows(self, name: str, value: ArrayLike, width: int) -> Floats:
        return checks.rows(name, value, (*self.batch_shape, width)).reshape(self._count, width)

    def _mask(self, mask: ArrayLike | None) -> Bools:
        return checks.mask(mask, self.batch_shape).reshape(self._count)

    def _out(self, rows: np.ndarray) -> np.ndarray:
        return rows if self.batch_shape else rows[0]
