"""Transfer: what policies that were trained on one object each do with the others.

The thesis (chapter 3, fig. cross transfer) has the transfer score R_ij / R_ii, where R_ij is the
average return of the policy of object i on object j. Here R_ij is the median rotation up to the
drop, which needs no reward to be understood; the thesis's score is given beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.statistics import Estimate, bootstrap, bootstrap_ratio
from learning.evaluation.figures import Evaluation
from learning.evaluation.protocol import Protocol
from learning.evaluation.rollout import Run, evaluate
from learning.evaluation.subject import Subject, open_subject

# what R is, and of which numbers of an evaluation
KINDS = {"rotation": ("rotation", "median"), "return": ("returns", "mean")}


class Trained(NamedTuple):
    """A policy, or a controller in its place, and the object that it is for.

    Attributes:
        subject: the policy.
        object: name of the object that it was trained on.
    """

    subject: Subject
    object: str

    @property
    def name(self) -> str:
        """What people call it."""
        return self.subject.name


@dataclass(frozen=True, eq=False)
class Transfer:
    """Every policy with every object.

    Attributes:
        policies: rows; row i was trained on ``policies[i].object``.
        objects: columns, the policies' own first.
        evaluations: ``[i][j]`` of policy i with object j.
    """

    policies: tuple[Trained, ...]
    objects: tuple[str, ...]
    evaluations: tuple[tuple[Evaluation, ...], ...]

    def raw(self, i: int, j: int, kind: str = "rotation") -> Estimate:
        """R_ij: "rotation" (median [rad]) or "return" (mean [rad/s])."""
        field, statistic = _kind(kind)
        return bootstrap(getattr(self.evaluations[i][j], field), statistic)

    def score(self, i: int, j: int, kind: str = "rotation") -> Estimate | None:
        """R_ij / R_ii; None where R_ii is not above zero.

        The ends of the interval are nan where R_ii cannot be told from zero.
        """
        field, statistic = _kind(kind)
        own = self.objects.index(self.policies[i].object)
        base = getattr(self.evaluations[i][own], field)
        if j == own:  # the same episodes: 1 by definition
            whole = bootstrap(base, statistic)
            return Estimate(1.0, 1.0, 1.0, whole.count) if whole.value > 0 else None
        return bootstrap_ratio(getattr(self.evaluations[i][j], field), base, statistic)

    def to_dict(self) -> dict[str, Any]:
        """Matrices with a row for each policy, as JSON can hold them."""

        def matrix(cell: Callable[[int, int, str], Estimate | None], kind: str) -> list[list[Any]]:
            rows, columns = range(len(self.policies)), range(len(self.objects))
            found = [[cell(i, j, kind) for j in columns] for i in rows]
            return [[None if one is None else one.to_dict() for one in row] for row in found]

        return {
            "policies": [{"name": one.name, "object": one.object} for one in self.policies],
            "objects": list(self.objects),
            "rotation_median_rad": matrix(self.raw, "rotation"),
            "rotation_score": matrix(self.score, "rotation"),
            "return_mean": matrix(self.raw, "return"),
            "return_score": matrix(self.score, "return"),
        }


def open_trained(
    names: Sequence[str], *, hand: str | None = None, parts: Sequence[str] | None = None
) -> list[Trained]:
    """Policies, each with the object that it was trained on.

    Args:
        names: what `open_subject` takes, or ``object=`` and that, where no card says the object.
        hand, parts: see `open_subject`.

    Raises:
        InvalidInput: the object of one is not known; or see `open_subject`.
    """
    found = []
    for text in names:
        given, separator, rest = text.partition("=")
        name = rest if separator and "/" not in given else text
        subject = open_subject(name, hand=hand, parts=parts)
        objects = (given,) if name is not text else subject.objects
        if len(objects) != 1:
            says = f"was trained on {' and '.join(objects)}" if objects else "has no such card"
            raise InvalidInput(
                f"a transfer matrix needs the one object that each policy was trained on; {name!r} "
                f"{says}: give it, as in {(*objects, 'cube')[0]}={name}"
            )
        found.append(Trained(subject, objects[0]))
    return found


def transfer(
    policies: Sequence[Trained],
    protocol: Protocol | None = None,
    objects: Sequence[str] = (),
    *,
    run: Run = evaluate,
    progress: Callable[[Trained, str, float], None] | None = None,
) -> Transfer:
    """Evaluate every policy with the objects of all of them.

    Args:
        policies: at least two, of different objects.
        protocol: how; None is the standard one.
        objects: further ones, that no policy was trained on.
        run: evaluates; a `learning.evaluation.store.EvaluationStore` keeps what is finished.
        progress: called with the policy, the object and the simulated time so far [s].

    Raises:
        InvalidInput: fewer than two policies, or two of one object.
        UnknownName: no such object.
    """
    own = [policy.object for policy in policies]
    if len(own) < 2:
        raise InvalidInput(f"got {len(own)} policies for a transfer matrix; expected two or more")
    twice = [name for i, name in enumerate(own) if name in own[:i]]
    if twice:
        names = " and ".join(one.name for one in policies if one.object == twice[0])
        raise InvalidInput(f"{names} are both for {twice[0]!r}; expected one policy per object")
    columns = tuple(dict.fromkeys([*own, *objects]))
    rows = []
    for policy in policies:
        row = []
        for name in columns:

            def seen(now: float, policy: Trained = policy, name: str = name) -> None:
                if progress is not None:
                    progress(policy, name, now)

            row.append(run(policy.subject, protocol, object=name, progress=seen))
        rows.append(tuple(row))
    return Transfer(tuple(policies), columns, tuple(rows))


def _kind(kind: str) -> tuple[str, str]:
    if kind not in KINDS:
        raise UnknownName("kind of transfer", kind, KINDS)
    return KINDS[kind]
