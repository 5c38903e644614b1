"""Whether grasps that episodes are to begin in hold at all."""

from __future__ import annotations

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.planning.starts import begins_under_another
from dexctl.sim import Simulation
from learning.starts.base import Remark

_SECONDS = 0.5
_FAR = 0.02  # an object that has moved so far by then is not held [m]
_FEWEST = 0.5  # share that has to hold


def check_starts(simulation: Simulation, remark: Remark) -> None:
    """Hold the set-points of one start in each environment, as noisy as episodes begin.

    A tree of another gravity, size or hand's stiffness has grasps that fall at once; it says so
    before hours of training on them. The environments are left where they are.

    Args:
        simulation: the environments, with states to start from.
        remark: called where a tenth or more do not hold, and where they were planned under another
            gravity, which may well hold them all the same.

    Raises:
        InvalidInput: most of them do not hold.
    """
    _remark_on_gravity(simulation, remark)
    held, said = _held(simulation)
    if held < _FEWEST * simulation.num_envs:
        raise InvalidInput(f"{said}; expected grasps of this very scene, as `dexctl plan` finds")
    if said:
        remark(said)


def remark_on_starts(simulation: Simulation, remark: Remark) -> None:
    """As `check_starts`, where none is refused: those of a policy's gait may be caught by it."""
    _remark_on_gravity(simulation, remark)
    _, said = _held(simulation)
    if said:
        remark(said)


def _remark_on_gravity(simulation: Simulation, remark: Remark) -> None:
    if said := begins_under_another(simulation):
        remark(said)


def _held(simulation: Simulation) -> tuple[int, str]:
    """How many hold; and where a tenth or more do not, a line that says so."""
    config = simulation.config
    simulation.reset()
    sim, target = simulation.sim, simulation.state.q_target
    for _ in range(max(1, round(_SECONDS / simulation.control_period))):
        simulation.write(target)
        simulation.step()
    position = simulation.state.object_position
    assert position is not None
    away = np.linalg.norm(position - sim.start_position, axis=-1)
    held = int((~simulation.diverged & (away <= _FAR)).sum())
    count = simulation.num_envs
    said = (
        f"{count - held} of {count} starts do not hold for {_SECONDS:g} s with "
        f"{config.hand_name}, {', '.join(config.object)}, {config.palm}"
    )
    return held, said if held <= 0.9 * count else ""
