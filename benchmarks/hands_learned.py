"""Policies for other hands, and the controllers that guided them, as trained and with all drawn.

What is drawn is what MuJoCo Playground draws for its LEAP cube spin, whose figures are the goal;
hands, and the object of some, are others. Needs the hands' files, see `hands_turning.py`;
`--resume` goes on with the rows that there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from measuring.results import Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, percent_interval, share

from dexctl import hands
from dexctl.exceptions import HandModelError, InvalidInput
from dexctl.settings import changed
from dexctl.sim.conditions import CONDITIONS as NAMED
from learning import policies
from learning.evaluation import Subject, evaluate, open_subject

HOLD, SPEED = 0.977, 0.94  # goal: share of episodes and mean speed [rad/s]
_UNIFORM = 0.029  # standard deviation of what is uniform within 0.05 rad


@dataclass(frozen=True)
class Condition:
    """Under what a policy is tested, in the scene that it was trained in.

    Attributes:
        text: for people.
        changes: settings of the scene.
        mass: share by which the object's mass is more or less.
        seconds: of an episode; None: the usual time.
        asked: whether the goal is for this one.
    """

    text: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    mass: float = 0.0
    seconds: float | None = None
    asked: bool = False


CONDITIONS = {
    "up": Condition("palm up"),
    "down": Condition("palm down", {"gravity": "down"}),
    "any": Condition("any way up", {**NAMED["any-gravity"], "gravity_straight_share": 0.0}),
    "late": Condition("palm up, 50 ms late", {"action_latency": 0.05}),
    "drawn": Condition(
        "palm up, all drawn",
        {
            "joint_noise": _UNIFORM,
            "joint_offset": _UNIFORM,
            "friction_range": (0.5, 1.0),
            "stiffness_range": (0.8, 1.2),
            "centre_of_mass": 0.005,
        },
        mass=0.2,
        seconds=10.0,
        asked=True,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 20_000
    """First seed; trial i has the seed seed + i. Nothing was chosen by these."""
    trials: int = 200
    """Episodes for each object."""
    seconds: float = 60.0
    """Of each, but where all is drawn: 10 s."""
    who: tuple[str, ...] = tuple(sorted({*policies.names()} - {*policies.names("dex5")}))
    """Policies, by name or file."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Which."""


def measure(policy: Subject, who: Subject, chosen: str, given: Options) -> dict[str, Any]:
    """One row: the policy, or its guide in its place."""
    condition = CONDITIONS[chosen]
    protocol = policy.protocol(
        episodes=given.trials,
        seconds=condition.seconds or given.seconds,
        seed=given.seed,
        threads=1,
    )
    mass = protocol.scene.with_mass(hands.config(policy.hand)).object_mass
    assert mass is not None
    drawn = {"mass_range": ((1.0 - condition.mass) * mass, (1.0 + condition.mass) * mass)}
    protocol = changed(protocol, {**condition.changes, **(drawn if condition.mass else {})})
    found = evaluate(who, protocol)
    return {
        "policy": policy.name,
        "who": who.name,
        "hand": policy.hand,
        "object": ", ".join(policy.objects),
        "mass_kg": mass,
        "condition": chosen,
        "time_s": protocol.seconds,
        "rotation_rad": over_seeds(found.rotation),
        "speed_rad_s": over_seeds(found.speed),
        "holding": share(~found.dropped),
        "fingertips_only": round(float(found.fingertips_only.mean()), 4),
        "sink_mm": over_seeds(1000.0 * found.sink),
    }


def figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """What was asked for of each policy."""
    found = []
    for row in rows:
        if row["who"] != row["policy"]:
            continue
        turned, held, asked = row["speed_rad_s"], row["holding"], CONDITIONS[row["condition"]].asked
        theirs = "" if row["object"] == "cube" else " (theirs is a cube)"
        found.append(
            Figure(
                f"{row['policy']}, {row['object']}, {CONDITIONS[row['condition']].text}, "
                f"{row['time_s']:g} s: mean speed in the median episode, held",
                f"{turned['median']:.2f} rad/s, {held['count']} of {held['of']}",
                f"{SPEED} rad/s, {100 * HOLD:.1f} % hold{theirs}" if asked else "",
                turned["median"] >= SPEED and held["share"] >= HOLD if asked else None,
            )
        )
    return found


def line(row: dict[str, Any]) -> list[str]:
    """A row for people."""
    if "missing" in row:
        return [row["policy"], "", row["missing"], *[""] * 6]
    rotation = row["rotation_rad"]
    return [
        row["hand"],
        row["object"],
        f"{CONDITIONS[row['condition']].text}, {row['time_s']:g} s",
        row["who"],
        f"{rotation['median']:.1f} ({rotation['p10']:.1f}-{rotation['p90']:.1f})",
        f"{row['speed_rad_s']['median']:.2f}",
        percent_interval(row["holding"]),
        f"{100 * row['fingertips_only']:.1f} %",
        f"{row['sink_mm']['median']:.0f}",
    ]


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    lines = [line(row) for row in rows]
    table = {
        "title": f"Policies for other hands and their guides, {given.trials} episodes each",
        "header": [
            "Hand", "Object", "", "Who", "Rotation: median (10-90 %) [rad]", "Speed [rad/s]",
            "Held (95 % interval)", "Only fingertips", "Sinks by: median [mm]",
        ],
        "rows": lines,
    }  # fmt: skip
    known = [row for row in rows if "missing" not in row]
    write("hands_learned", given, figures(known), [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("conditions", given.conditions, CONDITIONS)
    # a hand that was missing may be here now
    rows = [row for row in earlier("hands_learned", given) if "missing" not in row]
    done = {(row["policy"], row["who"], row["condition"]) for row in rows}
    for name in given.who:
        try:
            policy = open_subject(name)
        except InvalidInput as error:
            if not isinstance(error.__context__, HandModelError):
                raise
            missing = f"not here: {error.__context__}"
            progress(f"{name}: {missing}")
            rows.append({"policy": name, "missing": missing})
            continue
        guides = [open_subject(guide, hand=policy.hand) for guide in policy.guides]
        for chosen, who in product(given.conditions, (policy, *guides)):
            if (name, who.name, chosen) in done:
                continue
            row = measure(policy, who, chosen, given)
            rows.append(row)
            save(rows, given, say=False)
            progress(
                f"{name}, {who.name}, {chosen}: {percent_interval(row['holding'])}, "
                f"{row['rotation_rad']['median']:.1f} rad"
            )
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
