"""Evaluation: its figures against the environments and by hand, noise, files, the command."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.exceptions import InvalidInput, UnknownName
from learning.envs import EnvConfig, make_vector
from learning.envs.noise import SensorNoise
from learning.evaluate import Evaluation, Protocol, evaluate
from learning.evaluation_files import write_episodes
from learning.robustness import LEVELS, Disturbance, disturbance, protocols, robustness
from learning.senses import Senses

SHORT = Protocol(episodes=4, seconds=1.0, threads=1)


def made(rotation: list[float], held: list[float], dropped: list[bool]) -> Evaluation:
    count = len(rotation)
    return Evaluation(
        "cube",
        Protocol(episodes=count),
        np.array(rotation),
        np.array(held),
        np.array(dropped),
        np.zeros(count, bool),
        np.zeros(count),
    )


def test_figures_by_hand() -> None:
    found = made([1.0, 7.0, 3.0, 0.0], [10.0, 60.0, 60.0, 0.0], [True, False, False, True])
    figures = found.figures()
    assert figures["rotation_median_rad"].value == 2.0
    assert figures["revolutions_median"].value == pytest.approx(2.0 / (2 * np.pi))
    assert figures["speed_mean_rad_s"].value == pytest.approx((0.1 + 7 / 60 + 0.05) / 4)
    assert figures["share_dropped"].value == 0.5
    assert figures["share_full_turn"].value == 0.25
    assert json.loads(json.dumps(found.to_dict()))["share_dropped"]["count"] == 4


def test_rotation_and_return_are_the_environments(dex5: dexctl.HandModel) -> None:
    igm = controllers.make("igm", dex5)
    found = evaluate(igm, "cylinder", SHORT)
    envs = make_vector(EnvConfig(object="cylinder", max_speed=20.0, max_lead=1.0, threads=1), 4)
    envs.reset(seed=0)
    igm.reset(0)
    for _ in range(20):
        _, _, _, _, info = envs.step(envs.change_to_action(igm.act(envs.state)))
    np.testing.assert_allclose(found.rotation, info["rotation"], atol=1e-9)
    np.testing.assert_allclose(found.returns, info["episode_return"], atol=1e-9)
    np.testing.assert_array_equal(found.time_held, 1.0)
    assert not found.dropped.any()


def test_it_repeats_and_seeds_differ(dex5: dexctl.HandModel) -> None:
    igm = controllers.make("igm", dex5)
    noisy = Protocol(episodes=3, seconds=0.5, noise=SensorNoise(joint=0.05), threads=1)
    first, again = evaluate(igm, "cylinder", noisy), evaluate(igm, "cylinder", noisy)
    np.testing.assert_array_equal(first.rotation, again.rotation)
    shifted = evaluate(igm, "cylinder", Protocol(episodes=3, seconds=0.5, seed=1, threads=1,
                                                 noise=SensorNoise(joint=0.05)))  # fmt: skip
    np.testing.assert_array_equal(first.rotation[1:], shifted.rotation[:2])
    clean = evaluate(igm, "cylinder", Protocol(episodes=3, seconds=0.5, threads=1))
    assert not np.array_equal(clean.rotation, first.rotation)


def test_robustness_goes_through_every_level(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    found = robustness(
        controllers.make("hold", dex5),
        "cylinder",
        Protocol(episodes=2, seconds=0.1, threads=1),
        {"joint": (0.1,), "force": (0.25,), "push": (0.5,)},
        progress=lambda i, total: done.append((i, total)),
    )
    assert [one.protocol.noise for one in found] == [
        SensorNoise(),
        SensorNoise(joint=0.1),
        SensorNoise(force=0.25),
        SensorNoise(),
    ]
    assert [one.protocol.push.force for one in found] == [0.0, 0.0, 0.0, 0.5]
    assert not np.array_equal(found[3].rotation, found[0].rotation)
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    write_episodes(tmp_path / "episodes.csv", found)
    rows = list(csv.DictReader((tmp_path / "episodes.csv").open()))
    assert len(rows) == 8
    assert rows[3]["seed"] == "1"
    assert float(rows[3]["joint_noise"]) == 0.1
    assert float(rows[3]["time_held_s"]) == pytest.approx(0.1)


def test_the_sweeps_go_as_far_as_the_thesis_does() -> None:
    assert {kind: row[-1] for kind, row in LEVELS.items()} == {
        "joint": 0.1, "position": 0.01, "normal": 0.5, "force": 0.5, "push": 2.0,
    }  # fmt: skip
    every = protocols(Protocol(noise=SensorNoise(joint=0.3), gravity="down"))
    assert len(every) == 21 and not every[0].noise and not every[0].push
    assert {one.gravity for one in every} == {"down"}
    found = [disturbance(one) for one in every]
    assert found[0] == Disturbance("", 0.0)
    assert found[4] == Disturbance("joint", 0.1)
    assert found[-1] == Disturbance("push", 2.0)
    assert len(set(found)) == 21


def test_another_axis_palm_and_late_sensors(dex5: dexctl.HandModel) -> None:
    short = Protocol(
        episodes=2, seconds=0.5, threads=1, axis="x", gravity="down", latency=0.1,
        noise=SensorNoise(joint=0.01),
    )  # fmt: skip
    igm = controllers.make("igm", dex5, axis=(1.0, 0.0, 0.0))
    found = evaluate(igm, "sphere", short)
    envs = make_vector(
        EnvConfig(object="sphere", axis="x", gravity="down", max_speed=20.0, max_lead=1.0,
                  threads=1), 2,
    )  # fmt: skip
    envs.reset(seed=0)
    senses = Senses(igm, 2, short.noise, 2)
    senses.reset(0)
    for _ in range(10):
        _, _, _, _, info = envs.step(envs.change_to_action(senses.act(envs.state)))
    np.testing.assert_allclose(found.rotation, info["rotation"], atol=1e-9)
    np.testing.assert_allclose(found.returns, info["episode_return"], atol=1e-9)
    assert (found.rotation > 0.05).all()
    np.testing.assert_allclose(found.moments, 0.05 * np.arange(11))
    np.testing.assert_array_equal(found.rotations[-1], found.rotation)
    np.testing.assert_array_equal(found.rotations[0], 0.0)


def test_senses_are_late_and_begin_anew(dex5: dexctl.HandModel) -> None:
    class Seen(dexctl.Controller):
        def reset(self, seed=None, mask=None) -> None: ...

        def act(self, state: dexctl.GraspState) -> np.ndarray:
            self.q = state.q[:, 0]
            return np.zeros_like(state.q_target)

    seen = Seen(dex5, control_period=0.05)
    senses = Senses(seen, 2, latency=2)
    senses.reset(0)
    touch = np.zeros((2, 5), bool)
    found = []
    for i in range(6):
        if i == 4:
            senses.reset(mask=np.array([True, False]))
        state = dexctl.GraspState(
            q=np.full((2, 15), 0.1 * i), q_target=np.zeros((2, 15)), in_contact=touch,
            contact_position=np.zeros((2, 5, 3)), contact_normal=np.zeros((2, 5, 3)),
            contact_force=np.zeros((2, 5)), time=np.full(2, 0.05 * i),
        )  # fmt: skip
        senses.act(state)
        found.append(seen.q)
    expected = [[0, 0], [0, 0], [0, 0], [0.1, 0.1], [0.4, 0.2], [0.4, 0.3]]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_how_many_hold_it() -> None:
    found = made([1.0, 7.0, 3.0], [0.5, 1.0, 1.0], [True, False, True])
    np.testing.assert_array_equal(found.held(np.array([0.0, 0.5, 0.75, 1.0, 1.5])), [3, 3, 2, 2, 1])


def test_bad_input(dex5: dexctl.HandModel) -> None:
    hold = controllers.make("hold", dex5)
    with pytest.raises(UnknownName, match="unknown object 'brick'; known: cube"):
        evaluate(hold, "brick")
    with pytest.raises(InvalidInput, match="episodes is 0"):
        Protocol(episodes=0)
    with pytest.raises(InvalidInput, match="seconds is nan"):
        Protocol(seconds=np.nan)
    with pytest.raises(UnknownName, match="unknown axis 'w'"):
        Protocol(axis="w")
    with pytest.raises(InvalidInput, match="latency is nan"):
        Protocol(latency=np.nan)
    with pytest.raises(InvalidInput, match=r"joint is -1\.0"):
        SensorNoise(joint=-1.0)
    with pytest.raises(UnknownName, match="unknown disturbance 'smell'; known: joint, position"):
        robustness(hold, "cube", levels={"smell": (1.0,)})
