"""Sampled grasps: they hold, are distinct, and come far quicker than from random joints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.planning import Frame, GraspSampling, Metric, SampledGrasps, Stability, sample_grasps
from dexctl.planning.nodes import put, root_of
from dexctl.planning.sampling import _Draws
from dexctl.rotations import from_rotation_vector, multiply, rotation_vector
from dexctl.sim import BatchSimulator, GraspStates, Scene


@pytest.fixture(scope="module")
def l_shape() -> Scene:
    return Scene.build("dex5", "l_shape", "up")


@pytest.fixture(scope="module")
def sampled(l_shape: Scene) -> SampledGrasps:
    return sample_grasps(l_shape, 40, GraspSampling(batch=64), seed=0, threads=1)


def test_sampled_grasps_hold(l_shape: Scene, sampled: SampledGrasps) -> None:
    nodes = sampled.nodes
    assert len(nodes) == len(sampled.states) == 40
    assert (nodes.in_contact.sum(axis=1) >= 3).all()
    with BatchSimulator(l_shape, 40, disturbance=0.0, threads=1) as sim:
        put(sim, nodes)
        assert Stability(seconds=2.0).check(sim).stable.mean() > 0.9


def test_they_are_all_over_the_object_and_apart(l_shape: Scene, sampled: SampledGrasps) -> None:
    turned = np.sort(sampled.nodes.rotation)
    assert turned[0] < -2 and turned[-1] > 2  # any way round
    assert len({tuple(row) for row in sampled.nodes.in_contact.tolist()}) > 3
    points = Metric().of(Frame.of("z", root_of(l_shape)), sampled.nodes)
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    assert apart[np.triu_indices(40, 1)].min() >= 0.1


def test_all_that_were_tried_are_accounted_for(sampled: SampledGrasps) -> None:
    assert sampled.tried % 64 == 0
    assert sampled.tried - sum(sampled.refused.values()) >= 40  # some beyond the count are left out
    assert sampled.seconds > 0


def test_fingertips_round_the_object_are_quicker_than_random_joints(l_shape: Scene) -> None:
    shares = []
    for place in ("fingertips", "joints"):
        config = GraspSampling(place=place, batch=64, settle_seconds=0.2)
        try:
            found = sample_grasps(l_shape, 500, config, seed=1, most_tried=192, threads=1)
            shares.append(len(found.nodes) / found.tried)
        except InvalidInput:
            shares.append(0.0)
    assert shares[0] > 5 * shares[1]


def test_random_joints_need_no_contact_model(
    l_shape: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So there are grasps of hands whose joints have not a servo each."""

    def refused(*_: object, **__: object) -> None:
        raise InvalidInput("shadow: the joint 'j' follows another")

    monkeypatch.setattr("dexctl.planning.sampling.ContactModel", refused)
    root = root_of(l_shape)
    frame, rng = Frame.of("z", root), np.random.default_rng(0)
    nodes, reached = _Draws(l_shape, frame, root, GraspSampling(place="joints", batch=4))(rng)
    assert len(nodes) == 4 and reached.all()
    with pytest.raises(InvalidInput, match="'j' follows another; expected sampling.place joints"):
        _Draws(l_shape, frame, root, GraspSampling())


def test_states_are_a_file_that_episodes_start_from(sampled: SampledGrasps, tmp_path: Path) -> None:
    sampled.states.save(tmp_path / "grasps.npz")
    assert len(GraspStates.load(tmp_path / "grasps.npz")) == 40


def test_they_say_what_they_are_of(l_shape: Scene, sampled: SampledGrasps) -> None:
    meta = json.loads(sampled.states.meta)
    assert (meta["hand"], meta["object"], meta["seed"]) == ("dex5", "l_shape", 0)
    assert meta["gravity"] == l_shape.gravity.tolist() and set(meta["versions"]) >= {"dexctl"}
    assert meta["settings"]["sampling"]["batch"] == 64 and meta["scene"] is None
    assert meta["expansions"] == sampled.tried and meta["refused"] == sampled.refused


