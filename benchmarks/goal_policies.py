"""Trains the two policies that `sequence` turns a cube with, each from where the other leaves it.

A policy about x from the settled grasp; one about z from cubes that it has laid on another face;
the first again from cubes that the second has turned; then both from where the two of them, asked
for goals in turn, really take over from each other, and gently so again, with any orientation as a
goal and by the images of their axes. A cube looks the same in 24 orientations, so its states are
told in the one that is least tilted. A training that is there goes on, or is taken
as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.gait import GoalSequence
from dexctl.gait.sequence import Leg
from dexctl.rotations import inverse, multiply, rotate
from dexctl.settings import changed
from dexctl.sim import GraspStates, SceneConfig, Simulation
from dexctl.state import Bools, Floats, GraspState
from learning.config import TrainConfig, recipe
from learning.envs import ReorientationConfig, TaskConfig
from learning.envs.goals import CUBE, Goals
from learning.evaluation import Protocol, evaluate, rollout
from learning.training.run_folder import RunFolder

Palm = Literal["up", "down", "any"]
X, Z = np.eye(3)[0], np.eye(3)[2]
_TOLD = ("q", "q_target", "contact_position", "contact_normal", "contact_force",
         "goal_angular_velocity")  # fmt: skip
_NEAR = 0.025  # states further from the grasp's place are no starts [m]; ...
_FLAT = 0.2  # ... nor are cubes that lie on an edge [rad]
_FROM_GOALS = {
    "episode_steps": 200,
    "sac": {"learning_rate": 5e-4},
    "drift_cost": 4.0,
    "max_tilt": 0.8,
}
SLOWLY = {
    "learning_rate": 3e-4,
    "learning_rate_end": 5e-5,
    "gradient_steps": 1,
    "learning_starts": 50_000,
}
"""Settings of SAC where a policy goes on from what it can."""
_GENTLY = {
    "episode_steps": 200,
    "sac": SLOWLY,
    "drift_cost": 4.0,
    "drop_cost": 10.0,
    "max_tilt": 0.9,
}
_ROUNDS = 2


class Asked(NamedTuple):
    """What two policies in sequence are asked for while it is watched where they take over."""

    goals: Goals
    images: bool = False
    palm: Palm = "up"
    """Which way it looks, any: uniform on the sphere, for each episode."""


_ASKED = (Asked("uniform"), Asked("uniform", images=True), Asked("cube", images=True))


@dataclass(frozen=True, kw_only=True)
class Rounds(Settings):
    """Settings of any trainings of two policies that take over from each other."""

    num_envs: int = 128
    """Environments of each."""
    episodes: int = 192
    """Episodes with goals in which starts are looked for, and of the evaluation."""
    seconds: float = 60.0
    """Of each of these."""
    runs: Path = Path("out")
    """Folder of the trainings and of the starts."""


@dataclass(frozen=True, kw_only=True)
class Options(Rounds):
    """Settings of the trainings."""

    steps: int = 600_000
    """Environment steps of the first policy about x, and of its second training."""
    about_steps: int = 800_000
    """Of the first policy about z."""
    last_steps: int = 400_000
    """Of the next training of each."""
    gentle_steps: int = 900_000
    """Of the last two of each."""
    states_seconds: float = 25.0
    """Of the episodes in which the first starts are looked for."""
    runs: Path = Path("out/goal_policies")


def lean(quaternion: Floats, upright: Floats, axis: Floats) -> Floats:
    """Of a cube's faces, how far the nearest is from looking along ``axis``, ``(N,)`` [rad]."""
    there = rotate(
        inverse(multiply(quaternion, inverse(upright))), np.tile(axis, (len(upright), 1))
    )
    return np.arccos(np.clip(np.abs(there).max(axis=-1), -1.0, 1.0))


