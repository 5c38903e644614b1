"""GraspState: shapes that belong together, and picking environments out of a batch."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput
from dexctl.controller import check_state
from dexctl.hand import HandModel
from dexctl.rotations import inverse, rotate


def fields(batch: tuple[int, ...] = (), d: int = 15, m: int = 5) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {
        "q": rng.normal(size=(*batch, d)),
        "q_target": rng.normal(size=(*batch, d)),
        "in_contact": rng.random((*batch, m)) < 0.5,
        "contact_position": rng.normal(size=(*batch, m, 3)),
        "contact_normal": rng.normal(size=(*batch, m, 3)),
        "contact_force": rng.random((*batch, m)),
        "object_position": rng.normal(size=(*batch, 3)),
        "object_quaternion": rng.normal(size=(*batch, 4)),
        "time": rng.random(batch),
        "age": rng.random(batch),
    }


def test_lists_become_arrays() -> None:
    state = GraspState(
        q=[0, 1],  # type: ignore[arg-type]
        q_target=[0, 1],  # type: ignore[arg-type]
        in_contact=[1],  # type: ignore[arg-type]
        contact_position=[[0, 0, 1]],  # type: ignore[arg-type]
        contact_normal=[[0, 0, -1]],  # type: ignore[arg-type]
        contact_force=[2],  # type: ignore[arg-type]
    )
    assert state.q.dtype == float
    assert state.in_contact.dtype == bool
    assert state.batch_shape == ()
    assert state.object_position is None


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_batch_shape(batch: tuple[int, ...]) -> None:
    assert GraspState(**fields(batch)).batch_shape == batch


@pytest.mark.parametrize(
    "name",
    [name for name in fields() if name not in ("q", "in_contact")],
)
def test_a_wrong_shape_names_the_field(name: str) -> None:
    values = fields((4,))
    values[name] = values[name][1:]
    with pytest.raises(InvalidInput, match=rf"GraspState\.{name} has shape \(3,"):
        GraspState(**values)


@pytest.mark.parametrize("name", ["q", "in_contact", "contact_normal"])
@pytest.mark.parametrize("value", [3.0, "low", None, [[1.0], [1.0, 2.0]]])
def test_what_is_no_array_names_the_field(name: str, value: Any) -> None:
    with pytest.raises(InvalidInput, match=rf"GraspState\.{name}"):
        GraspState(**(fields() | {name: value}))


@pytest.mark.parametrize("name", [*fields(), "time", "age"])
@pytest.mark.parametrize("kind", [complex, str])
def test_what_is_no_real_number_names_the_field(name: str, kind: type) -> None:
    values: dict[str, Any] = fields((4,)) | {"time": np.zeros(4), "age": np.zeros(4)}
    values[name] = values[name].astype(kind)
    with pytest.raises(InvalidInput, match=rf"GraspState\.{name} is .*expected") as error:
        GraspState(**values)
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


@pytest.mark.parametrize("value", [0.5, np.nan, 2, -1.0])
def test_touch_is_bools_or_ones_and_zeros(value: float) -> None:
    touch: Any = np.zeros((4, 5))
    touch[1] = 1.0
    values = fields((4,)) | {"in_contact": touch}
    assert GraspState(**values).in_contact[1].all()
    touch[2, 0] = value
    with pytest.raises(InvalidInput, match=r"GraspState\.in_contact is .*; expected bools"):
        GraspState(**values)


@pytest.mark.parametrize(
    "value", ["yes", 0.5, float("nan"), None, [0.0, 1.0, 1.0, 0.0], [[True], [True, False]]]
)
def test_whether_normals_are_felt_is_yes_or_no(value: Any) -> None:
    with pytest.raises(InvalidInput, match=r"GraspState\.normals_felt is .*expected .*bool"):
        GraspState(**fields((4,)), normals_felt=value)


def test_whether_normals_are_felt_is_said_for_all_or_for_each() -> None:
    assert GraspState(**fields((4,))).normals_felt is True
    mixed = GraspState(**fields((4,)), normals_felt=[True, False, True, False])  # type: ignore[arg-type]
    assert mixed[1:3].normals_felt.tolist() == [False, True]  # type: ignore[union-attr]
    with pytest.raises(InvalidInput, match=r"GraspState\.normals_felt has shape \(3,\)"):
        GraspState(**fields((4,)), normals_felt=np.ones(3, bool))


def test_indexing() -> None:
    values = fields((4,))
    state = GraspState(**values)
    for index, batch in (
        (2, ()),
        (slice(1, 3), (2,)),
        (values["time"] > 0.3, None),
        ([3, 0], (2,)),
    ):
        part = state[index]
        for name, value in values.items():
            np.testing.assert_array_equal(getattr(part, name), value[index])
        if batch is not None:
            assert part.batch_shape == batch
    single = GraspState(**fields())
    assert single[None].batch_shape == (1,)
    np.testing.assert_array_equal(single[None][0].contact_force, single.contact_force)


def test_indexing_one_hand_by_number_is_an_error() -> None:
    with pytest.raises((InvalidInput, IndexError)):
        GraspState(**fields())[0]


def test_without_takes_fingers_out_of_contact() -> None:
    state = GraspState(**(fields() | {"in_contact": np.array([1, 1, 0, 1, 1], bool)}))
    off = np.array([1, 0, 1, 0, 0], bool)
    assert state.without(off).in_contact.tolist() == [False, True, False, True, True]
    assert state.in_contact[0], "the state itself does not change"


@pytest.mark.parametrize("fingers", [None, 10**400, [0.0] * 5, [True] * 4, [[True], [True] * 2]])
def test_fingers_taken_out_of_contact_are_bools(fingers: Any) -> None:
    with pytest.raises(InvalidInput, match=r"fingers has shape .* expected bools of shape \(5,\)"):
        GraspState(**fields()).without(fingers)


def test_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        GraspState(**fields()).q = np.zeros(15)  # type: ignore[misc]


def test_a_state_of_another_hand_is_an_error(dex5: HandModel) -> None:
    check_state(dex5, GraspState(**fields()))
    with pytest.raises(InvalidInput, match="16 joints and 4 fingers.*15 joints and 5 fingers"):
        check_state(dex5, GraspState(**fields(d=16, m=4)))


def test_in_the_frame_of_a_hand_that_is_carried() -> None:
    """A frame at (1, 2, 3), turned by 90 degrees about z: its x is the world's y."""
    half = np.sqrt(0.5)
    state = GraspState(**fields((4,)))
    touched = replace(state, in_contact=np.ones((4, 5), bool))
    seen = touched.in_frame((1.0, 2.0, 3.0), (half, 0.0, 0.0, half))
    away = touched.contact_position - (1.0, 2.0, 3.0)
    turned = np.stack([away[..., 1], -away[..., 0], away[..., 2]], axis=-1)
    np.testing.assert_allclose(seen.contact_position, turned, atol=1e-12)
    normal = touched.contact_normal
    turned = np.stack([normal[..., 1], -normal[..., 0], normal[..., 2]], axis=-1)
    np.testing.assert_allclose(seen.contact_normal, turned, atol=1e-12)
    for name in ("q", "q_target", "contact_force", "in_contact"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(touched, name))
    weighed = replace(touched, gravity=np.tile([0.0, 5.0, -9.0], (4, 1)))
    down = weighed.in_frame((1.0, 2.0, 3.0), (half, 0.0, 0.0, half)).gravity
    assert down is not None
    np.testing.assert_allclose(down, np.tile([5.0, 0.0, -9.0], (4, 1)), atol=1e-12)
    # each environment its own frame, and back by the inverse pose
    rng = np.random.default_rng(0)
    turn = rng.standard_normal((4, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    place = rng.standard_normal((4, 3))
    there = touched.in_frame(place, turn)
    home = there.in_frame(-rotate(inverse(turn), place), inverse(turn))
    for name in ("contact_position", "contact_normal", "object_position", "object_quaternion"):
        np.testing.assert_allclose(getattr(home, name), getattr(touched, name), atol=1e-12)
    none = replace(state, in_contact=np.zeros((4, 5), bool), object_position=None)
    seen = none.in_frame(place, turn)
    assert not seen.contact_position.any() and seen.object_position is None


@pytest.mark.parametrize(
    ("position", "quaternion", "message"),
    [
        ((0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "position has shape"),
        ((0.0, 0.0, np.nan), (1.0, 0.0, 0.0, 0.0), "position is"),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), "quaternion has the length 1.41"),
        ((0.0, 0.0, 0.0), np.ones((2, 4)) / 2, "quaternion has shape"),
        ("here", (1.0, 0.0, 0.0, 0.0), "position is not an array of numbers: 'here'"),
    ],
)
def test_a_frame_that_is_none(position: Any, quaternion: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        GraspState(**fields()).in_frame(position, quaternion)
