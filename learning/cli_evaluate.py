"""``dexctl evaluate``: how good a policy or a controller is, in figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dexctl import controllers, hands
from dexctl.cli.output import notes, print_json, progress, results, to_json
from dexctl.cli.parsing import check_count, check_seconds, make_folder, parse_gravity
from dexctl.exceptions import InvalidInput, UnknownName

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from learning.evaluate import Evaluation, Protocol
    from learning.statistics import Estimate


@dataclass(kw_only=True)
class Evaluate:
    """Say how good a policy or a controller is: rotation, speed, drops, with intervals.

    Episodes start from the settled grasp with set-points disturbed by N(0, 0.02 rad). An object
    whose centre moves by more than 0.05 m is dropped; rotation is the unwrapped angle about the
    hand's z axis up to the drop. Intervals are at 95 %: bootstrap over episodes, Wilson for shares.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file (.npz), or the name of a controller: igm, switch, gait, coordinated, hold."""
    object: tuple[str, ...] = ("cube",)
    """Name of the object, or several; they are evaluated one after the other."""
    gravity: str = "up"
    """Which way the palm looks: up, down, or gravity as x,y,z in m/s^2."""
    hand: str | None = None
    """Name of the hand; by default the policy's own, and dex5 for a controller."""
    episodes: int = 100
    """How many, for each object."""
    seconds: float = 60.0
    """Simulated time of each [s]."""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i."""
    robustness: bool = False
    """Once more for each kind and level of sensor noise, and of push on the object (20 of them)."""
    out: Path | None = None
    """Folder for evaluate.json and episodes.csv."""
    json: bool = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        check_count("--episodes", self.episodes)
        controller = self._controller()
        check_seconds(self.seconds, controller.control_period)
        folder = None if self.out is None else make_folder(self.out)
        from dexctl.sim import object_names
        from learning.evaluate import Protocol, write_csv

        for name in self.object:
            if name not in object_names():
                raise UnknownName("object", name, object_names())
        if not self.object:
            raise InvalidInput("--object is empty; expected a name, or several")
        gravity = parse_gravity(self.gravity)
        protocol = Protocol(
            episodes=self.episodes, seconds=self.seconds, seed=self.seed, gravity=gravity
        )
        found = self._evaluate(controller, protocol)
        result = self._as_dict(controller, found)
        if folder is not None:
            from learning.files import write_text

            write_text(folder / "evaluate.json", to_json(result) + "\n")
            write_csv(folder / "episodes.csv", found)
            notes().print(f"written: {folder / 'evaluate.json'} and {folder / 'episodes.csv'}")
        if self.json:
            print_json(result)
        else:
            self._print(found)
        return 0

    def _controller(self) -> Controller:
        if self.policy.endswith(".npz"):
            from learning.policy import load_policy

            return load_policy(self.policy, hand=self.hand)
        if self.policy not in controllers.names():
            raise UnknownName("policy", self.policy, ["a policy file (.npz)", *controllers.names()])
        return controllers.make(self.policy, hands.load(self.hand or "dex5"))

    def _evaluate(self, controller: Controller, protocol: Protocol) -> list[Evaluation]:
        from learning.evaluate import LEVELS, evaluate, robustness

        runs = 1 + sum(map(len, LEVELS.values())) if self.robustness else 1
        found: list[Evaluation] = []
        with progress(notes()) as bar:
            for name in self.object:
                task = bar.add_task(f"{name}, {self.episodes} episodes", total=runs * self.seconds)
                if self.robustness:
                    found += robustness(
                        controller,
                        name,
                        protocol,
                        progress=lambda done, _, task=task: bar.update(
                            task, completed=done * self.seconds
                        ),
                    )
                else:
                    found.append(
                        evaluate(
                            controller,
                            name,
                            protocol,
                            progress=lambda now, task=task: bar.update(task, completed=now),
                        )
                    )
        return found

    def _as_dict(self, controller: Controller, found: list[Evaluation]) -> dict[str, Any]:
        from dataclasses import asdict

        from dexctl.report.machine import machine

        return {
            "command": "evaluate",
            "policy": self.policy,
            "card": getattr(controller, "card", None),
            "hand": controller.hand.path.stem,
            "gravity": self.gravity,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "control_period_s": controller.control_period,
            "seeds": [self.seed, self.seed + self.episodes - 1],
            "results": [
                {
                    "object": one.object,
                    "noise": asdict(one.protocol.noise),
                    "push_N": one.protocol.push.force,
                    **one.to_dict(),
                }
                for one in found
            ],
            "machine": machine(),
        }

    def _print(self, found: list[Evaluation]) -> None:
        from rich.table import Table

        console = results()
        console.print(
            f"[bold]{self.policy}, palm or gravity {self.gravity}[/bold]\n"
            f"{self.episodes} episodes of {self.seconds:g} s for each row, seeds {self.seed} to "
            f"{self.seed + self.episodes - 1}; (95 % interval)\n",
            soft_wrap=True,
        )
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for heading in ("object", "disturbed", "rotation, rad", "revolutions", "speed, rad/s",
                        "dropped", "return"):  # fmt: skip
            table.add_column(heading)
        for one in found:
            figures = one.figures()
            table.add_row(
                one.object,
                _noise(one),
                _interval(figures["rotation_median_rad"]),
                f"{figures['revolutions_median'].value:.2f}",
                _interval(figures["speed_mean_rad_s"]),
                _interval(figures["share_dropped"], 100.0, 0, " %"),
                _interval(figures["return_mean"], digits=0),
            )
        console.print(table)
        broken = sum(int(one.diverged.sum()) for one in found)
        if broken:
            console.print(f"{broken} simulations broke down; they count as dropped.")


def _interval(one: Estimate, factor: float = 1.0, digits: int = 2, unit: str = "") -> str:
    value, low, high = (f"{factor * x:.{digits}f}" for x in (one.value, one.low, one.high))
    return f"{value}{unit} ({low} to {high})"


def _noise(one: Evaluation) -> str:
    noise = one.protocol.noise
    named = {kind: getattr(noise, kind) for kind in noise.__dataclass_fields__}
    named["push"] = one.protocol.push.force
    return ", ".join(f"{kind} {value:g}" for kind, value in named.items() if value) or "none"
