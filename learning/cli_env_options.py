"""Options of the environments for `dexctl train`, those that have no flag of their own there."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl.cli.parsing import parse_vector
from learning.envs.observation import DEFAULT_PARTS

if TYPE_CHECKING:
    from learning.envs import EnvConfig


@dataclass(kw_only=True)
class EnvOptions:
    """What the environments are beside hand, object, palm and length of an episode."""

    axis: str = "z"
    """Hand axis to turn the object about, controllers too: x, y, z or a vector as x,y,z."""
    parts: tuple[str, ...] = DEFAULT_PARTS
    """Of the observation, in this order; also: touch, object_position, object_quaternion."""
    joint_noise: float = 0.0
    """Of observed joint positions, standard deviation [rad]."""
    position_noise: float = 0.0
    """Of each observed contact coordinate [m]."""
    normal_noise: float = 0.0
    """Of each coordinate of observed unit normals."""
    force_noise: float = 0.0
    """Of observed forces, as a share of the force."""
    latency: float = 0.0
    """How old what is observed is, rounded to control steps [s]."""
    push_force: float = 0.0
    """Size of the force that pulls at the object [N]."""
    push_seconds: float = 1.0
    """How long it pulls into one direction [s]."""
    initial_states: Path | None = None
    """File of states that episodes start from; by default the settled grasp."""
    disturbance: float = 0.02
    """Of the set-points at the start, standard deviation [rad]."""
    object_size: float | None = None
    """Width of the object [m]; by default what suits the hand."""
    object_mass: float = 0.1
    """[kg]."""
    max_reward: float = 0.5
    """Angular velocity beyond which the reward grows no more [rad/s]."""
    max_tilt: float = 0.5
    """Tilt of the object up to which turning is rewarded [rad]."""
    min_fingertips: int = 3
    """That must touch for turning to be rewarded."""
    drop_distance: float = 0.05
    """An episode ends when the object is this far from where it started [m]."""
    max_speed: float = 2.0
    """Of set-points, what an action of 1 means [rad/s]."""
    max_lead: float = 0.25
    """Set-points stay this close to the measured joints [rad]."""
    control_period: float = 0.05
    """Time of one step [s]."""
    substeps: int = 10
    """Physics steps in it."""
    threads: int | None = None
    """Of the physics; by default every core."""

    def config(self, **options: Any) -> EnvConfig:
        """The configuration of these options, and of ``options``, which have their own flags.

        Raises:
            UnknownName, InvalidInput: a setting is wrong.
        """
        from learning.envs import EnvConfig, InitialStates

        own = {field.name: getattr(self, field.name) for field in fields(self)}
        own["axis"] = parse_vector("--env.axis", self.axis)
        if self.initial_states is not None:
            path = self.initial_states.expanduser().resolve()  # resumed from another folder, too
            InitialStates.load(path)
            own["initial_states"] = str(path)
        return EnvConfig(**own | options)
