"""GraspState: shapes that belong together, and picking environments out of a batch."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput
from dexctl.controller import check_state
from dexctl.hand import HandModel


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


def test_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        GraspState(**fields()).q = np.zeros(15)  # type: ignore[misc]


def test_a_state_of_another_hand_is_an_error(dex5: HandModel) -> None:
    check_state(dex5, GraspState(**fields()))
    with pytest.raises(InvalidInput, match="16 joints and 4 fingers.*15 joints and 5 fingers"):
        check_state(dex5, GraspState(**fields(d=16, m=4)))
