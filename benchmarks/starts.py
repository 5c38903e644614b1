"""Where episodes begin, and who guides them: the comparison of the thesis's chapter 5.

PPO from a fixed start, sampled grasps, explored states, under growing gravity, and from the paths
of a tree, without and with imitation; and this library's quicker learners from the same starts: SAC
alone, and guided by controllers or by a gait that follows a tree. Each policy is then alone, from
the settled grasp and from grasps of a tree that no training has seen. A training that is there is
not done again, or goes on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, percent_interval, share
from measuring.trials import FULL_TURN

from dexctl.controllers import is_named
from dexctl.planning import Kinematic, Stability, Tree, grow, path_states
from dexctl.settings import changed, to_plain
from dexctl.sim import Scene
from dexctl.statistics import bootstrap
from dexctl.validation import unit_axis
from learning.config import TrainConfig, recipe
from learning.evaluation import Protocol, Subject, evaluate, open_subject
from learning.evaluation.figures import Evaluation
from learning.training.run_folder import RunFolder

_HELD_OUT = 1000  # trees that nobody has trained from have the seed seed + this
_STARTS = 2000  # states of such a tree


@dataclass(frozen=True)
class Task:
    """What is turned, about which axis, and by what the guided methods are guided.

    Attributes:
        title: for people.
        object: its name.
        axis: of the rotation.
        gravity: which way the palm looks.
        guides: controllers of the guided methods.
        hand: its name.
        settings: others of scene and task, in training and out of it.
        training: others of its trainings.
        kinematic: how its trees are expanded.
        stability: when their grasps count.
        turns: goal for the median episode.
        least_turns: floor of it; None: there is none.
        most_dropped: share of episodes that the goal lets be dropped.
    """

    title: str
    object: str
    axis: str = "z"
    gravity: str = "up"
    guides: tuple[str, ...] = ("coordinated",)
    hand: str = "dex5"
    settings: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    kinematic: Kinematic = Kinematic()
    stability: Stability = Stability()
    turns: float = 8.0
    least_turns: float | None = 5.0
    most_dropped: float = 0.02

    @property
    def goal(self) -> str:
        """What is wanted, for people."""
        said = f"{self.turns:g} turns ({self.turns * FULL_TURN:.1f} rad)"
        if self.most_dropped < 1.0:
            said += f", under {100 * self.most_dropped:g} % dropped"
        if self.least_turns is None:
            return said
        return f"{said} (floor: {self.least_turns:g} turn{'s' * (self.least_turns != 1)})"

    @property
    def protocol(self) -> dict[str, Any]:
        """Settings of `Protocol`, by name."""
        return {
            "hand": self.hand, "object": self.object, "axis": self.axis, "gravity": self.gravity,
            **self.settings,
        }  # fmt: skip


@dataclass(frozen=True)
class Method:
    """One way to train.

    Attributes:
        title: for people.
        changes: settings of the training.
        algorithm, method: of the training.
        by_tree: a gait that follows a tree guides, in place of the task's own guides.
    """

    title: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    algorithm: str = "ppo"
    method: str = "rl"
    by_tree: bool = False


_FULL_CRITIC = ("object_position", "object_quaternion", "object_velocity", "fingertip_force")
TASKS = {
    "sphere_x": Task(
        "sphere about x, palm up", "sphere", "x", guides=("gait", "igm"),
        turns=4.0, least_turns=None, most_dropped=1.0,
    ),
    "cube_x": Task(
        "cube about x, palm up", "cube", "x", guides=("gait", "igm"),
        turns=4.0, least_turns=None, most_dropped=1.0,
    ),
    "l": Task("L about z, palm up", "l_shape"),
    "l_down": Task("L about z, palm down", "l_shape", gravity="down"),
    "u": Task("U about z, palm up", "u_shape"),
    "u_down": Task("U about z, palm down", "u_shape", gravity="down"),
    "allegro_cube": Task(
        "cube about z in the Allegro, palm up",
        "cube",
        hand="wonik_allegro",
        # its fingers' links lie at the cube whatever it does
        settings={"object_mass": 0.05, "only_fingertips": False, "max_reward": 1.0},
        training={
            "max_speed": 1.0,
            "joint_noise": 0.02,
            "critic_parts": _FULL_CRITIC,
        },
        kinematic=Kinematic(
            friction=0.8, margin=0.002, residual_limit=0.5, landing=1.0, height=0.02, force=1.0
        ),
        stability=Stability(fingertips_only=False),
        turns=4.0,
        least_turns=1.0,
        most_dropped=0.05,
    ),
}  # fmt: skip
METHODS = {
    "guides": Method("guide alone"),
    "tree": Method("gait that follows a tree, alone"),
    "policy": Method("one policy, any way up"),
    "fi": Method("PPO, fixed start (FI)"),
    "sgs": Method("PPO, sampled grasps (SGS)", {"start_from": "grasps"}),
    "er": Method("PPO, explored restarts (ER)", {"start_from": "explored"}),
    "gc": Method("PPO, gravity curriculum (GC)", {"start_from": "gravity"}),
    "rxr": Method("PPO, paths of a tree (RxR)", {"start_from": "paths"}),
    "rxr_ipt": Method(
        "PPO, paths, imitation (RxR + IPT)", {"start_from": "paths", "imitated": "joints"}
    ),
    "rl": Method("SAC, fixed start", algorithm="sac"),
    "rl_paths": Method("SAC, paths of a tree", {"start_from": "paths"}, "sac"),
    "vge": Method("guided (VGE), fixed start", {}, "sac", "vge"),
    "vge_paths": Method("guided (VGE), paths of a tree", {"start_from": "paths"}, "sac", "vge"),
    "vge_tree": Method("guided by a tree (VGE), fixed start", {}, "sac", "vge", by_tree=True),
    "vge_tree_paths": Method(
        "guided by a tree (VGE), paths of a tree", {"start_from": "paths"}, "sac", "vge",
        by_tree=True,
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    tasks: tuple[str, ...] = ("sphere_x", "l")
    """Which."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Which."""
    seeds: tuple[int, ...] = (0,)
    """Of the trainings, each once with each; with --resume those of other seeds stay. --seed is
    that of the episodes and of the trees that are held out."""
    steps: int = 1_000_000
    """Environment steps of each training with SAC; the guides stop after 4 of 10."""
    ppo_steps: int = 10_000_000
    """Environment steps of each training with PPO."""
    tree_nodes: int = 100_000
    """Nodes of a tree."""
    trials: int = 100
    """Episodes of each policy alone, from either kind of start."""
    seconds: float = 60.0
    """Of each."""
    num_envs: int = 128
    """Environments of each training."""
    policy: str = "dex5-shapes-fast"
    """Shipped policy that stands beside those trained here, by name."""
    trained_only: bool = False
    """Evaluate what has been trained, and train nothing."""
    runs: Path = Path("out/starts")
    """Folder of the trainings, TASK-METHOD-SEED; one that is there is taken as it is."""


