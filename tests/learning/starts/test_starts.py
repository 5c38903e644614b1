"""Reset distributions: what episodes begin in, by name, in a training that is resumed too."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.planning import Kinematic, RandomActions, Stability
from dexctl.settings import changed, from_plain, to_plain
from dexctl.sim import BatchSimulator, GraspStates, SceneConfig
from dexctl.sim.sensing import Sensing
from learning.config import TrainConfig
from learning.envs import EnvConfig, ManipulationVectorEnv
from learning.starts.catalogue import make_starts
from learning.starts.check import check_starts, remark_on_starts
from learning.starts.config import EXPANDS, NAMES, StartsConfig, TreeConfig

Make = Callable[..., TrainConfig]


def env(count: int = 12, **scene: Any) -> ManipulationVectorEnv:
    scene = {"object": ("cylinder",), "threads": 1, **scene}
    return ManipulationVectorEnv(EnvConfig(scene=SceneConfig(**scene)), count, 0)


def settled(made: ManipulationVectorEnv) -> GraspStates:
    state = made.state
    assert state.object_position is not None
    assert state.object_quaternion is not None
    return GraspStates(
        hand="dex5",
        q=state.q,
        q_target=state.q_target,
        object_position=state.object_position,
        object_quaternion=state.object_quaternion,
        object=np.array(made.objects),
        joint_names=np.array(made.hand.joint_names),
    )


@pytest.fixture
def said() -> list[str]:
    return []


def test_paths_and_grasps_are_planned_once(tmp_path: Path, said: list[str]) -> None:
    path = tmp_path / "starts.npz"
    config = StartsConfig(start_from="paths", start_count=40, tree_nodes=60, start_seconds=20)
    made = env(4)
    make_starts(config, made, 3).begin(path, said.append)
    states = GraspStates.load(path)
    assert 30 <= len(states) <= 80
    assert states.weight is not None and states.parent is not None
    assert json.loads(states.meta)["tree"]["seed"] == 3
    assert said[0] == "growing a tree for each object, for 20 s at most"
    assert said[1].startswith(f"cylinder: {len(states)} of 40 states wanted, of a tree of ")
    assert said[1].endswith(" rad") and len(said) == 3
    assert f"{len(states)} states to start from in {path}" in said[2]
    made.reset()
    for q in made.state.q:
        assert np.abs(states.q - q).max(axis=1).min() < 1e-12
    again = env(4)
    make_starts(config, again, 4).begin(path, said.append)  # as it is after a kill
    assert len(said) == 3
    assert again.simulation.starts is not None
    np.testing.assert_array_equal(again.simulation.starts.q, states.q)
    grasps = replace(config, start_from="grasps", start_count=5)
    make_starts(grasps, env(4), 0).begin(tmp_path / "grasps.npz", said.append)
    assert len(GraspStates.load(tmp_path / "grasps.npz")) == 5


def test_an_object_named_twice_is_met_twice_as_often_and_planned_once(
    tmp_path: Path, said: list[str]
) -> None:
    path = tmp_path / "starts.npz"
    config = StartsConfig(start_from="grasps", start_count=3, start_seconds=20)
    made = env(6, object=("cylinder", "cube", "cylinder"))
    assert Counter(made.objects) == {"cylinder": 4, "cube": 2}
    make_starts(config, made, 0).begin(path, said.append)
    assert [line.split(":")[0] for line in said[1:-1]] == ["cylinder", "cube"]
    assert Counter(GraspStates.load(path).object.tolist()) == {"cylinder": 3, "cube": 3}


def test_trees_and_samples_take_their_settings(tmp_path: Path, said: list[str]) -> None:
    ways = TreeConfig(kinematic=Kinematic(friction=0.8, margin=0.002, batch=64))
    loose = Stability(fingertips_only=False, max_distance=0.01)
    config = StartsConfig(
        start_from="paths", start_count=10, tree_nodes=20, start_seconds=20,
        tree=ways, stability=loose,
    )  # fmt: skip
    make_starts(config, env(2), 0).begin(tmp_path / "paths.npz", said.append)
    settings = json.loads(GraspStates.load(tmp_path / "paths.npz").meta)["tree"]["settings"]
    assert settings["expansion"] == to_plain(ways.kinematic)
    assert settings["stability"] == to_plain(loose)
    grasps = replace(config, start_from="grasps", start_count=3)
    make_starts(grasps, env(2), 0).begin(tmp_path / "grasps.npz", said.append)
    settings = json.loads(GraspStates.load(tmp_path / "grasps.npz").meta)["settings"]
    assert settings["stability"] == to_plain(loose)


@pytest.mark.parametrize("start_from", ["paths", "grasps"])
def test_plans_are_stepped_as_the_environments_are(
    start_from: Any, tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, seen = env(2, control_period=0.02, substeps=5, object=("cylinder", "sphere")), set()

    class Looked(BatchSimulator):
        def __init__(self, *arguments: Any, **keywords: Any) -> None:
            super().__init__(*arguments, **keywords)
            if self.num_envs != 1:  # the root's is looked at only
                seen.add((self.control_period, self.substeps))

    monkeypatch.setattr("dexctl.sim.BatchSimulator", Looked)
    config = StartsConfig(
        start_from=start_from, start_count=3, tree_nodes=12, start_seconds=20,
        tree_expand="random", tree=TreeConfig(random=RandomActions(batch=4)),
    )  # fmt: skip
    make_starts(config, made, 0).begin(tmp_path / "starts.npz", said.append)
    assert seen == {(0.02, 5)}
    states = GraspStates.load(tmp_path / "starts.npz")
    assert sorted(set(states.object)) == ["cylinder", "sphere"]


def test_a_plan_says_of_which_scene_it_is(tmp_path: Path, said: list[str]) -> None:
    """Its noise is the training's alone."""
    config = StartsConfig(start_from="grasps", start_count=2, start_seconds=20)
    made = env(2, control_period=0.02, sensing=Sensing(joint_noise=0.01))
    make_starts(config, made, 0).begin(tmp_path / "starts.npz", said.append)
    scene = json.loads(GraspStates.load(tmp_path / "starts.npz").meta)["scene"]
    expected = SceneConfig(object=("cylinder",), control_period=0.02, threads=1)
    assert from_plain(SceneConfig, scene) == expected


