"""Goal orientations and commanded axes: controllers for one axis put together, and policies.

Any controller or policy can be named instead; a policy must see what is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from measuring.poses import Pose, known
from measuring.results import FIXED, Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.trials import FULL_TURN

from dexctl.gait import CommandedTurning, GoalPursuit, GoalSequence
from dexctl.planning import sample_grasps
from dexctl.settings import Names, changed
from dexctl.sim import GraspStates, Scene
from learning import policies
from learning.envs import ReorientationConfig, TaskConfig, TurningConfig
from learning.envs.goals import GOALS, Goals
from learning.envs.observation import ORIENTATIONS, TURNING
from learning.evaluation import Subject, evaluate, open_subject
from learning.policies import Policy

AXES = ("x", "-x", "y", "-y", "z", "-z")
PARTS = ("goals", "axes", "changing", "long")
CHANGING = "changing"  # what is asked for where one command comes after the other
FLOOR = 0.8
"""Share of first goals that a controller has to reach at least."""
GOAL = {"cube": (0.96, 7.0), "uniform": (0.96, 7.0)}
"""What is asked for: that share, and the median time to the first goal [s]."""
IN_A_ROW = 20
"""Goals one after the other that are asked for, in the median episode."""


IN_CARDS = ("share_first_goal_reached", "first_goal_median_s", "goals_in_a_row_median")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    who: tuple[str, ...] = (
        "goal",
        "sequence:dex5-cube-z,dex5-cube-x",
        "sequence:dex5-cube-z-any,dex5-cube-x-any",
        "dex5-cube-goals",
        "dex5-cube-goals-touch",
        "commanded:dex5-cube-z,dex5-cube-x,dex5-cube-y",
        "commanded:dex5-easy-any,dex5-sphere-x",
        "dex5-axes",
        "pursuing:dex5-cube-goals",
        "pursuing:dex5-cube-goals-touch",
    )
    """Controllers, policies, policy files or run folders."""
    parts: tuple[str, ...] = PARTS
    """Which: goals, axes that stay for an episode, axes of which another is commanded every now and
    then (changing), and orientations of a cube in longer episodes (long)."""
    trials: int = 96
    """Episodes of each kind of goals and of each axis."""
    seconds: float = 60.0
    """Of episodes with goals, and of those whose commands change."""
    long: float = 150.0
    """Of the longer episodes [s]."""
    command_seconds: float = 10.0
    """How long each command holds where they change [s]."""
    turning: float = 30.0
    """Of episodes about one axis [s]."""
    object: str = "cube"
    """That is brought to goals."""
    turned: tuple[str, ...] = ("cube", "sphere")
    """That are turned about commanded axes, by policies that were trained with them."""
    goals: tuple[Goals, ...] = ("yaw", "cube", "uniform", "root")
    """Kinds of goals; to the root it is from grasps that are sampled all over the object."""
    palms: tuple[str, ...] = ("up", "down", "any")
    """Which way it looks, any: uniform on the sphere, for each episode; down and any for
    orientations of a cube and uniform ones, where the pose is more than reckoned."""
    starts: int = 200
    """How many grasps are sampled for the way to the root."""
    poses: tuple[Pose, ...] = ("tracked", "late", "touch", "odometry")
    """How the object's pose is known where there are goals; late: by a tracker 100 ms late, 3 mm
    and 0.05 rad off."""
    axes: Names = AXES
    """Commanded axes; where a policy is not told of axes, none."""
    cards: bool = False
    """Whether the policies' cards are to say what was measured."""


class Asked(NamedTuple):
    """What a subject is asked for, in episodes of so many seconds: goals of a kind, or axes."""

    what: str
    object: str
    seconds: float
    pose: Pose = "tracked"
    palm: str = "up"


def asked_of(row: dict[str, Any], given: Options) -> Asked:
    """What a row was asked for; those of earlier results do not say all of it."""
    usual = given.turning
    if row["what"] in GOALS:
        usual = given.seconds / 2 if row["what"] == "root" else given.seconds
    return Asked(
        row["what"],
        row["object"],
        row.get("seconds", usual),
        row["pose"],
        row.get("palm", "up"),
    )


def sampled(name: str, palm: str, given: Options) -> GraspStates:
    """Grasps all over an object, any way round."""
    scene = Scene.build("dex5", name, palm)
    return sample_grasps(scene, given.starts, seed=given.seed, threads=1).states


