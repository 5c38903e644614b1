"""Scene: one hand and one object in one MuJoCo model."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexctl import hands
from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.hand import HandModel
from dexctl.sim import checks
from dexctl.sim.file_settings import lean_model
from dexctl.sim.hand_spec import hand_spec
from dexctl.sim.moving_base import add_moving_base
from dexctl.sim.objects import MESH, add_object, object_names
from dexctl.sim.tactile import add_sensors
from dexctl.state import Floats

if TYPE_CHECKING:
    from dexctl.sim.settle import SettledGrasp
    from dexctl.sim.suggest import SuggestedGrasp


class Scene:
    """A hand holding an object, ready to be simulated. Build one with :meth:`build`.

    The hand stays where its file puts it; the direction of gravity says how it is held.

    Attributes:
        hand: the hand's kinematics.
        object: the object's name.
        gravity: ``(3,)`` [m/s^2], hand (= world) frame.
        object_mass: [kg].
        object_width: [m], 0 for a mesh that keeps its own size.
        grasp_centre: where the object is held, ``(3,)`` [m].
        open_q: the open hand, ``(d,)`` [rad].
        grasp_q: the hand about to touch the object, ``(d,)`` [rad]; None: found when it settles.
        grip: normal force that each finger of the settled grasp aims at [N].
        object_body: name of the object's body and joint in `model`: "object", unless the hand's
            file has one of that name.
        moving_base: whether the hand can be moved, with `BatchSimulator.move_base`.
        notes: what the hand's file lacks for a simulation, and what was done about it; which grasp
            was chosen where nobody says one, or where this object is not held (once it settles).
        model: the MuJoCo model that is stepped: no visual geoms, contact sensors added.
        qpos_columns, qvel_columns: the hand's d joints in ``qpos`` and ``qvel``.
        object_qpos: the object's pose in ``qpos``: position, quaternion wxyz.
        object_qvel: the object's twist in ``qvel``.
        actuators: the position servo of each of the d joints.
        ctrl_per_radian: control value of that servo per radian of its joint, ``(d,)``.
        stiffness: joint torque per radian of set-point error, ``(d,)`` [N m/rad].
        damping: joint torque per speed of the joint, of servo and joint together, ``(d,)``
            [N m s/rad].
        lower, upper: set-point limits, ``(d,)`` [rad]: of the joint and of its servo.
    """

    def __init__(
        self,
        hand: HandModel,
        spec: mujoco.MjSpec,
        *,
        object: str,  # noqa: A002
        object_mass: float,
        object_width: float,
        gravity: Floats,
        grasp_centre: Floats,
        open_q: Floats,
        grip: float,
        grasp_q: Floats | None = None,
        object_body: str = "object",
        moving_base: bool = False,
        notes: tuple[str, ...] = (),
        elsewhere: Mapping[str, Any] | None = None,
    ) -> None:
        self.hand = hand
        self.object = object
        self.object_mass = object_mass
        self.object_width = object_width
        self.gravity = gravity
        self.grasp_centre = grasp_centre
        self.open_q = open_q
        self.grasp_q = grasp_q
        self.grip = grip
        self.object_body = object_body
        self.moving_base = moving_base
        self.notes = notes
        self._elsewhere = elsewhere  # how to ask for another place; None: this one was wanted
        self._spec = spec
        self.model = lean_model(spec, hand)
        self._find_joints()
        self.find_servos()

    @classmethod
    def build(
        cls,
        hand: HandModel | str | Path,
        object: str | None = None,  # noqa: A002 (the field's name for it)
        gravity: str | ArrayLike = "up",
        *,
        object_mass: float | None = None,
        object_size: float | None = None,
        friction: float | ArrayLike = 1.0,
        mesh: str | Path | None = None,
        object_mesh: str | Path | None = None,
        grasp_centre: ArrayLike | None = None,
        open_q: ArrayLike | Mapping[str, float] | None = None,
        grasp_q: ArrayLike | Mapping[str, float] | None = None,
        grip: float = 2.0,
        moving_base: bool = False,
    ) -> Scene:
        """Put a hand and an object into one scene.

        Args:
            hand: the hand, its name, or its file.
            object: one of `object_names`, or "mesh" with ``mesh``. Default: "cube", or "mesh"
                where one is given.
            gravity: "up" (the palm looks up), "down", or a vector ``(3,)`` [m/s^2].
            object_mass: [kg]; None: what the hand's toml says.
            object_size: width of the object [m]. Default: what suits the hand; a mesh keeps its
                own size.
            friction: sliding coefficient of the object, or (sliding, torsional [m], rolling [m]).
            mesh: STL or OBJ file of the object. MuJoCo uses its convex hull; decomposing a
                concave object into convex parts is the user's part.
            object_mesh: the same, by the name that it has in `SceneConfig`.
            grasp_centre: where the hand holds the object, ``(3,)`` [m]. Default: as the hand's
                toml says; where it says nothing, the first that `suggest_grasp` finds, with its
                size and postures where these are not given (``notes`` says so). Where the toml
                says it for another object, and this one does not settle there, the same is asked
                for a place of this width when it settles, unless a posture is given.
            open_q: joints of the open hand, ``(d,)`` or by name [rad]. Default, and for joints
                that are left out: as the hand's toml says, else the middle of each range.
            grasp_q: joints with the fingertips about to touch the object, in the same forms.
                Default: as the hand's toml says, else found when the grasp settles.
            grip: normal force that each finger of the settled grasp aims at [N].
            moving_base: let the hand be moved, as on an arm; it begins where it stands otherwise.

        Raises:
            UnknownName: no such hand, object or gravity name.
            InvalidInput: a number out of range.
            SimulationError: MuJoCo cannot compile the scene, or the hand cannot be simulated, or
                not be moved.
        """
        model = hand if isinstance(hand, HandModel) else hands.load(hand)
        name, file = _object(object, mesh, object_mesh)
        held, postures, notes = model.config.object, model.config.postures, ()
        model.config.check_objects(object_names())
        mass = checks.positive("object_mass", held.mass if object_mass is None else object_mass)
        if object_size is not None:
            width = checks.object_size(object_size)
        else:
            width = 0.0 if name == MESH else held.width(name)
        place = held.centre if grasp_centre is None else grasp_centre
        elsewhere = None
        given = any(one is not None for one in (grasp_centre, open_q, grasp_q))
        if not given and held.shape not in (None, name):  # the place is another object's
            elsewhere = {
                "gravity": gravity, "mesh": file, "object_mass": mass,
                "object_size": width or None, "friction": friction, "grip": grip,
                "grasp_centre": None,
            }  # fmt: skip
        if place is None or width is None:
            from dexctl.sim.suggest import suggested

            found = suggested(
                model, name, gravity, mesh=file, object_mass=mass, object_size=width or None,
                friction=friction, grip=grip, grasp_centre=place,
            )  # fmt: skip
            place, width, notes = found.centre, found.size, (found.note,)
            open_q = found.open_q if open_q is None else open_q
            grasp_q = found.grasp_q if grasp_q is None else grasp_q
        centre = checks.vector("grasp_centre", place, 3)
        opened = _posture("open_q", model, postures.open, open_q)
        closed = None
        if grasp_q is not None or postures.grasp:
            closed = _posture("grasp_q", model, {**postures.open, **postures.grasp}, grasp_q)
        spec, changed = hand_spec(model)
        if moving_base:
            add_moving_base(spec, model)
        spec.option.gravity = checks.gravity_vector(gravity)
        others = _touchable_bodies(spec, model)
        own_name = _free_name(spec)
        body = spec.worldbody.add_body(name=own_name, pos=centre)
        body.add_freejoint(name=own_name)
        add_object(
            spec,
            body,
            name,
            width=width,
            mass=mass,
            friction=_friction(friction),
            mesh=file,
        )
        _meet_everything(spec, body)
        add_sensors(spec, model.fingertip_bodies, others, own_name)
        return cls(
            model,
            spec,
            object=name,
            object_mass=mass,
            object_width=width,
            gravity=checks.gravity_vector(gravity),
            grasp_centre=centre,
            open_q=opened,
            grasp_q=closed,
            grip=checks.positive("grip", grip),
            object_body=own_name,
            moving_base=moving_base,
            notes=(*changed, *notes),
            elsewhere=elsewhere if held.centre is not None else None,
        )

    @staticmethod
    def suggest_grasp(
        hand: HandModel | str | Path,
        object: str | None = None,  # noqa: A002
        *,
        mesh: str | Path | None = None,
        object_mass: float | None = None,
        object_size: float | None = None,
        friction: float | ArrayLike = 1.0,
        grasp_centre: ArrayLike | None = None,
        grip: float = 2.0,
        twist: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        count: int = 3,
        tries: int = 12,
        seed: int = 0,
        near: SuggestedGrasp | None = None,
    ) -> tuple[SuggestedGrasp, ...]:
        """Grasps that hold, best first: where, how large the object, and the hand's postures.

        Places, sizes and postures are ranked by the kernel and settled, palm up and palm down;
        `dexctl.sim.suggest` says how. Those that hold both ways come first.

        Args:
            hand: the hand, its name, or its file.
            object, mesh, object_mass, friction, grip: as in `build`.
            object_size: width of the object [m]; None: what suits the hand (a mesh keeps its own).
            grasp_centre: where it is held, ``(3,)`` [m]; None: to be found.
            twist: that the object is to be moved with, ``(6,)`` (linear, angular), hand frame; its
                direction counts. Default: a turn about z.
            count: how many grasps that hold both ways are enough.
            tries: how many are settled, at most.
            seed: of the search, 0 or more.
            near: a grasp, of any object, whose surroundings are searched: within centimetres of
                where it holds, at about its width. None: wherever the fingers reach.

        Raises:
            InvalidInput: a value is out of range.
            SettleFailure: none holds; with the attempts of the best.
            SimulationError: no place is in reach of three fingers (of both, where the hand has
                two) that move their tips all ways, with palm and links clear.
        """
        from dexctl.sim.suggest import suggest

        model = hand if isinstance(hand, HandModel) else hands.load(hand)
        name, file = _object(object, mesh, None)
        return suggest(
            model, name, mesh=file, object_mass=object_mass, object_size=object_size,
            friction=friction, grasp_centre=grasp_centre, grip=grip, twist=twist, count=count,
            tries=tries, seed=seed, near=near,
        )  # fmt: skip

    @property
    def spec(self) -> mujoco.MjSpec:
        """A copy of what `model` is compiled from, with everything visual still in it."""
        return self._spec.copy()

    @cached_property
    def settled(self) -> SettledGrasp:
        """The settled grasp of the object, found once (see `dexctl.sim.settle`).

        An object that does not settle where the hand's toml holds another is held where
        `suggest_grasp` finds a place for it: `grasp_centre`, `open_q` and `grasp_q` are then that
        grasp's, and `notes` says so.

        Raises:
            SimulationError: the object does not stay in the hand.
        """
        from dexctl.sim.settle import settle
        from dexctl.sim.settle_failure import SettleFailure

        try:
            return settle(self)
        except SettleFailure as failure:
            if self._elsewhere is None or failure.too_heavy:
                raise
            before = self.grasp_centre, self.open_q, self.grasp_q
            try:
                return self._settled_elsewhere(self._elsewhere)
            except SimulationError:  # no place at all: the first failure says more
                self._move(*before)
                raise failure from None

    def _settled_elsewhere(self, options: Mapping[str, Any]) -> SettledGrasp:
        from dexctl.sim.settle import settle
        from dexctl.sim.suggest import suggested

        found = suggested(self.hand, self.object, **options)
        self._move(found.centre, found.open_q, found.grasp_q)
        settled = settle(self)
        shape = self.hand.config.object.shape
        why = f"not held where the hand's toml holds a {shape}: {found.note}"
        self.notes = (*self.notes, why)
        return settled

    def hold_as(self, other: Scene) -> None:
        """Hold the object where another scene of this hand and object does, and nowhere else.

        To be called before it settles: other widths of one object are held in one place.
        """
        if self._elsewhere is not None:
            _ = other.settled  # it may be held elsewhere than it was built
            self._move(other.grasp_centre, other.open_q, other.grasp_q)
        self._elsewhere = None

    def _move(self, centre: Floats, open_q: Floats, grasp_q: Floats | None) -> None:
        """Have the object held elsewhere, in the compiled model and in what it is made of."""
        self.grasp_centre, self.open_q, self.grasp_q = centre, open_q, grasp_q
        self._spec.body(self.object_body).pos = centre
        self.model.body(self.object_body).pos = centre
        self.model.qpos0[self.object_qpos][:3] = centre

    def friction(self, model: mujoco.MjModel | None = None) -> float:
        """Sliding friction coefficient between object and fingertips, the least of all pairs.

        MuJoCo takes the larger of two geoms, unless one has the higher priority.

        Args:
            model: `model` with other parameters.
        """
        found = self.model if model is None else model
        tips = [found.body(name).id for name in self.hand.fingertip_bodies]
        own = np.flatnonzero(found.geom_bodyid == found.body(self.object_body).id)[:, None]
        other = np.flatnonzero(np.isin(found.geom_bodyid, tips))[None]
        value, priority = found.geom_friction[:, 0], found.geom_priority
        mixed = np.maximum(value[own], value[other])
        mixed = np.where(priority[own] > priority[other], value[own], mixed)
        mixed = np.where(priority[own] < priority[other], value[other], mixed)
        return float(mixed.min())

    def _find_joints(self) -> None:
        model = self.model
        joints = [model.joint(name).id for name in self.hand.joint_names]
        self.qpos_columns = model.jnt_qposadr[joints].copy()
        self.qvel_columns = model.jnt_dofadr[joints].copy()
        free = model.joint(self.object_body)
        self.object_qpos = slice(int(free.qposadr[0]), int(free.qposadr[0]) + 7)
        self.object_qvel = slice(int(free.dofadr[0]), int(free.dofadr[0]) + 6)

    def find_servos(self) -> None:
        """The servo of each joint: a position actuator, force = kp (ctrl - gear q) - kv ...

        To be called again where their gains were changed.
        """
        model, hand = self.model, self.hand
        servo_of = {}
        for a in range(model.nu):
            position = (
                model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
                and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
                and model.actuator_gainprm[a, 0] > 0
                and np.isclose(model.actuator_biasprm[a, 1], -model.actuator_gainprm[a, 0])
            )
            if position:
                servo_of[model.joint(model.actuator_trnid[a, 0]).name] = a
        missing = [name for name in hand.joint_names if name not in servo_of]
        if missing:
            raise SimulationError(
                f"{hand.path}: no position actuator drives {', '.join(missing)}; every joint of "
                "the hand needs one (<position joint=...>) to be simulated"
            )
        self.actuators = np.array([servo_of[name] for name in hand.joint_names])
        gear = model.actuator_gear[self.actuators, 0]
        self.ctrl_per_radian = gear.copy()
        self.stiffness = model.actuator_gainprm[self.actuators, 0] * gear**2
        servo = -model.actuator_biasprm[self.actuators, 2] * gear**2
        self.damping = servo + model.dof_damping[self.qvel_columns]
        limited = model.actuator_ctrllimited[self.actuators].astype(bool)
        ends = np.sort(model.actuator_ctrlrange[self.actuators] / gear[:, None], axis=1)
        self.lower = np.where(limited, np.maximum(hand.lower, ends[:, 0]), hand.lower)
        self.upper = np.where(limited, np.minimum(hand.upper, ends[:, 1]), hand.upper)

    def __repr__(self) -> str:
        return f"Scene({self.hand.name!r}, {self.object!r}, gravity={self.gravity.tolist()})"


def _touchable_bodies(spec: mujoco.MjSpec, hand: HandModel) -> tuple[str, ...]:
    """The bodies with collision geoms, fingertips apart; those without a name are given one."""
    found = []
    for i, body in enumerate(spec.bodies):
        if not body.name:
            body.name = f"body_{i}"
        if body.name in hand.fingertip_bodies or body.name == "world":
            continue
        if any(geom.contype or geom.conaffinity for geom in body.geoms):
            found.append(body.name)
    if any(geom.contype or geom.conaffinity for geom in spec.worldbody.geoms):
        found.append("world")
    return tuple(found)


def _free_name(spec: mujoco.MjSpec) -> str:
    """A name for the object that no body and no joint of the hand's file has."""
    name = "object"
    while spec.body(name) is not None or spec.joint(name) is not None:
        name = f"held_{name}"
    return name


