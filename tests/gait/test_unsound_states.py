"""No controller moves a motor by a state that cannot be: it says what is wrong, and goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.gait import CommandedTurning, GoalGait, GoalPursuit, GoalSequence, GoalSteering
from dexctl.igm import InGraspManipulationConfig

THESIS = InGraspManipulationConfig.thesis()
CONTROLLERS: dict[str, Callable[[dexctl.HandModel], dexctl.Controller]] = {
    "in-grasp": lambda hand: dexctl.InGraspManipulation(hand),
    "in-grasp, plain": lambda hand: dexctl.InGraspManipulation(hand, engine="plain"),
    "in-grasp, thesis": lambda hand: dexctl.InGraspManipulation(hand, THESIS),
    "switch": lambda hand: dexctl.ContactSwitch(hand),
    "switch, guarded": lambda hand: dexctl.ContactSwitch(hand, kind="guarded"),
    "gait": lambda hand: dexctl.FingerGaiting(hand),
    "coordinated": lambda hand: dexctl.CoordinatedGait(hand),
    "superposed": lambda hand: dexctl.Superposition(
        [dexctl.InGraspManipulation(hand), dexctl.ContactSwitch(hand)]
    ),
}


def held(hand: dexctl.HandModel, batch: tuple[int, ...], seed: int = 0) -> dexctl.GraspState:
    """Five fingers round a cylinder."""
    rng = np.random.default_rng(seed)
    q = np.tile([0.0, 0.75, -1.5], 5) + rng.normal(0, 0.03, (*batch, hand.nq))
    tip = hand.fingertip_positions(q)
    centre = tip.mean(axis=-2)
    normal = centre[..., None, :] - tip + rng.normal(0, 0.002, tip.shape)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return dexctl.GraspState(
        q=q,
        q_target=q + rng.normal(0, 0.02, q.shape),
        in_contact=np.ones((*batch, 5), bool),
        contact_position=tip + 0.014 * normal,
        contact_normal=normal,
        contact_force=rng.uniform(0.5, 3.0, (*batch, 5)),
        object_position=centre,
        object_quaternion=np.broadcast_to([1.0, 0, 0, 0], (*batch, 4)).copy(),
    )


def spoilt(state: dexctl.GraspState, field: str, change: Callable[[Any], Any]) -> dexctl.GraspState:
    """The state with row 3 of the fingers (or the one row) of environment 1 changed."""
    value = np.array(getattr(state, field))
    one = value[1] if state.batch_shape else value
    where: Any = 3 if field.startswith("contact") else slice(None)
    one[where] = change(one[where])
    return replace(state, **{field: value})


WRONG = [
    ("contact_normal", lambda n: 2 * n, "of unit length"),
    ("contact_normal", lambda n: 0 * n, "of unit length"),
    ("contact_normal", lambda n: 1.02 * n, "of unit length"),
    ("contact_normal", lambda n: 1e160 * n, "of unit length"),
    ("contact_normal", lambda n: np.nan * n, "finite"),
    ("contact_position", lambda p: p + np.inf, "finite"),
    ("contact_position", lambda p: p + 1e4, "within 1000"),
    ("contact_position", lambda p: p + 1e200, "within 1000"),
    ("contact_force", lambda f: np.nan, "finite"),
    ("contact_force", lambda f: 1e9, "within 1e"),
    ("contact_force", lambda f: -20.0, "0 N or more"),  # a sensor with its sign the other way
    ("contact_force", lambda f: -1e9, "0 N or more"),
    ("object_quaternion", lambda q: 2 * q, "of unit length"),
    ("object_quaternion", lambda q: 0 * q, "of unit length"),
    ("object_position", lambda p: p * np.nan, "finite"),
    ("object_position", lambda p: p + 1e160, "within 1e"),
    ("q", lambda q: q + 1e160, "within 1000"),
    ("q", lambda q: q + 1e5, "within 1000"),
    ("q_target", lambda q: q - 1e5, "within 1000"),
    ("q", lambda q: q * np.nan, "finite"),
    ("q_target", lambda q: q + np.inf, "finite"),
]


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_state_that_cannot_be_is_refused(dex5, name, batch):
    controller, same = CONTROLLERS[name](dex5), CONTROLLERS[name](dex5)
    state = held(dex5, batch)
    for one in (controller, same):
        one.reset(seed=0)
        one.act(state)
    finger = dex5.fingertip_names[3]
    for field, change, expected in WRONG:
        with pytest.raises(InvalidInput, match=f"the state is not {expected}") as error:
            controller.act(spoilt(state, field, change))
        text = str(error.value)
        assert field in text and "\n" not in text and len(text) < 250
        assert not field.startswith("contact") or f"finger {finger!r}" in text
        assert not batch or "in environments [1]" in text
    # nothing was taken over from what was refused
    following = held(dex5, batch, seed=1)
    np.testing.assert_array_equal(controller.act(following), same.act(following))


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_fingers_out_of_touch_may_have_any_normal(dex5, name, batch):
    state = held(dex5, batch)
    touch = np.broadcast_to([True, True, True, False, True], (*batch, 5))
    state = replace(state, in_contact=touch, object_position=None, object_quaternion=None)
    for change in (lambda n: 0 * n, lambda n: 2 * n, lambda n: n * np.nan):
        controller = CONTROLLERS[name](dex5)
        assert np.isfinite(controller.act(spoilt(state, "contact_normal", change))).all()


GOALS = {
    "goal_quaternion": [([2.0, 0, 0, 0], "of unit length"), ([0.0] * 4, "of unit length"),
                        ([np.nan, 0, 0, 0], "finite")],
    "goal_angular_velocity": [([0, 0, np.nan], "finite"), ([np.inf, 0, 0], "finite")],
    "gravity": [([0, 0, np.nan], "finite"), ([0, 1e9, 0], "within 1e")],
}  # fmt: skip
TOLD: dict[str, Callable[[dexctl.HandModel], dexctl.Controller]] = {
    "coordinated": lambda hand: dexctl.CoordinatedGait(hand),
    "goal": lambda hand: GoalGait(hand),
    "steered": lambda hand: GoalSteering(hand),
    "pursuing": lambda hand: GoalPursuit(hand, reacher=GoalGait(hand)),
    "commanded": lambda hand: CommandedTurning(hand, [dexctl.CoordinatedGait(hand)]),
    "sequence": lambda hand: GoalSequence(hand),
}


@pytest.mark.parametrize("name", TOLD)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_what_is_asked_for_is_checked_too(dex5, name, batch):
    """A command that was no number turned the object all the same."""
    controller, state = TOLD[name](dex5), held(dex5, batch)
    told = {"goal_quaternion": [1.0, 0, 0, 0], "goal_angular_velocity": [0, 0, 0.4],
            "gravity": [0, 0, -9.81]}  # fmt: skip
    for field, value in told.items():
        state = replace(state, **{field: np.broadcast_to(value, (*batch, len(value))).copy()})
    controller.act(state)
    for field, values in GOALS.items():
        for value, expected in values:
            wrong = spoilt(state, field, lambda _, value=value: np.array(value))
            with pytest.raises(InvalidInput, match=f"not {expected}.*{field} is"):
                controller.act(wrong)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_mask_that_is_none_is_refused_in_one_line(dex5, name):
    controller = CONTROLLERS[name](dex5)
    controller.act(held(dex5, (3,)))
    for mask in (1.0, "all", [0.0, 1.0, 1.0], [[True], [True, False]]):
        for seed in (None, 3):
            with pytest.raises(InvalidInput, match="^mask has shape .*; expected bools"):
                controller.reset(seed, mask)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_no_hand_at_all_is_a_batch(dex5, name):
    controller, state = CONTROLLERS[name](dex5), held(dex5, (3,))
    assert controller.act(state[:0]).shape == (0, dex5.nq)


@pytest.mark.skipif(find_spec("numba") is None, reason="the extra 'fast' is not installed")
def test_the_compiled_check_has_the_plain_one_s_numbers() -> None:
    from dexctl import controller
    from dexctl.igm import compiled

    assert compiled.UNIT_TOLERANCE == controller.UNIT_TOLERANCE
    assert compiled.FARTHEST == controller.FARTHEST
    assert compiled.FALLEN == controller.FALLEN


def under_attack(hand: dexctl.HandModel, calls: int, seed: int) -> tuple[int, int]:
    """Calls of every controller with states of which half are spoilt; answered and refused."""
    rng = np.random.default_rng(seed)
    numbers = [0.0, -1.0, 2.0, 1e-300, 1e7, 1e160, -1e308, np.nan, np.inf, -np.inf]
    fields = list(dict.fromkeys(field for field, _, _ in WRONG))
    controllers = [make(hand) for make in CONTROLLERS.values()]
    limit = np.full(hand.nq, 2.0 * 0.05 * 1.001)  # most of all the controllers' speeds
    answered = refused = 0
    for number in range(calls):
        controller = controllers[number % len(controllers)]
        batch: tuple[int, ...] = () if rng.random() < 0.7 else (3,)
        controller.reset(seed=number)
        state = held(hand, batch, seed=int(rng.integers(1000)))
        touch = rng.random((*batch, 5)) < 0.8
        state = replace(state, in_contact=touch)
        if rng.random() < 0.3:
            state = replace(state, object_position=None, object_quaternion=None)
        if rng.random() < 0.6:
            field = fields[rng.integers(len(fields))]
            value = getattr(state, field)
            if value is not None:
                value = np.array(value)
                value.flat[rng.integers(value.size)] = numbers[rng.integers(len(numbers))]
                state = replace(state, **{field: value})
        message = ""
        try:
            action = controller.act(state)
        except InvalidInput as error:
            message = str(error)
        if message:
            assert "\n" not in message and len(message) < 300, message
            refused += 1
            continue
        assert action.shape == state.q.shape and np.isfinite(action).all(), number
        # as fast as allowed, unless the set-point comes back from out of its limits
        inside = np.abs(state.q_target - state.q) < 0.25
        inside &= (state.q > hand.lower) & (state.q < hand.upper)
        count = 2 if isinstance(controller, dexctl.Superposition | dexctl.FingerGaiting) else 1
        assert (np.abs(action) <= count * limit)[inside].all(), number
        squared = (np.where(touch[..., None], state.contact_normal, 0.0) ** 2).sum(axis=-1)
        assert (np.abs(squared - 1.0) < 0.021)[touch].all(), number
        answered += 1
    return answered, refused


def test_eight_hundred_calls(dex5):
    answered, refused = under_attack(dex5, 800, 0)
    assert answered > 300 and refused > 150


@pytest.mark.slow
def test_twenty_thousand_calls(dex5):
    """Half a minute of one core."""
    answered, refused = under_attack(dex5, 20_000, 1)
    assert answered > 8000 and refused > 4000
