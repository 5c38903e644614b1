"""SweepConfig: what a sweep runs, how it evaluates and what counts, every run with all it needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from dexctl import settings
from dexctl.controllers import label
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import from_plain, to_plain
from learning.config import TrainConfig
from learning.evaluation.figures import FULL_TURN
from learning.evaluation.protocol import Protocol

GUIDE = "guide"


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
        return "-".join((self.method, *map(label, self.controllers)))


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
        for key in table:
            if key != "rotation":
                raise UnknownName("setting of criterion", key, ("rotation",))
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
