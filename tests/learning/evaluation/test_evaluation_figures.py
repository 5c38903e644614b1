"""Evaluation: its figures against the environments and by hand, every setting of the reward."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed
from dexctl.sim import Trace
from dexctl.sim.conditions import CONDITIONS
from learning.envs import EnvConfig, make_vector
from learning.evaluation import Evaluation, Protocol, evaluate, open_subject, rollout
from learning.evaluation.figures import sunk
from learning.evaluation.files import write_episodes
from learning.evaluation.judged import Goals
from learning.evaluation.robustness import (
    LEVELS,
    Disturbance,
    disturbance,
    levels_of,
    protocols,
    robustness,
)

SHORT = changed(Protocol(), {"episodes": 4, "seconds": 1.0, "threads": 1, "object": "cylinder"})


def made(rotation: list[float], held: list[float], dropped: list[bool]) -> Evaluation:
    count = len(rotation)
    return Evaluation(
        object="cube",
        protocol=Protocol(episodes=count),
        rotation=np.array(rotation),
        time_held=np.array(held),
        dropped=np.array(dropped),
        strayed=np.array(dropped) | (np.arange(count) == 1),
        time_near=np.minimum(held, 20.0),
        diverged=np.zeros(count, bool),
        returns=np.zeros(count),
        goals_reached=np.array([3, 0, 1, 0])[:count],
        goals_missed=np.array([0, 2, 1, 0])[:count],
        goals_in_a_row=np.array([3, 0, 1, 0])[:count],
        first_goal_time=np.array([4.0, np.inf, 6.0, np.inf])[:count],
        fingertips_only=np.arange(count) / (count - 1.0),
        drift=np.arange(count) / 100.0,
        mean_drift=np.arange(count) / 400.0,
        sink=np.arange(count) / 200.0,
        moments=np.zeros(0),
        rotations=np.zeros((0, count)),
    )


def test_figures_by_hand() -> None:
    found = made([1.0, 7.0, 3.0, 0.0], [10.0, 60.0, 60.0, 0.0], [True, False, False, True])
    figures = found.figures()
    assert figures["rotation_median_rad"].value == 2.0
    assert figures["revolutions_median"].value == pytest.approx(2.0 / (2 * np.pi))
    assert figures["speed_mean_rad_s"].value == pytest.approx((0.1 + 7 / 60 + 0.05) / 4)
    assert figures["share_dropped"].value == 0.5
    assert figures["share_full_turn"].value == 0.25
    assert figures["time_held_median_s"].value == 35.0
    assert figures["share_fingertips_only"].value == 0.5
    assert figures["drift_median_m"].value == pytest.approx(0.015)
    assert figures["mean_drift_median_m"].value == pytest.approx(0.00375)
    assert figures["sink_median_m"].value == pytest.approx(0.0075)
    told = json.loads(json.dumps(found.to_dict()))
    assert told["share_dropped"]["count"] == 4
    assert told["share_strayed"]["count"] == 4 and told["share_strayed"]["value"] == 0.75
    assert told["survival_near"] == {
        "time_s": [0.0, 10.0, 20.0],
        "share_held": [0.75, 0.5, 0.25],
    }
    assert told["survival"] == {"time_s": [0.0, 10.0], "share_held": [0.75, 0.5]}


def test_half_the_drop_distance_is_the_stricter_rule() -> None:
    far = np.array([0.0, 0.02, 0.03, 0.01, 0.06])  # beyond 25 mm, back, then dropped
    position = np.zeros((5, 2, 3))
    position[:, 0, 0] = far
    position[:, 1, 1] = far / 3
    held = np.array([[True, True]] * 4 + [[False, True]])
    quaternion = np.tile((1.0, 0.0, 0.0, 0.0), (5, 2, 1))
    nothing = np.zeros((5, 2))
    trace = Trace(
        time=np.arange(5.0),
        held=held,
        q=nothing[..., None],
        q_target=nothing[..., None],
        contact_force=np.zeros((5, 2, 5)),
        contact_position=np.zeros((5, 2, 5, 3)),
        contact_normal=np.zeros((5, 2, 5, 3)),
        object_position=position,
        object_quaternion=quaternion,
        other_contact=nothing,
        in_contact=np.ones((5, 2, 5), bool),
        rotation=nothing,
        diverged=nothing > 0,
    )
    scene: Any = SimpleNamespace(
        object="cube",
        settled=SimpleNamespace(qpos=np.array([0.0, 0, 0, 1, 0, 0, 0])),
        object_qpos=slice(0, 7),
    )
    none = np.zeros(2, int)
    goals = Goals(reached=none, missed=none, in_a_row=none, first_time=np.full(2, np.inf))
    judged: Any = SimpleNamespace(
        returns=lambda trace: np.zeros(2),
        goals=lambda trace: goals,
        held=lambda trace: trace.held,
        within=lambda: np.ones((5, 2), bool),
        gravity=np.tile([0.0, 0.0, -9.81], (5, 2, 1)),
    )
    found = Evaluation.of(trace, scene, Protocol(episodes=2), judged)
    assert found.strayed.tolist() == [True, False]
    assert found.time_near.tolist() == [1.0, 4.0]


def test_figures_of_goals_by_hand() -> None:
    found = made([1.0, 7.0, 3.0, 0.0], [10.0, 60.0, 60.0, 0.0], [True, False, False, True])
    assert "share_goals_reached" not in found.figures()
    figures = replace(found, protocol=changed(found.protocol, {"goals": "cube"})).figures()
    assert figures["share_first_goal_reached"].value == 0.5
    # 3 of 4, the last being dropped; 0 of 2; 1 of 2; 0 of 1, dropped
    assert figures["share_goals_reached"].value == pytest.approx((0.75 + 0.0 + 0.5 + 0.0) / 4)
    assert figures["first_goal_median_s"].value == 18.0  # of 4, 6, 30 and 30
    assert figures["goals_in_a_row_median"].value == 0.5


def test_how_far_an_object_has_sunk_by_hand() -> None:
    position = np.zeros((3, 4, 3))
    position[:, 0, 2] = [0.1, 0.12, 0.07]
    position[:, 1:, 2] = np.array([0.1, 0.2, 0.3])[:, None]
    position[2, 3, :2] = [0.03, 0.04]
    gravity = np.zeros((3, 4, 3))
    gravity[:, 0, 2] = gravity[:, 1, 2] = -9.81
    gravity[:, 3] = [[0.0, 0.0, 2.0], [0.0, 0.0, 2.0], [0.6, 0.8, 0.0]]  # it turned
    trace: Any = SimpleNamespace(object_position=position)
    expected = [[0.0, 0.0, 0.0, 0.0], [-0.02, -0.1, 0.0, 0.1], [0.03, -0.2, 0.0, 0.05]]
    np.testing.assert_allclose(sunk(trace, gravity), expected, atol=1e-12)


def test_drift_is_any_way_and_sinking_along_the_gravity_of_each_episode() -> None:
    """Up to the drop, whichever way gravity is drawn; and it may turn on the way."""
    protocol = changed(
        SHORT, {"object": "cube", "gravity_tilt": np.pi, "gravity_turning_range": (0.5, 1.0)}
    )
    found = rollout(open_subject("coordinated"), protocol)
    drift, sink = found.evaluation.drift, found.evaluation.sink
    moved = found.trace.object_position - found.trace.object_position[0]
    np.testing.assert_allclose(drift, np.linalg.norm(moved, axis=-1).max(axis=0))
    assert ((sink > 0) & (sink <= drift)).all()
    away = np.linalg.norm(moved, axis=-1)
    np.testing.assert_allclose(found.evaluation.mean_drift, away.mean(axis=0))
    fixed = rollout(open_subject("coordinated"), changed(SHORT, {"object": "cube"}))
    moved = fixed.trace.object_position - fixed.trace.object_position[0]
    np.testing.assert_allclose(fixed.evaluation.sink, (-moved[..., 2]).max(axis=0))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"max_reward": 0.1},
        {"max_tilt": 0.01},
        {"min_fingertips": 5},
        {"commands": ("x", "any"), "command_seconds": 0.3},
        {"substeps": 5, "axis": "-x", "gravity": "down", "object_mass": 0.05, "seed": 3},
    ],
)
def test_rotation_and_return_are_the_environments(settings: dict[str, Any]) -> None:
    subject = open_subject("commanded:igm" if "commands" in settings else "igm")
    protocol = changed(SHORT, settings)
    found = evaluate(subject, protocol)
    config = EnvConfig(
        scene=protocol.scene,
        task=protocol.task,
        max_speed=20.0,
        max_lead=1.0,
        parts=("q", "goal_angular_velocity"),
    )
    envs = make_vector(config, 4)
    envs.reset(seed=protocol.seed)
    igm = subject.acting(protocol)
    igm.reset(0)
    for _ in range(20):
        _, _, _, _, info = envs.step(envs.change_to_action(igm.act(envs.state)))
    np.testing.assert_allclose(found.rotation, info["rotation"], atol=1e-9)
    np.testing.assert_allclose(found.returns, info["episode_return"], atol=1e-9)
    np.testing.assert_array_equal(found.time_held, 1.0)
    np.testing.assert_allclose(found.moments, 0.05 * np.arange(21))
    np.testing.assert_array_equal(found.rotations[-1], found.rotation)
    np.testing.assert_array_equal(found.rotations[0], 0.0)
    assert not found.dropped.any()


def test_goals_are_the_environments() -> None:
    """The same goals in the same order, and the same return, in evaluation and in training."""
    subject = open_subject("goal")
    asked = {"goals": "yaw", "goal_seconds": 0.3, "goal_angle": 0.6, "success_joint_speed": 9.0}
    protocol = changed(SHORT, asked)
    found = rollout(subject, protocol)
    config = EnvConfig(
        scene=protocol.scene, task=protocol.task, max_speed=20.0, max_lead=1.0,
        parts=("q", "goal_rotation"),
    )  # fmt: skip
    envs = make_vector(config, 4)
    envs.reset(seed=protocol.seed)
    gait = subject.acting(protocol)
    gait.reset(0)
    for row in range(20):
        state = envs.state
        np.testing.assert_array_equal(found.wanted["goal_quaternion"][row], state.goal_quaternion)
        _, _, _, _, info = envs.step(envs.change_to_action(gait.act(state)))
    np.testing.assert_allclose(found.evaluation.returns, info["episode_return"], atol=1e-9)
    np.testing.assert_array_equal(found.evaluation.goals_reached, info["goals"])
    assert found.evaluation.goals_missed.any()
    envs.close()


def test_an_episode_ends_where_its_task_says_so() -> None:
    """As a success with the last goal, and lost where links touch: nothing counts after that."""
    subject = open_subject("goal")
    asked = {"goals": "yaw", "goal_angle": 0.6, "success_joint_speed": 9.0, "goal_count": 1}
    protocol = changed(SHORT, {**asked, "least_goal_angle": 0.7})
    found = rollout(subject, changed(protocol, {"episodes": 8}))
    one, trace = found.evaluation, found.trace
    over = np.isfinite(one.first_goal_time)
    assert over.any() and not over.all() and not trace.dropped.any()
    np.testing.assert_array_equal(one.time_held[over], one.first_goal_time[over])
    assert (one.time_held[~over] == 1.0).all() and not one.dropped.any()
    rows = np.rint(one.time_held / 0.05).astype(int)
    np.testing.assert_array_equal(one.rotation, trace.rotation[rows, np.arange(8)])
    assert (one.rotation[over] != trace.final_rotation[over]).all()
    assert (one.held(np.array([0.0, 1.0])) == 8).all()

    weak = changed(SHORT, {"stiffness": 0.3, "end_on_links": True})  # some sink on to the links
    found = rollout(open_subject("hold"), weak)
    one, touched = found.evaluation, found.trace.other_contact[1:] > 0
    assert not found.trace.dropped.any()
    np.testing.assert_array_equal(one.dropped, touched.any(axis=0))
    assert one.dropped.any() and not one.dropped.all()
    first = np.where(one.dropped, touched.argmax(axis=0), 20)
    np.testing.assert_allclose(one.time_held, 0.05 * first)
    assert (one.fingertips_only == 1.0).all()


def test_a_nearer_drop_distance_drops_sooner() -> None:
    subject = open_subject("igm")
    protocol = subject.protocol(episodes=2, seconds=0.5, object="cylinder")
    usual = rollout(subject, protocol)
    assert not usual.evaluation.dropped.any()
    near = rollout(subject, changed(protocol, {"drop_distance": 1e-5})).evaluation
    assert near.dropped.all() and (near.rotation < usual.evaluation.rotation).all()


def test_it_repeats_and_seeds_differ() -> None:
    subject = open_subject("igm")
    noisy = changed(SHORT, {"episodes": 3, "seconds": 0.5, "joint_noise": 0.05})
    first, again = evaluate(subject, noisy), evaluate(subject, noisy)
    np.testing.assert_array_equal(first.rotation, again.rotation)
    shifted = evaluate(subject, replace(noisy, seed=1))
    np.testing.assert_array_equal(first.rotation[1:], shifted.rotation[:2])
    late = evaluate(subject, changed(noisy, {"joint_noise": 0.0, "sensor_latency": 0.1}))
    clean = evaluate(subject, changed(noisy, {"joint_noise": 0.0}))
    assert len({one.rotation.tobytes() for one in (first, late, clean)}) == 3


def test_robustness_goes_through_every_level(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    found = robustness(
        controllers.make("hold", dex5),
        changed(SHORT, {"episodes": 2, "seconds": 0.1}),
        {"joint_noise": (0.1,), "force_noise_share": (0.25,), "push_force": (0.5,)},
        progress=lambda i, total: done.append((i, total)),
    )
    assert [disturbance(one.protocol, found[0].protocol) for one in found] == [
        ("", 0.0), ("joint_noise", 0.1), ("force_noise_share", 0.25), ("push_force", 0.5),
    ]  # fmt: skip
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
        "joint_noise": 0.1, "position_noise": 0.01, "normal_noise": 0.5, "force_noise_share": 0.5,
        "push_force": 2.0,
    }  # fmt: skip
    base = changed(Protocol(), {"sensor_latency": 0.1, "gravity": "down"})
    every = protocols(base)
    assert len(every) == 21
    assert {one.scene.gravity for one in every} == {"down"}
    assert {one.scene.sensing.sensor_latency for one in every} == {0.1}
    found = [disturbance(one, base) for one in every]
    assert found[0] == Disturbance("", 0.0)
    assert found[4] == Disturbance("joint_noise", 0.1)
    assert found[-1] == Disturbance("push_force", 2.0)
    assert len(set(found)) == 21


def test_what_is_disturbed_already_stays_so() -> None:
    """Levels come on top of the protocol's own noise, which the row of none has, too."""
    noise = dict(CONDITIONS["noise"])
    base = changed(Protocol(), noise | {"joint_noise": 0.05, "push_force": 2.0})
    every = protocols(base)
    found = [disturbance(one, base) for one in every]
    assert every[0] == base and found[0] == Disturbance("", 0.0)
    assert found[1:3] == [Disturbance("joint_noise", 0.075), Disturbance("joint_noise", 0.1)]
    assert len(set(found)) == len(found) == 1 + 2 + 4 + 4 + 4  # what is no more is left out
    for one, (kind, level) in zip(every, found, strict=True):
        assert levels_of(one) == levels_of(base) | ({kind: level} if kind else {})
        assert one.scene.sensing.joint_offset == base.scene.sensing.joint_offset
    with pytest.raises(InvalidInput, match="push_force is -1"):
        protocols(base, {"push_force": (-1.0,)})


