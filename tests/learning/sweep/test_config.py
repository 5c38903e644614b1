"""What a sweep's file means: the runs, and what is said to mistakes in it."""

from __future__ import annotations

import json
import tomllib
from dataclasses import fields
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import changed as with_changes
from dexctl.settings import from_plain, get, paths, to_plain
from dexctl.sim.randomisation import Randomisation
from learning.cli.sweep import Sweep
from learning.config import TrainConfig
from learning.evaluation.protocol import Protocol
from learning.sweep.config import Cell, SweepConfig, difference
from learning.sweep.jobs import jobs
from learning.sweep.reading import load_sweep, parse_sweep

ROOT = Path(__file__).parents[3]
GIVEN: dict[str, Any] = {
    "methods": ["rl", "vge", "rl+bc"],
    "controllers": ["gait", ["igm", "switch"]],
    "seeds": 2,
    "train": {
        "steps": 1000,
        "sac": {"network": [16, 8]},
        "env": {"object": "cylinder", "episode_steps": 60, "gravity": [0, 0, 9.81]},
        "guidance": {"hard_stop": 500},
    },
    "method": {
        "rl": {"seeds": [7]},
        "rl+bc": {"controllers": ["igm"], "sac.gamma": 0.5, "guidance": {"beta": 1}},
    },
    "evaluation": {"episodes": 3, "seconds": 2},
    "criterion": {"rotation": 1},
}


def changed(**changes: Any) -> dict[str, Any]:
    """`GIVEN` with other values; a dotted name (a__b) reaches into tables."""
    found = json.loads(json.dumps(GIVEN))
    for name, value in changes.items():
        *path, last = name.split("__")
        inside = found
        for part in path:
            inside = inside.setdefault(part, {})
        inside[last] = value
    return found


def test_it_is_found_by_name() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    points = tomllib.loads(text)["project"]["entry-points"]["dexctl.commands"]
    assert EntryPoint("sweep", points["sweep"], "dexctl.commands").load() is Sweep


def test_the_matrix_by_hand() -> None:
    config = parse_sweep(GIVEN)
    assert config.cells == (
        Cell("rl", ()),
        Cell("vge", ("gait",)),
        Cell("vge", ("igm", "switch")),
        Cell("rl+bc", ("igm",)),
    )
    # everybody's first seed, then the second ones
    assert [run.name for run in config.runs] == [
        "rl-7", "vge-gait-0", "vge-igm-switch-0", "rl+bc-igm-0",
        "vge-gait-1", "vge-igm-switch-1", "rl+bc-igm-1",
    ]  # fmt: skip


def test_settings_reach_the_runs() -> None:
    runs = {run.name: run.config for run in parse_sweep(GIVEN).runs}
    vge, clone, alone = runs["vge-igm-switch-1"], runs["rl+bc-igm-1"], runs["rl-7"]
    assert (vge.seed, alone.seed) == (1, 7)
    assert (vge.guidance.method, vge.controllers) == ("vge", ("igm", "switch"))
    assert (alone.guidance.method, alone.controllers) == ("rl", ())
    assert (vge.sac.gamma, clone.sac.gamma) == (0.99, 0.5)
    assert (vge.guidance.beta, clone.guidance.beta, clone.guidance.hard_stop) == (0.1, 1.0, 500)
    for config in runs.values():
        assert (config.steps, config.sac.network, config.torch_threads) == (1000, (16, 8), 1)
        assert (config.env.scene.object, config.env.episode_steps) == (("cylinder",), 60)
        assert config.env.scene.gravity == (0, 0, 9.81)
        assert config.env.scene.threads == 1  # several runs share the machine
        assert from_plain(TrainConfig, json.loads(json.dumps(to_plain(config)))) == config


def test_a_recipe_gives_what_is_not_given() -> None:
    given = changed(train__recipe="fast", train__sac__tau=0.5, train__guidance={"hard_stop": 500})
    runs = {run.name: run.config for run in parse_sweep(given).runs}
    clone, alone = runs["rl+bc-igm-0"], runs["rl-7"]
    for config in (clone, alone):
        assert (config.sac.n_step, config.sac.layer_norm, config.env.scaled) == (5, True, True)
        assert (config.sac.tau, config.guidance.hard_stop, config.steps) == (0.5, 500, 1000)
        assert config.env.critic_parts == ("object_position", "object_quaternion")
    assert (clone.guidance.cloning, clone.guidance.beta) == ("squared", 1.0)
    assert alone.guidance.cloning == "likelihood"
    # for one method alone; and for all but one
    runs = {run.name: run.config for run in parse_sweep(changed(method__rl__recipe="fast")).runs}
    assert (runs["rl-7"].sac.n_step, runs["vge-gait-0"].sac.n_step) == (5, 1)
    given = changed(train__recipe="fast", method__rl__recipe="thesis")
    runs = {run.name: run.config for run in parse_sweep(given).runs}
    assert (runs["rl-7"].sac.n_step, runs["vge-gait-0"].sac.n_step) == (1, 5)


