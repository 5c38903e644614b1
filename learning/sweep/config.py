"""SweepConfig: what a sweep runs, read from TOML and checked before anything starts.

A file names methods, controllers and seeds; ``[train]`` has settings of `TrainConfig`, with
``[train.env]`` and ``[train.guidance]``; ``[method.NAME]`` has what differs for one method, its own
``controllers`` and ``seeds`` among it; ``[evaluation]`` and ``[criterion]`` say what counts.
``examples/sweep.toml`` is one.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dexctl import controllers as known_controllers
from dexctl.exceptions import InvalidInput, UnknownName
from learning.evaluate import FULL_TURN
from learning.exploration import METHODS
from learning.settings import TrainConfig
from learning.sweep import reading
from learning.sweep.reading import EvaluationPlan

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
        cell: which row it belongs to.
        config: everything that decides what it does; its seed among it.
    """

    cell: Cell
    config: TrainConfig

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


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """A checked sweep.

    Attributes:
        name: for people.
        runs: first all cells' first seeds, then their second, ...: a sweep that is cut short has
            something of everything.
        evaluation: how each policy is evaluated, and which controllers in a policy's place.
        criterion: when a seed has learned.
        given: what it was made from.
    """

    name: str
    runs: tuple[PlannedRun, ...]
    evaluation: EvaluationPlan
    criterion: Criterion
    given: Mapping[str, Any]

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The rows of the table."""
        return tuple(dict.fromkeys(run.cell for run in self.runs))

    @classmethod
    def load(cls, path: Path, *, seed: int = 0, steps: int | None = None) -> SweepConfig:
        """Read a file.

        Args:
            path: TOML.
            seed: added to every seed in it.
            steps: environment steps of each run, in place of the file's.

        Raises:
            UnknownName, InvalidInput: it is not right; one line that says what.
        """
        try:
            given = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InvalidInput(f"cannot read {path}: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidInput(f"{path} is not TOML: {error}") from None
        given = {"name": path.stem, **given}
        _absolute_states(given, path.parent)
        return cls.parse(_shifted(given, seed, steps))

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> SweepConfig:
        """The sweep that a mapping, as TOML gives it, describes.

        Raises:
            UnknownName, InvalidInput: it is not right.
        """
        reading.check_keys("sweep", given, _TOP)
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
        base = reading.table(given, "train")
        reading.check_settings(base, "train")
        plan: list[tuple[Cell, list[TrainConfig]]] = []
        for method in methods:
            over = dict(reading.table(overrides, method, f"method.{method}"))
            groups = reading.groups(over.pop("controllers", given.get("controllers", [])))
            seeds = reading.seeds(over.pop("seeds", given.get("seeds", 1)))
            reading.check_settings(over, f"method.{method}")
            settings = reading.merged(base, over)
            for cell in _cells(method, groups):
                made = [reading.train_config(settings, method, cell.controllers, s) for s in seeds]
                plan.append((cell, made))
        criterion = _criterion(reading.table(given, "criterion"))
        used = tuple(dict.fromkeys(name for cell, _ in plan for name in cell.controllers))
        evaluation = reading.evaluation(
            reading.table(given, "evaluation"),
            plan[0][1][0].env,
            used if criterion.rotation is None else (),
        )
        if criterion.rotation is None and not evaluation.controllers:
            raise InvalidInput('criterion.rotation is "guide", and no controllers are in the sweep')
        return cls(
            name=name,
            runs=tuple(_seeds_first(plan)),
            evaluation=evaluation,
            criterion=criterion,
            given=given,
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything that decides what the sweep does, as JSON can hold it."""
        content = {
            "given": self.given,
            "evaluation": asdict(self.evaluation),
            "criterion": self.criterion.to_dict(),
            "runs": {run.name: run.config.to_dict() for run in self.runs},
        }
        return json.loads(json.dumps(content))


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """Where a sweep differs from what ``before`` (`to_dict`) has begun; None where it continues it.

    Runs may have been added (seeds, methods, controllers): that changes none of those before.
    """
    gone = [name for name in before["runs"] if name not in now["runs"]]
    if gone:
        return f"the run {gone[0]} is no longer in it"
    kept = {name: now["runs"][name] for name in before["runs"]}
    old = {key: before[key] for key in ("evaluation", "criterion", "runs")}
    new = {"evaluation": now["evaluation"], "criterion": now["criterion"], "runs": kept}
    if set(old["evaluation"]["controllers"]) <= set(new["evaluation"]["controllers"]):
        for one in (old, new):
            one["evaluation"] = {**one["evaluation"], "controllers": None}
    return next(_differences("", old, new), None)


