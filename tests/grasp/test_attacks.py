"""The kernel gives an answer or one clear line, in bounded time, whatever it is given."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pytest

from dexctl import grasp
from dexctl.exceptions import InvalidInput, UnknownName

spec = importlib.util.spec_from_file_location("attack", Path(__file__).with_name("attack.py"))
assert spec is not None and spec.loader is not None
attack = importlib.util.module_from_spec(spec)
spec.loader.exec_module(attack)

kernel: Any = grasp  # what is wrong here is wrong on purpose
OUT = np.array([[1.0, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0], [0, 0, 1.0]])
OUT /= np.linalg.norm(OUT, axis=1, keepdims=True)
TOUCH = np.ones(4, bool)
POSED = (0.05 * OUT, -OUT, TOUCH, np.zeros(3))


def under_attack(dex5, seed, calls):
    rng = np.random.default_rng(seed)
    found = {"answer": 0, "refused": 0}
    for number in range(calls):
        function, arguments = attack.call(dex5, rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found[attack.check(function, arguments)] += 1
        except Exception as error:
            error.add_note(f"call {number} of seed {seed}: {function.__name__}({arguments})")
            raise
    return found


def test_two_thousand_calls(dex5):
    found = under_attack(dex5, 0, 2000)
    assert found["answer"] > 1000 and found["refused"] > 500


@pytest.mark.slow
def test_a_hundred_thousand_calls(dex5):
    """About 40 seconds of one core."""
    found = under_attack(dex5, 1, 100_000)
    assert found["answer"] > 50_000 and found["refused"] > 25_000


def empty(*shape):
    return np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape, bool), np.zeros(3)


@pytest.mark.parametrize("shape", [(0, 4), (2, 0, 4), (0, 0), (3, 0)])
@pytest.mark.parametrize("model", ["hard", "soft"])
def test_batches_and_hands_of_nothing(shape, model):
    batch, m = shape[:-1], shape[-1]
    contacts: Any = empty(*shape)
    assert kernel.isotropy(*contacts, model=model).shape == batch
    assert kernel.smallest_singular_value(*contacts, model=model).shape == batch
    assert kernel.epsilon_quality(*contacts, 0.5, model=model).shape == batch
    assert kernel.is_force_closure(*contacts, 0.5, model=model).shape == batch
    held = kernel.grasp_forces(
        *contacts, 0.5, np.ones(6), model=model, jacobian=np.zeros((*shape, 3, 2)), effort=[1, 1]
    )
    assert held.forces.shape == (*shape, 3) and held.feasible.shape == batch
    assert held.torques is not None and held.torques.shape == (*batch, 2)
    assert not held.feasible.any() and (held.violation > 0).all()
    checked = kernel.check_static(*contacts, 0.5, external_wrench=np.ones(6), model=model)
    assert checked.stable.shape == batch
    for rho in (0.0, 1e-3):
        forces = kernel.stability_forces(*contacts, regulariser=rho)
        assert forces.forces.shape == shape and forces.held.shape == batch
    columns = {"hard": 3, "soft": 4}[model] * m
    assert kernel.grasp_map(*contacts[:1], np.zeros(3), normal=contacts[1], model=model).shape == (
        *batch, 6, columns,
    )  # fmt: skip


FUNCTIONS = {
    "stability": lambda *c: kernel.stability_forces(*c, regulariser=1e-3),
    "stability, no regulariser": lambda *c: kernel.stability_forces(*c),
    "closure": lambda *c: kernel.is_force_closure(*c, 0.5),
    "isotropy": lambda *c: kernel.isotropy(*c),
    "epsilon": lambda *c: kernel.epsilon_quality(*c, 0.5),
    "forces": lambda *c: kernel.grasp_forces(*c, 0.5, np.ones(6)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("batch", [False, True])
def test_what_is_no_contact_is_refused_in_one_line(name, batch):
    position, normal, touch, origin = (np.array(a) for a in POSED)
    far, long, short = position.copy(), normal.copy(), normal.copy()
    far[1] *= 1e200
    long[2] *= 1e160
    short[2] *= 1e-170
    cases = [
        ((far, normal, touch, origin), r"contact_position.*1\] is 4.24e\+198 m from the origin"),
        ((position * 1e9, normal, touch, origin), "m from the origin; expected at most 1e"),
        ((position, normal, touch, origin + 1e300), "m from the origin"),
        ((position, long, touch, origin), r"contact_normal.*2\] has length 1e\+160; expected 1"),
        ((position, short, touch, origin), r"contact_normal.*2\] has length 1e-170; expected 1"),
        ((position, normal + 0j, touch, origin), "contact_normal is not an array of numbers"),
        ((position * 1j, normal, touch, origin), "contact_position is not an array of numbers"),
        ((position, normal, touch, origin * 1j), "origin is not an array of numbers"),
        ((position, normal, touch * 1j, origin), "in_contact is .*; expected bools"),
        ((position, normal, touch * np.nan, origin), "in_contact is .*; expected bools"),
        ((position, normal, touch * 2, origin), "in_contact is .*; expected bools"),
        (([[1.0], [1.0, 2.0]], normal, touch, origin), "contact_position is not an array"),
        ((np.full((4, 3), "x"), normal, touch, origin), "contact_position is not an array"),
    ]
    for arguments, message in cases:
        if batch and isinstance(arguments[0], np.ndarray):
            arguments = tuple(np.stack([a, a]) for a in arguments[:3]) + arguments[3:]
        with pytest.raises(InvalidInput, match=message) as error:
            FUNCTIONS[name](*arguments)
        assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize("ratio", [1e2, 1e4, 9e5, 7e6, 1e12, 1e300])
@pytest.mark.parametrize("rho", [0.0, 1e-6, 1e-3])
def test_lengths_far_below_the_distances(ratio, rho):
    """An answer while it means something, one line after that; never seconds."""
    position, normal, touch, origin = (np.array(a) for a in POSED)
    position = position + 0.01 * np.random.default_rng(0).normal(size=position.shape)
    length = 0.05 / ratio
    arguments = dict(length=length, regulariser=rho, min_force=0.1)
    if ratio > 1e6:
        for function in (kernel.stability_forces, kernel.isotropy, kernel.smallest_singular_value):
            options: Any = arguments if function is kernel.stability_forces else {"length": length}
            with pytest.raises(InvalidInput, match="length is .*expected"):
                function(position, normal, touch, origin, **options)
        return
    one = kernel.stability_forces(position, normal, touch, origin, **arguments)
    many = kernel.stability_forces(
        np.stack([position] * 3), np.stack([normal] * 3), [touch] * 3, origin, **arguments
    )
    np.testing.assert_allclose(many.forces, [one.forces] * 3, atol=1e-7)
    w = np.vstack([normal.T, np.cross(position, normal).T / length])
    best = np.sum((w @ one.forces) ** 2) + rho * np.sum((1 - one.forces) ** 2)
    rng = np.random.default_rng(1)
    for _ in range(300):  # nothing near it, within the bounds, is better
        step = rng.normal(size=4) * 10 ** rng.uniform(-6, 0)
        other = np.clip(one.forces + step, 0.1, 1.0)
        other[one.held] = 1.0
        value = np.sum((w @ other) ** 2) + rho * np.sum((1 - other) ** 2)
        assert value >= best - 1e-11 * ratio**2


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (kernel.stability_forces, {"regulariser": 1e7}, "regulariser is 1.*; expected 0, or"),
        (kernel.stability_forces, {"regulariser": "x"}, "regulariser is 'x'"),
        (kernel.stability_forces, {"regulariser": 1j}, "regulariser is 1j"),
        (kernel.stability_forces, {"min_force": None}, "min_force is None"),
        (kernel.stability_forces, {"max_force": [1j] * 4}, "max_force is not an array of numbers"),
        (kernel.stability_forces, {"length": 1j}, "length is not an array of numbers"),
        (kernel.is_force_closure, {"friction": 1e300}, "friction is 1e.300"),
        (kernel.is_force_closure, {"friction": 1j}, "friction is not an array of numbers"),
        (kernel.is_force_closure, {"friction": 1, "edges": 10**6}, "edges is 1000000"),
        (kernel.is_force_closure, {"friction": 1, "edges": "8"}, "edges is '8'"),
        (kernel.is_force_closure, {"friction": 1, "model": "soft", "torsion": 1e300}, "torsion is"),
        (kernel.is_force_closure, {"friction": 1, "model": "soft", "torsion": "x"}, "torsion is"),
        (kernel.epsilon_quality, {"friction": 1, "edges": 65}, "edges is 65; expected a whole"),
        (kernel.grasp_forces, {"friction": 1, "external_wrench": 1e300 * np.ones(6)}, "external"),
        (kernel.grasp_forces, {"friction": 1, "external_wrench": 1j * np.ones(6)}, "external"),
        (
            kernel.grasp_forces,
            {"friction": 1, "external_wrench": np.ones(6), "max_normal": "x"},
            "max_normal is 'x'",
        ),
    ],
)
def test_options_out_of_range_are_named(function, options, message):
    with pytest.raises(InvalidInput, match=message) as error:
        function(*POSED, **options)
    assert "\n" not in str(error.value)


def test_models_and_hands_that_are_none(dex5):
    wrong: list[Any] = ["wet", None, ["hard"], np.zeros(3)]
    for model in wrong:
        with pytest.raises(UnknownName, match="unknown contact model"):
            kernel.is_force_closure(*POSED, 0.5, model=model)
        with pytest.raises(UnknownName, match="unknown contact model"):
            kernel.grasp_map(POSED[0], np.zeros(3), model=model)
    point = np.zeros((5, 3))
    with pytest.raises(InvalidInput, match="hand is 'dex5'; expected a HandModel"):
        kernel.hand_jacobian("dex5", np.zeros(15), point)
    for q in (np.full(15, np.nan), np.full(15, 1e300), np.full(15, 1j)):
        with pytest.raises(InvalidInput, match="^q is"):
            kernel.hand_jacobian(dex5, q, point)
    point[2] = np.nan
    with pytest.raises(InvalidInput, match=r"contact_position\[2\] is not finite, or over"):
        kernel.hand_jacobian(dex5, np.zeros(15), point)
    for normal in (np.zeros(2), 1.0, np.full(3, np.nan), np.full(3, 1e160), "x"):
        with pytest.raises(InvalidInput, match="^normal "):
            kernel.tangent_basis(normal)


def ball(count):
    rng = np.random.default_rng(count)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return -0.03 * normal, normal, np.ones(count, bool), np.zeros(3)


@pytest.mark.parametrize(
    ("name", "most"),
    [("stability", 128), ("stability, no regulariser", 128), ("epsilon", 32), ("forces", 128)],
)
def test_a_thousand_contacts_are_refused_and_as_many_as_are_taken_take_no_time(name, most):
    contacts = ball(1000)
    with pytest.raises(InvalidInput, match=f"in_contact has 1000 .*; expected at most {most}"):
        FUNCTIONS[name](*contacts)
    touch = np.arange(1000) < most
    start = process_time()
    FUNCTIONS[name](contacts[0], contacts[1], touch, contacts[3])
    assert process_time() - start < 20  # a second or so


def test_many_contacts_of_many_edges_are_refused():
    with pytest.raises(InvalidInput, match="edges is 64, 6400 of all contacts; expected at most"):
        kernel.grasp_forces(*ball(100), 0.5, np.ones(6), edges=64)