def test_every_setting_can_be_given() -> None:
    """A complete configuration, as a run writes it down, is a sweep's [train]."""
    whole = without_none(to_plain(TrainConfig()))  # TOML has no null
    del whole["seed"], whole["controllers"], whole["guidance"]["method"]
    whole["env"]["scene"]["threads"] = 2
    given = {"methods": ["vge"], "controllers": ["gait"], "train": whole}
    (run,) = parse_sweep(given).runs
    assert run.config == with_changes(TrainConfig(), {"threads": 2})


def without_none(values: dict[str, Any]) -> dict[str, Any]:
    return {
        name: without_none(value) if isinstance(value, dict) else value
        for name, value in values.items()
        if value is not None
    }


def test_what_a_method_says_goes_before_train_by_any_name() -> None:
    given = changed(
        train__axis="x", method__rl={"env": {"task": {"axis": "y"}}}, evaluation__axis="-z"
    )
    runs = {run.config.guidance.method: run.config for run in parse_sweep(given).runs}
    assert (runs["rl"].env.task.axis, runs["vge"].env.task.axis) == ("y", "x")
    # [train] alone is no configuration of rl+bc, where no controller acts
    given = changed(train__guidance={"cloned": "acted"}, **{"method__rl+bc__cloned": "visited"})
    runs = {run.config.guidance.method: run.config for run in parse_sweep(given).runs}
    assert (runs["rl+bc"].guidance.cloned, runs["vge"].guidance.cloned) == ("visited", "acted")


OTHER = {
    "scene.hand": "allegro",
    "scene.object": ("sphere", "cube"),
    "scene.object_mesh": Path("/there/mug.stl"),
    "scene.gravity": (1.0, 0.0, -9.0),
    "scene.initial_states": Path("/there/states.npz"),
    "scene.sensing.touch": "binary",
    "scene.sensing.object_pose": "odometry",
    "scene.threads": 3,
    "task.goals": "cube",
    "task.turning.axis": "-y",
    "scene.sensing.joint_touch.weigh_links": False,
    "task.holding.end_on_links": True,
    "task.turning.keep_speed": True,
    "task.turning.only_fingertips": False,
    "task.turning.commands": ("x", "any"),
}
DISTURBANCES = (
    "joint_noise", "position_noise", "normal_noise", "force_noise", "force_noise_share",
    "sensor_latency", "push_force", "initial_states", "joint_offset",
    "tracker_latency", "tracker_position_noise", "tracker_rotation_noise",
    *(one.name for one in fields(Randomisation)),
)  # fmt: skip
"""What training has and evaluation has not, unless it says so."""
TOLD = {"goals": "goal_rotation", "commands": "goal_angular_velocity"}
"""What a policy must see of them."""


def other(path: str) -> Any:
    """A value of a setting of `Protocol` that is not its default."""
    if path in OTHER:
        return OTHER[path]
    if path.endswith("_range"):
        return (0.25, 0.75)
    value = get(Protocol(), path)
    return 0.125 if value is None else 2 * value or 0.25 if isinstance(value, float) else value + 2


def protocols_of(given: dict[str, Any], folder: Path) -> list[Protocol]:
    """What the jobs of a sweep evaluate, as their processes read it."""
    every = [type(job).from_json(job.to_json()) for job in jobs(parse_sweep(given), folder)]
    assert every[0].config is None and every[1].config is not None
    return [from_plain(Protocol, job.protocol) for job in every]


