"""Goal orientations and commanded axes: controllers for one axis put together, and policies.

Any controller or policy can be named instead; a policy must see what is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

from common import FULL_TURN, Figure, Settings, earlier, progress, settings, write

from dexctl.gait import CommandedTurning, GoalSequence
from dexctl.planning import sample_grasps
from dexctl.settings import Names, changed
from dexctl.sim import GraspStates, Scene
from learning.envs import ReorientationConfig, TaskConfig, TurningConfig
from learning.envs.goals import GOALS, Goals
from learning.envs.observation import ORIENTATIONS, TURNING
from learning.evaluation import Subject, evaluate, open_subject
from learning.policies import Policy

Pose = Literal["tracked", "odometry"]
AXES = ("x", "-x", "y", "-y", "z", "-z")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    who: tuple[str, ...] = (
        "goal",
        "sequence:dex5-cube-z,dex5-cube-x",
        "commanded:dex5-cube-z,dex5-cube-x,dex5-cube-y",
        "commanded:dex5-easy-any,dex5-sphere-x",
    )
    """Controllers, policies, policy files or run folders."""
    trials: int = 96
    """Episodes of each kind of goals and of each axis."""
    seconds: float = 60.0
    """Of episodes with goals."""
    turning: float = 30.0
    """Of episodes about one axis [s]."""
    object: str = "cube"
    """That is brought to goals."""
    turned: tuple[str, ...] = ("cube", "sphere")
    """That are turned about commanded axes, by policies that were trained with them."""
    goals: tuple[Goals, ...] = ("yaw", "cube", "uniform", "root")
    """Kinds of goals; to the root it is from grasps that are sampled all over the object."""
    palms: tuple[str, ...] = ("up", "down")
    """Which way it looks; down for orientations of a cube alone, where the pose is tracked."""
    starts: int = 200
    """How many grasps are sampled for the way to the root."""
    poses: tuple[Pose, ...] = ("tracked", "odometry")
    """How the object's pose is known where there are goals."""
    axes: Names = AXES
    """Commanded axes; where a policy is not told of axes, none."""


class Asked(NamedTuple):
    """What a subject is asked for: goals of a kind, or an axis."""

    what: str
    object: str
    pose: Pose = "tracked"
    palm: str = "up"


def sampled(name: str, palm: str, given: Options) -> GraspStates:
    """Grasps all over an object, any way round."""
    scene = Scene.build("dex5", name, palm)
    return sample_grasps(scene, given.starts, seed=given.seed, threads=1).states


def measure(subject: Subject, asked: Asked, given: Options) -> dict[str, Any]:
    """One controller with one kind of goals, or about one axis."""
    what: Any = asked.what
    if what in GOALS:
        root = what == "root"
        seconds = given.seconds / 2 if root else given.seconds
        reorientation = ReorientationConfig(goal_count=1 if root else 1000)
        task = TaskConfig(goals=what, reorientation=reorientation)
    else:  # one command for all of the episode
        seconds, most = given.turning, given.turning + 1.0
        task = TaskConfig(turning=TurningConfig(commands=(what,), command_seconds=most))
    protocol = changed(
        replace(subject.protocol(), task=task),
        {
            "object": asked.object,
            "gravity": asked.palm,
            "object_pose": asked.pose,
            "episodes": given.trials,
            "seconds": seconds,
            "seed": given.seed,
        },
    )
    with TemporaryDirectory() as folder:
        if what == "root":
            path = Path(folder) / "starts.npz"
            sampled(asked.object, asked.palm, given).save(path)
            protocol = changed(protocol, {"initial_states": path})
        found = evaluate(subject, protocol)
    return {name: one.to_dict() for name, one in found.figures().items()}