@pytest.mark.parametrize("way", EXPANDS)
def test_each_way_has_its_own_settings(way: Any) -> None:
    found = StartsConfig(tree_expand=way).expansion
    assert found == getattr(TreeConfig(), way)


def test_runs_from_before_trees_had_settings_are_read() -> None:
    """And the names that physics and sensing have for theirs are still theirs."""
    plain = to_plain(TrainConfig())
    del plain["starts"]["tree"], plain["starts"]["stability"]
    assert from_plain(TrainConfig, plain) == TrainConfig()
    made = changed(TrainConfig(), {"substeps": 5, "starts.tree.kinematic.substeps": 3})
    assert (made.env.scene.substeps, made.starts.tree.kinematic.substeps) == (5, 3)


def test_a_single_state_is_refused(tmp_path: Path, said: list[str]) -> None:
    for seconds, why in (
        (
            0.05,
            "dodecahedron: 1 of 40 states wanted, of a tree of 1 nodes that turns it by 0.00 rad",
        ),
        (20.0, "no grasp of the dodecahedron was reached from the settled one in 3072 expansions"),
    ):
        config = StartsConfig(start_from="paths", start_count=40, start_seconds=seconds)
        with pytest.raises(InvalidInput, match=why):
            make_starts(config, env(4, object=("dodecahedron",)), 0).begin(
                tmp_path / "none.npz", said.append
            )
    assert not (tmp_path / "none.npz").exists()
    assert said == [
        f"growing a tree for each object, for {limit} s at most" for limit in (0.05, 20)
    ]


def test_a_training_whose_starts_cannot_be_planned_leaves_no_run(
    small: Make, tmp_path: Path, said: list[str]
) -> None:
    """So that the same command may be given again, with other settings."""
    pytest.importorskip("torch")
    from learning.training.trainer import train

    settings = {"object": ("dodecahedron",), "start_seconds": 20.0, "steps": 4, "num_envs": 4}
    with pytest.raises(InvalidInput, match="no grasp of the dodecahedron"):
        train(small(start_from="paths", **settings), tmp_path / "run", remark=said.append)
    assert said[0] == f"the run is kept in {tmp_path / 'run'}"  # for a Ctrl-C on the way
    assert said[-1] == f"the run has not begun, and nothing is kept in {tmp_path / 'run'}"
    train(small(start_from="fixed", **settings), tmp_path / "run")