def test_what_was_found_before_ctrl_c_is_kept(l_shape: Scene, tmp_path: Path) -> None:
    path = tmp_path / "made" / "grasps.npz"

    def stop(now: int) -> None:
        if now:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample_grasps(l_shape, 99, GraspSampling(batch=64), threads=1, path=path, progress=stop)
    assert 0 < len(GraspStates.load(path)) < 99


def test_other_links_may_touch_where_the_check_lets_them(l_shape: Scene) -> None:
    def refused(fingertips_only: bool) -> dict[str, int]:
        check = Stability(fingertips_only=fingertips_only)
        config = GraspSampling(batch=64)
        return sample_grasps(
            l_shape, 1000, config, stability=check, most_tried=64, seed=0, threads=1
        ).refused

    assert refused(True)["other contact"] > 0
    assert refused(False)["other contact"] == 0


def test_what_sampling_refuses(l_shape: Scene) -> None:
    with pytest.raises(InvalidInput, match="path is '/dev/null/a'; cannot write there"):
        sample_grasps(l_shape, 5, path="/dev/null/a")
    with pytest.raises(InvalidInput, match="seed is -1; expected a whole number from 0 on"):
        sample_grasps(l_shape, 5, seed=-1)
    with pytest.raises(InvalidInput, match="count is 0; expected a whole number"):
        sample_grasps(l_shape, 0)
    with pytest.raises(UnknownName, match="unknown place 'elbows'; known: fingertips, joints"):
        GraspSampling(place="elbows")
    hard = Stability(min_contacts=5, max_distance=1e-9)
    with pytest.raises(InvalidInput, match="none of 32 random grasps of Scene"):
        sample_grasps(
            l_shape, 2, GraspSampling(batch=32, min_contacts=5), stability=hard, most_tried=32,
            threads=1,
        )  # fmt: skip
    with pytest.raises(
        InvalidInput, match=r"sampling\.min_contacts is 2 and stability\.min_contacts 3, which"
    ):
        sample_grasps(l_shape, 2, GraspSampling(min_contacts=2), stability=Stability())
    wrong: dict[str, Any]
    for wrong, why in (
        ({"seconds": float("nan")}, "seconds is nan; expected a number above 0"),
        ({"seconds": -1}, "seconds is -1; expected a number above 0"),
        ({"seconds": "x"}, "seconds is 'x'; expected a number above 0"),
        ({"most_tried": -1}, "most_tried is -1; expected a whole number above 0"),
        ({"most_tried": 2.5}, "most_tried is 2.5; expected a whole number above 0"),
        ({"stability": 5}, "stability is 5; expected of class Stability"),
        ({"sampling": {}}, "sampling is {}; expected of class GraspSampling"),
        ({"metric": 0}, "metric is 0; expected of class Metric"),
        ({"scene_config": {}}, "scene_config is {}; expected of class SceneConfig"),
    ):
        with pytest.raises(InvalidInput, match=why):
            sample_grasps(l_shape, 2, **wrong)


def test_fewest_contacts_are_said_once(l_shape: Scene) -> None:
    for sampling, stability in (
        (GraspSampling(min_contacts=2, batch=32), None),
        (None, Stability(min_contacts=2)),
        (GraspSampling(), Stability(min_contacts=4)),  # as a command has it that is told the latter
    ):
        found = sample_grasps(l_shape, 1, sampling, stability=stability, seed=0, threads=1)
        settings = json.loads(found.states.meta)["settings"]
        wanted = 4 if sampling and stability else 2
        for name in ("sampling", "stability"):
            assert settings[name]["min_contacts"] == wanted


def test_rotation_vectors_and_back() -> None:
    vector = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(rotation_vector(from_rotation_vector(vector)), vector, atol=1e-12)
    half = from_rotation_vector(0.5 * vector)
    np.testing.assert_allclose(multiply(half, half), from_rotation_vector(vector), atol=1e-12)
    np.testing.assert_allclose(from_rotation_vector(np.zeros(3)), [1, 0, 0, 0])


def test_about_any_axis_fingertips_stand_around_the_palms_direction() -> None:
    sphere = Scene.build("dex5", "sphere", "up")
    found = sample_grasps(sphere, 8, GraspSampling(batch=64), axis="x", seed=0, threads=1)
    assert len(found.nodes) == 8  # about x, none could be reached
    assert np.ptp(found.nodes.rotation) > 2.0