def least_tilted(quaternion: Floats, upright: Floats, axis: Floats) -> Floats:
    """The same cubes told so that what was along ``axis`` upright is nearest to it now."""
    alike = multiply(quaternion[:, None], CUBE)  # (N, 24, 4)
    since = multiply(alike, inverse(upright)[:, None])
    along = rotate(since, np.broadcast_to(axis, (*since.shape[:-1], 3))) @ axis
    return alike[np.arange(len(alike)), along.argmax(axis=1)]


class Kept:
    """States, as starts for a training."""

    def __init__(self) -> None:
        self.rows: list[GraspState] = []

    def add(self, state: GraspState, chosen: Bools) -> None:
        """Take in those of the rows of a batch."""
        self.rows.extend(state[i] for i in np.flatnonzero(chosen))

    def save(self, path: Path, upright: Floats, axis: Floats) -> Path:
        """Write them to a file, each cube told as it is least tilted from ``axis``."""
        if not self.rows:
            raise SystemExit(f"no state for {path}; expected longer episodes")
        column: dict[str, Any] = {
            name: np.array([getattr(row, name) for row in self.rows])
            for name in ("q", "q_target", "object_position", "object_quaternion")
        }
        upright = np.tile(upright, (len(self.rows), 1))
        column["object_quaternion"] = least_tilted(column["object_quaternion"], upright, axis)
        hand = hands.load("dex5")
        GraspStates(
            hand=hand.name,
            joint_names=np.array(hand.joint_names),
            object=np.full(len(self.rows), "cube"),
            **column,
        ).save(path)
        progress(f"{path.name}: {len(self.rows)} starts")
        return path


def visited(
    policy: str, axis: Floats, starts: Path | None, square: bool, given: Options
) -> tuple[Kept, Floats]:
    """What a policy about ``axis`` gets to: cubes that lie flat, and square where that counts."""
    scene = SceneConfig(object=("cube",), initial_states=starts, threads=1)
    kept, rng = Kept(), np.random.default_rng(given.seed)
    who = controllers.resolve(policy, hands.load("dex5"))
    with Simulation(scene, 64, given.seed) as sim:
        settled = sim.sim.groups[0].scene
        upright = settled.settled.qpos[settled.object_qpos][3:]
        rows = np.tile(upright, (64, 1))
        for _ in range(3):
            sim.reset()
            place = sim.state.object_centre().copy()
            for _ in range(round(given.states_seconds / sim.control_period)):
                state = sim.state
                told = replace(state, goal_angular_velocity=np.tile(0.5 * axis, (64, 1)))
                sim.write(state.q_target + who.act(told))
                sim.step()
                state = sim.state
                assert state.object_quaternion is not None
                good = np.linalg.norm(state.object_centre() - place, axis=1) < _NEAR
                good &= state.in_contact.sum(axis=1) >= 3
                good &= lean(state.object_quaternion, rows, Z) < _FLAT
                if square:
                    good &= lean(state.object_quaternion, rows, X) < _FLAT
                kept.add(state, good & (rng.uniform(size=64) < 0.15))
    return kept, upright


def protocol(given: Rounds, seed: int, goals: Goals = "cube", palm: Palm = "up") -> Protocol:
    """Goals of a cube, one after the other."""
    task = TaskConfig(goals=goals, reorientation=ReorientationConfig(goal_count=1000))
    way = {"gravity_tilt": np.pi} if palm == "any" else {"gravity": palm}
    own = {"object": "cube", "episodes": given.episodes, "seconds": given.seconds, "seed": seed}
    return changed(Protocol(task=task), own | way)