def test_how_many_hold_it() -> None:
    found = made([1.0, 7.0, 3.0], [0.5, 1.0, 1.0], [True, False, True])
    np.testing.assert_array_equal(found.held(np.array([0.0, 0.5, 0.75, 1.0, 1.5])), [3, 3, 2, 2, 1])
    strict = replace(
        found, strayed=np.array([True, True, False]), time_near=np.array([0.2, 0.9, 1.0])
    )
    moments = np.array([0.0, 0.2, 0.5, 1.0])
    np.testing.assert_array_equal(strict.held(moments, near=True), [3, 3, 2, 1])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"seconds": np.nan}, "seconds is nan"),
        ({"seed": -1}, "seed is -1"),
        ({"axis": "w"}, "unknown axis 'w'"),
        ({"sensor_latency": -1.0}, "sensor_latency is -1"),
        ({"smell": 1.0}, "unknown setting 'smell'"),
        ({"object": "brick"}, "unknown object 'brick'; known: cube"),
        ({"object": ("cube", "sphere")}, "object is cube, sphere; expected one"),
        ({"control_period": 0.1}, "control_period is 0.1; the policy 'still' was trained with"),
    ],
)
def test_bad_input(settings: dict[str, Any], said: str, still: Any) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=said):
        evaluate(still, changed(Protocol(), settings))


def test_an_unknown_disturbance(dex5: dexctl.HandModel) -> None:
    with pytest.raises(UnknownName, match="unknown disturbance 'smell'; known: joint_noise"):
        robustness(controllers.make("hold", dex5), levels={"smell": (1.0,)})