def _differences(where: str, a: Any, b: Any) -> Iterator[str]:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in dict.fromkeys([*a, *b]):
            yield from _differences(f"{where}.{key}" if where else key, a.get(key), b.get(key))
    elif a != b:
        yield f"{where} was {json.dumps(a)}, is {json.dumps(b)}"


def _methods(given: Mapping[str, Any]) -> list[str]:
    methods = given.get("methods")
    if not isinstance(methods, list) or not methods:
        raise InvalidInput(f"methods is {methods!r}; expected a list of {', '.join(METHODS)}")
    for method in methods:
        if method not in METHODS:
            raise UnknownName("method", method, METHODS)
    reading.check_different("methods", methods)
    return methods


def _cells(method: str, groups: list[tuple[str, ...]]) -> list[Cell]:
    """The rows of a method."""
    if method == "rl":
        return [Cell(method, ())]
    if not groups:
        raise InvalidInput(
            f"method {method!r} has no controllers; expected some of "
            f"{', '.join(known_controllers.names())}"
        )
    for group in groups:
        if method == "rl+bc" and len(group) > 1:
            raise InvalidInput(
                f"method 'rl+bc' has the controllers {', '.join(group)} at once; it takes one: "
                'give [method."rl+bc"] controllers of its own'
            )
    return [Cell(method, group) for group in groups]


def _seeds_first(plan: list[tuple[Cell, list[TrainConfig]]]) -> Iterator[PlannedRun]:
    for k in range(max(len(made) for _, made in plan)):
        for cell, made in plan:
            if k < len(made):
                yield PlannedRun(cell, made[k])


def _criterion(table: Mapping[str, Any]) -> Criterion:
    reading.check_keys("criterion", table, ("rotation",))
    value = table.get("rotation", FULL_TURN)
    if value == GUIDE:
        return Criterion(None)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e6:
        raise InvalidInput(
            f'criterion.rotation is {value!r}; expected radians above 0, or "{GUIDE}"'
        )
    return Criterion(float(value))


def _shifted(given: dict[str, Any], seed: int, steps: int | None) -> dict[str, Any]:
    """With ``seed`` added to every seed, and ``steps`` for every run."""
    if isinstance(seed, bool) or seed < 0:
        raise InvalidInput(f"--seed is {seed}; expected a whole number from 0 on")
    overrides = reading.table(given, "method")
    parts = [given, *(part for part in overrides.values() if isinstance(part, dict))]
    for part in parts:
        if "seeds" in part or part is given:
            part["seeds"] = [seed + one for one in reading.seeds(part.get("seeds", 1))]
        if steps is not None and part is not given:
            part.pop("steps", None)
    if steps is not None:
        given["train"] = {**reading.table(given, "train"), "steps": steps}
    return given


def _absolute_states(given: dict[str, Any], folder: Path) -> None:
    """Files of initial states are meant from where the sweep's file is; runs are elsewhere."""
    overrides = reading.table(given, "method").values()
    for part in (given.get("train"), *overrides):
        env = part.get("env") if isinstance(part, dict) else None
        if isinstance(env, dict) and isinstance(env.get("initial_states"), str):
            env["initial_states"] = str((folder / env["initial_states"]).expanduser().resolve())
