"""The stability QP where contacts coincide or nearly oppose each other, against exact fractions."""

from __future__ import annotations

import itertools
from fractions import Fraction
from math import sqrt

import numpy as np
import pytest

from dexctl.grasp import stability_forces

KINDS = ("coincident", "opposed", "nearly coincident")


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def contacts(rng, kind, n, m):
    """Round an object; some of them coincide, or two of them press (almost) at each other."""
    position = 0.05 * unit(rng.normal(size=(n, m, 3)))
    normal = unit(-position + 0.02 * rng.normal(size=position.shape))
    off = 10 ** rng.uniform(-9, -1, (n, 1))
    if kind == "coincident":
        position[:, -1], normal[:, -1] = position[:, 0], normal[:, 0]
    elif kind == "opposed":
        position[:, 1] = -position[:, 0]
        normal[:, 0] = unit(-position[:, 0])
        normal[:, 1] = unit(-normal[:, 0] + off * rng.normal(size=(n, 3)))
    else:
        position[:, 1] = position[:, 0] + 0.05 * off * rng.normal(size=(n, 3))
        normal[:, 1] = unit(normal[:, 0] + off * rng.normal(size=(n, 3)))
    return position, normal


def wrenches(position, normal, length):
    return np.vstack([normal.T, np.cross(position, normal).T / length])


def eliminated(matrix, right):
    """The solution in fractions; None where there is not one."""
    k = len(right)
    rows = [[*line, r] for line, r in zip(matrix, right, strict=True)]
    for a in range(k):
        found = next((i for i in range(a, k) if rows[i][a]), None)
        if found is None:
            return None
        rows[a], rows[found] = rows[found], rows[a]
        for i in range(k):
            if i != a and rows[i][a]:
                factor = rows[i][a] / rows[a][a]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[a], strict=True)]
    return [rows[a][k] / rows[a][a] for a in range(k)]


def exact_least(w, rho, least):
    """The least ||W c||^2 + rho ||1 - c||^2 over every set of forces at their bounds."""
    k = w.shape[1]
    columns = [[Fraction(x) for x in column] for column in w.T.tolist()]
    gram = [[sum(a * b for a, b in zip(p, q, strict=True)) for q in columns] for p in columns]
    rho, least, best = Fraction(rho), Fraction(least), None
    for j in range(k):
        for sides in itertools.product((0, -1, 1), repeat=k - 1):
            at = [*sides[:j], 1, *sides[j:]]
            c = [least if side < 0 else Fraction(1) for side in at]
            free = [i for i in range(k) if at[i] == 0]
            held = [i for i in range(k) if at[i] != 0]
            solution = eliminated(
                [[gram[i][m] + (rho if i == m else 0) for m in free] for i in free],
                [rho - sum(gram[i][m] * c[m] for m in held) for i in free],
            )
            if solution is None or any(not least <= x <= 1 for x in solution):
                continue
            for i, x in zip(free, solution, strict=True):
                c[i] = x
            value = sum(c[a] * c[b] * gram[a][b] for a in range(k) for b in range(k))
            value += rho * sum((1 - x) ** 2 for x in c)
            best = value if best is None else min(best, value)
    assert best is not None
    return float(best)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rho", [1e-6, 1e-5, 1e-4, 1e-3])
def test_the_least_objective_to_the_last_digits(kind, rho):
    rng = np.random.default_rng(1)
    for trial in range(5):
        m, least = int(rng.integers(2, 4)), 0.2 * (trial % 2)
        position, normal = contacts(rng, kind, 1, m)
        got = stability_forces(
            position, normal, np.ones((1, m), bool), np.zeros(3), regulariser=rho, min_force=least
        )
        w = wrenches(position[0], normal[0], got.length[0])
        value = np.sum((w @ got.forces[0]) ** 2) + rho * np.sum((1 - got.forces[0]) ** 2)
        assert value <= exact_least(w, rho, least) + 2e-11


@pytest.mark.parametrize("kind", KINDS)
def test_the_least_residual_is_reached_to_1e_8(kind):
    rng = np.random.default_rng(2)
    for trial in range(25):
        m, least = 2 + trial % 3 if trial < 15 else 2, 0.1 * (trial % 2)
        position, normal = contacts(rng, kind, 1, m)
        got = stability_forces(
            position[0], normal[0], np.ones(m, bool), np.zeros(3), min_force=least
        )
        w = wrenches(position[0], normal[0], got.length)
        assert got.residual <= sqrt(exact_least(w, 0, least)) + 1e-8


def test_no_feasible_point_is_far_below_the_residual():
    """Normals that oppose each other but for 1e-9 to 0.1 rad, thousands of them."""
    rng = np.random.default_rng(3)
    position, normal = contacts(rng, "opposed", 2000, 4)
    got = stability_forces(position, normal, np.ones((2000, 4), bool), np.zeros(3))
    opposed = np.tile([1.0, 1.0, 0.0, 0.0], (2000, 1))
    torque = np.cross(position, normal) / got.length[:, None, None]
    w = np.concatenate([normal, torque], axis=-1)
    left = np.linalg.norm((opposed[..., None] * w).sum(axis=1), axis=-1)
    assert (got.residual <= left + 1e-8).all()
    assert np.abs(got.forces).max(axis=1).min() == 1.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rho", [0.0, 1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("m", [2, 3, 5, 7])
def test_ties_are_broken_alike_in_batches_and_alone(kind, rho, m):
    rng = np.random.default_rng(m)
    n = 40
    position, normal = contacts(rng, kind, n, m)
    touch = np.ones((n, m), bool)
    options = dict(regulariser=rho, min_force=0.15)
    many = stability_forces(position, normal, touch, np.zeros(3), **options)
    for i in range(n):
        one = stability_forces(position[i], normal[i], touch[i], np.zeros(3), **options)
        assert many.held[i] == one.held
        np.testing.assert_allclose(many.forces[i], one.forces, atol=1e-8)
        assert abs(many.residual[i] - one.residual) < 1e-9


@pytest.mark.parametrize("rho", [0.0, 1e-6, 1e-3])
def test_of_equal_contacts_the_first_is_held(rho):
    position = np.array([[0.05, 0, 0], [0.05, 0, 0], [-0.05, 0, 0], [-0.05, 0, 0]])
    normal = -position / 0.05
    for shape in ((4, 3), (1, 4, 3), (3, 4, 3)):
        p, n = np.broadcast_to(position, shape), np.broadcast_to(normal, shape)
        got = stability_forces(p, n, np.ones(shape[:-1], bool), np.zeros(3), regulariser=rho)
        assert (got.held == 0).all()
        np.testing.assert_allclose(got.forces, np.ones(shape[:-1]), atol=1e-9)


@pytest.mark.parametrize("m", [4, 8, 10])
def test_all_contacts_at_one_point(m):
    position, normal = np.tile([0.05, 0, 0], (6, m, 1)), np.tile([-1.0, 0, 0], (6, m, 1))
    for rho in (0.0, 1e-6, 1e-5, 1e-4):
        got = stability_forces(position, normal, np.ones((6, m)), np.zeros(3), regulariser=rho)
        # one presses, and the others bear what the regulariser is worth
        np.testing.assert_allclose(got.forces[:, 0], 1.0)
        assert (got.held == 0).all() and got.forces[:, 1:].max() < 1e-3
        assert got.residual == pytest.approx(1.0, abs=1e-3)
