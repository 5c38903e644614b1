"""Subject: who is evaluated or inspected, and what it was trained in."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import Vector, changed, from_plain, get, leaves
from dexctl.sim.checks import gravity_name, gravity_vector
from dexctl.validation import unit_axis
from learning.config import TrainConfig
from learning.evaluation.protocol import Protocol
from learning.policies import Policy, load, names, other_hand
from learning.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False, kw_only=True)
class Subject:
    """Who is evaluated or inspected: a policy, the policy of a run, or a controller.

    Attributes:
        name: as given.
        kind: "policy", "run" or "controller".
        hand: name of the hand that it acts with.
        controller: who acts. A controller, which is no policy, is made anew for another axis, hand
            or control period (`acting`).
        trained: what trained it; of a policy, environments and guides as its card says. None for a
            controller, or where the card does not say.
        folder: of the run; None for the others.
        axis: that a controller was opened for; None where nobody said.
    """

    name: str
    kind: Literal["policy", "run", "controller"]
    hand: str
    controller: Controller
    trained: TrainConfig | None = None
    folder: RunFolder | None = None
    axis: Vector | None = None

    @property
    def card(self) -> dict[str, Any] | None:
        """Of a policy; None for a controller."""
        return self.controller.card if isinstance(self.controller, Policy) else None

    @property
    def objects(self) -> tuple[str, ...]:
        """What it was trained with, or made for; empty where nobody knows."""
        if self.trained is not None:
            return tuple(dict.fromkeys(self.trained.env.scene.object))
        return () if self.controller.object is None else (self.controller.object,)

    @property
    def guides(self) -> tuple[str, ...]:
        """Names of the controllers that guided the training; empty without."""
        return () if self.trained is None else self.trained.guide_names

    def remark(self, protocol: Protocol) -> str | None:
        """What to know before its figures are read: that it is made for something else."""
        if isinstance(self.controller, Policy):
            return other_hand(self.controller) or self.controller.other_commands(
                protocol.task.turning.commands, protocol.task.turning.command_speed_range
            )
        scene = protocol.scene
        return controllers.made_for_another(
            self.name, self.controller, scene.object, gravity_vector(scene.gravity)
        )

    def protocol(self, **changes: Any) -> Protocol:
        """As in training, but undisturbed: without noise, late sensors, pushes and given starts.

        Only a tracker by which it has learned is as late as it was then (`Controller.pose_age`).

        Where nobody knows how it was trained, and for a controller, it is the standard one.

        Args:
            **changes: settings of `Protocol`, by the names of the leaves too.

        Raises:
            UnknownName, InvalidInput: one of them is wrong.
        """
        base = Protocol()
        if self.trained is not None:
            env = self.trained.env
            base = replace(
                base, scene=replace(env.scene.undisturbed(), threads=None), task=env.task
            )
        sensing = base.scene.sensing.aged(self.controller.pose_age or 0.0)
        base = replace(base, scene=replace(base.scene, sensing=sensing))
        own: dict[str, Any] = {"hand": self.hand}
        own["control_period"] = float(self.controller.control_period)
        if self.controller.object is not None:
            own["object"] = (self.controller.object,)
        if self.controller.gravity is not None:
            own["gravity"] = gravity_name(self.controller.gravity)
        if self.axis is not None:
            own["axis"] = self.axis
        return changed(base, own | changes)

    def acting(self, protocol: Protocol) -> Controller:
        """Who acts in a protocol: a controller made for its hand, axis and control period.

        Raises:
            InvalidInput: a policy for another hand, for an axis that cannot be turned to this one,
                or trained with another control period; goals or commands that it does not see, or
                none where it sees them.
        """
        scene = protocol.scene
        if isinstance(self.controller, Policy):
            for what, own, asked in (
                ("hand", self.hand, scene.hand),
                ("control_period", self.controller.control_period, scene.control_period),
            ):
                if own != asked and not (what != "hand" and np.isclose(own, asked)):
                    raise InvalidInput(
                        f"{what} is {asked}; the policy {self.name!r} was trained with {own}"
                    )
            protocol.task.check_told(
                self.controller.observation.parts, f"the policy {self.name!r} sees"
            )
            protocol.task.check_needed(
                self.controller.observation.parts, f"the policy {self.name!r}"
            )
            return self.controller.turned_to(protocol.task.direction)
        if controllers.is_named(self.name):
            follows = controllers.entry(self.name).follows
            if follows is not None:
                protocol.task.check_told(follows, f"the controller {self.name!r} follows")
        hand = self.controller.hand if scene.hand == self.hand else hands.load(scene.hand)
        return controllers.resolve(
            self.name, hand, control_period=scene.control_period, axis=protocol.task.direction
        )


def open_subject(
    name: str,
    *,
    hand: str | None = None,
    parts: Sequence[str] | None = None,
    axis: Vector | None = None,
) -> Subject:
    """Who ``name`` names.

    Args:
        name: a controller, a policy by name, a policy file (.npz), a run folder, these with a pace
            behind them or without, or ``module:function`` (see `dexctl.controllers.resolve`).
        hand: name of the hand; None is a policy's own, dex5 for a controller.
        parts: refuse a policy that was trained with other observation parts than these.
        axis: that a controller turns about; None is its own.

    Raises:
        UnknownName: it is none of these, or there is no such hand.
        InvalidInput: a damaged file, a run without policy, a policy for another hand or with other
            parts, or a card that this version cannot read.
    """
    plain = controllers.paced(name)[0]
    path = Path(plain).expanduser()
    policy = controllers.is_policy_file(name) or plain in names()
    if policy and not controllers.is_named(name):
        folder = RunFolder(path) if path.is_dir() else None
        if folder is not None and not folder.config_path.exists():
            raise InvalidInput(f"{name!r} is no run folder: it has no {folder.config_path.name}")
        who: Controller = load(name, hand=hand, parts=parts)
    else:
        folder = None
        direction = None if axis is None else unit_axis(axis)
        who = controllers.resolve(name, hands.load(hand or "dex5"), axis=direction)
    if not isinstance(who, Policy):
        return Subject(name=name, kind="controller", hand=hand or "dex5", controller=who, axis=axis)
    return Subject(
        name=name,
        kind="policy" if folder is None else "run",
        hand=hand or who.spec.hand,
        controller=who,
        trained=_trained(name, who) if folder is None else folder.config(),
        folder=folder,
    )


def as_trained(
    subjects: Sequence[Subject], given: Collection[str] = (), **changes: Any
) -> Protocol:
    """One protocol for several subjects: what is not given is as all of them were trained.

    Their objects may differ; those are the protocol's in their order.

    Args:
        subjects: one at least; controllers do not say anything beside policies that do.
        given: names of settings that are given later, so that the policies may differ in them.
        **changes: see `Subject.protocol`.

    Raises:
        InvalidInput: the policies were trained with different settings.
    """
    known = [one for one in subjects if one.trained is not None] or list(subjects[:1])
    found = [one.protocol(**changes) for one in known]
    for name, path in leaves(Protocol).items():
        values = list(dict.fromkeys(get(one, path) for one in found))
        if len(values) > 1 and name not in ("object", *given):
            raise InvalidInput(
                f"the policies were trained with {name} {' and '.join(map(str, values))}; "
                f"say which with --{name.replace('_', '-')}"
            )
    every = tuple(dict.fromkeys(name for one in found for name in one.scene.object))
    return changed(found[0], {"object": every} | changes)


def _trained(name: str, policy: Policy) -> TrainConfig | None:
    """What the card of a policy says that trained it; None where it does not say.

    Environments and guides only: how an algorithm of an earlier version learned decides nothing.
    """
    said = policy.card.get("trained")
    if said is None:
        return None
    if isinstance(said, Mapping):
        said = {key: said[key] for key in ("env", "guidance", "controllers") if key in said}
    try:
        return from_plain(TrainConfig, said, "trained")
    except (InvalidInput, UnknownName) as error:
        # of the many names that are known, none is what the card's writer meant
        what = f"unknown {error.kind} {error.name!r}" if isinstance(error, UnknownName) else error
        raise InvalidInput(f"the card of policy {name!r} is of another version: {what}") from None
