"""Where an object is by touch alone: its shape tracked, reckoned without it, and fitted anew.

A learned gait, which lets contacts slip as it likes, turns each object, whichever way up; what the
sensors tell goes to three estimates of its pose at once. `TouchTracking` knows the shape and how
the fingers moved, `ContactOdometry` only how they moved, and a least-squares fit by scipy only the
shape: it brings the surface to the contacts of each control period from where it had it before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.timing import in_turns, ratio, spread
from scipy.optimize import least_squares

from dexctl import GraspState, HandModel, controllers
from dexctl.grasp import TouchTracking
from dexctl.grasp.odometry import ContactOdometry
from dexctl.rotations import angle_between, from_rotation_vector, inverse, multiply, rotate
from dexctl.settings import from_plain
from dexctl.sim import SceneConfig, Shape, Simulation, object_names
from dexctl.sim.trial import DROP_DISTANCE

NOISE = {
    "none": {},
    "2 mm, 0.1 rad, 0.5 N": {"position_noise": 0.002, "normal_noise": 0.1, "force_noise": 0.5},
}
NEAR = 0.2
"""What a goal orientation counts as reached within [rad]."""
LOST = np.pi / 4
"""Nearer to another side of a cube than to the right one [rad]."""
ALL_TURNS = ("sphere",)  # looks the same however it is turned
ONE_TURN = ("cylinder",)  # looks the same turned about its axis; the tilt of that counts
ESTIMATES = ("tracking", "odometry", "fit")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 1000
    trials: int = 32
    """Episodes of each object, with and without noise."""
    seconds: float = 30.0
    """Of each [s]."""
    who: str = "dex5-nine"
    """Who turns the objects; it is not told where they are."""
    objects: tuple[str, ...] = object_names()
    fitted: int = 1
    """Of the episodes, so many are fitted anew, too, which takes its time."""
    rounds: int = 5
    """Of timing."""
    steps: int = 100
    """Control periods in each of them."""
    hands: int = 128
    """That are tracked together, where a batch is timed."""


class Fit:
    """The pose of one object that fits the contacts of a moment best, and near the one before."""

    def __init__(self, hand: HandModel, shape: Shape, position: Any, quaternion: Any) -> None:
        self.shape, self.outside = shape, hand.config.fingertip_radius
        self.position, self.quaternion = np.array(position), np.array(quaternion)

    def update(self, state: GraspState) -> None:
        touch = state.in_contact
        normal = state.contact_normal[touch]
        place = state.contact_position[touch] - self.outside * normal

        def left(step: np.ndarray) -> np.ndarray:
            turn = multiply(from_rotation_vector(step[3:]), self.quaternion)
            back = np.broadcast_to(inverse(turn), (len(place), 4))
            distance, facing = self.shape.closest(rotate(back, place - self.position - step[:3]))
            facing = rotate(np.broadcast_to(turn, (len(place), 4)), facing)
            far = (distance - self.outside) / 0.001
            return np.concatenate([far, ((facing + normal) / 0.1).ravel(), step / 0.1])

        step = least_squares(left, np.zeros(6), loss="soft_l1").x
        self.position = self.position + step[:3]
        self.quaternion = multiply(from_rotation_vector(step[3:]), self.quaternion)


def episodes(
    name: str, noise: dict[str, float], given: Options
) -> Iterator[tuple[Simulation, GraspState]]:
    """The simulation at each control step, and what is sensed."""
    scene = from_plain(SceneConfig, {"object": name, "gravity_tilt": np.pi, "threads": 1} | noise)
    with Simulation(scene, given.trials, given.seed) as simulation:
        turner = controllers.resolve(given.who, simulation.hand)
        turner.reset(given.seed)
        for _ in range(round(given.seconds / simulation.control_period)):
            seen = simulation.read()
            yield simulation, seen
            simulation.write(seen.q_target + turner.act(seen))
            simulation.step()
        yield simulation, simulation.read()


def shape_of(simulation: Simulation) -> Shape:
    """Of the object that all of them have."""
    scene = simulation.sim.groups[0].scene
    return Shape.of_body(scene.model, scene.object_body)


def measure(name: str, noise: dict[str, float], given: Options) -> dict[str, Any]:
    """How far the estimates of one object are off, until it is dropped."""
    rows: dict[str, list[np.ndarray]] = {one: [] for one in ESTIMATES}
    held: list[np.ndarray] = []
    for simulation, seen in episodes(name, noise, given):
        truth, hand = simulation.state, simulation.hand
        place, turn = np.asarray(truth.object_position), np.asarray(truth.object_quaternion)
        now = hand.configuration(seen.q)
        if not held:
            everyone = np.ones(given.trials, bool)
            shape = shape_of(simulation)
            tracking, odometry = TouchTracking(hand, shape), ContactOdometry(hand, 0.05)
            for one in (tracking, odometry):
                one.start(given.trials)
                one.place(everyone, place, turn)
            fits = [Fit(hand, shape, place[i], turn[i]) for i in range(given.fitted)]
            start = place
        for one in (tracking, odometry):
            one.update(seen, now, seen.in_contact)
        for i, fit in enumerate(fits):
            fit.update(seen[i])
        fitted = [
            np.array([getattr(one, part) for one in fits]) for part in ("position", "quaternion")
        ]
        for key, (at, to) in {
            "tracking": (tracking.position, tracking.quaternion),
            "odometry": (odometry.position, odometry.quaternion),
            "fit": fitted,
        }.items():
            count = len(at)
            off = at - place[:count]
            angle = angle_between(to, turn[:count])
            if name in ONE_TURN:
                up = [rotate(q, np.tile([0.0, 0.0, 1.0], (count, 1))) for q in (to, turn[:count])]
                angle = np.arccos(np.clip((up[0] * up[1]).sum(axis=1), -1.0, 1.0))
            across = np.linalg.norm(off[:, :2], axis=1)
            rows[key].append(np.stack([angle, across, np.abs(off[:, 2])], axis=-1))
        fell = np.linalg.norm(place - start, axis=1) > DROP_DISTANCE
        held.append(~fell & (held[-1] if held else True))
    counts = np.array(held)
    found: dict[str, Any] = {"object": name, "held": int(counts[-1].sum())}
    for key, each in rows.items():
        errors = np.array(each)
        chosen = errors[counts[:, : errors.shape[1]]]
        angle = np.where(counts[:, : errors.shape[1]], errors[..., 0], 0.0)
        found[key] = {
            "never_lost": int((angle < LOST).all(axis=0).sum()),
            "always_near": int((angle < NEAR).all(axis=0).sum()),
            "of": int(angle.shape[1]),
            "share_near": float((chosen[:, 0] < NEAR).mean()),
            "orientation_median_rad": float(np.median(chosen[:, 0])),
            "orientation_p99_rad": float(np.percentile(chosen[:, 0], 99)),
            "across_median_m": float(np.median(chosen[:, 1])),
            "height_median_m": float(np.median(chosen[:, 2])),
            "height_p90_m": float(np.percentile(chosen[:, 2], 90)),
        }
    return found


def timing(given: Options) -> dict[str, Any]:
    """One cube tracked and fitted, in turns, and a batch tracked."""
    one = Options(**{**given.__dict__, "seconds": given.steps * 0.05, "objects": ("cube",)})
    states = []
    for simulation, seen in episodes("cube", {}, one):
        if not states:
            start, hand, shape = simulation.state, simulation.hand, shape_of(simulation)
        states.append(seen)
    place, turn = np.asarray(start.object_position), np.asarray(start.object_quaternion)

    def tracked(count: int) -> Callable[[int], None]:
        rows = np.arange(count) % given.trials
        seen = [state[rows] for state in states]
        now = [hand.configuration(state.q) for state in seen]
        tracking = TouchTracking(hand, shape)
        tracking.start(count)
        everyone = np.ones(count, bool)

        def update(i: int) -> None:
            if i == 0:
                tracking.place(everyone, place[rows], turn[rows])
            tracking.update(seen[i], now[i], seen[i].in_contact)

        return update

    single = [state[0] for state in states]
    fit = Fit(hand, shape, place[0], turn[0])

    def fitting(i: int) -> None:
        if i == 0:
            fit.position, fit.quaternion = place[0], turn[0]
        fit.update(single[i])

    calls = {"one": tracked(1), "fit": fitting, "batch": tracked(given.hands)}
    taken = in_turns(calls, given.steps, given.rounds)
    return {name: spread(value) for name, value in taken.items()} | {
        "one_over_fit": ratio(taken["one"], taken["fit"])
    }


def main() -> None:
    given = settings(Options, __doc__)
    times = timing(given)
    rows = []
    for noise, name in product(NOISE, given.objects):
        rows.append({"noise": noise} | measure(name, NOISE[noise], given))
        progress(f"{name}, noise {noise}")
    told = [row for row in rows if row["object"] not in ALL_TURNS]
    figures = []
    for noise in NOISE:
        own = [row["tracking"] | {"object": row["object"]} for row in told if row["noise"] == noise]
        if not own:
            continue
        lost = [one["object"] for one in own if one["never_lost"] < 0.95 * one["of"]]
        aside = f" ({', '.join(lost)} in less)" if lost else ""
        figures.append(
            Figure(
                f"tracked by touch, noise {noise}: objects whose orientation is not lost (45 "
                f"degrees off) in {given.seconds:g} s, in 95 % of the episodes",
                f"{len(own) - len(lost)} of {len(own)}{aside}",
                f"{len(own)} of {len(own)}",
                not lost,
            )
        )
    against = times["one_over_fit"]
    figures.append(
        Figure(
            "tracking one cube by touch, a control period, against a least-squares fit of its "
            "contacts by scipy",
            f"{against['median']:.2f} ({times['one']['median_us'] / 1e3:.2f} ms; "
            f"{given.hands} cubes {times['batch']['median_us'] / 1e3:.1f} ms)",
            "less than 1",
            against["median"] < 1,
        )
    )

    def cell(one: dict[str, Any]) -> str:
        return (
            f"{one['never_lost']} of {one['of']}, {100 * one['share_near']:.0f} %, "
            f"{one['orientation_median_rad']:.2f}"
        )

    table = {
        "title": f"Objects turned by {given.who}, any way up, {given.trials} episodes of "
        f"{given.seconds:g} s each: episodes in which the orientation (of a cylinder, that of its "
        f"axis) was not lost (45 degrees off), share of the time within {NEAR} rad, and the median "
        "error [rad]; a fit of some of the episodes",
        "header": [
            "noise of contacts", "object", "tracked by touch", "odometry", "fitted anew",
            "place across [mm]", "height [mm], and of 90 %",
        ],
        "rows": [
            [
                row["noise"],
                row["object"],
                *(
                    "" if row["object"] in ALL_TURNS else cell(row[name]) for name in ESTIMATES
                ),
                f"{1e3 * row['tracking']['across_median_m']:.1f}",
                f"{1e3 * row['tracking']['height_median_m']:.1f}, "
                f"{1e3 * row['tracking']['height_p90_m']:.1f}",
            ]
            for row in rows
        ],
    }  # fmt: skip
    write("touch_tracking", given, figures, [table], trials=rows, times=times)


if __name__ == "__main__":
    main()