def test_explored_states_are_those_of_the_training(tmp_path: Path, said: list[str]) -> None:
    made = env(12)
    config = StartsConfig(start_from="explored", start_count=50, explored_share=0.8)
    starts = make_starts(config, made, 0)
    starts.begin(tmp_path / "none", said.append)
    before = made.state.q
    seen = [before]
    for turn in range(100):
        made.step(np.full((12, 15), 0.05 * np.sin(0.3 * turn)))
        done = np.zeros(12, bool)
        done[0] = True  # its state is the first of an episode, and not remembered
        starts.after_step(12 * (turn + 1), done)
        seen.append(made.state.q)
    given = made.simulation.starts
    assert given is not None and given.weight is not None
    assert len(given) == 12 + 50
    np.testing.assert_array_equal(given.q[:12], before)
    assert given.weight[12:].sum() == pytest.approx(0.8 * given.weight.sum())
    visited = np.concatenate(seen)
    turns = []
    for q in given.q[12:]:
        row = int(np.abs(visited - q).max(axis=1).argmin())
        assert np.array_equal(visited[row], q) and row % 12 != 0
        turns.append(row // 12)
    assert np.ptp(turns) > 5 and max(turns) == 100  # older ones become rarer, but there are some
    assert not (tmp_path / "none").exists()


def test_gravity_grows(tmp_path: Path, said: list[str]) -> None:
    made = env(2)
    starts = make_starts(StartsConfig(start_from="gravity", gravity_steps=1000), made, 0)
    starts.begin(tmp_path / "none", said.append)
    found = []
    for step in (0, 4, 250, 999, 1000, 5000):
        starts.after_step(step, np.zeros(2, bool))
        gravity = made.simulation.sim.read().gravity
        assert gravity is not None
        found.append(float(gravity[0, 2]) / -9.81)
    assert found == pytest.approx([0.0, 0.0, 0.25, 0.99, 1.0, 1.0])


@pytest.mark.parametrize(
    ("name", "cut", "turns"),
    # explored: in the middle of what is started from, for long enough to begin in it
    [
        ("paths", 70, 120),
        ("explored", 150, 190),
        *(pytest.param(name, 70, 120, marks=pytest.mark.slow) for name in NAMES if name != "paths"),
    ],
)
def test_a_resumed_training_ends_with_the_same_bits(
    name: str, cut: int, turns: int, small: Make, tmp_path: Path
) -> None:
    pytest.importorskip("torch")
    from learning.training.trainer import resume, train

    config = small(
        start_from=name, start_count=20, tree_nodes=30, start_seconds=20, gravity_steps=300,
        steps=4 * turns, num_envs=4, algorithm="ppo", method="rl", checkpoint_every=240,
    )  # fmt: skip
    train(config, tmp_path / "whole")
    train(replace(config, steps=4 * cut), tmp_path / "cut")
    resume(tmp_path / "cut", 4 * turns)
    one, other = (np.load(tmp_path / run / "policy.npz") for run in ("whole", "cut"))
    for key in one.files:
        if one[key].dtype.kind == "f":
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)


@pytest.mark.parametrize(
    ("changes", "alike"),
    [
        ({}, True),
        ({"friction_range": (0.5, 1.0), "joint_noise": 0.01, "drop_cost": 3.0}, True),
        ({"axis": "-z"}, False),
        ({"object": ("cube",)}, False),
        ({"gravity": "down"}, False),
        ({"start_count": 4}, False),
        ({"seed": 1}, False),
        ({"start_from": "fixed"}, False),
    ],
)
def test_a_run_that_begins_with_another_takes_what_was_planned_for_it(
    changes: dict[str, Any], alike: bool, small: Make, tmp_path: Path
) -> None:
    """It planned the same states anew, for a quarter of an hour with four objects."""
    pytest.importorskip("torch")
    from learning.training.run_folder import RunFolder
    from learning.training.trainer import Trainer, train

    first, second = RunFolder(tmp_path / "first"), RunFolder(tmp_path / "second")
    plans = {"start_from": "grasps", "start_count": 5, "start_seconds": 20, "method": "rl"}
    train(small(**plans, steps=8), first.path)
    kept = json.loads(first.hand_path.read_text())
    first.hand_path.write_text(json.dumps(kept | {"toml": "elsewhere/dex5.toml"}))  # as copied
    said: list[str] = []
    config = small(**{**plans, "steps": 8, "begin_from": first.path, **changes})
    trainer = Trainer(config, second, remark=said.append)
    second.create(config)
    second.note_hand(trainer.env.hand, config.env.scene)
    trainer.take_starts()
    trainer.close()
    assert second.starts_path.exists() == alike
    assert said == ([f"states to start from are those of {first.path}"] if alike else [])
    if alike:
        assert second.starts_path.read_bytes() == first.starts_path.read_bytes()
        second.starts_path.unlink()
        whole = first.starts_path.read_bytes()
        first.starts_path.write_bytes(b"")
        with pytest.raises(InvalidInput, match="first/starts.npz' cannot be read"):
            trainer.take_starts()
        assert not second.starts_path.exists()
        first.starts_path.write_bytes(whole)
        first.hand_path.write_text(json.dumps(kept | {"sha256": "another"}))
        trainer.take_starts()
        first.hand_path.unlink()  # as in folders of earlier versions: it may be another hand
        trainer.take_starts()
        assert not second.starts_path.exists()


