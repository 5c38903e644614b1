"""From a sweep's file to what it means; what is wrong with it is named in one line.

A file names methods, controllers and seeds; ``[train]`` changes `TrainConfig`, and
``[method.NAME]`` does so for one method, which may have ``controllers`` and ``seeds`` of its own;
``[evaluation]`` changes `Protocol`, and ``[criterion]`` says what counts. ``examples/sweep.toml``
is one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dexctl import controllers
from dexctl.exceptions import InvalidInput, UnknownName
from learning.config import TrainConfig
from learning.exploration.config import METHODS, check_controllers
from learning.sweep import tables
from learning.sweep.config import Criterion, PlannedRun, SweepConfig

_TOP = ("name", "methods", "controllers", "seeds", "train", "method", "evaluation", "criterion")


def load_sweep(path: Path, *, seed: int = 0, steps: int | None = None) -> SweepConfig:
    """Read a file.

    Args:
        path: TOML.
        seed, steps: see `parse_sweep`.

    Raises:
        UnknownName, InvalidInput: it is not right; one line that says what.
    """
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path} is not TOML: {error}") from None
    return parse_sweep({"name": path.stem, **given}, path.parent, seed=seed, steps=steps)


def parse_sweep(
    given: Mapping[str, Any],
    folder: Path = Path(),
    *,
    seed: int = 0,
    steps: int | None = None,
) -> SweepConfig:
    """The sweep that a mapping, as TOML gives it, describes.

    Args:
        given: the mapping.
        folder: that files in it are meant from.
        seed: added to every seed in it.
        steps: environment steps of each run, in place of those in it.

    Raises:
        UnknownName, InvalidInput: it is not right.
    """
    for key in given:
        if key not in _TOP:
            raise UnknownName("setting of sweep", key, _TOP)
    if seed < 0:
        raise InvalidInput(f"--seed is {seed}; expected a whole number from 0 on")
    name = given.get("name", "sweep")
    if not isinstance(name, str):
        raise InvalidInput(f"name is {name!r}; expected a text")
    methods = _methods(given)
    overrides = _table(given, "method")
    for method in overrides:
        if method not in METHODS:
            raise UnknownName("method", method, METHODS)
        if method not in methods:
            raise InvalidInput(f"[method.{method}] is given; methods are {', '.join(methods)}")
    base = tables.changes(_table(given, "train"), "train")
    last = tables.Changes(None, {} if steps is None else {"steps": steps})
    plan: list[list[TrainConfig]] = []
    for method in methods:
        over = dict(_table(overrides, method, f"method.{method}"))
        groups = _groups(over.pop("controllers", given.get("controllers", [])))
        seeds = _seeds(over.pop("seeds", given.get("seeds", 1)))
        parts = (base, tables.changes(over, f"method.{method}"), last)
        plan += [
            [tables.train_config(parts, method, group, seed + k, folder) for k in seeds]
            for group in _rows(method, groups)
        ]
    runs = tuple(PlannedRun(config) for config in _seeds_first(plan))
    criterion = Criterion.from_dict(_table(given, "criterion"))
    evaluation = dict(_table(given, "evaluation"))
    compared = _compared(evaluation.pop("controllers", []))
    if criterion.rotation is None:
        compared += [name for made in plan for name in made[0].guide_names]
        if not compared:
            raise InvalidInput('criterion.rotation is "guide", and no controllers are in the sweep')
    return SweepConfig(
        name=name,
        runs=runs,
        protocol=tables.protocol(evaluation, [run.config for run in runs], folder),
        compared=tuple(dict.fromkeys(compared)),
        criterion=criterion,
        given=given,
    )


def _methods(given: Mapping[str, Any]) -> list[str]:
    methods = given.get("methods")
    if not isinstance(methods, list) or not methods:
        found = f"methods is {methods!r}" if "methods" in given else "methods is not given"
        raise InvalidInput(f"{found}; expected a list of {', '.join(METHODS)}")
    for method in methods:
        if method not in METHODS:
            raise UnknownName("method", method, METHODS)
    _check_different("methods", methods)
    return methods


def _rows(method: str, groups: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The controllers of each row of a method."""
    if method == "rl":
        return [()]
    if not groups:
        raise InvalidInput(
            f"method {method!r} has no controllers; expected some of "
            f"{', '.join(controllers.names())}"
        )
    for group in groups:
        check_controllers(method, group)
    return groups


def _compared(values: Any) -> list[str]:
    groups = _groups(values, "evaluation.controllers")
    for group in groups:
        if len(group) > 1:
            raise InvalidInput(
                f"evaluation.controllers has {list(group)}; each is evaluated by itself"
            )
    return [name for group in groups for name in group]


def _seeds_first(plan: list[list[TrainConfig]]) -> Iterator[TrainConfig]:
    for k in range(max(map(len, plan))):
        for made in plan:
            if k < len(made):
                yield made[k]


def _table(values: Mapping[str, Any], name: str, title: str | None = None) -> Mapping[str, Any]:
    """The table ``name``, empty where there is none."""
    found = values.get(name, {})
    if not isinstance(found, Mapping):
        raise InvalidInput(f"{title or name} is {found!r}; expected a table [{title or name}]")
    return found


def _check_different(what: str, values: Sequence[Any]) -> None:
    """Raise InvalidInput where a value is there twice."""
    for i, value in enumerate(values):
        if value in values[:i]:
            raise InvalidInput(f"{what} has {value!r} twice")


def _groups(values: Any, what: str = "controllers") -> list[tuple[str, ...]]:
    """Controllers: names, or lists of names that guide together."""
    if not isinstance(values, list):
        raise InvalidInput(f"{what} is {values!r}; expected a list of names")
    found = []
    for value in values:
        group = tuple(value) if isinstance(value, list) else (value,)
        if not group:
            raise InvalidInput(f"{what} has an empty list; expected names")
        for name in group:
            if not isinstance(name, str):
                raise UnknownName("controller", name, controllers.names())
            controllers.entry(name)
        _check_different(f"a group of {what}", group)
        found.append(group)
    _check_different(what, found)
    return found


def _seeds(value: Any) -> list[int]:
    """Seeds: a list of them, or how many, from 0 on."""
    if _whole(value, 1):
        return list(range(value))
    if not isinstance(value, list) or not value or not all(_whole(one, 0) for one in value):
        raise InvalidInput(
            f"seeds is {value!r}; expected how many, or a list of whole numbers from 0 on"
        )
    _check_different("seeds", value)
    return value


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
