"""Goal orientations and commanded axes: a cube, palm up, by the axis-specific controllers in turn.

Any controller or policy can be named instead; a policy must see what is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from common import Figure, Settings, earlier, progress, settings, write

from dexctl.gait import GoalSequence
from dexctl.settings import Names, changed
from learning.envs import ReorientationConfig, TaskConfig, TurningConfig
from learning.envs.goals import GOALS, Goals
from learning.envs.observation import ORIENTATIONS, TURNING
from learning.evaluation import Subject, evaluate, open_subject

Pose = Literal["tracked", "odometry"]
AXES = ("x", "-x", "y", "-y", "z", "-z")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    who: tuple[str, ...] = ("goal", "sequence:dex5-cube-z,dex5-cube-x")
    """Controllers, policies, policy files or run folders."""
    trials: int = 96
    """Episodes of each kind of goals and of each axis."""
    seconds: float = 60.0
    """Of episodes with goals."""
    turning: float = 30.0
    """Of episodes about one axis [s]."""
    object: str = "cube"
    """Which."""
    goals: tuple[Goals, ...] = ("yaw", "cube", "uniform")
    """Kinds of goals."""
    poses: tuple[Pose, ...] = ("tracked", "odometry")
    """How the object's pose is known where there are goals."""
    axes: Names = AXES
    """Commanded axes; where a policy is not told of axes, none."""


def measure(subject: Subject, what: Any, pose: Pose, given: Options) -> dict[str, Any]:
    """One controller with one kind of goals, or about one axis."""
    if what in GOALS:
        seconds, reorientation = given.seconds, ReorientationConfig(goal_count=1000)
        task = TaskConfig(goals=what, reorientation=reorientation)
    else:  # one command for all of the episode
        seconds, most = given.turning, given.turning + 1.0
        task = TaskConfig(turning=TurningConfig(commands=(what,), command_seconds=most))
    protocol = changed(
        replace(subject.protocol(), task=task),
        {
            "object": given.object,
            "gravity": "up",
            "object_pose": pose,
            "episodes": given.trials,
            "seconds": seconds,
            "seed": given.seed,
        },
    )
    found = evaluate(subject, protocol)
    return {name: one.to_dict() for name, one in found.figures().items()}


def wanted(subject: Subject, given: Options) -> list[tuple[str, Pose]]:
    """What a subject can be asked for, and how the object's pose is known then."""
    goals: list[tuple[str, Pose]] = [(what, pose) for pose in given.poses for what in given.goals]
    axes: list[tuple[str, Pose]] = [(what, "tracked") for what in given.axes]
    if isinstance(subject.controller, GoalSequence):
        return goals
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
    tables = [
        {
            "title": f"Goal orientations of a {given.object}, palm up, {given.trials} episodes of "
            f"{given.seconds:g} s, 30 s for each goal: reached within 0.2 rad and at rest",
            "header": [
                "goals", "pose", "", "first goal", "all goals", "to the first [s]", "in a row",
                "dropped",
            ],
            "rows": [
                [
                    row["what"],
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
            "title": f"Turning a {given.object} about commanded axes, palm up, {given.trials} "
            f"episodes of {given.turning:g} s: rotation before any drop, median",
            "header": ["axis", "", "rotation [rad]", "dropped"],
            "rows": [
                [
                    row["what"],
                    row["who"],
                    number(row["rotation_median_rad"], 2),
                    percent(row["share_dropped"]),
                ]
                for row in axes
            ],
        },
    ]  # fmt: skip
    found = [
        Figure(
            f"{row['who']}: first goals reached ({row['what']}, {row['pose']})",
            f"{percent(row['share_first_goal_reached'])}, median "
            f"{row['first_goal_median_s']['value']:.1f} s",
            "80 %",
            row["share_first_goal_reached"]["value"] >= 0.8,
        )
        for row in goals
    ]
    write(
        "reorientation", given, found, [one for one in tables if one["rows"]], trials=rows, say=say
    )


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("reorientation", given)
    done = {(row["who"], row["what"], row["pose"]) for row in rows}
    for name in given.who:
        subject = open_subject(name)
        for what, pose in wanted(subject, given):
            if (name, what, pose) not in done:
                asked = {"who": name, "what": what, "pose": pose}
                rows.append(asked | measure(subject, what, pose, given))
                save(rows, given, say=False)
                progress(f"{name}, {what}, {pose}")
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
