"""[train], [method.NAME] and [evaluation] of a sweep's file, as changes of configurations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from dexctl.exceptions import DexctlError, InvalidInput, UnknownName
from dexctl.settings import absolute, by_path, changed, get, paths
from learning.config import RECIPES, TrainConfig, recipe
from learning.evaluation.protocol import Protocol

C = TypeVar("C")

_DEFAULTS = {"env.scene.threads": 1}  # several runs share the machine
_ELSEWHERE = {"seed": "seeds", "controllers": "controllers", "guidance.method": "methods"}


class Changes(NamedTuple):
    """What [train] or [method.NAME] says.

    Attributes:
        recipe: its name; None where none is given.
        settings: of `TrainConfig`, by path.
    """

    recipe: str | None
    settings: Mapping[str, Any]


def changes(values: Mapping[str, Any], where: str) -> Changes:
    """What the table ``where``, [train] or [method.NAME], says."""
    named = values.get("recipe")
    if named is not None and (not isinstance(named, str) or named not in RECIPES):
        raise UnknownName(f"{where}.recipe", named, RECIPES)
    rest = {name: value for name, value in values.items() if name != "recipe"}
    found = by_path(TrainConfig, rest, where)
    for path, own in _ELSEWHERE.items():
        if path in found:
            raise InvalidInput(f"{where} has {path}, which the sweep says itself, as {own}")
    return Changes(named, found)


def train_config(
    parts: Sequence[Changes], method: str, names: tuple[str, ...], seed: int, folder: Path
) -> TrainConfig:
    """The configuration of one run.

    Args:
        parts: what changes the recipe, each before the one before it.
        method: of exploration.
        names: of the controllers.
        seed: of the run.
        folder: where files are meant from; runs are elsewhere.
    """
    named = [part.recipe for part in parts if part.recipe is not None]
    settings = dict(_DEFAULTS)
    for part in parts:
        settings |= part.settings
    base = recipe(named[-1] if named else "thesis", method)
    made = _changed(
        base, {**settings, "controllers": names, "seed": seed}, f"runs of {method}", folder
    )
    made.env.scene.check_objects(f"runs of {method}")
    return made


def protocol(values: Mapping[str, Any], trained: Sequence[TrainConfig], folder: Path) -> Protocol:
    """How all policies are evaluated: as they were trained, but undisturbed, where [evaluation]
    says nothing else.

    Args:
        values: the table [evaluation].
        trained: every run's configuration.
        folder: where files are meant from.
    """
    settings = by_path(Protocol, values, "evaluation")
    threads = trained[0].env.scene.threads
    made = []
    for env in dict.fromkeys(config.env for config in trained):
        scene = replace(env.scene.undisturbed(), threads=threads)
        made.append(_changed(Protocol(scene=scene, task=env.task), settings, "evaluation", folder))
    for path in paths(Protocol):
        found = list(dict.fromkeys(get(one, path) for one in made))
        if len(found) > 1:
            raise InvalidInput(
                f"runs are trained with {path} {found[0]} and {found[1]}, and all are evaluated "
                "alike; say which in [evaluation]"
            )
    made[0].scene.check_objects("evaluation")
    made[0].task.check_starts(made[0].scene.initial_states is not None)
    if made[0].seconds < made[0].scene.control_period:
        raise InvalidInput(
            f"evaluation.seconds is {made[0].seconds}; expected at least one control period of "
            f"{made[0].scene.control_period}"
        )
    return made[0]


def _changed(config: C, settings: Mapping[str, Any], where: str, folder: Path) -> C:
    """``config`` with settings, and with files as absolute paths."""
    try:
        made = changed(config, settings)
    except DexctlError as error:  # the configurations do not know the sweep's tables
        raise InvalidInput(f"{where}: {error}") from None
    return absolute(made, folder)