class Watched(GoalSequence):
    """Keeps the states in which another controller takes over, as that one sees them."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.kept = {Leg.ABOUT: Kept(), Leg.ACROSS: Kept()}
        self._before: Floats | None = None

    def act_batch(self, state: GraspState) -> Floats:
        action = super().act_batch(state)
        leg = self._leg
        for one, same in ((Leg.READY, Leg.ABOUT), (Leg.LAST, Leg.ACROSS)):
            leg = np.where(leg == one, same, leg)
        away = np.linalg.norm(state.object_centre() - self._place, axis=1)
        before = np.full(len(leg), Leg.NONE) if self._before is None else self._before
        image = np.asarray(self.turner.diagnostics["image"])
        for number, (_, symmetry) in enumerate(self.turner.images):
            seen = symmetry.inverse.of_state(state)
            for one, kept in self.kept.items():
                kept.add(seen, (leg == one) & (before != one) & (away < 0.04) & (image == number))
        self._before = leg
        return action


def pair(
    about: Path | str,
    across: Path | str,
    kind: type[GoalSequence] = GoalSequence,
    *,
    images: bool = False,
) -> Any:
    """The sequence of two policies."""
    hand = hands.load("dex5")
    who: list[Controller] = [controllers.resolve(str(one), hand) for one in (about, across)]
    return kind(hand, about=who[0], across=who[1], images=images)


def taken_over(
    about: Path | str,
    across: Path | str,
    asked: Sequence[Asked],
    seed: int,
    files: tuple[Path, Path],
    given: Rounds,
) -> None:
    """Write where two policies take over from each other, behind what is in the files."""
    if files[1].exists():
        return
    kept, upright = (Kept(), Kept()), np.zeros(4)
    for goals, images, palm in asked:
        both = pair(about, across, Watched, images=images)
        found = rollout(both, protocol(given, seed, goals, palm))
        upright = found.scene.settled.qpos[found.scene.object_qpos][3:]
        for leg, one in zip((Leg.ABOUT, Leg.ACROSS), kept, strict=True):
            one.rows.extend(both.kept[leg].rows)
    for one, path, axis in zip(kept, files, (Z, X), strict=True):
        one.save(path, upright, axis)


def config(given: Rounds, method: str, steps: int, **changes: Any) -> TrainConfig:
    """A training with the recipe fast, its guides there for three of eight steps."""
    own = {"object": "cube", "steps": steps, "seed": given.seed, "num_envs": given.num_envs}
    own |= {"threads": 1, "hard_stop": max(3 * steps // 8, 1)}
    return changed(recipe("fast", method), own | changes)


def train(name: str, given: Rounds, wanted: Callable[[], TrainConfig]) -> Path:
    """The folder of a run that is done."""
    from learning.training.trainer import resume
    from learning.training.trainer import train as begin

    folder = given.runs / name
    run = RunFolder(folder)
    if not RunFolder.is_run(folder):
        begin(wanted(), folder)
    elif max((row["step"] for row in run.progress()), default=0) < run.config().steps:
        resume(folder)
    progress(f"{name}: trained")
    return folder


def gently(
    number: int,
    before: tuple[Path, Path],
    starts: tuple[Path, Path],
    told: dict[str, Any],
    given: Options,
) -> tuple[Path, Path]:
    """Train both on from where they take over from each other; the files of their starts."""
    new = (given.runs / f"new{number}-z.npz", given.runs / f"new{number}-x.npz")
    taken_over(*before, _ASKED, given.seed + 899 + number, new, given)
    found = (given.runs / f"about{number}.npz", given.runs / f"across{number}.npz")
    for one, earlier, path in zip(new, starts, found, strict=True):
        GraspStates.concatenate([GraspStates.load(one), GraspStates.load(earlier)]).save(path)
    for name, begin_from, path, more in (
        ("about", before[0], found[0], told),
        ("across", before[1], found[1], {"axis": "x"}),
    ):
        own = {"begin_from": begin_from, "initial_states": path, **more, **_GENTLY}
        train(f"{name}{number}", given, partial(config, given, "rl", given.gentle_steps, **own))
    return found


def main() -> None:
    given = settings(Options, __doc__)
    given.runs.mkdir(parents=True, exist_ok=True)
    told = {"parts": _TOLD, "commands": ("z",), "command_seconds": 4.0}
    told["critic_parts"] = ("object_position", "object_quaternion", "object_velocity")
    guides = ("gait", "igm")
    x = train("x", given, lambda: config(given, "vge", given.steps, axis="x", controllers=guides))
    files = {name: given.runs / f"{name}.npz" for name in ("laid", "turned", "about", "across")}
    if not files["turned"].exists():
        laid, upright = visited(str(x), X, None, False, given)
        laid.save(files["laid"], upright, Z)
    z = train("z", given, lambda: config(
        given, "vge", given.about_steps, controllers=("coordinated",), episode_steps=400,
        initial_states=files["laid"], **told,
    ))  # fmt: skip
    if not files["turned"].exists():
        turned, upright = visited(str(z), Z, files["laid"], True, given)
        laid, _ = visited(str(x), X, None, False, given)
        turned.rows.extend(laid.rows)
        turned.save(files["turned"], upright, X)
    x2 = train("x2", given, lambda: config(
        given, "rl", given.steps, axis="x", begin_from=x, initial_states=files["turned"],
        episode_steps=400, sac={"learning_rate": 5e-4},
    ))  # fmt: skip
    starts = (files["about"], files["across"])
    taken_over(z, x2, [Asked("cube")], given.seed + 900, starts, given)
    across = train("across", given, lambda: config(
        given, "rl", given.last_steps, axis="x", begin_from=x2, initial_states=starts[1],
        **_FROM_GOALS,
    ))  # fmt: skip
    about = train("about", given, lambda: config(
        given, "rl", given.last_steps, begin_from=z, initial_states=starts[0], **told,
        **_FROM_GOALS,
    ))  # fmt: skip
    pairs = [(z, x), (z, x2), (about, across)]
    for i in range(2, 2 + _ROUNDS):
        starts = gently(i, pairs[-1], starts, told, given)
        pairs.append((given.runs / f"about{i}", given.runs / f"across{i}"))
    rows = []
    for (first, second), goals in product(pairs, ("cube", "uniform")):
        got = evaluate(pair(first, second), protocol(given, given.seed + 50_000, goals)).figures()
        rows.append({"about": first.name, "across": second.name, "goals": goals} | {
            name: one.to_dict() for name, one in got.items()
        })  # fmt: skip
    save(rows, given)


COLUMNS = ["first goal", "to it [s]", "all goals", "in a row", "dropped"]
"""Of what `cells` gives."""


def cells(row: dict[str, Any]) -> list[str]:
    """What a pair of policies reached, for people."""
    return [
        f"{100 * row['share_first_goal_reached']['value']:.0f} %",
        f"{row['first_goal_median_s']['value']:.1f}",
        f"{100 * row['share_goals_reached']['value']:.0f} %",
        f"{row['goals_in_a_row_median']['value']:.0f}",
        f"{100 * row['share_dropped']['value']:.0f} %",
    ]


def figure(row: dict[str, Any], palm: str = "") -> Figure:
    """First goals beside what is asked for; ``palm`` says which way it looks, for people."""
    reached, time = (
        row[name]["value"] for name in ("share_first_goal_reached", "first_goal_median_s")
    )
    return Figure(
        f"goals ({row['goals']}) of a cube{palm}, two policies in sequence: first goals reached",
        f"{100 * reached:.0f} %, median {time:.1f} s",
        "96 %, 7 s",
        reached >= 0.96 and time <= 7,
    )


def title(given: Rounds) -> str:
    """Of the table."""
    return (
        f"Goal orientations of a cube by two policies in sequence, {given.episodes} "
        f"episodes of {given.seconds:g} s"
    )


def save(rows: list[dict[str, Any]], given: Options) -> None:
    """Write what the pairs of policies reach."""
    table = {
        "title": title(given),
        "header": ["about z", "across", "goals", *COLUMNS],
        "rows": [[row["about"], row["across"], row["goals"], *cells(row)] for row in rows],
    }
    write("goal_policies", given, [figure(row) for row in rows[-2:]], [table], trials=rows)


if __name__ == "__main__":
    main()
