"""The compiled in-grasp step against the plain one."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dexctl
from dexctl.grasp import box_qp, stability_solver
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig, Share

pytest.importorskip("numba", reason="the extra 'fast' is not installed")
compiled_numbers = pytest.importorskip("dexctl.igm.compiled")


def _state(
    hand: dexctl.HandModel, rng: np.random.Generator, count: int, tracked: bool
) -> dexctl.GraspState:
    """Hands round an object, fingers touching it from anywhere, some not at all."""
    middle = np.clip(0.5 * (hand.lower + hand.upper), -1, 1)
    q = hand.clip(middle + rng.normal(0, 0.2, (count, hand.nq)))
    tip = hand.fingertip_positions(q)
    normal = rng.normal(size=tip.shape)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    touch = rng.random(tip.shape[:2]) < 0.7
    point = np.where(touch[..., None], tip + 0.01 * normal, np.nan)
    return dexctl.GraspState(
        q=q,
        q_target=q + rng.normal(0, 0.05, q.shape),
        in_contact=touch,
        contact_position=point,
        contact_normal=np.where(touch[..., None], normal, np.nan),
        contact_force=np.where(touch, rng.uniform(0, 4, touch.shape), np.nan),
        object_position=tip.mean(axis=1) + rng.normal(0, 0.005, (count, 3)) if tracked else None,
        object_quaternion=quaternion if tracked else None,
    )


def _share(rng: np.random.Generator, shape: tuple[int, int]) -> Share:
    return Share(
        released=rng.random(shape) < 0.15,
        max_force=np.where(rng.random(shape) < 0.3, rng.random(shape), 1.0),
        twist=rng.normal(0, 0.2, (shape[0], 6)),
        yielding=np.where(rng.random(shape) < 0.2, 8.0, 0.0),
    )


@given(
    seed=st.integers(0, 10_000),
    tracked=st.booleans(),
    shared=st.booleans(),
    friction=st.sampled_from([0.0, 0.3, 1.0]),
    length=st.sampled_from([None, 0.05]),
    closing=st.sampled_from([0.0, 0.03]),
    reach_distance=st.sampled_from([0.0, 0.01, 0.3]),
    link_limit=st.sampled_from([0.1, 1.0]),
    slip_limit=st.sampled_from([0.0, 0.35, 3.0]),
)
def test_compiled_and_plain_agree(
    dex5: dexctl.HandModel,
    seed: int,
    tracked: bool,
    shared: bool,
    friction: float,
    length: float | None,
    closing: float,
    reach_distance: float,
    link_limit: float,
    slip_limit: float,
) -> None:
    rng = np.random.default_rng(seed)
    config = InGraspManipulationConfig(
        friction=friction,
        length=length,
        closing_speed=closing,
        reach_distance=reach_distance,
        link_limit=link_limit,
        slip_limit=slip_limit,
        twist=(0.01, 0, 0, 0.1, 0, 0.3),
    )
    compiled = InGraspManipulation(dex5, config, engine="compiled")
    plain = InGraspManipulation(dex5, config, engine="plain")
    for _ in range(3):  # the first step takes the reference, the others regulate towards it
        state = _state(dex5, rng, 6, tracked)
        share = _share(rng, state.in_contact.shape) if shared else Share()
        np.testing.assert_allclose(
            compiled.command(state, share), plain.command(state, share), atol=1e-9
        )
        for name, value in plain.diagnostics.items():
            np.testing.assert_allclose(compiled.diagnostics[name], value, atol=1e-8, err_msg=name)


def test_compiled_and_plain_agree_for_four_fingers_of_four_joints(
    four_fingers: dexctl.HandModel,
) -> None:
    rng = np.random.default_rng(3)
    compiled = InGraspManipulation(four_fingers, engine="compiled")
    plain = InGraspManipulation(four_fingers, engine="plain")
    for _ in range(20):
        state = _state(four_fingers, rng, 4, True)
        np.testing.assert_allclose(compiled.act(state), plain.act(state), atol=1e-9)


def test_arrays_may_lie_in_memory_as_they_like(dex5: dexctl.HandModel) -> None:
    """Slices and read-only arrays must not start the compiler in the middle of a run."""
    state = _state(dex5, np.random.default_rng(0), 8, True)
    strided = state[::2]
    for array in (strided.q, strided.contact_normal):
        array.flags.writeable = False
    controller = InGraspManipulation(dex5, engine="compiled")
    whole = controller.act(state)
    controller.reset()
    np.testing.assert_allclose(controller.act(strided), whole[::2], atol=1e-12)


def test_auto_falls_back_without_numba(
    dex5: dexctl.HandModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    with monkeypatch.context() as patch:
        patch.setattr("dexctl.igm.controller.find_spec", lambda name: None)
        assert InGraspManipulation(dex5).engine == "plain"
        with pytest.raises(dexctl.MissingExtra, match=r"dexctl\[fast\]"):
            InGraspManipulation(dex5, engine="compiled")


def test_zero_regulariser_takes_the_plain_step(dex5: dexctl.HandModel) -> None:
    assert InGraspManipulation(dex5, regulariser=0.0).engine == "plain"
    with pytest.raises(dexctl.InvalidInput, match="regulariser is 0"):
        InGraspManipulation(dex5, regulariser=0.0, engine="compiled")


@pytest.mark.parametrize("regulariser", [1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("tracked", [False, True])
def test_fingers_at_one_contact(
    dex5: dexctl.HandModel, regulariser: float, friction: float, tracked: bool
) -> None:
    """Contacts that coincide or oppose each other: both engines break ties alike."""
    rng = np.random.default_rng(5)
    config = InGraspManipulationConfig(regulariser=regulariser, friction=friction)
    compiled = InGraspManipulation(dex5, config, engine="compiled")
    plain = InGraspManipulation(dex5, config, engine="plain")
    for size in (1, 24):
        for controller in (compiled, plain):
            controller.reset()
        state = _state(dex5, rng, size, tracked)
        state.in_contact[:] = True
        point = np.where(np.isnan(state.contact_position), 0.01, state.contact_position)
        normal = rng.normal(size=point.shape)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        point[:, 3], normal[:, 3] = point[:, 1], normal[:, 1]
        normal[::2, 2] = -normal[::2, 0]
        state = dataclasses.replace(
            state,
            contact_position=point,
            contact_normal=normal,
            contact_force=np.ones(point.shape[:2]),
        )
        np.testing.assert_allclose(compiled.act(state), plain.act(state), atol=1e-9)
        for name, value in plain.diagnostics.items():
            np.testing.assert_allclose(compiled.diagnostics[name], value, atol=1e-7, err_msg=name)


def test_the_numbers_of_both_solvers_are_the_same() -> None:
    for name in ("TOLERANCE", "ROUNDS"):
        assert getattr(compiled_numbers, name) == getattr(box_qp, name)
    for name in ("TIE", "LOST", "DUAL"):
        assert getattr(compiled_numbers, name) == getattr(stability_solver, name)
