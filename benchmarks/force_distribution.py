"""The force distribution against general QP solvers, and epsilon quality against the whole hull.

The peers are those that `qpsolvers` finds here, each asked for the same: the wrench that is left
over, squared, plus a millionth of the squared forces, inside the same pyramids and below the same
greatest normal force. Their matrices are built beforehand; ours is timed from contacts to forces.
An answer is right where it is inside the limits and no other that is leaves less: the edge of each
finger's pyramid that helps most, pressed as hard as it may be, helps no more than the answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.shares import percent, share
from measuring.timing import in_turns, ratio, spread
from qpsolvers import Problem, available_solvers, solve_problem
from scipy.spatial import ConvexHull

from dexctl.grasp import epsilon_quality, grasp_forces
from dexctl.grasp.cones import (
    DEFAULT_EDGES,
    DEFAULT_TORSION,
    FrictionalContacts,
    check_cones,
    facets,
    primitive_wrenches,
)

EFFORT = 1e-6  # weight of the squared forces beside the wrench left over, for the peers
BROKEN = 1e-6  # of a limit [N]
WORSE = 1e-4  # of the squared wrench left over [N^2]
_PACKAGES = {"proxqp": "proxsuite"}  # of solvers that are called otherwise


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    count: int = 1000
    """Grasps of each number of contacts."""
    rounds: int = 3
    """Rounds of each side, taken in turns."""
    contacts: tuple[int, ...] = (3, 5, 8, 16)
    """Numbers of contacts."""
    hulls: int = 50
    """Grasps of each number of contacts for epsilon quality."""


class Case(NamedTuple):
    """A grasp, what it has to hold, and the same as a QP."""

    contacts: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    friction: float
    wrench: np.ndarray
    asked: np.ndarray  # the same with torques over the length
    max_normal: float
    cones: FrictionalContacts
    program: Problem


def case(rng: np.random.Generator, count: int) -> Case:
    """Contacts around a ball of 30 mm, more or less, with 1 N and up to 0.3 N m to hold."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    position = -0.03 * normal + rng.choice([0.0, 0.003, 0.02]) * rng.normal(size=(count, 3))
    contacts = (position, normal, np.ones(count, bool), np.zeros(3))
    friction, most = float(rng.choice([0.1, 0.4, 0.8])), float(rng.choice([0.1, 1.0, 10.0]))
    wrench = np.array([0, 0, -1.0, *(rng.choice([0, 0.03, 0.3]) * rng.normal(size=3))])
    cones = check_cones(*contacts, friction, "hard", DEFAULT_EDGES, DEFAULT_TORSION)
    grasp = np.swapaxes(cones.maps, 0, 1).reshape(6, 3 * count)
    asked = np.r_[wrench[:3], wrench[3:] / cones.length]
    rows = facets(DEFAULT_EDGES, soft=False) / np.array([friction, friction, 1.0])
    normals = np.kron(np.eye(count), [[0.0, 0.0, 1.0]])
    program = Problem(
        grasp.T @ grasp + EFFORT * np.eye(3 * count),
        grasp.T @ asked,
        np.vstack([np.kron(np.eye(count), rows), normals]),
        np.concatenate([np.zeros(count * len(rows)), np.full(count, most)]),
    )
    return Case(contacts, friction, wrench, asked, most, cones, program)


def ours(one: Case) -> np.ndarray:
    """The forces ``(m, 3)``, world frame."""
    return grasp_forces(*one.contacts, one.friction, one.wrench, max_normal=one.max_normal).forces


def peer(one: Case, solver: str) -> np.ndarray | None:
    """The same from a QP solver; None where it has no answer."""
    found = solve_problem(one.program, solver).x
    if found is None:
        return None
    return np.einsum("mij,mj->mi", one.cones.basis, found.reshape(-1, 3))


def is_right(one: Case, forces: np.ndarray | None) -> bool:
    """Whether the forces are allowed and no allowed ones leave less."""
    if forces is None or not np.isfinite(forces).all():
        return False
    local = np.einsum("mij,mi->mj", one.cones.basis, forces)
    if (one.program.G @ local.ravel() - one.program.h).max() > BROKEN:
        return False
    reached = np.einsum("mij,mj->i", one.cones.maps, local)
    left = reached + one.asked
    edges = (left @ primitive_wrenches(one.cones)).reshape(len(forces), -1)
    helps = one.max_normal * np.minimum(edges.min(axis=1), 0.0).sum()
    return bool(left @ reached <= helps + WORSE)


