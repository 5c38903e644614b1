"""What each part of the recipe behind `dex5-seen` brings: the same training with one part changed.

Five easy objects, any way up, from the paths of trees, guided by a policy in the first 45 % of the
steps. Then each policy is alone, with nothing drawn and with everything that a hand may be off by.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from conditions import EASY
from learning_ablation import Ablation, Options, Variant
from measuring.settings import settings
from measuring.shares import over_seeds, percent_interval, share

from dexctl.sim import SceneConfig
from dexctl.sim.conditions import CONDITIONS, under
from learning.envs.observation import DEFAULT_PARTS
from learning.evaluation import Evaluation, Protocol, Subject, evaluate, open_subject

FELT = (*DEFAULT_PARTS, "gravity")
POSE = ("object_position", "object_rotation")
TRUTH = (*POSE, "object_velocity", "fingertip_force")
TASK: dict[str, Any] = {
    "object": EASY,
    "controllers": ("regulated:dex5-easy-any",),
    "parts": (*FELT, *POSE),
    "critic_parts": TRUTH,
    "start_from": "paths",
    "start_count": 500,
    "tree_nodes": 8000,
    "starts.tree.kinematic.friction": 0.9,  # else no other grasp of the dodecahedron is found
    "starts.tree.kinematic.residual_limit": 2.0,
    **CONDITIONS["any-gravity"],
    "gravity_straight_share": 0.3,
    "env.max_speed": 1.0,
    "max_reward": 1.0,
    "drop_cost": 20.0,
    "drift_cost": 20.0,
    "joint_noise": 0.01,
    "position_noise": 0.002,
    "normal_noise": 0.1,
    "force_noise": 0.3,
    "symmetry": True,
}
VARIANTS = {
    "recipe": Variant("the recipe"),
    "unseen": Variant("not told the object's pose", changes={"parts": FELT}),
    "by_touch": Variant("told the pose by touch", changes={"object_pose": "touch"}),
    "less_drift": Variant("a fifth of the cost of drift", changes={"drift_cost": 4.0}),
    "less_cost": Variant(
        "the same, and a quarter of that of a drop", changes={"drift_cost": 4.0, "drop_cost": 5.0}
    ),
    "one_image": Variant("without symmetry", changes={"symmetry": False}),
    "exact": Variant(
        "without noise",
        changes=dict.fromkeys(("joint_noise", "position_noise", "normal_noise", "force_noise"), 0),
    ),
    "no_gravity": Variant("not told gravity", changes={"parts": (*DEFAULT_PARTS, *POSE)}),
    "before": Variant("history of 1 and 4 steps", changes={"history": (1, 4)}),
    "blind_critics": Variant("critics see what the policy sees", changes={"critic_parts": ()}),
    "links": Variant("charged for links that touch, 0.2 rad/s", changes={"links_cost": 0.2}),
    "settled": Variant("from the settled grasp", changes={"start_from": "fixed"}),
    "drawn": Variant("everything drawn", changes=CONDITIONS["everything"]),
    "drawn_seen": Variant(
        "the same, and critics see what was drawn",
        changes={
            **CONDITIONS["everything"], "critic_parts": (*TRUTH, "drawn", "joint_offset")
        },
    ),
}  # fmt: skip
_EPISODES = 1000  # seeds of those that policies are evaluated in begin so much later
UNDER = {"nominal": ("any-gravity",), "everything": ("everything", "any-gravity")}
"""What each policy is evaluated under."""


@dataclass(frozen=True, kw_only=True)
class SeenOptions(Options):
    """Settings of the measurement."""

    steps: int = 600_000
    trials: int = 40
    """Episodes of each policy alone, with each object, under each of two sets of conditions."""


class SeenAblation(Ablation):
    """Trainings of several variants, and each policy alone any way up."""

    columns = tuple(f"{what}: {of}" for what in UNDER for of in ("held", "rad/s", "drift [mm]"))

    def alone(self, given: Options) -> str:
        return (
            "the policy alone any way up, told the pose by a tracker, in "
            f"{len(EASY) * given.trials} episodes of {given.seconds:g} s"
        )

    def measure(self, name: str, seed: int, given: Options) -> dict[str, Any]:
        folder, row = self.trained(name, seed, given)
        who = open_subject(folder)
        return {**row, **{what: _alone(who, names, given) for what, names in UNDER.items()}}

    @staticmethod
    def cells(row: Mapping[str, Any]) -> list[str]:
        return [text(row[what]) for what in UNDER for text in (_held, _speed, _drift)]

    @staticmethod
    def line(row: Mapping[str, Any]) -> str:
        return "; ".join(f"{what} {_held(row[what])} {_speed(row[what])}" for what in UNDER)


def _alone(who: Subject, names: tuple[str, ...], given: Options) -> dict[str, Any]:
    """A policy under conditions: over all objects, and how many of each were held."""
    scene = under(SceneConfig(threads=1), *names)
    protocol = Protocol(
        scene=scene, episodes=given.trials, seconds=given.seconds, seed=given.seed + _EPISODES
    )
    every = {name: evaluate(who, protocol, object=name) for name in EASY}

    def over(values: Mapping[str, Evaluation], of: str) -> np.ndarray:
        return np.concatenate([getattr(one, of) for one in values.values()])

    return {
        "held": share(~over(every, "dropped")),
        "held_of_each": {name: int((~one.dropped).sum()) for name, one in every.items()},
        "speed_rad_s": round(float(over(every, "speed").mean()), 4),
        "rotation_rad": over_seeds(over(every, "rotation")),
        "drift_mm": over_seeds(1000.0 * over(every, "drift")),
        "sink_mm": over_seeds(1000.0 * over(every, "sink")),
        "fingertips_only": round(float(over(every, "fingertips_only").mean()), 4),
    }


def _held(row: Mapping[str, Any]) -> str:
    return percent_interval(row["held"])


def _speed(row: Mapping[str, Any]) -> str:
    return f"{row['speed_rad_s']:.2f}"


def _drift(row: Mapping[str, Any]) -> str:
    return f"{row['drift_mm']['median']:.0f}"


def main() -> None:
    given = settings(SeenOptions, __doc__)
    SeenAblation(
        "seen_ablation", "The recipe behind `dex5-seen`", VARIANTS, TASK, "five easy objects", 0.45
    ).run(given)


if __name__ == "__main__":
    main()
