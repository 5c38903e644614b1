"""Files of grasp states: quick, whole, and clear about what is wrong with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.sim import GraspStates
from dexctl.sim.grasp_states import StateSampler


def grasps(count: int = 3, d: int = 15, **changes: Any) -> GraspStates:
    hand = dexctl.hands.load("dex5")
    fields = {
        "hand": "dex5",
        "q": np.arange(count)[:, None] + np.zeros((count, d)),
        "q_target": np.zeros((count, d)),
        "object_position": np.zeros((count, 3)),
        "object_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "object": ["cube", "sphere", "cube"] * (count // 3),
        "joint_names": hand.joint_names,
    }
    return GraspStates(**{**fields, **changes})


def test_a_file_has_what_was_saved(tmp_path: Path) -> None:
    states, path = grasps(), tmp_path / "grasps.npz"
    states.save(path)
    found = GraspStates.load(path)
    assert (found.hand, len(found), found.object.tolist()) == (
        "dex5",
        3,
        ["cube", "sphere", "cube"],
    )
    np.testing.assert_array_equal(found.q, states.q)
    assert found.of("cube").q[:, 0].tolist() == [0.0, 2.0]
    assert [file.name for file in tmp_path.iterdir()] == ["grasps.npz"]


def test_thousands_are_read_in_a_moment(tmp_path: Path) -> None:
    grasps(6000).save(tmp_path / "many.npz")
    start = perf_counter()
    assert len(GraspStates.load(tmp_path / "many.npz")) == 6000
    assert perf_counter() - start < 1.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"object": []}, "GraspStates has no states"),
        ({"object": "cube"}, "GraspStates.object is cube; expected a list"),
        ({"q": np.zeros((3, 14))}, r"GraspStates.q has shape \(3, 14\); expected \(3, 15\)"),
        ({"q_target": np.full((3, 15), np.nan)}, "GraspStates.q_target has numbers that are not"),
        ({"q": np.full((3, 15), "a")}, "GraspStates.q has no numbers"),
        ({"object_quaternion": np.ones((3, 4))}, "object_quaternion has norm 2; expected 1"),
        ({"weight": np.zeros(3)}, "GraspStates.weight has numbers that are not finite and above 0"),
        ({"weight": np.ones(2)}, r"GraspStates.weight has shape \(2,\) .*expected \(3,\) numbers"),
        (
            {"parent": [-1, 0, 3]},
            "GraspStates.parent of row 2 is 3; expected another of the",
        ),
        ({"parent": [-1, 0, 0.5]}, "GraspStates.parent has shape .* of float64; expected"),
        ({"object_position": np.zeros(3)}, r"object_position has shape \(3,\); expected \(3, 3\)"),
    ],
)
def test_bad_states(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=said):
        grasps(**changes)
    path, fields = tmp_path / "bad.npz", {**vars(grasps(weight=np.ones(3))), **changes}
    fields = {name: value for name, value in fields.items() if value is not None}
    np.savez(path, **fields)
    with pytest.raises(InvalidInput, match=rf"grasp states '.*bad\.npz': .*{said}") as caught:
        GraspStates.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read: .*No such file"),
        (b"", "cannot be read"),
        (b"grasps", r"cannot be read: it is no \.npz file"),
        ("npy", r"cannot be read: it is no \.npz file"),
        ("cut", "cannot be read"),
        ("flag", "cannot be read"),  # a bit of the archive's directory says another way to pack
        ("part", "lacks q_target, .*expected hand, q, "),
    ],
)
def test_files_that_are_none(content: object, said: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "npy":
        with path.open("wb") as stream:
            np.save(stream, np.zeros(3))
    elif content == "cut":
        grasps().save(path)
        path.write_bytes(path.read_bytes()[:-200])
    elif content == "flag":
        grasps().save(path)
        damaged = bytearray(path.read_bytes())
        damaged[damaged.rfind(b"PK\x01\x02") + 8] ^= 0x20
        path.write_bytes(damaged)
    elif content == "part":
        np.savez(path, hand="dex5", q=np.zeros((1, 15)))
    with pytest.raises(InvalidInput, match=said) as caught:
        GraspStates.load(path)
    assert "bad.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_each_environment_draws_states_of_its_object(dex5: dexctl.HandModel) -> None:
    sampler = StateSampler(grasps(), dex5, ("cube", "sphere", "cube"))
    assert sampler(np.array([0.0, 0.99, 0.99])).tolist() == [0, 1, 2]
    with pytest.raises(InvalidInput, match="none of the object 'cylinder'; they are of cube, sph"):
        StateSampler(grasps(), dex5, ("cylinder",))
    other = grasps(d=2, hand="claw", joint_names=["a", "b"])
    with pytest.raises(InvalidInput, match="of the hand 'claw', whose 2 joints are not the 15 of"):
        StateSampler(other, dex5, ("cube",))


def test_weights_say_how_often_each_is_drawn(dex5: dexctl.HandModel) -> None:
    states = grasps(6, weight=[1.0, 9.0, 2.0, 9.0, 1.0, 9.0])  # cube sphere cube sphere cube sphere
    states = replace(states, object=np.array(["cube", "sphere"] * 3))
    sampler = StateSampler(states, dex5, ("cube",) * 400)
    drawn = sampler((np.arange(400) + 0.5) / 400)
    assert [int((drawn == row).sum()) for row in (0, 2, 4)] == [100, 200, 100]
    assert StateSampler(states, dex5, ("cube", "sphere"))(np.array([1 - 1e-16] * 2)).tolist() == [
        4,
        5,
    ]


def test_parents_follow_their_states(tmp_path: Path) -> None:
    states = grasps(6, parent=[-1, 0, 1, 2, 0, 4], weight=np.arange(1.0, 7.0), meta='{"seed": 1}')
    states.save(tmp_path / "kept.npz")
    again = GraspStates.load(tmp_path / "kept.npz")
    assert again.meta == '{"seed": 1}'
    chosen = again.take([5, 4, 2, 0])  # 2's parent is left out
    assert chosen.parent is not None
    assert chosen.weight is not None
    assert chosen.parent.tolist() == [1, 3, -1, -1]
    assert chosen.weight.tolist() == [6.0, 5.0, 3.0, 1.0]
    assert again.take([1, 1]).parent is None
    both = GraspStates.concatenate([chosen, grasps(3)])
    assert both.parent is not None
    assert both.weight is not None
    assert both.parent.tolist() == [1, 3, -1, -1, -1, -1, -1]
    assert both.weight.tolist() == [6.0, 5.0, 3.0, 1.0, 1.0, 1.0, 1.0]
    assert json.loads(both.meta) == {
        "parts": [{"states": 4, "meta": {"seed": 1}}, {"states": 3, "meta": ""}]
    }
    assert GraspStates.concatenate([chosen, chosen]).meta == chosen.meta
    with pytest.raises(InvalidInput, match="concatenate got no"):
        GraspStates.concatenate([])
