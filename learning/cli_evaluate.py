"""``dexctl evaluate``: how good a policy or a controller is, in figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dexctl.cli.output import notes, print_json, progress
from dexctl.cli.parsing import (
    check_count,
    check_seconds,
    make_folder,
    parse_gravity,
    parse_vector,
)
from dexctl.exceptions import InvalidInput, UnknownName

if TYPE_CHECKING:
    from rich.progress import TaskID

    from learning.evaluate import Evaluation, Protocol
    from learning.transfer import Trained, Transfer


@dataclass(kw_only=True)
class Evaluate:
    """Say how good a policy or a controller is: rotation, speed, drops, with intervals.

    Episodes start from the settled grasp with set-points disturbed by N(0, 0.02 rad). An object
    whose centre moves by more than 0.05 m is dropped; rotation is the unwrapped angle about the
    axis up to the drop. Intervals are at 95 %: bootstrap over episodes, Wilson for shares.

    What is not said is as in training; for a controller a cube, palm up, about z. With --out, the
    same command goes on where it was killed.
    """

    policy: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POLICY]", help_behavior_hint="")
    ] = None
    """A policy file (.npz), or the name of a controller: igm, switch, gait, coordinated, hold."""
    transfer: tuple[str, ...] = ()
    """Policies instead of one, of an object each (cube=POLICY if no card says); gives R_ij/R_ii."""
    robustness: bool = False
    """Once more for each kind and level of sensor noise, and of push on the object (20 of them)."""
    object: tuple[str, ...] = ()
    """Name of the object, or several; by default as in training. With --transfer: further ones."""
    gravity: str | None = None
    """How the palm looks: up, down, or gravity as x,y,z in m/s^2; by default as in training."""
    axis: str | None = None
    """Hand axis that rotation is about: x, y, z or a vector x,y,z; by default as in training."""
    hand: str | None = None
    """Name of the hand; by default the policy's own, and dex5 for a controller."""
    parts: tuple[str, ...] = ()
    """Observation parts that there are; a policy that was trained with others is refused."""
    latency: float = 0.0
    """How old what is sensed is, rounded to control steps [s]."""
    object_size: float | None = None
    """Width of the object [m]; by default as in training."""
    object_mass: float | None = None
    """Of the object [kg]; by default as in training."""
    episodes: int = 100
    """How many, for each object."""
    seconds: float = 60.0
    """Simulated time of each [s]."""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i."""
    out: Path | None = None
    """Folder for evaluate.json, CSV files and figures."""
    json: bool = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        from learning.contenders import aimed

        check_count("--episodes", self.episodes)
        trained = self._trained()
        for one in trained:
            check_seconds(self.seconds, one.controller.control_period)
        protocol = self._protocol(trained)
        trained = aimed(trained, protocol.axis)
        objects = self._objects(trained)
        folder = None if self.out is None else make_folder(self.out)
        from learning.cli_evaluate_out import described, write

        found, matrix = self._evaluate(trained, objects, protocol, folder)
        result = {"command": "evaluate"} | described(trained, protocol, found, matrix)
        if folder is not None:
            write(folder, result, found, matrix)
        if self.json:
            print_json(result)
        else:
            from learning.cli_evaluate_tables import print_evaluations, print_transfer

            if matrix is not None:
                print_transfer(matrix, protocol)
            else:
                print_evaluations(self.policy or "", protocol, found)
        return 0

    def _trained(self) -> list[Trained]:
        """What is evaluated: several with --transfer, else one, whose object does not matter."""
        from learning.contenders import load_contender, load_trained
        from learning.transfer import Trained

        if bool(self.transfer) == (self.policy is not None):
            got = "both" if self.transfer else "neither"
            raise InvalidInput(f"got {got} of a policy and --transfer; expected one of them")
        if self.transfer and self.robustness:
            raise InvalidInput("got --transfer and --robustness; expected one of them")
        parts = self.parts or None
        if self.policy is None:
            return load_trained(self.transfer, hand=self.hand, parts=parts)
        return [Trained(self.policy, "", load_contender(self.policy, hand=self.hand, parts=parts))]

    def _protocol(self, trained: Sequence[Trained]) -> Protocol:
        """What is not said is as in training."""
        from learning.contenders import as_trained
        from learning.evaluate import Protocol

        given = {
            "gravity": None if self.gravity is None else parse_gravity(self.gravity),
            "axis": None if self.axis is None else parse_vector("--axis", self.axis),
            "object_size": self.object_size,
            "object_mass": self.object_mass,
        }
        return Protocol(
            episodes=self.episodes,
            seconds=self.seconds,
            seed=self.seed,
            latency=self.latency,
            **as_trained(trained, given),
        )

    def _objects(self, trained: Sequence[Trained]) -> tuple[str, ...]:
        """Those asked for, or those that one policy was trained on."""
        from dexctl.sim import object_names
        from learning.contenders import trained_env

        objects = tuple(dict.fromkeys(self.object))
        if not objects and not self.transfer:
            env = trained_env(trained[0].name, trained[0].controller)
            objects = ("cube",) if env is None else env.objects
        for name in (*(one.object for one in trained if self.transfer), *objects):
            if name not in object_names():
                raise UnknownName("object", name, object_names())
        return objects

    def _evaluate(
        self,
        trained: Sequence[Trained],
        objects: tuple[str, ...],
        protocol: Protocol,
        folder: Path | None,
    ) -> tuple[list[Evaluation], Transfer | None]:
        from learning.evaluate import evaluate
        from learning.evaluation_store import EvaluationStore
        from learning.robustness import protocols
        from learning.transfer import transfer

        store = None if folder is None else EvaluationStore(folder / "points")
        run = evaluate if store is None else store
        matrix, found = None, []
        with progress(notes()) as bar:
            tasks: dict[str, TaskID] = {}

            def show(title: str, done: float, total: float) -> None:
                if title not in tasks:
                    tasks[title] = bar.add_task(title, total=total)
                bar.update(tasks[title], completed=done)

            if self.transfer:
                matrix = transfer(
                    trained,
                    protocol,
                    objects,
                    run=run,
                    progress=lambda policy, name, now: show(
                        f"policy of {policy.object} with {name}", now, self.seconds
                    ),
                )
                found = [one for row in matrix.evaluations for one in row]
            else:
                every = protocols(protocol) if self.robustness else [protocol]
                for name in objects:
                    for i, one in enumerate(every):
                        before = i * self.seconds
                        found.append(
                            run(
                                trained[0].controller,
                                name,
                                one,
                                progress=lambda now, name=name, before=before: show(
                                    f"{name}, {self.episodes} episodes",
                                    before + now,
                                    len(every) * self.seconds,
                                ),
                            )
                        )
        if store is not None and store.found:
            notes().print(f"{store.found} of {len(found)} were there already, in {folder}/points")
        return found, matrix
