"""Arguments that nobody should pass to the kernel, and what it may make of them."""

from __future__ import annotations

from collections.abc import Callable
from time import thread_time
from typing import Any

import numpy as np

import dexctl
from dexctl import grasp
from dexctl.exceptions import InvalidInput, UnknownName

BATCHES: tuple[tuple[int, ...], ...] = ((), (), (1,), (3,), (0,), (2, 2), (2, 0))
NUMBERS = (0.0, -1.0, np.nan, np.inf, -np.inf, 1e-320, 1e-9, 1e7, 1e160, -1e308, 10**400)
THINGS = (
    None,
    "x",
    b"x",
    {},
    object(),
    1j,
    np.array(1j),
    [[1.0], [2.0, 3.0]],
    np.datetime64(1, "s"),
)
SLOWEST = 3.0
"""No call takes longer, of processor time, which a busy machine does not stretch much [s]."""


def _unit(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    v = rng.normal(size=shape)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _contacts(rng: np.random.Generator, most: int) -> dict[str, Any]:
    """Contacts round an object, of which some coincide, oppose each other or are far away."""
    batch, m = BATCHES[rng.integers(len(BATCHES))], int(rng.integers(0, most + 1))
    outward = _unit(rng, (*batch, m, 3))
    position = 0.05 * outward + 0.01 * rng.normal(size=outward.shape)
    normal = _unit(rng, outward.shape) if rng.random() < 0.2 else -outward
    if m > 1 and rng.random() < 0.3:
        position[..., 1, :], normal[..., 1, :] = position[..., 0, :], normal[..., 0, :]
        if rng.random() < 0.5:
            normal[..., 1, :] *= -1
    if rng.random() < 0.1:
        position = position * 10 ** rng.uniform(-12, 9)
    if rng.random() < 0.03:
        position = position * 1e200
    touch = rng.random((*batch, m)) < 0.85
    position[~touch] = np.nan
    origin = 0.01 * rng.normal(size=3 if rng.random() < 0.5 else (*batch, 3))
    return {
        "contact_position": position,
        "contact_normal": normal,
        "in_contact": touch,
        "origin": origin,
    }


def _length(rng: np.random.Generator) -> Any:
    return None if rng.random() < 0.6 else 10 ** rng.uniform(-10, 3)


def _cone(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "friction": rng.choice([0.0, 0.3, 0.8, 10.0]),
        "model": rng.choice(["hard", "soft"]).item(),
        "edges": int(rng.choice([3, 4, 8, 16])),
        "torsion": 10 ** rng.uniform(-4, 0),
    }


def _stability(rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    return {
        **given,
        "length": _length(rng),
        "regulariser": rng.choice([0.0, 1e-6, 1e-5, 1e-3, 1.0]),
        "min_force": rng.choice([0.0, 0.15, 1.0]),
        "max_force": None if rng.random() < 0.5 else rng.random(given["in_contact"].shape),
    }


def _forces(rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    wrench = rng.normal(size=6) * 10 ** rng.uniform(-6, 3)
    more: dict[str, Any] = {"external_wrench": wrench, "length": _length(rng)}
    if rng.random() < 0.3:
        shape = given["in_contact"].shape
        more |= {"jacobian": 0.05 * rng.normal(size=(*shape, 3, 4)), "effort": np.full(4, 0.5)}
    if rng.random() < 0.3:
        more["max_normal"] = 10 ** rng.uniform(-3, 3)
    return {**given, **_cone(rng), **more}


def _static(rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    arguments = _forces(rng, given)
    del arguments["length"]
    return arguments


def _map(rng: np.random.Generator, given: dict[str, Any]) -> dict[str, Any]:
    model = rng.choice(["hard", "soft", "frictionless"]).item()
    return {"normal" if key == "contact_normal" else key: v for key, v in given.items()} | {
        "model": model
    }


def _jacobian(hand: dexctl.HandModel, rng: np.random.Generator) -> dict[str, Any]:
    batch = BATCHES[rng.integers(len(BATCHES))]
    return {
        "hand": hand,
        "q": rng.uniform(hand.lower, hand.upper, (*batch, hand.nq)),
        "contact_position": 0.1 * rng.normal(size=(*batch, hand.n_fingers, 3)),
        "in_contact": rng.random((*batch, hand.n_fingers)) < 0.8,
    }


def _scaled(rng: np.random.Generator, given: dict[str, Any], *more: str) -> dict[str, Any]:
    cone = {key: value for key, value in _cone(rng).items() if key in more}
    return {**given, **cone, **({"length": _length(rng)} if "length" in more else {})}


CONE = ("friction", "model", "edges", "torsion")
SHARES = ((grasp.stability_forces, 0.5), (grasp.grasp_map, 0.1), (grasp.hand_jacobian, 0.05),
          (grasp.tangent_basis, 0.05), (grasp.is_force_closure, 0.1), (grasp.isotropy, 0.05),
          (grasp.smallest_singular_value, 0.05), (grasp.grasp_forces, 0.05),
          (grasp.check_static, 0.04), (grasp.epsilon_quality, 0.01))  # fmt: skip


def call(
    hand: dexctl.HandModel, rng: np.random.Generator
) -> tuple[Callable[..., Any], dict[str, Any]]:
    """A function of the kernel and its arguments, of which one may be spoilt."""
    function = SHARES[rng.choice(len(SHARES), p=[share for _, share in SHARES])][0]
    many = function is grasp.stability_forces and rng.random() < 0.02
    given = _contacts(rng, 100 if many else 6)
    arguments = {
        grasp.stability_forces: lambda: _stability(rng, given),
        grasp.grasp_map: lambda: _map(rng, given),
        grasp.hand_jacobian: lambda: _jacobian(hand, rng),
        grasp.tangent_basis: lambda: {"normal": given["contact_normal"]},
        grasp.is_force_closure: lambda: _scaled(rng, given, *CONE),
        grasp.isotropy: lambda: _scaled(rng, given, "length", "model", "torsion"),
        grasp.smallest_singular_value: lambda: _scaled(rng, given, "length", "model", "torsion"),
        grasp.grasp_forces: lambda: _forces(rng, given),
        grasp.check_static: lambda: _static(rng, given),
        grasp.epsilon_quality: lambda: _scaled(rng, given, *CONE, "length"),
    }[function]()
    if rng.random() < 0.4:
        _spoil(rng, arguments)
    return function, arguments


def _spoil(rng: np.random.Generator, arguments: dict[str, Any]) -> None:
    name = rng.choice(list(arguments)).item()
    value = arguments[name]
    kind = rng.integers(5)
    if kind == 0:
        arguments[name] = THINGS[rng.integers(len(THINGS))]
    elif kind == 1 or not (isinstance(value, np.ndarray) and value.size and value.dtype == float):
        arguments[name] = NUMBERS[rng.integers(len(NUMBERS))]
    elif kind == 2:
        number = NUMBERS[rng.integers(len(NUMBERS) - 1)]
        array = value.copy()
        array.flat[rng.integers(array.size)] = number
        arguments[name] = array
    elif kind == 3:
        arguments[name] = value + 1j * rng.normal(size=value.shape)
    else:
        arguments[name] = value[..., :-1] if rng.random() < 0.5 else value[None]


def check(function: Callable[..., Any], arguments: dict[str, Any]) -> str:
    """What came of a call: "answer" or "refused".

    Raises:
        AssertionError: numbers that are not finite, a message of several lines, too long a time.
    """
    start = thread_time()
    try:
        found = function(**arguments)
    except (InvalidInput, UnknownName) as error:
        text = str(error)
        assert text and "\n" not in text and len(text) < 400, text
        found = None
    seconds = thread_time() - start
    assert seconds < SLOWEST, f"{seconds:.1f} s"
    if found is None:
        return "refused"
    _finite(found)
    return "answer"


def _finite(value: Any) -> None:
    if isinstance(value, tuple):
        for part in value:
            _finite(part)
    elif value is not None:
        array = np.asarray(value)
        assert array.dtype.kind in "bif", array.dtype
        assert np.isfinite(array).all(), array
