"""``dexctl evaluate``: how good a policy or a controller is, in figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import tyro

from dexctl.cli.checks import check_seconds, make_folder
from dexctl.cli.output import notes, print_json, progress
from dexctl.cli.parsing import Switch, check_conditions, said
from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.settings import NESTED
from learning.evaluation.protocol import Protocol

if TYPE_CHECKING:
    from rich.progress import TaskID

    from learning.evaluation import Evaluation, Subject
    from learning.evaluation.transfer import Trained, Transfer


@dataclass(kw_only=True)
class Evaluate:
    """Say how good a policy or a controller is: rotation, speed, drops, with intervals.

    An object is dropped when its centre moves too far; rotation is the unwrapped angle about the
    axis up to the drop. Intervals are at 95 %: bootstrap over episodes, Wilson for shares.

    The defaults below are what the policy was trained in, but without noise, late sensors, pushes
    and given starts; for a controller a cube, palm up, about z. With --out, the same command goes
    on where it was killed.
    """

    short: ClassVar[Mapping[str, str]] = {"--from": "--initial-states"}

    policy: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[POLICY]", help_behavior_hint="")
    ] = None
    """A policy by name, a policy file (.npz), a run folder, or the name of a controller."""
    protocol: Annotated[Protocol, NESTED] = field(default_factory=Protocol)
    conditions: tuple[str, ...] = ()
    """Named ranges and limits in place of those of the training: nominal (none), limits (of a real
    hand), everything (that is uncertain of one), noise (of its sensors), bounded (its encoders'
    offsets are), any-gravity; several add up. Or a .toml of settings. What is typed beside them
    counts."""
    transfer: tuple[str, ...] = ()
    """Policies instead of one, of an object each (cube=POLICY if no card says); gives R_ij/R_ii.
    --object has further ones."""
    robustness: Switch = False
    """Once more for each kind and level of sensor noise, and of push on the object (20 of them)."""
    parts: tuple[str, ...] = ()
    """Observation parts that there are; a policy that was trained with others is refused."""
    out: Path | None = None
    """Folder for evaluate.json, CSV files and figures."""
    json: Switch = False
    """Print one JSON object instead of the table."""

    deciding: ClassVar[tuple[str, ...]] = ("--policy", "--transfer", "--conditions", "--hand")

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings that the policies were trained in."""
        from learning.evaluation import as_trained

        before = said(cls, argv)
        names = {word[2:].partition("=")[0].replace("-", "_") for word in argv if word[:2] == "--"}
        if before is not None:
            check_conditions(argv, before.conditions)
        if before is None or bool(before.transfer) == (before.policy is not None):
            return cls()
        from dexctl.sim.conditions import under

        hand = before.protocol.scene.hand if "hand" in names else None
        subjects = [one.subject for one in before._trained(hand)]
        protocol = as_trained(subjects, names)
        scene = protocol.scene
        if before.conditions:  # in place of those that the policy was trained with
            scene = under(replace(scene, limits=HandLimits()), *before.conditions)
        return cls(protocol=replace(protocol, scene=scene))

    def run(self) -> int:
        from learning.cli.evaluate_output import (
            described,
            print_evaluations,
            print_transfer,
            write,
        )

        if bool(self.transfer) == (self.policy is not None):
            got = "both" if self.transfer else "neither"
            raise InvalidInput(f"got {got} of a policy and --transfer; expected one of them")
        if self.transfer and self.robustness:
            raise InvalidInput("got --transfer and --robustness; expected one of them")
        protocol = self.protocol
        check_seconds(protocol.seconds, protocol.scene.control_period)
        trained = self._trained(protocol.scene.hand)
        for one in trained:
            if remark := one.subject.remark(protocol):
                notes().print(f"dexctl: {remark}")
        own = tuple(one.object for one in trained if self.transfer)
        replace(protocol.scene, object=(*own, *protocol.scene.object)).check_objects()
        self._check_starts(trained[0].subject, own)
        folder = None if self.out is None else make_folder(self.out)
        found, matrix = self._evaluate(trained, folder)
        result = {"command": "evaluate", "conditions": list(self.conditions)}
        result |= described(trained, protocol, found, matrix)
        if folder is not None:
            write(folder, result, found, matrix)
        if self.json:
            print_json(result)
        elif matrix is not None:
            print_transfer(matrix, protocol)
        else:
            print_evaluations(self.policy or "", protocol, found)
        return 0

    def _check_starts(self, who: Subject, own: Sequence[str]) -> None:
        """Say where the grasps of a file do not hold by themselves, object by object."""
        scene = self.protocol.scene
        if scene.initial_states is None:
            return
        from dexctl.sim import Simulation
        from learning.starts.check import remark_on_starts

        hand = who.acting(self.protocol).hand
        for name in dict.fromkeys((*own, *scene.object)):
            config = replace(scene, object=(name,))
            with Simulation(config, self.protocol.episodes, self.protocol.seed, hand=hand) as made:
                remark_on_starts(made, lambda said: notes().print(f"dexctl: {said}"))

    def _trained(self, hand: str | None) -> list[Trained]:
        """Who is evaluated: several with --transfer, else one, whose object does not matter."""
        from learning.evaluation import open_subject
        from learning.evaluation.transfer import Trained, open_trained

        parts = self.parts or None
        if self.policy is None:
            return open_trained(self.transfer, hand=hand, parts=parts)
        return [Trained(open_subject(self.policy, hand=hand, parts=parts), "")]

    def _evaluate(
        self, trained: Sequence[Trained], folder: Path | None
    ) -> tuple[list[Evaluation], Transfer | None]:
        from learning.evaluation import evaluate
        from learning.evaluation.robustness import protocols
        from learning.evaluation.store import EvaluationStore
        from learning.evaluation.transfer import transfer

        protocol = self.protocol
        objects = tuple(dict.fromkeys(protocol.scene.object))
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
                        f"policy of {policy.object} with {name}", now, protocol.seconds
                    ),
                )
                found = [one for row in matrix.evaluations for one in row]
            else:
                every = protocols(protocol) if self.robustness else [protocol]
                for name in objects:
                    title = f"{name}, {protocol.episodes} episodes"
                    total = len(every) * protocol.seconds
                    for i, one in enumerate(every):

                        def seen(now: float, before: float = i * protocol.seconds) -> None:
                            show(title, before + now, total)  # noqa: B023

                        found.append(run(trained[0].subject, one, object=name, progress=seen))
        if store is not None and store.found:
            notes().print(f"{store.found} of {len(found)} were there already, in {folder}/points")
        return found, matrix