def wanted(subject: Subject, given: Options) -> list[Asked]:
    """What a subject can be asked for, and how the object's pose is known then."""
    goals = [
        Asked(what, given.object, pose, palm)
        for palm in given.palms
        for pose in given.poses
        for what in given.goals
        if palm == "up" or (what, pose) == ("cube", "tracked")
    ]
    axes = [Asked(what, name) for name in given.turned for what in given.axes]
    if isinstance(subject.controller, GoalSequence):
        return goals
    if isinstance(subject.controller, CommandedTurning):
        cards = [one.card for one in subject.controller.turners if isinstance(one, Policy)]
        known = [card["trained"]["env"]["scene"]["object"] for card in cards]
        return [one for one in axes if all(one.object in objects for objects in known)]
    if subject.trained is None:
        return goals + axes
    parts = subject.trained.env.parts
    found = goals if set(ORIENTATIONS) & set(parts) else []
    return found + (axes if TURNING in parts else [])


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""

    def percent(one: dict[str, float]) -> str:
        return f"{100 * one['value']:.0f} % ({100 * one['low']:.0f}-{100 * one['high']:.0f})"

    def number(one: dict[str, float], digits: int = 1) -> str:
        return f"{one['value']:.{digits}f} ({one['low']:.{digits}f}-{one['high']:.{digits}f})"

    goals = [row for row in rows if row["what"] in GOALS]
    axes = [row for row in rows if row["what"] not in GOALS]
    cells = {
        (row["who"], row["object"], row["what"]): f"{number(row['rotation_median_rad'])}, "
        f"{percent(row['share_dropped'])}"
        for row in axes
    }
    tables = [
        {
            "title": f"Goal orientations of a {given.object}, {given.trials} episodes of "
            f"{given.seconds:g} s (to the root half of that, from sampled grasps), 30 s for each "
            "goal: reached within 0.2 rad and at rest",
            "header": [
                "goals", "palm", "pose", "", "first goal", "all goals", "to the first [s]",
                "in a row", "dropped",
            ],
            "rows": [
                [
                    row["what"],
                    row.get("palm", "up"),
                    row["pose"],
                    row["who"],
                    percent(row["share_first_goal_reached"]),
                    percent(row["share_goals_reached"]),
                    number(row["first_goal_median_s"]),
                    number(row["goals_in_a_row_median"]),
                    percent(row["share_dropped"]),
                ]
                for row in goals
            ],
        },
        {
            "title": f"Turning about commanded axes, palm up, {given.trials} episodes of "
            f"{given.turning:g} s: rotation before any drop, median [rad], and dropped",
            "header": ["", "object", *given.axes],
            "rows": [
                [who, name, *(cells.get((who, name, axis), "") for axis in given.axes)]
                for who, name in dict.fromkeys((row["who"], row["object"]) for row in axes)
            ],
        },
    ]  # fmt: skip
    found = [
        Figure(
            f"{row['who']}: first goals reached ({row['what']}, {row['pose']}"
            f"{', palm down' if row.get('palm') == 'down' else ''})",
            f"{percent(row['share_first_goal_reached'])}, median "
            f"{row['first_goal_median_s']['value']:.1f} s",
            "80 %",
            row["share_first_goal_reached"]["value"] >= 0.8,
        )
        for row in goals
    ]
    for who, name in dict.fromkeys((row["who"], row["object"]) for row in axes):
        own = [row for row in axes if (row["who"], row["object"]) == (who, name)]
        good = [
            row["rotation_median_rad"]["value"] >= 2 * FULL_TURN
            and row["share_dropped"]["value"] <= 0.05
            for row in own
        ]
        found.append(
            Figure(
                f"{who}: axes about which a {name} makes two turns in {given.turning:g} s, 95 % "
                "held",
                f"{sum(good)} of {len(own)}",
                f"{len(own)} of {len(own)}",
                all(good),
            )
        )
    write(
        "reorientation", given, found, [one for one in tables if one["rows"]], trials=rows, say=say
    )


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("reorientation", given)
    names = ("who", "what", "object", "pose")
    done = {(*(row[name] for name in names), row.get("palm", "up")) for row in rows}
    for name in given.who:
        subject = open_subject(name)
        for asked in wanted(subject, given):
            if (name, *asked) not in done:
                rows.append({"who": name, **asked._asdict(), **measure(subject, asked, given)})
                save(rows, given, say=False)
                progress(", ".join((name, *asked)))
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
