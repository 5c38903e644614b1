"""Physical parameters of each environment: one MuJoCo model per environment, of one structure."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.sim.scene import Scene
from dexctl.state import Bools, Floats

Row = Mapping[str, Floats]
"""The parameters of one environment that were set, by name."""


def _friction(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    body = model.geom_bodyid
    sliding = scene.model.geom_friction[:, 0].copy()
    own = body == model.body(scene.object_body).id
    tips = [body == model.body(name).id for name in scene.hand.fingertip_bodies]
    if "friction" in row:
        # MuJoCo takes the larger coefficient of the two geoms, so the fingertips' is set as well
        sliding[own | np.any(tips, axis=0)] = row["friction"]
    if "tip_friction" in row or "link_friction" in row:
        share = np.full(len(sliding), row.get("link_friction", 1.0))
        for tip, of_tip in zip(tips, row.get("tip_friction", np.ones(len(tips))), strict=True):
            share[tip] = of_tip
        sliding = _shared(scene, model, sliding, own, share)
    model.geom_friction[:, 0] = sliding


def _shared(
    scene: Scene, model: mujoco.MjModel, sliding: Floats, own: Bools, share: Floats
) -> Floats:
    """Coefficients of all geoms by which each meets the object with its share of what it had.

    The object gets the least of what is wanted, if that is less than it has. As the larger of two
    counts, each other geom then decides by its own; one that wants no more stays as it is.
    """
    priority, objects = scene.model.geom_priority, sliding[own].max()
    usual = priority[own].max()
    first, last = priority > usual, priority < usual  # whose coefficient counts alone, or never
    met = np.where(first, sliding, np.where(last, objects, np.maximum(sliding, objects)))
    wanted = met * share
    least = min(wanted[~own].min(), objects)
    model.geom_priority[:] = np.maximum(priority, usual)  # or it would never count here either
    found = np.where(first | (wanted > least), wanted, np.minimum(sliding, least))
    return np.where(own, least, found)


def _object(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    """Size, mass and centre of mass of the object.

    The body's frame is its centre of mass, which MuJoCo's fast paths take for granted once it was
    compiled so: instead of that centre, the shape is shifted.
    """
    base, body = scene.model, model.body(scene.object_body).id
    size = row.get("object_size", 1.0)
    shift = -row.get("centre_of_mass", np.zeros(3))
    ratio = row.get("object_mass", base.body_mass[body]) / base.body_mass[body]
    model.body_mass[body] = base.body_mass[body] * ratio
    model.body_inertia[body] = base.body_inertia[body] * ratio * size**2
    own = base.geom_bodyid == body
    model.geom_size[own] = base.geom_size[own] * size
    model.geom_rbound[own] = base.geom_rbound[own] * size
    model.geom_aabb[own] = base.geom_aabb[own] * size
    model.geom_pos[own] = base.geom_pos[own] * size + shift
    if shift.any():
        model.geom_sameframe[own] = 0
    boxes = slice(base.body_bvhadr[body], base.body_bvhadr[body] + base.body_bvhnum[body])
    model.bvh_aabb[boxes] = base.bvh_aabb[boxes] * size
    model.bvh_aabb[boxes, :3] += shift
    for mesh in {int(mesh) for mesh in base.geom_dataid[own] if mesh >= 0}:
        corners = slice(base.mesh_vertadr[mesh], base.mesh_vertadr[mesh] + base.mesh_vertnum[mesh])
        model.mesh_vert[corners] = base.mesh_vert[corners] * size
        leaves = slice(base.mesh_bvhadr[mesh], base.mesh_bvhadr[mesh] + base.mesh_bvhnum[mesh])
        model.bvh_aabb[leaves] = base.bvh_aabb[leaves] * size


def _stiffness(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    gear2 = scene.ctrl_per_radian**2
    model.actuator_gainprm[scene.actuators, 0] = row["kp"] / gear2
    model.actuator_biasprm[scene.actuators, 1] = -row["kp"] / gear2


def _servo_damping(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    model.actuator_biasprm[scene.actuators, 2] = -row["kv"] / scene.ctrl_per_radian**2


def _damping(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    model.dof_damping[scene.qvel_columns] = row["damping"]


def _gear_friction(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    model.dof_frictionloss[scene.qvel_columns] = row["gear_friction"]


def _armature(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    model.dof_armature[scene.qvel_columns] = row["armature"]


def _gravity(scene: Scene, model: mujoco.MjModel, row: Row) -> None:
    model.opt.gravity[:] = row["gravity"]


class Parameter(NamedTuple):
    """One parameter.

    Attributes:
        apply: puts it into a model, with whatever else of the same thing was set.
        per: "joint", "finger", "axis" (three coordinates), or "" for one number.
        least: what its numbers are not below; not at either where ``positive``.
        positive: see there.
        constants: whether MuJoCo derives constants from it.
    """

    apply: Callable[[Scene, mujoco.MjModel, Row], None]
    per: str = ""
    least: float = 0.0
    positive: bool = False
    constants: bool = False


PARAMETERS: dict[str, Parameter] = {
    "friction": Parameter(_friction),
    "tip_friction": Parameter(_friction, per="finger"),
    "link_friction": Parameter(_friction),
    "object_mass": Parameter(_object, positive=True, constants=True),
    "object_size": Parameter(_object, positive=True, constants=True),
    "centre_of_mass": Parameter(_object, per="axis", least=-np.inf),
    "kp": Parameter(_stiffness, per="joint", positive=True),
    "kv": Parameter(_servo_damping, per="joint"),
    "damping": Parameter(_damping, per="joint"),
    "gear_friction": Parameter(_gear_friction, per="joint"),
    "armature": Parameter(_armature, per="joint", constants=True),
    "gravity": Parameter(_gravity, per="axis", least=-np.inf),
}


def set_on(scene: Scene, parameters: Mapping[str, ArrayLike]) -> None:
    """Give a scene itself other parameters, those of `PARAMETERS`, before it is simulated.

    Values are numbers, or ``(1, d)`` for those that are of joints, ``(1, m)`` of fingers.

    Raises:
        UnknownName, InvalidInput: no such parameter, or a value out of range.
    """
    row = {name: _checked(scene, name, value, 1)[0] for name, value in parameters.items()}
    _apply(scene, scene.model, row, row)
    scene.find_servos()


def _apply(scene: Scene, model: mujoco.MjModel, row: Row, names: Mapping[str, object]) -> None:
    for setter in {PARAMETERS[name].apply: None for name in names}:
        setter(scene, model, row)
    if any(PARAMETERS[name].constants for name in names):
        mujoco.mj_setConst(model, mujoco.MjData(model))


class ParameterSet:
    """The models that a batch is stepped with: one for all until parameters differ."""

    def __init__(self, scene: Scene, count: int, timestep: float) -> None:
        self._scene, self._count = scene, count
        self._base = copy.copy(scene.model)
        self._base.opt.timestep = timestep
        self._values: dict[str, Floats] = {}
        self.models = [self._base] * count

    @property
    def values(self) -> dict[str, Floats]:
        """Parameters that were set, ``(N,)`` or a row for each environment; NaN: as the scene."""
        return {name: value.copy() for name, value in self._values.items()}

    def has(self, name: str) -> bool:
        """Whether a parameter was set in any environment."""
        return name in self._values

    def value(self, name: str, default: Floats) -> Floats:
        """A parameter of every environment, ``default`` where it was not set."""
        if name not in self._values:
            return np.tile(default, (self._count, *(1,) * np.ndim(default)))
        return np.where(np.isnan(self._values[name]), default, self._values[name])

    def set(self, parameters: Mapping[str, ArrayLike], chosen: Bools | None = None) -> None:
        """Set some parameters, in the environments chosen ``(N,)``; the others stay."""
        checked = {
            name: _checked(self._scene, name, value, self._count)
            for name, value in parameters.items()
        }
        if not checked or (chosen is not None and not chosen.any()):
            return
        if self.models[0] is self._base:
            self.models = [copy.copy(self._base) for _ in range(self._count)]
        for name, values in checked.items():
            before = self._values.get(name, np.full(values.shape, np.nan))
            rows = np.ones(self._count, bool) if chosen is None else chosen
            where = rows.reshape(-1, *(1,) * (values.ndim - 1))
            self._values[name] = np.where(where, values, before)
        for i in range(self._count) if chosen is None else np.flatnonzero(chosen):
            _apply(self._scene, self.models[i], self._row(int(i)), checked)

    def _row(self, i: int) -> Row:
        return {name: v[i] for name, v in self._values.items() if not np.isnan(v[i]).any()}

    def restore(self, values: dict[str, Floats]) -> None:
        """Exactly the parameters of `values`."""
        same = values.keys() == self._values.keys() and all(
            np.array_equal(values[name], self._values[name], equal_nan=True) for name in values
        )
        if same:
            return
        self._values = {name: np.asarray(value, float).copy() for name, value in values.items()}
        self.models = [self._base] * self._count
        if not values:
            return
        self.models = [copy.copy(self._base) for _ in range(self._count)]
        for i, model in enumerate(self.models):
            row = self._row(i)
            _apply(self._scene, model, row, row)


def _checked(scene: Scene, name: str, value: ArrayLike, count: int) -> Floats:
    """``value`` as a row or number for each environment."""
    if name not in PARAMETERS:
        raise UnknownName("parameter", name, PARAMETERS)
    parameter = PARAMETERS[name]
    try:
        values = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InvalidInput(f"{name} is {value!r}; expected numbers") from None
    hand = scene.hand
    width = {"": (), "joint": (hand.nq,), "finger": (hand.n_fingers,), "axis": (3,)}[parameter.per]
    shapes = [(count, 3)] if parameter.per == "axis" else [(), (count,), (count, *width)]
    if values.shape not in shapes:
        known = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        raise InvalidInput(
            f"{name} has shape {values.shape}; expected {known}, one for each environment"
        )
    good = np.isfinite(values) & (values >= parameter.least)
    if parameter.positive:
        good &= values > parameter.least
    if not good.all():
        bad = np.atleast_1d(values)[~np.atleast_1d(good)].flat[0]
        sign = ">" if parameter.positive else ">="
        bound = f" {sign} {parameter.least:g}" if np.isfinite(parameter.least) else ""
        raise InvalidInput(f"{name} is {bad}; expected finite numbers{bound}")
    if parameter.per in ("joint", "finger") and values.ndim == 1:  # one number for all of them
        values = values[:, None]
    return np.broadcast_to(values, (count, *width)).copy()