def _meet_everything(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Let the object collide with every collision geom, whatever bits the hand's file uses."""
    bits = 1
    for geom in spec.geoms:
        bits |= int(geom.contype) | int(geom.conaffinity)
    for geom in body.geoms:
        geom.contype = geom.conaffinity = bits


def _object(
    name: str | None, mesh: str | Path | None, object_mesh: str | Path | None
) -> tuple[str, str | Path | None]:
    """The object's name, and its file where it is a mesh."""
    if mesh is not None and object_mesh is not None and Path(mesh) != Path(object_mesh):
        raise InvalidInput(f"mesh is {str(mesh)!r} and object_mesh {str(object_mesh)!r}; give one")
    file = object_mesh if mesh is None else mesh
    return (name or (MESH if mesh is not None else "cube")), file


def _posture(
    what: str,
    hand: HandModel,
    stated: Mapping[str, float],
    given: ArrayLike | Mapping[str, float] | None,
) -> Floats:
    """Joints ``(d,)`` given as an array, or by name, which goes before what the hand states."""
    if given is None or isinstance(given, Mapping):
        return hand.posture({**stated, **(given or {})})
    return hand.clip(checks.vector(what, given, hand.nq))


def _friction(friction: float | ArrayLike) -> tuple[float, float, float]:
    values = np.atleast_1d(np.asarray(friction, float))
    if values.shape not in ((1,), (3,)) or not np.all(np.isfinite(values) & (values >= 0)):
        raise InvalidInput(
            f"friction is {friction}; expected one number >= 0, or three (sliding, torsional, "
            "rolling)"
        )
    sliding, torsional, rolling = values if len(values) == 3 else (values[0], 0.005, 0.0001)
    return float(sliding), float(torsional), float(rolling)
