"""EnvConfig: everything that decides what an environment is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from dexctl.exceptions import InvalidInput
from dexctl.settings import NESTED
from dexctl.sim.scene_config import SceneConfig
from dexctl.validation import check_numbers, check_whole
from learning.envs.history import check_steps
from learning.envs.observation import (
    DEFAULT_PARTS,
    ORIENTATIONS,
    TRUTH,
    TURNING,
    check_names,
    check_parts,
)
from learning.envs.tasks import NO_GOALS, TaskConfig


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Settings of an environment: what is simulated, what it is for, what is seen and done.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    scene: Annotated[SceneConfig, NESTED] = SceneConfig()
    task: Annotated[TaskConfig, NESTED] = TaskConfig()
    episode_steps: int = 1000
    """Control steps until an episode is truncated."""
    max_speed: float = 2.0
    """Speed of the set-points that an action of 1 asks for [rad/s]."""
    max_lead: float = 0.25
    """Set-points are kept this close to the measured joints [rad]."""
    parts: tuple[str, ...] = DEFAULT_PARTS
    """What the policy observes, in this order; touch, gravity, object_position, object_quaternion,
    object_rotation, goal_quaternion, goal_rotation and goal_angular_velocity may be added."""
    history: tuple[int, ...] = ()
    """What the policy observed so many control steps ago is observed beside it: 1 4, say."""
    critic_parts: tuple[str, ...] = ()
    """What the critics observe beside it, without noise: any of these parts, and object_velocity,
    fingertip_force (net force of each on the object), joint_offset (what encoders read at zero) and
    drawn (what randomisation drew for the episode). The thesis has nothing here with SAC; with PPO,
    object_position, object_quaternion, object_velocity and fingertip_force."""
    scaled: bool = False
    """Whether observations are brought to about unit size; the thesis has them in SI units."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("max_speed", "max_lead"))
        check_whole(self, episode_steps=1)
        check_parts(self.parts)
        check_steps(self.history)
        seen = (*self.parts, *self.critic_parts)
        if self.critic_parts:
            check_names(self.critic_parts, "critic_parts")
        check_parts(list(dict.fromkeys(name for name in seen if name not in TRUTH)))
        self._check_goals(seen)

    def _check_goals(self, seen: tuple[str, ...]) -> None:
        """Whoever is to reach goals must see them; and nobody sees those that there are not."""
        goals = self.task.goals
        for name in seen:
            if name in (ORIENTATIONS if goals == NO_GOALS else (TURNING,)):
                raise InvalidInput(f"parts has {name}, and goals is {goals!r}, where there is none")
        self.task.check_told(self.parts)
