"""One inspection: rollouts, grasps, gait, drops and training together, and their figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dexctl.settings import to_plain
from dexctl.state import Bools, Floats
from dexctl.statistics import wilson
from learning.evaluation import Protocol, Subject
from learning.inspection.critic import Critic, open_critic
from learning.inspection.gait import GaitStatistics, gait_statistics
from learning.inspection.grasps import Grasps, examine, with_margin
from learning.inspection.onset import CAUSES, Drop, DropRule, find_drops, moments_of
from learning.inspection.rollout import Rollouts, roll_out
from learning.inspection.training import TrainingLog, read_training

MARGIN_EVERY = 2.5
"""Sampling period of the margin over all episodes [s]."""
MARGIN_SHOWN = 0.25
"""The same in the episodes that are shown [s]."""
EXAMPLES = 3
"""Drops that are shown, each of another cause where there are so many."""


@dataclass(frozen=True, eq=False)
class Inspection:
    """What an inspection found.

    Attributes:
        subject: who was inspected.
        rollouts, grasps: what happened.
        sound: where the grasp was sound, by the rule of `learning.inspection.onset`,
            ``(T+1, N)`` bool.
        drops: how each began.
        examples: those that are shown.
        gait: how the fingers took turns.
        rule: of soundness and drops.
        training: the log of the run; None without.
        asked: the critic of the run; None without.
        remarks: what the reader should know.
    """

    subject: Subject
    rollouts: Rollouts
    grasps: Grasps
    sound: Bools
    drops: list[Drop]
    examples: list[Drop]
    gait: GaitStatistics
    rule: DropRule
    training: TrainingLog | None
    asked: Critic | None = None
    remarks: tuple[str, ...] = ()

    def causes(self) -> list[tuple[str, list[Drop]]]:
        """The causes that occurred with their drops, the most frequent first."""
        count = Counter(drop.cause for drop in self.drops)
        order = sorted(count, key=lambda name: (-count[name], list(CAUSES).index(name)))
        return [(name, [drop for drop in self.drops if drop.cause == name]) for name in order]

    def angles(self) -> dict[str, dict[str, Any]]:
        """The angle between what was done and what each controller would have done, by name."""
        found: dict[str, dict[str, Any]] = {}
        acting = self.rollouts.acting
        done = np.linalg.norm(self.rollouts.action, axis=-1)[acting]
        for name, shadow in self.rollouts.shadows.items():
            one: dict[str, Any] = {}
            for which in ("all", "on", "off", "motion"):
                angle = self.rollouts.angle(name, which)[acting]
                defined = angle[np.isfinite(angle)]
                one[which] = {
                    **_spread(np.rad2deg(defined), "deg"),
                    "below_60_deg_share": float((defined < np.pi / 3).mean())
                    if len(defined)
                    else None,
                    "undefined_share": float(1.0 - len(defined) / max(len(angle), 1)),
                }
            asked = np.linalg.norm(shadow, axis=-1)[acting]
            both = (done > 0) & (asked > 0)
            one["size_ratio_median"] = (
                float(np.median(done[both] / asked[both])) if both.any() else None
            )
            found[name] = one
        return found

    def critic(self) -> dict[str, Any] | None:
        """What the critic says of the policy and each controller; None without a critic."""
        valued = self.rollouts.valued
        if valued is None or self.asked is None:
            return None
        acting = self.rollouts.acting
        values, chances = valued.values[acting], valued.chances[acting]
        names = ("policy", *self.rollouts.shadows)
        best = values.argmax(axis=-1)
        return {
            "checkpoint_steps": self.asked.steps,
            "temperature": self.asked.temperature,
            "p_psi": _spread(1.0 - chances[:, 0]),
            "candidates": {
                name: {
                    "value": _spread(values[:, k]),
                    "p": _spread(chances[:, k]),
                    "best_share": float((best == k).mean()),
                }
                for k, name in enumerate(names)
            },
        }

    def grip(self) -> dict[str, Any]:
        """Soundness, residual, margin, slip and force over the time held."""
        trace, grasps = self.rollouts.trace, self.grasps
        held, acting = trace.held, self.rollouts.acting
        touching = trace.in_contact & held[..., None]
        seconds = (trace.in_contact[:-1] & acting[..., None]).sum(axis=(0, 1)) * self.period
        slid = np.where(acting[..., None], grasps.slip, 0.0).sum(axis=(0, 1))
        force = np.where(touching, trace.contact_force, 0.0).sum(axis=(0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            slip, press = slid / seconds, force / touching.sum(axis=(0, 1))
        return {
            "sound_share": float(self.sound[held].mean()),
            "closure_share": float(grasps.closure[held].mean()),
            "residual": _spread(grasps.residual[held]),
            "margin": _spread(grasps.margin[held]),
            "margin_samples": int(np.isfinite(grasps.margin[held]).sum()),
            "tilt_rad": _spread(grasps.tilt[held]),
            "slip_m_per_s": slip,
            "force_mean_n": press,
        }

    @property
    def period(self) -> float:
        """Of control [s]."""
        return self.rollouts.period

    def to_dict(self) -> dict[str, Any]:
        """Every figure, as JSON can hold it; units are in the names."""
        subject, evaluation = self.subject, self.rollouts.evaluation
        seed, count = evaluation.protocol.seed, len(evaluation.rotation)
        return {
            "subject": subject.name,
            "kind": subject.kind,
            "card": subject.card,
            "remarks": list(self.remarks),
            "protocol": to_plain(evaluation.protocol),
            "object": evaluation.object,
            "results": evaluation.to_dict(),
            "gait": self.gait.to_dict(),
            "grasp": self.grip(),
            "angles": self.angles(),
            "critic": self.critic(),
            "drops": {
                "rule": asdict(self.rule),
                "causes": {
                    name: {
                        "count": len(drops),
                        "share_of_drops": wilson(len(drops), len(self.drops)).to_dict(),
                        "lead_median_s": float(np.median([drop.lead for drop in drops])),
                    }
                    for name, drops in self.causes()
                },
                "each": [drop.to_dict() | {"seed": seed + drop.episode} for drop in self.drops],
            },
            "episodes": [
                {
                    "seed": seed + i,
                    "rotation_rad": float(evaluation.rotation[i]),
                    "time_held_s": float(evaluation.time_held[i]),
                    "dropped": bool(evaluation.dropped[i]),
                    "return": float(evaluation.returns[i]),
                }
                for i in range(count)
            ],
            "training": None if self.training is None else self.training.to_dict(),
        }


def inspect(
    subject: Subject,
    protocol: Protocol | None = None,
    shadows: Sequence[str] = (),
    *,
    rule: DropRule | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Inspection:
    """Inspect a run, a policy, or a controller in the policy's place.

    Args:
        subject: see `learning.evaluation.open_subject`.
        protocol: how it is rolled out, with one object; None is 16 episodes as in training.
        shadows: the controllers to compare with; none: see `roll_out`.
        rule: of soundness and drops; None is `DropRule.of` the protocol's task.
        progress: called with what is going on and the share of it that is done.

    Raises:
        UnknownName, InvalidInput, SimulationError: see `roll_out` and `read_training`.
        CheckpointError, MissingExtra: see `open_critic`.
    """
    if protocol is None:
        protocol = subject.protocol(episodes=16)
    rule = rule if rule is not None else DropRule.of(protocol.task.turning)
    tell = progress if progress is not None else (lambda what, share: None)
    critic, *remarks = open_critic(subject)
    training = None
    if subject.folder is not None and subject.folder.progress_path.exists():
        training = read_training(subject.folder)
    rollouts = roll_out(
        subject,
        protocol,
        shadows,
        critic=critic,
        progress=lambda now: tell("rollouts", now / protocol.seconds),
    )
    name = rollouts.evaluation.object
    if subject.trained is not None and name not in subject.objects:
        remarks.append(
            f"The policy was trained with {', '.join(subject.objects)}, not with {name}."
        )
    trace, period = rollouts.trace, rollouts.period
    scene = rollouts.scene
    grasps = examine(
        trace,
        scene,
        friction=scene.friction(),
        progress=lambda share: tell("grasps", share),
    )
    drops = find_drops(trace, grasps, period, rule)
    examples = _examples(drops)
    wanted = np.zeros(trace.held.shape, bool)
    wanted[:: max(1, round(MARGIN_EVERY / period))] = True
    fine = max(1, round(MARGIN_SHOWN / period))
    for episode in {rollouts.typical, *(drop.episode for drop in examples)}:
        wanted[::fine, episode] = True
    grasps = with_margin(grasps, trace, wanted, progress=lambda share: tell("margins", share))
    count = trace.held.shape[1]
    sound = np.stack([moments_of(trace, grasps, i).sound(rule) for i in range(count)], axis=1)
    return Inspection(
        subject=subject,
        rollouts=rollouts,
        grasps=grasps,
        sound=sound,
        drops=drops,
        examples=examples,
        gait=gait_statistics(trace.in_contact, trace.held, period),
        rule=rule,
        training=training,
        asked=critic,
        remarks=tuple(remark for remark in remarks if remark is not None),
    )


def _examples(drops: list[Drop]) -> list[Drop]:
    """Drops to show: of the most frequent causes, each with the median lead of its cause."""
    count = Counter(drop.cause for drop in drops)
    chosen = []
    for name, _ in count.most_common(EXAMPLES):
        ordered = sorted((drop for drop in drops if drop.cause == name), key=lambda d: d.lead)
        chosen.append(ordered[len(ordered) // 2])
    return chosen


def _spread(values: Floats, unit: str = "") -> dict[str, float | None]:
    """Median, 10th and 90th percentile of the finite numbers; None where there are none."""
    end = f"_{unit}" if unit else ""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {f"{name}{end}": None for name in ("median", "p10", "p90")}
    low, middle, high = np.percentile(finite, [10, 50, 90])
    return {f"median{end}": float(middle), f"p10{end}": float(low), f"p90{end}": float(high)}
