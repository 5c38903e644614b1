"""What a hand's file says of the simulation itself: taken back, so that it is dexctl's own."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.exceptions import SimulationError
from dexctl.hand import HandModel

TIMESTEP = 0.005
"""Of the physics, unless the simulator is given another [s]."""
# What differs from MuJoCo's defaults among the options; a file has no say in any of them. With an
# impratio of 10 fingertips creep along the object by up to a millimetre a second under its weight.
_OPTIONS = {
    "timestep": TIMESTEP,
    "integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "cone": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "impratio": 100.0,
}
_SIZES = ("memory", "njmax", "nconmax", "nemax", "nstack", "nuserdata")


def lean_model(spec: mujoco.MjSpec, hand: HandModel) -> mujoco.MjModel:
    """The compiled model without what is only seen; the spec stays as it is.

    Raises:
        SimulationError: MuJoCo cannot compile it.
    """
    lean = spec.copy()  # compiling removes what is discarded from the spec itself
    lean.compiler.discardvisual = True
    return _compiled(lean, hand)


def _compiled(spec: mujoco.MjSpec, hand: HandModel) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        why = " ".join(str(error).split())
        raise SimulationError(f"{hand.path}: MuJoCo cannot compile the scene: {why}") from None


def own_options(spec: mujoco.MjSpec) -> None:
    """Give a spec dexctl's own simulation options, every one of them, and sizes without limits."""
    fresh = mujoco.MjSpec()
    for name in dir(fresh.option):
        if not name.startswith("_"):
            setattr(spec.option, name, _OPTIONS.get(name, getattr(fresh.option, name)))
    for name in _SIZES:
        setattr(spec, name, getattr(fresh, name))


TWISTING = 4  # condim: contacts resist sliding and twisting; of the object's, and so of the tips'
_LIMITS = ("solref_limit", "solimp_limit", "solref_friction", "solimp_friction", "margin")
_SOFTNESS = {
    "geom": ("solref", "solimp", "solmix", "margin", "gap"),
    "pair": ("solref", "solreffriction", "solimp", "margin", "gap"),
    "joint": _LIMITS,
    "tendon": _LIMITS,
}


def own_contacts(spec: mujoco.MjSpec) -> None:
    """Give contacts and limits the softness, and the distance, that MuJoCo has where nobody says.

    The constants that a file says were chosen for its own timestep and solver: contacts stiffer
    than the timestep can follow make forces jump from step to step, and grasps let go. A geom's
    ``priority`` stays, with which its friction counts alone; it may not make contacts with the
    object frictionless, or free to twist, by the way.
    """
    fresh = mujoco.MjSpec().default
    for kind, names in _SOFTNESS.items():
        usual = getattr(fresh, kind)
        for one in getattr(spec, f"{kind}s"):
            for name in names:
                setattr(one, name, getattr(usual, name))
    for geom in spec.geoms:
        if geom.priority > 0:
            geom.condim = max(geom.condim, TWISTING)


_MASS_SETTINGS = ("settotalmass", "boundmass", "boundinertia", "inertiafromgeom")


def settle_masses(spec: mujoco.MjSpec, hand: HandModel) -> None:
    """Write masses into the bodies where the compiler would make them up for our object too."""
    fresh = mujoco.MjSpec().compiler
    groups = fresh.inertiagrouprange.copy()
    same = all(getattr(spec.compiler, n) == getattr(fresh, n) for n in _MASS_SETTINGS)
    if same and np.array_equal(spec.compiler.inertiagrouprange, groups):
        return
    model = lean_model(spec, hand)
    for body in spec.bodies[1:]:
        i = model.body(body.name).id
        body.explicitinertial, body.mass = True, model.body_mass[i]
        body.ipos, body.iquat = model.body_ipos[i], model.body_iquat[i]
        body.inertia = model.body_inertia[i]
        body.fullinertia = np.full(6, np.nan)
    for name in _MASS_SETTINGS:
        setattr(spec.compiler, name, getattr(fresh, name))
    spec.compiler.inertiagrouprange = groups


_KINDS = ("geom", "joint", "actuator", "equality", "mesh", "material", "light", "camera")
_NO_VALUES = (
    "alt",
    "classname",
    "compiler",
    "frame",
    "id",
    "info",
    "parent",
    "plugin",
    "signature",
)


def plain_defaults(spec: mujoco.MjSpec) -> None:
    """Make MuJoCo's defaults those of all that is added from now on; what is there has its own."""
    fresh = mujoco.MjSpec()
    for kind in _KINDS:
        theirs, ours = getattr(spec.default, kind), getattr(fresh.default, kind)
        for name in dir(ours):
            if name.startswith("_") or name in _NO_VALUES:
                continue
            value = getattr(ours, name)
            choice = hasattr(type(value), "__members__")
            if choice or isinstance(value, (int, float, np.ndarray)):
                setattr(theirs, name, value)
    spec.default.geom.material = ""
