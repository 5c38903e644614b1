"""What only critics observe: velocity, forces, encoders' offsets, what an episode drew."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dexctl.sim.randomisation import Drawn
from dexctl.sim.simulation import Simulation
from dexctl.state import Floats, GraspState
from dexctl.symmetry import HandSymmetry
from learning.envs.observation import DRAWN, FINGERTIP_FORCE, JOINT_OFFSET, OBJECT_VELOCITY, Part

# what brings each to about unit size, from the value where nothing is drawn
_SCALES = {
    "friction": 0.5,  # [1]
    "object_mass": 0.1,  # [kg]
    "object_size": 0.1,  # [1]
    "centre_of_mass": 0.005,  # [m]
    "gear_friction": 0.02,  # [N m]
    "gravity_turning": 0.5,  # [rad/s]
    "speed_limit": 1.0,  # [rad/s]
    "torque_limit": 0.5,  # [N m]
    "action_latency": 0.05,  # [s]
    "noise": 1.0,  # [1]
    "sensor_latency": 0.05,  # [s]
    "touch_threshold": 0.5,  # [N]
    "touch_dropout": 0.1,  # [1]
    "push_force": 0.5,  # [N]
    "tip_friction": 0.3,  # [1]
    "link_friction": 0.3,  # [1]
}
_SHARES = ("kp", "kv", "damping")  # of what they usually are, by tenths
_JOINTS = (*_SHARES, "gear_friction")  # of which each joint has its own
_FINGERS = ("touch_threshold", "tip_friction")  # of which each finger has its own
_SURFACES = ("tip_friction", "link_friction")
"""Seen only where one of them is drawn: networks from before they were there keep their widths."""


def truth_parts(simulation: Simulation) -> Mapping[str, Part]:
    """The parts of `TRUTH`: of the simulation itself, which no sensor tells.

    The object's velocity ``(N, 6)`` [m/s, rad/s] and the net force of each fingertip on it
    ``(N, 3 m)`` [N], in the world's frame (both in the thesis's critic, chapter 5); what the
    encoders read at zero ``(N, d)`` [rad]; and what holds in each episode, as deviations from what
    usually does. Gravity and the offsets are parts of their own there, the motors' inertia is left
    out, and a limit that there is not counts as not deviating. The friction of fingertips and
    links is at the end, where one of them is drawn.
    """
    sim, usual = simulation.sim, simulation.randomiser.usual
    surfaces = simulation.config.randomisation.draws_surfaces
    size = features(usual, usual, surfaces=surfaces).shape[1]

    def drawn(state: GraspState) -> Floats:
        return features(simulation.randomiser.drawn, usual, surfaces=surfaces)

    return {
        DRAWN: Part(lambda d, m: size, drawn),
        OBJECT_VELOCITY: Part(lambda d, m: 6, lambda state: sim.object_velocity),
        FINGERTIP_FORCE: Part(lambda d, m: 3 * m, lambda state: sim.fingertip_force),
        JOINT_OFFSET: Part(lambda d, m: d, lambda state: simulation.joint_offset),
    }


def features(drawn: Drawn, usual: Drawn, *, surfaces: bool = False) -> Floats:
    """``(N, k)`` numbers of about unit size; ``surfaces``: with the friction of tips and links."""
    found = []
    with np.errstate(invalid="ignore"):
        for name in _seen(Drawn._fields, surfaces=surfaces):
            value, nominal = getattr(drawn, name), getattr(usual, name)
            if name in _SHARES:
                part = (value / np.where(nominal > 0, nominal, 1.0) - 1.0) * (nominal > 0) / 0.3
            else:
                nominal = np.where(np.isfinite(nominal), nominal, 0.0)
                part = np.where(np.isfinite(value), (value - nominal) / _SCALES[name], 0.0)
            found.append(part.reshape(len(value), -1))
    return np.concatenate(found, axis=1)


def turned_features(one: HandSymmetry, values: Floats) -> Floats:
    """`features` ``(N, k)`` of the hands that a symmetry makes of those with ``values``.

    Single numbers stay. What a joint or a finger has goes to the one that it comes to, without a
    sign, which gains do not have.
    """
    d, m = len(one.joints), len(one.fingers)
    sizes = dict.fromkeys(_JOINTS, d) | dict.fromkeys(_FINGERS, m)
    sizes |= {"centre_of_mass": 3, "gravity_turning": 3}
    found, start = values.copy(), 0
    known = sum(sizes.get(name, 1) for name in _seen(Drawn._fields))
    for name in _seen(Drawn._fields, surfaces=values.shape[1] > known):
        columns = slice(start, start + sizes.get(name, 1))
        start, part = columns.stop, values[:, columns]
        if name in _JOINTS:
            found[:, columns][:, one.joints] = part
        elif name in _FINGERS:
            found[:, columns] = one.of_fingers(part)
        elif name == "gravity_turning":
            found[:, columns] = one.of_turnings(part)
        elif name == "centre_of_mass" and one.mirrors:  # in the object's frame, which turns along
            found[:, columns] = part * [1.0, -1.0, 1.0]
    return found


def _seen(names: Iterable[str], *, surfaces: bool = False) -> list[str]:
    """Which of `Drawn` critics see, in their order."""
    seen = [name for name in names if name in _SHARES or name in _SCALES]
    return [name for name in seen if surfaces or name not in _SURFACES]
