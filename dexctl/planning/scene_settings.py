"""Which settings of a `SceneConfig` planning uses, and which it would ignore."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from dexctl.exceptions import InvalidInput
from dexctl.settings import differing, get
from dexctl.sim import SceneConfig

PHYSICS = (
    "object_friction", "stiffness", "damping", "gear_friction", "control_period", "substeps",
)  # fmt: skip
"""Settings on which it depends whether a grasp holds, beside those that a tree's header names."""
USED = (
    "hand", "object", "object_size", "object_mass", "object_mesh", "gravity", "threads", *PHYSICS,
)  # fmt: skip


class Stepping(NamedTuple):
    """How the physics of a plan is stepped.

    Attributes:
        control_period: time of one control step [s].
        substeps: physics steps in it.
    """

    control_period: float
    substeps: int

    @classmethod
    def of(cls, scene: SceneConfig | Mapping[str, Any] | None) -> Stepping:
        """As a configuration says, or its plain values; None: by default."""
        if isinstance(scene, SceneConfig):
            return cls(scene.control_period, scene.substeps)
        usual, known = SceneConfig(), scene or {}
        return cls(*(known.get(name, getattr(usual, name)) for name in cls._fields))


def used_of(config: SceneConfig, name: str) -> SceneConfig:
    """The settings of ``config`` that planning uses, for the object ``name`` alone."""
    used = {each: getattr(config, each) for each in USED}
    return SceneConfig(**{**used, "object": (name,)})


def check_used(config: SceneConfig) -> None:
    """Raise InvalidInput where a setting is not as by default that planning would ignore.

    It begins at the settled grasp and plans with the hand as it is, exactly known.
    """
    usual = SceneConfig()
    for path in differing(config, usual):
        if path not in USED:
            option, value = path.rpartition(".")[2].replace("_", "-"), get(config, path)
            raise InvalidInput(
                f"--{option} is {value}; planning does not use it, expected its default, "
                f"{get(usual, path)}"
            )
