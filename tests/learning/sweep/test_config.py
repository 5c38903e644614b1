"""What a sweep's file means: the runs, and what is said to mistakes in it."""

from __future__ import annotations

import json
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from dexctl.exceptions import DexctlError, InvalidInput
from learning.cli_sweep import Sweep
from learning.settings import TrainConfig
from learning.sweep.config import Cell, SweepConfig, difference
from learning.sweep.jobs import jobs

ROOT = Path(__file__).parents[2]
GIVEN: dict[str, Any] = {
    "methods": ["rl", "vge", "rl+bc"],
    "controllers": ["gait", ["igm", "switch"]],
    "seeds": 2,
    "train": {
        "steps": 1000,
        "network": [16, 8],
        "env": {"object": "cylinder", "episode_steps": 60, "gravity": [0, 0, 9.81]},
        "guidance": {"hard_stop": 500},
    },
    "method": {
        "rl": {"seeds": [7]},
        "rl+bc": {"controllers": ["igm"], "gamma": 0.5, "guidance": {"beta": 1}},
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
    config = SweepConfig.parse(GIVEN)
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
    runs = {run.name: run.config for run in SweepConfig.parse(GIVEN).runs}
    vge, clone, alone = runs["vge-igm-switch-1"], runs["rl+bc-igm-1"], runs["rl-7"]
    assert (vge.seed, alone.seed) == (1, 7)
    assert (vge.guidance.method, vge.controllers) == ("vge", ("igm", "switch"))
    assert (alone.guidance.method, alone.controllers) == ("rl", ())
    assert (vge.gamma, clone.gamma) == (0.99, 0.5)
    assert (vge.guidance.beta, clone.guidance.beta, clone.guidance.hard_stop) == (0.1, 1.0, 500)
    for config in runs.values():
        assert (config.steps, config.network, config.torch_threads) == (1000, (16, 8), 1)
        assert (config.env.objects, config.env.episode_steps) == (("cylinder",), 60)
        assert config.env.gravity == (0, 0, 9.81)
        assert config.env.threads == 1  # several runs share the machine
        assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_a_recipe_gives_what_is_not_given() -> None:
    given = changed(train__recipe="fast", train__tau=0.5, train__guidance={"hard_stop": 500})
    runs = {run.name: run.config for run in SweepConfig.parse(given).runs}
    clone, alone = runs["rl+bc-igm-0"], runs["rl-7"]
    for config in (clone, alone):
        assert (config.n_step, config.layer_norm, config.env.scaled) == (5, True, True)
        assert (config.tau, config.guidance.hard_stop, config.steps) == (0.5, 500, 1000)
        assert config.critic_parts == ("object_position", "object_quaternion")
    assert (clone.guidance.cloning, clone.guidance.beta) == ("squared", 1.0)
    assert alone.guidance.cloning == "likelihood"
    # for one method alone; and for all but one
    runs = {
        run.name: run.config for run in SweepConfig.parse(changed(method__rl__recipe="fast")).runs
    }
    assert (runs["rl-7"].n_step, runs["vge-gait-0"].n_step) == (5, 1)
    given = changed(train__recipe="fast", method__rl__recipe="thesis")
    runs = {run.name: run.config for run in SweepConfig.parse(given).runs}
    assert (runs["rl-7"].n_step, runs["vge-gait-0"].n_step) == (1, 5)


def test_every_setting_can_be_given() -> None:
    """A complete configuration, as a run writes it down, is a sweep's [train]."""
    whole = TrainConfig().to_dict()
    for name in ("seed", "controllers"):
        del whole[name]
    del whole["guidance"]["method"]
    for inside in (whole, whole["env"], whole["guidance"]):  # TOML has no null
        for name in [name for name, value in inside.items() if value is None]:
            del inside[name]
    whole["env"]["threads"] = 2
    given = {"methods": ["vge"], "controllers": ["gait"], "train": whole}
    (run,) = SweepConfig.parse(given).runs
    expected = TrainConfig().to_dict()
    expected["env"]["threads"] = 2
    assert json.dumps(run.config.to_dict()) == json.dumps(expected)


def test_evaluation_is_of_what_was_trained_with_unless_it_says_otherwise() -> None:
    plan = SweepConfig.parse(GIVEN).evaluation
    assert (plan.objects, plan.gravity, plan.hand) == (("cylinder",), (0, 0, 9.81), "dex5")
    assert (plan.episodes, plan.seconds, plan.seed, plan.controllers) == (3, 2.0, 0, ())
    other = {"objects": ["cube", "sphere"], "gravity": "down", "seed": 5, "controllers": ["hold"]}
    plan = SweepConfig.parse(changed(evaluation=other)).evaluation
    assert (plan.objects, plan.gravity, plan.seed) == (("cube", "sphere"), "down", 5)
    assert plan.controllers == ("hold",)


def test_the_guides_are_evaluated_where_they_are_the_measure() -> None:
    config = SweepConfig.parse(
        changed(criterion__rotation="guide", evaluation__controllers=["hold"])
    )
    assert config.criterion.rotation is None
    assert config.evaluation.controllers == ("hold", "gait", "igm", "switch")


def test_jobs(tmp_path: Path) -> None:
    config = SweepConfig.parse(
        changed(evaluation__controllers=["hold"], train__env__threads=3, train__torch_threads=2)
    )
    first, second, *_ = jobs(config, tmp_path)
    assert (first.name, first.config, first.threads) == ("hold", None, 1)
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
    config = SweepConfig.load(path)
    assert config.name == "small"
    assert [(run.name, run.config.steps) for run in config.runs] == [
        ("rl-0", 99), ("vge-gait-3", 10), ("vge-gait-5", 10),
    ]  # fmt: skip
    # runs work elsewhere
    assert config.runs[0].config.env.initial_states == str(tmp_path.resolve() / "states.npz")
    config = SweepConfig.load(path, seed=10, steps=500)
    assert [(run.name, run.config.steps) for run in config.runs] == [
        ("rl-10", 500), ("vge-gait-13", 500), ("vge-gait-15", 500),
    ]  # fmt: skip
    assert SweepConfig.parse(config.to_dict()["given"]).to_dict() == config.to_dict()


def test_the_example() -> None:
    config = SweepConfig.load(ROOT / "examples" / "sweep.toml")
    # 3 of RL, 2 of RL+BC with one controller, 2 of three methods with three controllers
    assert len(config.runs) == 3 + 2 + 2 * 3 * 3
    assert len(config.cells) == 1 + 1 + 9
    assert config.evaluation.objects == ("cylinder", "cube")


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
        ({"train__stesp": 1}, "unknown setting of train 'stesp'; known: algorithm, steps"),
        ({"train__seed": 1}, "unknown setting of train 'seed'"),
        ({"train__env__hnad": "dex5"}, "unknown setting of train.env 'hnad'; known: hand, object"),
        ({"train__env": 1}, "train.env is 1; expected a table"),
        ({"train__guidance__method": "rl"}, "unknown setting of train.guidance 'method'"),
        ({"train__recipe": "slow"}, "unknown recipe 'slow'; known: thesis, fast"),
        ({"train__recipe": 3}, "unknown recipe 3; known: thesis, fast"),
        ({"train__steps": 0}, "steps is 0; expected a whole number from 1 on"),
        ({"train__steps": True}, "train.steps is True; expected no truth value"),
        ({"train__algorithm": 3}, "train.algorithm is 3; expected a name"),
        ({"train__network": 8}, "[train] has a value of the wrong kind"),
        ({"train__env__scaled": 1}, "train.env.scaled is 1; expected true or false"),
        ({"train__env__object": "teapot"}, "unknown object in train.env.object 'teapot'; known: "),
        ({"train__env__gravity": "left"}, "unknown gravity 'left'; known: up, down"),
        ({"train__env__hand": "paw"}, "unknown hand 'paw'; known: dex5"),
        ({"train__guidance__horizon": "x"}, "[train.guidance] has a value of the wrong kind"),
        ({"method__rl__gama": 1}, "unknown setting of method.rl 'gama'"),
        ({"method__rl__gamma": 2}, "gamma is 2.0; expected a number from 0 to 1"),
        ({"method__sac": {}}, "unknown method 'sac'"),
        ({"method__fge": {}}, "[method.fge] is given; methods are rl, vge, rl+bc"),
        ({"evaluation__episode": 3}, "unknown setting of evaluation 'episode'; known: objects"),
        ({"evaluation__episodes": 0}, "episodes is 0; expected a whole number above 0"),
        ({"evaluation__seconds": 0.01}, "evaluation.seconds is 0.01; expected at least"),
        ({"evaluation__objects": ["mug"]}, "unknown object in evaluation.objects 'mug'"),
        ({"evaluation__objects": []}, "evaluation.objects is []"),
        ({"evaluation__controllers": [["igm", "gait"]]}, "each is evaluated by itself"),
        ({"criterion__rotation": 0}, 'criterion.rotation is 0; expected radians above 0, or "'),
        ({"criterion__rotation": "best"}, "criterion.rotation is 'best'"),
        ({"criterion__speed": 1}, "unknown setting of criterion 'speed'; known: rotation"),
    ],
)  # fmt: skip
def test_bad_input(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(DexctlError) as caught:
        SweepConfig.parse(changed(**changes))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_measure_that_nobody_sets() -> None:
    given = {"methods": ["rl"], "criterion": {"rotation": "guide"}}
    with pytest.raises(InvalidInput, match='"guide", and no controllers are in the sweep'):
        SweepConfig.parse(given)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot read .*: No such file"),
        ("methods = [", "is not TOML"),
        ("", "methods is None"),
    ],
)
def test_bad_files(tmp_path: Path, content: str | None, said: str) -> None:
    path = tmp_path / "sweep.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InvalidInput, match=said):
        SweepConfig.load(path)


def test_what_may_change_in_a_sweep_that_was_begun() -> None:
    before = SweepConfig.parse(GIVEN).to_dict()

    def found(**changes: Any) -> str | None:
        return difference(before, SweepConfig.parse(changed(**changes)).to_dict())

    assert found() is None
    assert found(seeds=4) is None  # more runs change none that there are
    assert found(controllers=["gait", ["igm", "switch"], "coordinated"]) is None
    assert found(evaluation__controllers=["hold"]) is None
    assert found(seeds=1) == "the run vge-gait-1 is no longer in it"
    assert found(train__steps=2000) == "runs.rl-7.steps was 1000, is 2000"
    assert found(train__env__axis="x") == 'runs.rl-7.env.axis was "z", is "x"'
    assert found(method__rl__gamma=0.9) == "runs.rl-7.gamma was 0.99, is 0.9"
    assert found(evaluation__episodes=4) == "evaluation.episodes was 3, is 4"
    assert found(criterion__rotation=2) == "criterion.rotation was 1.0, is 2.0"
