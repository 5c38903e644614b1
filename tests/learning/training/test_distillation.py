"""One policy of several: who labels what, which settings go together, and a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed
from learning import policies
from learning.config import TrainConfig, recipe
from learning.training.build import build_env, build_guide
from learning.training.run_folder import RunFolder
from learning.training.trainer import resume, train

Make = Callable[..., TrainConfig]
DAGGER = {"algorithm": "dagger", "method": "rl+bc", "hard_stop": None}


def test_each_object_is_labelled_by_its_own_guide(small: Make) -> None:
    config = small(
        **DAGGER, object=("cube", "sphere"), scaled=True, max_speed=2.0, episode_steps=3,
        controllers=("sphere=hold", "cube=dex5-easy"),
    )  # fmt: skip
    assert config.guide_names == ("hold", "dex5-easy")
    with contextlib.closing(build_env(config)) as env:
        guide = build_guide(config, env)
        env.reset()
        still = np.zeros((env.num_envs, env.hand.nq), np.float32)
        found = guide.act(0, still, lambda rows, actions: np.zeros(actions.shape[:2]))
        policy = policies.load("dex5-easy")
        policy.reset()
        wanted = env.change_to_action(policy.act(env.state))
    cube = np.array(env.objects) == "cube"
    assert found.guided.all() and cube.any() and not cube.all()
    np.testing.assert_allclose(found.label[cube], wanted[cube], atol=1e-6)
    assert np.abs(found.label[cube]).max() > 0.1 and not found.label[~cube].any()


def test_a_run_makes_a_policy_that_does_what_its_guide_does(small: Make, tmp_path: Path) -> None:
    config = small(
        **DAGGER, controllers=("dex5-easy",), scaled=True, max_speed=2.0, steps=4000, num_envs=16,
        dagger__network=(64, 64), dagger__batch_size=256, dagger__gradient_steps=4,
    )  # fmt: skip
    found = train(config, tmp_path / "run")
    rows = RunFolder(tmp_path / "run").progress()
    assert rows[-1]["bc_loss"] < 0.5 * rows[0]["bc_loss"]
    with contextlib.closing(build_env(config)) as env:
        env.reset(seed=100)
        state = env.state
        error = policies.load(found["policy"]).act(state) - policies.load("dex5-easy").act(state)
    assert np.sqrt((error**2).mean()) < 0.03  # [rad]; they move by up to 0.1


def test_guides_of_files_are_found_from_anywhere(
    small: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copyfile(policies.FOLDER / "dex5-easy.npz", tmp_path / "mine.npz")
    more = {"scaled": True, "max_speed": 2.0, "object": ("cube", "sphere"), "steps": 40}
    guides = ("cube=commanded:mine.npz,dex5-easy", "sphere=teacher")
    train(small(**DAGGER, **more, controllers=("dex5-easy",)), Path("teacher"))
    train(small(**DAGGER, **more, controllers=guides), Path("run"))
    monkeypatch.chdir(tmp_path / "run")
    assert RunFolder(Path()).config().guide_names == (
        f"commanded:{tmp_path}/mine.npz,dex5-easy", f"{tmp_path}/teacher",
    )  # fmt: skip
    assert resume(Path(), 80)["steps"] == 80


def test_the_recipe() -> None:
    config = recipe("distil")
    assert (config.algorithm, config.guidance.method) == ("dagger", "rl+bc")
    assert config.guidance.hard_stop is None and config.env.scaled
    assert recipe("distil", "rl+bc") == config


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"method": "vge"}, "algorithm is 'dagger' and method 'vge'; .*expected method 'rl.bc'"),
        ({"hard_stop": 100}, "labels end at the hard_stop 100; expected none, or at least the 200"),
        (
            {"object": ("cube", "sphere"), "controllers": ("cube=igm",)},
            "no controller guides with sphere",
        ),
        ({"controllers": ("l_shape=igm",)}, "unknown object of a guide 'l_shape'; known: cylinder"),
        ({"controllers": ("=igm",)}, "unknown controller '=igm'"),
        ({"controllers": ("dex5-hard",)}, "unknown controller 'dex5-hard'; known: .*dex5-easy"),
        ({"controllers": ("igm", "gait")}, "it takes one, or one for each object"),
        ({"dagger.buffer_size": 2000, "num_envs": 3000}, "buffer_size is 2000; expected at least"),
    ],
)
def test_what_does_not_go_together(changes: dict[str, Any], text: str) -> None:
    given = {**DAGGER, "object": "cylinder", "steps": 200, "controllers": ("igm",), **changes}
    with pytest.raises((InvalidInput, UnknownName), match=text):
        changed(TrainConfig(), given)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nowhere.npz", "nowhere.npz"),
        ("dex5-cube-x", "axis"),  # it turns about x, and no symmetry makes z of that
    ],
)
def test_guides_that_cannot_be_made(name: str, text: str, small: Make, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=text):
        train(small(**DAGGER, controllers=(name,)), tmp_path / "run")
    assert not (tmp_path / "run").exists()