def config(
    task: Task, method: Method, given: Options, seed: int = 0, by: tuple[str, ...] = ()
) -> TrainConfig:
    """Everything that a training with this seed is, guided by the task's own guides or ``by``."""
    steps = given.ppo_steps if method.algorithm == "ppo" else given.steps
    base = recipe("fast", method.method)
    own: dict[str, Any] = {}
    if method.algorithm == "ppo":
        own["critic_parts"] = _FULL_CRITIC
        own["gravity_steps"] = max(steps // 2, 1)
    if method.changes.get("imitated"):
        own["critic_steps"] = steps // 20
    return changed(
        base,
        {
            "algorithm": method.algorithm,
            **task.protocol,
            **task.training,
            "controllers": by or task.guides,
            "hard_stop": max(int(0.4 * steps), 1),
            "steps": steps,
            "seed": seed,
            "num_envs": given.num_envs,
            "tree_nodes": given.tree_nodes,
            "threads": 1,
            "starts.tree.kinematic": to_plain(task.kinematic),
            "starts.stability": to_plain(task.stability),
            **own,
            **method.changes,
        },
    )


def trained(folder: Path, wanted: TrainConfig, given: Options) -> TrainConfig | None:
    """Train, or go on; the configuration of the run, None where there is none."""
    from learning.training.trainer import resume, train

    there = RunFolder.is_run(folder)
    if not there and given.trained_only:
        return None
    if not given.trained_only:
        _ = resume(folder) if there else train(wanted, folder)
    return RunFolder(folder).config()


def tree_of(
    task: Task,
    seed: int,
    nodes: int,
    *,
    seconds: float | None = None,
    until_rotation: float | None = None,
) -> tuple[Scene, Tree]:
    """The scene of a task and a tree of it, which is done where `grow` says."""
    (scene,) = changed(Protocol(), task.protocol).scene.scenes()
    tree = grow(
        scene, task.kinematic, nodes=max(nodes, 2), axis=unit_axis(task.axis), seed=seed,
        stability=task.stability, seconds=seconds, until_rotation=until_rotation,
    )  # fmt: skip
    return scene, tree


def guiding_tree(name: str, task: Task, given: Options, seed: int) -> Path:
    """File of a tree that turns the object once, to be followed."""
    path = given.runs / f"tree-{name}-{seed}.npz"
    if not path.exists():
        _, tree = tree_of(task, seed, given.tree_nodes, until_rotation=FULL_TURN)
        path.parent.mkdir(parents=True, exist_ok=True)
        tree.save(path)
    return path


def held_out(name: str, task: Task, given: Options) -> Path:
    """File of grasps on the paths of another tree."""
    path = given.runs / f"held-out-{name}-{given.seed + _HELD_OUT}.npz"
    if not path.exists():
        scene, tree = tree_of(task, given.seed + _HELD_OUT, given.tree_nodes // 4, seconds=60.0)
        path.parent.mkdir(parents=True, exist_ok=True)
        path_states(tree, _STARTS, goals="even", scene=scene).save(path)
    return path


def guides(name: str, method: str, given: Options) -> list[dict[str, Any]]:
    """The controllers that guide a task, or one that follows a tree, each alone: their rows."""
    task, rows = TASKS[name], []
    own = task.guides
    if method == "tree":
        own = (f"planned:{guiding_tree(name, task, given, given.seed)}",)
    for guide in own:
        subject = open_subject(guide, hand=task.hand)
        protocol = subject.protocol(
            **task.protocol, episodes=given.trials, seconds=given.seconds,
            seed=given.seed + _HELD_OUT,
        )  # fmt: skip
        about = {"task": name, "method": method, "guides": [guide.partition(":")[0]], "steps": 0}
        rows.append({**about, "from": "settled", **outcome(evaluate(subject, protocol))})
    return rows


def outcome(got: Evaluation) -> dict[str, Any]:
    """What an evaluation came to."""
    return {
        "rotation_rad": over_seeds(got.rotation),
        "time_held_s": over_seeds(got.time_held),
        "dropped": share(got.dropped),
        "full_turn": share(got.rotation >= FULL_TURN),
        "return_mean": round(float(got.returns.mean()), 2),
        "fingertips_only": round(float(got.fingertips_only.mean()), 4),
    }


def shipped(name: str, given: Options) -> list[dict[str, Any]]:
    """The rows of the shipped policy; none where it is for another hand."""
    task = TASKS[name]
    # a policy knows its hand; who is put together by name is asked for the task's
    own = task.hand if is_named(given.policy) else None
    subject = open_subject(given.policy, hand=own)
    if subject.hand != task.hand:
        return []
    about = {"task": name, "method": "policy", "policy": given.policy, "steps": 0}
    return both_starts(subject, name, about, given, **task.protocol)


def both_starts(
    subject: Subject,
    name: str,
    about: dict[str, Any],
    given: Options,
    **changes: Any,
) -> list[dict[str, Any]]:
    """What it does from the settled grasp, and from grasps that were held out."""
    task, rows = TASKS[name], []
    for kind in ("settled", "held out"):
        protocol = subject.protocol(
            episodes=given.trials, seconds=given.seconds, seed=given.seed + _HELD_OUT, **changes
        )
        if kind == "held out":
            scene = replace(protocol.scene, initial_states=held_out(name, task, given))
            protocol = replace(protocol, scene=scene)
        rows.append({**about, "from": kind, **outcome(evaluate(subject, protocol))})
    return rows


def measure(name: str, method: str, seed: int | None, given: Options) -> list[dict[str, Any]]:
    """One training: its rows, none where it is not there; no seed: nothing is trained."""
    if method in ("guides", "tree"):
        return guides(name, method, given)
    if seed is None:
        return shipped(name, given)
    task = TASKS[name]
    folder, how, by = given.runs / f"{name}-{method}-{seed}", METHODS[method], ()
    if how.by_tree and not (given.trained_only or RunFolder.is_run(folder)):
        by = (f"planned:{guiding_tree(name, task, given, seed)}",)
    found = trained(folder, config(task, how, given, seed, by), given)
    if found is None:
        return []
    subject = open_subject(str(folder))
    start = found.starts.start_from
    if found.env.scene.initial_states is not None:
        start = "file"
    last = RunFolder(folder).progress()[-1]
    about = {
        "task": name, "method": method, "training_seed": found.seed, "steps": int(last["step"]),
        "training_s": tenths(last["seconds"]), "training_cpu_s": tenths(last.get("cpu_seconds")),
        "start_from": start, "algorithm": found.algorithm, "guides": [
            guide.partition(":")[0] for guide in found.guides
        ],
        "hard_stop": found.guidance.hard_stop if found.guides else None,
    }  # fmt: skip
    return both_starts(subject, name, about, given)


def tenths(seconds: float | None) -> float | None:
    """Seconds to a tenth, so that short trainings take some; None where the log has no number."""
    return None if seconds is None or np.isnan(seconds) else round(seconds, 1)


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    """What is measured once: task, method, policy and seed of the training."""
    return row["task"], row["method"], row.get("policy"), row.get("training_seed")


def whose(row: dict[str, Any]) -> str:
    """Whose row it is, in words."""
    names = {"guides": ", ".join(row.get("guides") or ()), "policy": row.get("policy")}
    name = names.get(row["method"])
    return METHODS[row["method"]].title + (f": {name}" if name else "")


def minutes(row: dict[str, Any]) -> str:
    """How long a training took, and the processor time of it, where they are known."""
    wall, cpu = row.get("training_s"), row.get("training_cpu_s")
    if wall is None:
        return ""
    return f"{wall / 60:.0f}" + ("" if cpu is None else f" ({cpu / 60:.0f})")


def line(row: dict[str, Any]) -> list[str]:
    """A line of the table."""
    turned = row["rotation_rad"]
    low, high = turned["bootstrap95"]
    return [
        TASKS[row["task"]].title,
        whose(row),
        str(row.get("training_seed", "")),
        f"{row['steps'] / 1e6:.2f}" if row["steps"] else "",
        minutes(row),
        row["from"],
        f"{turned['median']:.1f} ({low:.1f}-{high:.1f})",
        f"{turned['median'] / FULL_TURN:.1f}",
        percent_interval(row["full_turn"]),
        percent_interval(row["dropped"]),
    ]


@dataclass(frozen=True)
class Pooled:
    """The rows of one method, or of one policy, from starts held out: a row for each seed."""

    rows: list[dict[str, Any]]

    @property
    def turned(self) -> float:
        """Interquartile mean over the seeds of the median rotation [rad]."""
        return bootstrap([row["rotation_rad"]["median"] for row in self.rows], "iqm").value

    def share(self, name: str) -> dict[str, Any]:
        """Of the episodes of all seeds."""
        hits = sum(row[name]["count"] for row in self.rows)
        of = sum(row[name]["of"] for row in self.rows)
        return share(np.arange(of) < hits)

    def said(self) -> str:
        """What they came to, for people."""
        what = "median" if len(self.rows) == 1 else f"interquartile mean of {self.seeds}' medians"
        dropped = self.share("dropped")
        return f"{what} {self.turned:.1f} rad, {dropped['count']} of {dropped['of']} dropped"

    @property
    def seeds(self) -> str:
        """How many, for people."""
        return f"{len(self.rows)} seeds"

    def named(self, title: str) -> str:
        """``title``, with the seeds where there are several."""
        return title if len(self.rows) == 1 else f"{title}, {self.seeds}"


def figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """How far the surest policy of each task turns, and what planned starts are worth."""
    found = []
    for name, task in TASKS.items():
        each: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            if row["task"] == name and row["from"] == "held out":
                each.setdefault(whose(row), []).append(row)
        if not each:
            continue
        own = {title: Pooled(those) for title, those in each.items()}
        # of those that turn as far as is asked the surest, by these episodes; else the furthest
        title, best = max(own.items(), key=partial(_rank, task))
        sure = task.most_dropped >= 1.0 or best.share("dropped")["share"] < task.most_dropped
        found.append(
            Figure(
                f"{task.title}: rotation in {best.rows[0]['time_s']:g} s from starts held out, "
                f"{title}",
                best.said(),
                task.goal,
                bool(best.turned >= task.turns * FULL_TURN and sure),
            )
        )
        for fixed, paths in (
            ("fi", "rxr"), ("fi", "rxr_ipt"), ("rl", "rl_paths"), ("vge", "vge_paths"),
            ("vge_tree", "vge_tree_paths"),
        ):  # fmt: skip
            theirs, ours = (own.get(METHODS[method].title) for method in (fixed, paths))
            if theirs is None or ours is None:
                continue
            before, now = theirs.share("full_turn"), ours.share("full_turn")
            found.append(
                Figure(
                    f"{task.title}: episodes with a full turn from starts held out, "
                    f"{ours.named(METHODS[paths].title)}",
                    percent_interval(now),
                    "more than from a fixed start, intervals apart: "
                    + theirs.named(percent_interval(before)),
                    bool(now["wilson95"][0] > before["wilson95"][1]),
                )
            )
    return found


def _rank(task: Task, one: tuple[str, Pooled]) -> tuple[bool, float, float]:
    pooled = one[1]
    far = pooled.turned >= task.turns * FULL_TURN
    return far, -pooled.share("dropped")["share"] if far else 0.0, pooled.turned


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    found = sorted({row["dropped"]["of"] for row in rows})
    counts = " or ".join(map(str, found))
    table = {
        "title": f"Starts of episodes: the policy alone, {counts} episodes of "
        f"{given.seconds:g} s, median rotation before any drop (95 % interval), each seed of "
        "training by itself; minutes of training (processor time)",
        "header": [
            "Task", "Method", "seed", "10^6 steps", "minutes", "from", "rotation [rad]", "turns",
            "full turn", "dropped",
        ],
        "rows": [line(row) for row in rows],
    }  # fmt: skip
    write("starts", given, figures(rows), [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("task", given.tasks, TASKS)
    check_chosen("method", given.methods, METHODS)
    rows = earlier("starts", given)
    done = {key(row) for row in rows}
    for name, method in product(given.tasks, given.methods):
        alone = method in ("guides", "tree", "policy")
        for seed in (None,) if alone else given.seeds:
            if (name, method, given.policy if method == "policy" else None, seed) in done:
                continue
            more = [{**row, "time_s": given.seconds} for row in measure(name, method, seed, given)]
            rows += more
            if more:
                save(rows, given, say=False)
                progress("; ".join(line(more[-1])))
    tasks, methods = list(TASKS), list(METHODS)
    rows.sort(
        key=lambda row: (
            tasks.index(row["task"]), methods.index(row["method"]), row.get("training_seed", 0),
        )
    )  # fmt: skip
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