@pytest.fixture
def any_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of hands are not looked up: there need not be a second one."""
    monkeypatch.setattr("dexctl.hands.check", lambda name: None)


@pytest.mark.parametrize("path", list(paths(Protocol)))
@pytest.mark.usefixtures("any_hand")
def test_every_setting_of_the_evaluation_reaches_the_jobs(path: str, tmp_path: Path) -> None:
    value, leaf = other(path), path.rpartition(".")[2]
    written = json.loads(json.dumps(value, default=str))  # as TOML has it
    expected = with_changes(Protocol(), {"threads": 1, path: value})
    for name in (path, leaf):
        given = {"methods": ["rl"], "evaluation": {"controllers": ["hold"], name: written}}
        for protocol in protocols_of(given, tmp_path):
            assert protocol == expected
    if leaf == path:
        return  # episodes, seconds and seed are the evaluation's alone
    given = {
        "methods": ["rl"], "train": {leaf: written}, "evaluation": {"controllers": ["hold"]},
    }  # fmt: skip
    if leaf in TOLD:
        given["train"] = {leaf: written, "parts": ["q", TOLD[leaf]]}
    if leaf in DISTURBANCES:
        expected = with_changes(Protocol(), {"threads": 1})
    for protocol in protocols_of(given, tmp_path):
        assert protocol == expected


def test_policies_are_evaluated_in_what_they_were_trained_in() -> None:
    """The axis and the size, which evaluation once had of its own."""
    given = changed(train__env={"axis": "x", "object_size": 0.07, "object": "cylinder"})
    config = parse_sweep(given)
    assert (config.protocol.task.axis, config.protocol.scene.object_size) == ("x", 0.07)
    assert (config.protocol.episodes, config.protocol.seconds, config.compared) == (3, 2.0, ())
    with pytest.raises(
        InvalidInput, match="runs are trained with task.turning.axis x and y, and all are"
    ):
        parse_sweep({**given, "method": {"vge": {"controllers": ["gait"], "axis": "y"},
                                               "rl+bc": {"controllers": ["igm"]}}})  # fmt: skip


def test_the_guides_are_evaluated_where_they_are_the_measure() -> None:
    config = parse_sweep(changed(criterion__rotation="guide", evaluation__controllers=["hold"]))
    assert config.criterion.rotation is None
    assert config.compared == ("hold", "gait", "igm", "switch")


def test_jobs(tmp_path: Path) -> None:
    config = parse_sweep(
        changed(evaluation__controllers=["hold"], train__threads=3, train__torch_threads=2)
    )
    first, second, *_ = jobs(config, tmp_path)
    assert (first.name, first.config, first.threads) == ("hold", None, 3)
    assert first.folder == tmp_path.resolve() / "controllers" / "hold"
    assert (second.name, second.threads) == ("rl-7", 3)
    assert type(second).from_json(second.to_json()) == second


def test_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_text(
        'methods = ["rl", "vge"]\ncontrollers = ["gait"]\nseeds = [3, 5]\n'
        "[train]\nsteps = 10\n[train.env]\ninitial_states = 'states.npz'\n"
        "[method.rl]\nseeds = 1\nsteps = 99\n"
    )
    config = load_sweep(path)
    assert config.name == "small"
    assert [(run.name, run.config.steps) for run in config.runs] == [
        ("rl-0", 99), ("vge-gait-3", 10), ("vge-gait-5", 10),
    ]  # fmt: skip
    # runs work elsewhere
    assert config.runs[0].config.env.scene.initial_states == tmp_path.resolve() / "states.npz"
    config = load_sweep(path, seed=10, steps=500)
    assert [(run.name, run.config.steps) for run in config.runs] == [
        ("rl-10", 500), ("vge-gait-13", 500), ("vge-gait-15", 500),
    ]  # fmt: skip
    assert SweepConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_the_example() -> None:
    config = load_sweep(ROOT / "examples" / "sweep.toml")
    # 3 of RL, 2 of RL+BC with one controller, 2 of three methods with three controllers
    assert len(config.runs) == 3 + 2 + 2 * 3 * 3
    assert len(config.cells) == 1 + 1 + 9
    assert config.objects == ("cylinder", "cube")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"methods": ["vge", "dagger"]}, "unknown method 'dagger'; known: rl, rl+bc, fge, vge"),
        ({"methods": []}, "methods is []; expected a list of rl,"),
        ({"methods": ["rl", "rl"]}, "methods has 'rl' twice"),
        ({"controllers": ["walk"]}, "unknown controller 'walk'; known: igm, switch, gait"),
        ({"controllers": "gait"}, "controllers is 'gait'; expected a list of names"),
        ({"controllers": ["gait", "gait"]}, "controllers has ('gait',) twice"),
        ({"controllers": []}, "method 'vge' has no controllers; expected some of igm"),
        ({"method": {}}, "method 'rl+bc' has the controllers igm, switch at once; it takes one"),
        ({"seeds": 0}, "seeds is 0; expected how many, or a list"),
        ({"seeds": [1, -1]}, "seeds is [1, -1]"),
        ({"seeds": [1, 1]}, "seeds has 1 twice"),
        ({"colour": "red"}, "unknown setting of sweep 'colour'; known: name, methods"),
        ({"train": 3}, "train is 3; expected a table [train]"),
        ({"train__stesp": 1}, "unknown setting of train 'stesp'; known: env, guidance"),
        ({"train__seed": 1}, "train has seed, which the sweep says itself, as seeds"),
        ({"train__env__hnad": "dex5"}, "unknown setting of train.env 'hnad'; known: scene, task"),
        ({"train__env": 1}, "train.env is 1; expected a table"),
        ({"train__method": "rl"}, "train has guidance.method, which the sweep says itself, as met"),
        ({"method__rl": {"sac": {"tua": 1}}}, "unknown setting of method.rl.sac 'tua'; known: ba"),
        ({"train__recipe": "slow"}, "unknown train.recipe 'slow'; known: thesis, fast, distil"),
        ({"method__rl__recipe": [3]}, "unknown method.rl.recipe [3]; known: thesis, fast, distil"),
        ({"train__steps": 0}, "runs of rl: steps is 0; expected a whole number from 1 on"),
        ({"train__steps": True}, "train.steps is True; expected a whole number"),
        ({"train__algorithm": 3}, "train.algorithm is 3; expected 'sac' or 'td3' or 'ppo'"),
        ({"train__sac": {"network": 8}}, "train.sac.network is 8; expected a list, each a whole"),
        ({"train__learning_rate": 1}, "unknown setting of train 'learning_rate'"),
        ({"train__scaled": 1}, "train.env.scaled is 1; expected true or false"),
        ({"train__object": "teapot"}, "unknown object in runs of rl 'teapot'; known: "),
        ({"train__env__gravity": "left"}, "unknown gravity 'left'; known: up, down"),
        ({"train__hand": "paw"}, "runs of rl: unknown hand 'paw'; known: dex5"),
        ({"train__guidance__horizon": "x"}, "train.guidance.horizon is 'x'; expected a whole num"),
        ({"method__rl__gama": 1}, "unknown setting of method.rl 'gama'"),
        ({"method__rl": {"sac.gamma": 2}}, "runs of rl: gamma is 2.0; expected a number from 0"),
        ({"method__sac": {}}, "unknown method 'sac'"),
        ({"method__fge": {}}, "[method.fge] is given; methods are rl, vge, rl+bc"),
        ({"method__rl__object_size": 0.05}, "runs are trained with scene.object_size 0.05 and No"),
        ({"evaluation__episode": 3}, "unknown setting of evaluation 'episode'; known: scene, task"),
        ({"evaluation__episodes": 0}, "evaluation: episodes is 0; expected a whole number from 1"),
        ({"evaluation__seconds": 0.01}, "evaluation.seconds is 0.01; expected at least"),
        ({"evaluation__object": ["mug"]}, "unknown object in evaluation 'mug'"),
        ({"evaluation__object": []}, "evaluation: object is ()"),
        ({"evaluation__controllers": [["igm", "gait"]]}, "each is evaluated by itself"),
        ({"evaluation__controllers": "igm"}, "evaluation.controllers is 'igm'; expected a list"),
        ({"criterion__rotation": 0}, 'criterion.rotation is 0; expected radians above 0, or "'),
        ({"criterion__rotation": "best"}, "criterion.rotation is 'best'"),
        ({"criterion__speed": 1}, "unknown setting of criterion 'speed'; known: rotation"),
    ],
)  # fmt: skip
def test_bad_input(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(DexctlError) as caught:
        parse_sweep(changed(**changes))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_measure_that_nobody_sets() -> None:
    given = {"methods": ["rl"], "criterion": {"rotation": "guide"}}
    with pytest.raises(InvalidInput, match='"guide", and no controllers are in the sweep'):
        parse_sweep(given)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot read .*: No such file"),
        ("methods = [", "is not TOML"),
        ("", "methods is not given; expected a list of"),
    ],
)
def test_bad_files(tmp_path: Path, content: str | None, said: str) -> None:
    path = tmp_path / "sweep.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InvalidInput, match=said):
        load_sweep(path)


def test_what_may_change_in_a_sweep_that_was_begun() -> None:
    before = parse_sweep(GIVEN).to_dict()

    def found(**changes: Any) -> str | None:
        return difference(before, parse_sweep(changed(**changes)).to_dict())

    assert found() is None
    assert found(seeds=4) is None  # more runs change none that there are
    assert found(controllers=["gait", ["igm", "switch"], "coordinated"]) is None
    assert found(evaluation__controllers=["hold"]) is None
    assert found(seeds=1) == "the run vge-gait-1 is no longer in it"
    assert found(train__steps=2000) == "runs.rl-7.steps was 1000, is 2000"
    assert found(method__rl__axis="x", evaluation__axis="z") == (
        "runs.rl-7.env.task.turning.axis was 'z', is 'x'"
    )
    assert found(**{"method__rl__sac.gamma": 0.9}) == "runs.rl-7.sac.gamma was 0.99, is 0.9"
    assert found(evaluation__episodes=4) == "evaluation.episodes was 3, is 4"
    assert found(criterion__rotation=2) == "criterion.rotation was 1.0, is 2.0"
