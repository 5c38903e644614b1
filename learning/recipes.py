"""Recipes: training settings that belong together, by name.

"thesis" changes nothing: the defaults of `learning.settings.TrainConfig` are the thesis's method,
with numbers of ours where it gives none. "fast" is what made policies gait within a million steps;
docs/learning.md says what each part of it brings.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from dexctl.exceptions import UnknownName

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Recipe(NamedTuple):
    """Settings by the class that they are of.

    Attributes:
        env: of `learning.envs.EnvConfig`.
        guidance: of `learning.exploration.GuidanceConfig`.
        training: of `learning.settings.TrainConfig`.
    """

    env: Mapping[str, Any] = _NOTHING
    guidance: Mapping[str, Any] = _NOTHING
    training: Mapping[str, Any] = _NOTHING


RECIPES: Mapping[str, Recipe] = {
    "thesis": Recipe(),
    "fast": Recipe(
        env={"scaled": True},
        guidance={
            "cloned": "visited",
            "cloning": "squared",
            "cloning_weight": "equal",
            "beta": 10.0,
            "hard_stop": 500_000,
        },
        training={
            "critic_parts": ("object_position", "object_quaternion"),
            "layer_norm": True,
            "n_step": 5,
            "learning_rate": 1e-3,
            "learning_rate_end": 1e-4,
            "policy_average": 0.999,
            "tau": 0.02,
        },
    ),
}


def recipe(name: str, method: str = "vge+bc") -> Recipe:
    """The recipe ``name`` for a method; settings that the method has no use for are left out.

    Raises:
        UnknownName: no such recipe.
    """
    if not isinstance(name, str) or name not in RECIPES:
        raise UnknownName("recipe", name, RECIPES)
    found = RECIPES[name]
    if method.endswith("+bc"):
        return found
    cloning = ("cloned", "cloning", "cloning_weight", "beta")
    return found._replace(guidance={k: v for k, v in found.guidance.items() if k not in cloning})
