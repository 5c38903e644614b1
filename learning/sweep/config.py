"""SweepConfig: what a sweep runs, read from TOML and checked before anything starts.

A file names methods, controllers and seeds; ``[train]`` changes `TrainConfig`, and
``[method.NAME]`` does so for one method, which may have ``controllers`` and ``seeds`` of its own;
``[evaluation]`` changes `Protocol`, and ``[criterion]`` says what counts. ``examples/sweep.toml``
is one.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from dexctl import controllers as known_controllers
from dexctl import settings
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import from_plain, to_plain
from learning.config import TrainConfig
from learning.evaluation.figures import FULL_TURN
from learning.evaluation.protocol import Protocol
from learning.exploration.config import METHODS, check_controllers
from learning.sweep import reading

GUIDE = "guide"
_TOP = ("name", "methods", "controllers", "seeds", "train", "method", "evaluation", "criterion")


@dataclass(frozen=True)
class Cell:
    """A row of the table: a method with the controllers that guide it.

    Attributes:
        method: its name.
        controllers: their names; none for "rl".
    """

    method: str
    controllers: tuple[str, ...]

    @property
    def name(self) -> str:
        """As its run folders begin."""
        return "-".join((self.method, *self.controllers))


@dataclass(frozen=True)
class PlannedRun:
    """One training run of a sweep.

    Attributes:
        config: everything that decides what it does; its seed among it.
    """

    config: TrainConfig

    @property
    def cell(self) -> Cell:
        """Which row it belongs to."""
        return Cell(self.config.guidance.method, self.config.guides)

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.cell.name}-{self.config.seed}"


@dataclass(frozen=True)
class Criterion:
    """When a seed has learned: its median rotation, evaluated, is at least this.

    Attributes:
        rotation: [rad]; None: that of the best of the controllers that guided it, evaluated in the
            same way. A method without controllers is held to the best of all in the sweep.
    """

    rotation: float | None = FULL_TURN

    def to_dict(self) -> dict[str, Any]:
        """As TOML has it."""
        return {"rotation": GUIDE if self.rotation is None else self.rotation}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        """What the table [criterion] says."""
        reading.check_keys("criterion", table, ("rotation",))
        value = table.get("rotation", FULL_TURN)
        if value == GUIDE:
            return cls(None)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e6:
            raise InvalidInput(
                f'criterion.rotation is {value!r}; expected radians above 0, or "{GUIDE}"'
            )
        return cls(float(value))


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """A checked sweep.

    Attributes:
        name: for people.
        runs: first all cells' first seeds, then their second, ...: a sweep that is cut short has
            something of everything.
        protocol: how each policy is evaluated, with one object of its scene after the other.
        compared: controllers that are evaluated in a policy's place.
        criterion: when a seed has learned.
        given: the file that it was read from.
    """

    name: str
    runs: tuple[PlannedRun, ...]
    protocol: Protocol
    compared: tuple[str, ...]
    criterion: Criterion
    given: Mapping[str, Any] = field(default_factory=dict)

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The rows of the table."""
        return tuple(dict.fromkeys(run.cell for run in self.runs))

    @property
    def objects(self) -> tuple[str, ...]:
        """What the policies are evaluated with."""
        return tuple(dict.fromkeys(self.protocol.scene.object))

    @classmethod
    def load(cls, path: Path, *, seed: int = 0, steps: int | None = None) -> SweepConfig:
        """Read a file.

        Args:
            path: TOML.
            seed, steps: see `parse`.

        Raises:
            UnknownName, InvalidInput: it is not right; one line that says what.
        """
        try:
            given = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InvalidInput(f"cannot read {path}: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidInput(f"{path} is not TOML: {error}") from None
        return cls.parse({"name": path.stem, **given}, path.parent, seed=seed, steps=steps)

    @classmethod
    def parse(
        cls,
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
        reading.check_keys("sweep", given, _TOP)
        if seed < 0:
            raise InvalidInput(f"--seed is {seed}; expected a whole number from 0 on")
        name = given.get("name", "sweep")
        if not isinstance(name, str):
            raise InvalidInput(f"name is {name!r}; expected a text")
        methods = _methods(given)
        overrides = reading.table(given, "method")
        for method in overrides:
            if method not in METHODS:
                raise UnknownName("method", method, METHODS)
            if method not in methods:
                raise InvalidInput(f"[method.{method}] is given; methods are {', '.join(methods)}")
        base = reading.changes(reading.table(given, "train"), "train")
        last = reading.Changes(None, {} if steps is None else {"steps": steps})
        plan: list[list[TrainConfig]] = []
        for method in methods:
            over = dict(reading.table(overrides, method, f"method.{method}"))
            groups = reading.groups(over.pop("controllers", given.get("controllers", [])))
            seeds = reading.seeds(over.pop("seeds", given.get("seeds", 1)))
            parts = (base, reading.changes(over, f"method.{method}"), last)
            plan += [
                [reading.train_config(parts, method, group, seed + k, folder) for k in seeds]
                for group in _rows(method, groups)
            ]
        runs = tuple(PlannedRun(config) for config in _seeds_first(plan))
        criterion = Criterion.from_dict(reading.table(given, "criterion"))
        evaluation = dict(reading.table(given, "evaluation"))
        compared = _compared(evaluation.pop("controllers", []))
        if criterion.rotation is None:
            compared += [name for made in plan for name in made[0].guides]
            if not compared:
                raise InvalidInput(
                    'criterion.rotation is "guide", and no controllers are in the sweep'
                )
        return cls(
            name=name,
            runs=runs,
            protocol=reading.protocol(evaluation, [run.config for run in runs], folder),
            compared=tuple(dict.fromkeys(compared)),
            criterion=criterion,
            given=given,
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything that decides what the sweep does, as JSON can hold it."""
        content = {
            "name": self.name,
            "given": self.given,
            "evaluation": to_plain(self.protocol),
            "compared": self.compared,
            "criterion": self.criterion.to_dict(),
            "runs": {run.name: to_plain(run.config) for run in self.runs},
        }
        return json.loads(json.dumps(content, default=str))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> SweepConfig:
        """What `to_dict` wrote.

        Raises:
            UnknownName, InvalidInput: it was written by another version.
        """
        return cls(
            name=content["name"],
            runs=tuple(
                PlannedRun(from_plain(TrainConfig, config, f"runs.{name}"))
                for name, config in content["runs"].items()
            ),
            protocol=from_plain(Protocol, content["evaluation"], "evaluation"),
            compared=tuple(content["compared"]),
            criterion=Criterion.from_dict(content["criterion"]),
            given=content["given"],
        )


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """Where a sweep differs from what ``before`` (`to_dict`) has begun; None where it continues it.

    Runs may have been added (seeds, methods, controllers): that changes none of those before.
    """
    gone = [name for name in before["runs"] if name not in now["runs"]]
    if gone:
        return f"the run {gone[0]} is no longer in it"
    keys = ["evaluation", "criterion", "runs"]
    if not set(before["compared"]) <= set(now["compared"]):
        keys.append("compared")
    same = {**now, "runs": {name: now["runs"][name] for name in before["runs"]}}
    return settings.difference({key: before[key] for key in keys}, {key: same[key] for key in keys})


def _methods(given: Mapping[str, Any]) -> list[str]:
    methods = given.get("methods")
    if not isinstance(methods, list) or not methods:
        raise InvalidInput(f"methods is {methods!r}; expected a list of {', '.join(METHODS)}")
    for method in methods:
        if method not in METHODS:
            raise UnknownName("method", method, METHODS)
    reading.check_different("methods", methods)
    return methods


def _rows(method: str, groups: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The controllers of each row of a method."""
    if method == "rl":
        return [()]
    if not groups:
        raise InvalidInput(
            f"method {method!r} has no controllers; expected some of "
            f"{', '.join(known_controllers.names())}"
        )
    for group in groups:
        check_controllers(method, group)
    return groups


def _compared(values: Any) -> list[str]:
    groups = reading.groups(values, "evaluation.controllers")
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