def test_starts_that_do_not_hold_are_one_line(said: list[str]) -> None:
    made = env(8)
    good = settled(made)
    made.simulation.start_from(good)
    check_starts(made.simulation, said.append)
    assert said == []
    loose = replace(good, q_target=good.q - 0.5)
    made.simulation.start_from(loose)
    with pytest.raises(InvalidInput, match="8 of 8 starts do not hold .* cylinder, palm up") as e:
        check_starts(made.simulation, said.append)
    assert "\n" not in str(e.value)
    remark_on_starts(made.simulation, said.append)  # an evaluation goes on
    (line,) = said
    assert line in str(e.value)
    said.clear()
    planned = replace(good, meta=json.dumps({"gravity": [0.0, 0.0, 9.81]}))
    made.simulation.start_from(planned)  # they hold all the same
    for check in (check_starts, remark_on_starts):
        check(made.simulation, said.append)
    told = "the starts were planned under gravity (0, 0, 9.81) m/s²; this is (0, 0, -9.81)"
    assert said == [told, told]
    said.clear()
    few = replace(
        loose, q_target=np.where(np.arange(8)[:, None] < 2, loose.q_target, good.q_target)
    )
    made.simulation.start_from(few)
    made.simulation.reset(7)
    check_starts(made.simulation, said.append)
    assert len(said) <= 1


def test_a_file_of_falling_starts_is_refused_before_the_run(small: Make, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from learning.training.run_folder import RunFolder
    from learning.training.trainer import train

    good = settled(env(4))
    replace(good, q_target=good.q - 0.5).save(tmp_path / "loose.npz")
    config = small(num_envs=4, env__initial_states=tmp_path / "loose.npz")
    with pytest.raises(InvalidInput, match="4 of 4 starts do not hold"):
        train(config, tmp_path / "run")
    assert not RunFolder.is_run(tmp_path / "run")
    path = tmp_path / "cut.npz"
    path.write_bytes((tmp_path / "loose.npz").read_bytes()[:-300])
    with pytest.raises(InvalidInput, match="'.*cut.npz' cannot be read"):
        train(small(env__initial_states=path), tmp_path / "run")


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        (
            {"start_from": "anywhere"},
            "start_from is 'anywhere'; expected 'fixed' or",
        ),
        (
            {"start_from": "paths", "env__initial_states": Path("x.npz")},
            "'paths' and initial_states",
        ),
        (
            {"start_from": "explored", "env__size_range": (0.9, 1.1)},
            r"start_from is 'explored', whose grasps are of one size, and size_range is \(0.9, 1.1",
        ),
        ({"tree_expand": "magic"}, "tree_expand is 'magic'; expected 'kinematic' or"),
        ({"start_count": 0}, "start_count is 0"),
        ({"explored_share": 1.5}, "explored_share is 1.5"),
        ({"imitated": "joints", "start_from": "paths"}, "algorithm 'sac'; expected ppo"),
        (
            {"imitated": "joints", "algorithm": "ppo", "method": "rl"},
            "'joints' and start_from 'fixed'; expected 'paths', or initial_states",
        ),
    ],
)
def test_what_is_refused(small: Make, settings: dict[str, Any], what: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=what):
        small(**settings)
