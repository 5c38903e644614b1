"""Physical parameters of each environment: one MuJoCo model per environment, of one structure."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.sim.scene import Scene
from dexctl.state import Floats


def _friction(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    # MuJoCo takes the larger coefficient of the two geoms, so the fingertips' is set as well
    tips = [model.body(name).id for name in scene.hand.fingertip_bodies]
    bodies = [model.body(scene.object_body).id, *tips]
    model.geom_friction[np.isin(model.geom_bodyid, bodies), 0] = value


def _object_mass(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    body = model.body(scene.object_body).id
    ratio = value / scene.model.body_mass[body]
    model.body_inertia[body] = scene.model.body_inertia[body] * ratio
    model.body_mass[body] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))  # what follows from masses


def _kp(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    gear2 = scene.ctrl_per_radian**2
    model.actuator_gainprm[scene.actuators, 0] = value / gear2
    model.actuator_biasprm[scene.actuators, 1] = -value / gear2


def _kv(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    model.actuator_biasprm[scene.actuators, 2] = -value / scene.ctrl_per_radian**2


def _damping(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    model.dof_damping[scene.qvel_columns] = value


def _gear_friction(scene: Scene, model: mujoco.MjModel, value: float) -> None:
    model.dof_frictionloss[scene.qvel_columns] = value


_SETTERS: dict[str, tuple[Callable[[Scene, mujoco.MjModel, float], None], bool]] = {
    # name: (setter, whether zero is allowed)
    "friction": (_friction, True),
    "object_mass": (_object_mass, False),
    "kp": (_kp, False),
    "kv": (_kv, True),
    "damping": (_damping, True),
    "gear_friction": (_gear_friction, True),
}


def set_on(scene: Scene, parameters: Mapping[str, float]) -> None:
    """Give a scene itself other parameters, those of `ParameterSet`, before it is simulated.

    Raises:
        UnknownName, InvalidInput: no such parameter, or a value out of range.
    """
    for name, value in parameters.items():
        setter, _ = _SETTERS[name]
        setter(scene, scene.model, float(_checked(name, value, 1)[0]))
    scene.find_servos()


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
        """Parameters that were set, ``(N,)`` each."""
        return {name: value.copy() for name, value in self._values.items()}

    def set(self, parameters: Mapping[str, ArrayLike]) -> None:
        """Set some parameters; the others stay."""
        checked = {name: _checked(name, value, self._count) for name, value in parameters.items()}
        if not checked:
            return
        if self.models[0] is self._base:
            self.models = [copy.copy(self._base) for _ in range(self._count)]
        for name, values in checked.items():
            setter, _ = _SETTERS[name]
            for model, value in zip(self.models, values, strict=True):
                setter(self._scene, model, float(value))
        self._values.update(checked)

    def restore(self, values: dict[str, Floats]) -> None:
        """Exactly the parameters of `values`."""
        same = values.keys() == self._values.keys() and all(
            np.array_equal(values[name], self._values[name]) for name in values
        )
        if not same:
            self.models, self._values = [self._base] * self._count, {}
            self.set(values)


def _checked(name: str, value: ArrayLike, count: int) -> Floats:
    if name not in _SETTERS:
        raise UnknownName("parameter", name, _SETTERS)
    values = np.asarray(value, float)
    if values.shape not in ((), (count,)):
        raise InvalidInput(
            f"{name} has shape {values.shape}; expected () or ({count},), one for each environment"
        )
    zero = _SETTERS[name][1]
    good = np.isfinite(values) & ((values >= 0) if zero else (values > 0))
    if not good.all():
        bad = np.atleast_1d(values)[~np.atleast_1d(good)][0]
        bound = ">= 0" if zero else "> 0"
        raise InvalidInput(f"{name} is {bad}; expected finite numbers {bound}")
    return np.broadcast_to(values, (count,)).copy()