def whole_hull(one: Case) -> float:
    """Epsilon quality from every facet of the hull; for grasps with force closure."""
    wrenches = primitive_wrenches(one.cones)
    return float(-ConvexHull(wrenches.T).equations[:, -1].max())


def distribution(count: int, given: Options) -> dict[str, Any]:
    """One row: right answers and times of each side for a number of contacts."""
    rng = np.random.default_rng([given.seed, count])
    cases = [case(rng, count) for _ in range(given.count)]
    sides: dict[str, Callable[[Case], np.ndarray | None]] = {"dexctl": ours}
    sides |= {name: lambda one, name=name: peer(one, name) for name in sorted(available_solvers)}
    right = {
        name: share(np.array([is_right(one, solve(one)) for one in cases]))
        for name, solve in sides.items()
    }
    seconds = in_turns(
        {name: lambda i, solve=solve: solve(cases[i]) for name, solve in sides.items()},
        given.count,
        given.rounds,
    )
    return {
        "contacts": count,
        "right": right,
        "timings": {name: spread(value) for name, value in seconds.items()},
        "ratios": {
            name: ratio(seconds["dexctl"], value)
            for name, value in seconds.items()
            if name != "dexctl"
        },
    }


def quality(count: int, given: Options) -> dict[str, Any]:
    """One row: epsilon quality, grown hull against whole hull, of grasps with force closure."""
    rng = np.random.default_rng([given.seed, count, 1])
    cases: list[Case] = []
    while len(cases) < given.hulls:
        one = case(rng, count)
        if epsilon_quality(*one.contacts, one.friction) > 0:
            cases.append(one)
    apart = [abs(epsilon_quality(*one.contacts, one.friction) - whole_hull(one)) for one in cases]
    seconds = in_turns(
        {
            "grown": lambda i: epsilon_quality(*cases[i].contacts, cases[i].friction),
            "whole": lambda i: whole_hull(cases[i]),
        },
        given.hulls,
        given.rounds,
    )
    return {
        "contacts": count,
        "most_apart": float(max(apart)),
        "timings": {name: spread(value) for name, value in seconds.items()},
        "ratio": ratio(seconds["grown"], seconds["whole"]),
    }


def table_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What people read."""
    return {
        "title": "Forces that hold a wrench: right answers, and median time",
        "header": ["contacts", "side", "right", "median [ms]", "p99 [ms]", "ours over theirs"],
        "rows": [
            [
                str(row["contacts"]),
                name,
                percent(row["right"][name]),
                f"{row['timings'][name]['median_us'] / 1e3:.2f}",
                f"{row['timings'][name]['p99_us'] / 1e3:.2f}",
                f"{row['ratios'][name]['median']:.2f}" if name in row["ratios"] else "",
            ]
            for row in rows
            for name in row["right"]
        ],
    }


def figures_of(rows: list[dict[str, Any]], hulls: list[dict[str, Any]]) -> list[Figure]:
    """A line for each number of contacts, of forces and of hulls."""
    out = []
    for row in rows:
        sides = ", ".join(
            f"{name} {percent(part)} in {row['timings'][name]['median_us'] / 1e3:.2f} ms"
            for name, part in row["right"].items()
        )
        out.append(Figure(f"forces that hold a wrench, {row['contacts']} contacts: right", sides))
    out += [
        Figure(
            f"epsilon quality, {row['contacts']} contacts, against the whole hull",
            f"{row['ratio']['median']:.2f} of its time (median "
            f"{row['timings']['grown']['median_us'] / 1e3:.1f} ms), at most "
            f"{row['most_apart']:.0e} apart",
        )
        for row in hulls
    ]
    return out


def main() -> None:
    given = settings(Options, __doc__)
    rows, hulls = [], []
    for count in given.contacts:
        rows.append(distribution(count, given))
        progress(f"{count} contacts | {figures_of(rows[-1:], [])[0].measured}")
    for count in given.contacts:
        hulls.append(quality(count, given))
        progress(f"{count} contacts | {figures_of([], hulls[-1:])[0].measured}")
    write(
        "force_distribution",
        given,
        figures_of(rows, hulls),
        [table_of(rows)],
        distribution=rows,
        quality=hulls,
        peers={name: version(_PACKAGES.get(name, name)) for name in sorted(available_solvers)},
    )


if __name__ == "__main__":
    main()