def measure(subject: Subject, asked: Asked, given: Options) -> dict[str, Any]:
    """One controller with one kind of goals, or about one axis."""
    what: Any = asked.what
    if what in GOALS:
        reorientation = ReorientationConfig(goal_count=1 if what == "root" else 1000)
        task = TaskConfig(goals=what, reorientation=reorientation)
    elif what == CHANGING:
        commands = TurningConfig(commands=given.axes, command_seconds=given.command_seconds)
        task = TaskConfig(turning=commands)
    else:  # one command for all of the episode
        most = asked.seconds + 1.0
        task = TaskConfig(turning=TurningConfig(commands=(what,), command_seconds=most))
    protocol = changed(
        replace(subject.protocol(), task=task),
        {
            "object": asked.object,
            "gravity": "up" if asked.palm == "any" else asked.palm,
            "gravity_tilt": pi if asked.palm == "any" else 0.0,
            **known(asked.pose),
            "episodes": given.trials,
            "seconds": asked.seconds,
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
    goals, axes = [], []
    if "goals" in given.parts:
        goals = [
            Asked(
                what,
                given.object,
                given.seconds / 2 if what == "root" else given.seconds,
                pose,
                palm,
            )
            for palm in given.palms
            for pose in given.poses
            for what in given.goals
            if palm == "up" or (what in GOAL and pose != "odometry")
        ]
    if "long" in given.parts:
        goals += [Asked("cube", given.object, given.long, palm=palm) for palm in given.palms]
    for name in given.turned:
        if "axes" in given.parts:
            axes += [Asked(what, name, given.turning) for what in given.axes]
        if CHANGING in given.parts:
            axes.append(Asked(CHANGING, name, given.seconds))
    if isinstance(subject.controller, GoalSequence):
        return goals
    if isinstance(subject.controller, CommandedTurning):
        cards = [one.card for one in subject.controller.turners if isinstance(one, Policy)]
        shown = [card["trained"]["env"]["scene"]["object"] for card in cards]
        return [one for one in axes if all(one.object in objects for objects in shown)]
    if isinstance(subject.controller, GoalPursuit):  # to goals it leaves the way to another
        return axes
    if subject.trained is None:
        return goals + axes
    parts = subject.trained.env.parts
    found = goals if set(ORIENTATIONS) & set(parts) else []
    return found + (axes if TURNING in parts else [])


def percent(one: dict[str, float]) -> str:
    """A share for people with its interval."""
    return f"{100 * one['value']:.0f} % ({100 * one['low']:.0f}-{100 * one['high']:.0f})"


def goal_figures(row: dict[str, Any], asked: Asked) -> list[Figure]:
    """Of first goals, the floor and what is asked for in a line each."""
    reached, time = (row[name] for name in ("share_first_goal_reached", "first_goal_median_s"))
    palm = {"up": "", "down": ", palm down", "any": ", any way up"}[asked.palm]
    what = f"{row['who']}: first goals reached ({asked.what}, {asked.pose}{palm}), "
    what += f"{asked.seconds:g} s"
    measured = f"{percent(reached)}, median {time['value']:.1f} s"
    found = [Figure(what, measured, f"floor: {100 * FLOOR:.0f} %", reached["value"] >= FLOOR)]
    if asked.what in GOAL:
        share, most = GOAL[asked.what]
        good = reached["value"] >= share and time["value"] <= most
        found.append(Figure(what, measured, f"{100 * share:.0f} % in {most:g} s", good))
        row_of = row["goals_in_a_row_median"]["value"]
        found.append(
            Figure(
                what.replace("first goals reached", "goals reached one after the other"),
                f"median {row_of:g}",
                f"{IN_A_ROW} in a row",
                bool(row_of >= IN_A_ROW),
            )
        )
    return found


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""

    def number(one: dict[str, float], digits: int = 1) -> str:
        return f"{one['value']:.{digits}f} ({one['low']:.{digits}f}-{one['high']:.{digits}f})"

    goals = [row for row in rows if row["what"] in GOALS]
    changing = [row for row in rows if row["what"] == CHANGING]
    axes = [row for row in rows if row["what"] not in (*GOALS, CHANGING)]
    cells = {
        (row["who"], row["object"], row["what"]): f"{number(row['rotation_median_rad'])}, "
        f"{percent(row['share_dropped'])}"
        for row in axes
    }
    tables = [
        {
            "title": f"Goal orientations of a {given.object}, {given.trials} episodes (to the root "
            "from sampled grasps), 30 s for each goal: reached within 0.2 rad and at rest",
            "header": [
                "goals", "palm", "pose", "episodes of [s]", "", "first goal", "all goals",
                "to the first [s]", "in a row", "dropped",
            ],
            "rows": [
                [
                    row["what"],
                    row.get("palm", "up"),
                    row["pose"],
                    f"{asked_of(row, given).seconds:g}",
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
        {
            "title": f"Turning about one axis after the other, another one commanded every "
            f"{given.command_seconds:g} s, palm up, {given.trials} episodes of {given.seconds:g} s",
            "header": ["", "object", "rotation before any drop: median [rad]", "dropped"],
            "rows": [
                [
                    row["who"],
                    row["object"],
                    number(row["rotation_median_rad"]),
                    percent(row["share_dropped"]),
                ]
                for row in changing
            ],
        },
    ]  # fmt: skip
    found = [one for row in goals for one in goal_figures(row, asked_of(row, given))]
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


def write_cards(rows: list[dict[str, Any]], given: Options) -> None:
    """What was measured, in the cards of all policies that come with the package."""
    for name in policies.names():
        tested = []
        for row in rows:
            if row["who"] == name:
                told = IN_CARDS if row["what"] in GOALS else ("rotation_median_rad",)
                asked = asked_of(row, given)._asdict()
                tested.append(asked | {key: row[key] for key in (*told, "share_dropped")})
        if tested:
            path = policies.FOLDER / f"{name}.npz"
            policies.annotate(path, tested={"first_seed": given.seed, "results": tested})


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("part", given.parts, PARTS)
    check_chosen("palm", given.palms, ("up", "down", "any"))
    rows = earlier("reorientation", given, (*FIXED, "turning"))
    done = {(row["who"], *asked_of(row, given)) for row in rows}
    for name in given.who:
        subject = open_subject(name)
        for asked in wanted(subject, given):
            if (name, *asked) not in done:
                rows.append({"who": name, **asked._asdict(), **measure(subject, asked, given)})
                save(rows, given, say=False)
                progress(", ".join(map(str, (name, *asked))))
    save(rows, given, say=True)
    if given.cards:
        write_cards(rows, given)


if __name__ == "__main__":
    main()
