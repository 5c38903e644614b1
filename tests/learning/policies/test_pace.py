"""A policy that goes slower than it was trained to: by a keyword, and by what stands behind its
name."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed
from learning import policies
from learning.config import TrainConfig
from learning.evaluation import open_subject
from learning.policies import Policy

NAME = "dex5-cylinder"


@pytest.fixture(scope="module")
def state(dex5: dexctl.HandModel) -> dexctl.GraspState:
    q = dex5.posture({})[None].repeat(3, axis=0)
    return dexctl.GraspState(
        q=q,
        q_target=q + 0.01,
        in_contact=np.ones((3, 5), bool),
        contact_position=dex5.fingertip_positions(q),
        contact_normal=np.tile([0.0, 0.0, 1.0], (3, 5, 1)),
        contact_force=np.ones((3, 5)),
    )


def test_every_set_point_change_is_that_share(
    dex5: dexctl.HandModel, state: dexctl.GraspState
) -> None:
    usual, slow = policies.load(NAME, hand=dex5), policies.load(NAME, hand=dex5, pace=0.25)
    whole = usual.action.to_change(usual.predict(usual.observation(state)))
    assert np.abs(whole).max() > 0.01
    np.testing.assert_allclose(slow.act(state), usual.action.limited(state, 0.25 * whole))
    np.testing.assert_array_equal(usual.act(state), policies.load(NAME, pace=1).act(state))
    assert (usual.pace, slow.pace) == (1.0, 0.25)


def test_its_image_keeps_the_pace(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    slow = policies.load(f"{NAME}@0.5", axis=(0, 0, -1))
    assert slow.symmetry is not None
    usual = policies.load(NAME, axis=(0, 0, -1))
    image = slow.symmetry.inverse.of_state(state)
    own = slow.predict(slow.observation(image))
    whole = slow.action.to_change(slow.symmetry.of_joints(own))
    np.testing.assert_allclose(slow.act(state), usual.action.limited(state, 0.5 * whole))


def test_behind_a_name_a_file_and_a_folder(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    run = tmp_path / "run@home"
    run.mkdir()
    shutil.copy(policies.FOLDER / f"{NAME}.npz", run / "policy.npz")
    for name in (NAME, str(run), str(run / "policy.npz")):
        for pace, behind in ((0.8, "@0.8"), (0.5, "@.5"), (1.0, "@1"), (1.0, "")):
            made: Controller = controllers.resolve(name + behind, dex5)
            assert isinstance(made, Policy)
            assert made.pace == pace == policies.load(name + behind).pace
    assert policies.load(f"{NAME}@0.8", pace=0.6).pace == 0.6  # what is said last
    made = controllers.resolve("learned@0.4", dex5)
    assert isinstance(made, Policy)
    assert made.pace == 0.4
    made = controllers.resolve(f"steered:{NAME}@0.3", dex5)
    assert made.turner.pace == 0.3  # type: ignore[attr-defined]


def test_it_is_a_subject_like_another(dex5: dexctl.HandModel) -> None:
    usual, slow = open_subject(NAME), open_subject(f"{NAME}@0.8")
    assert (slow.name, slow.kind, slow.objects) == (f"{NAME}@0.8", "policy", usual.objects)
    assert slow.protocol() == usual.protocol()
    acting = slow.acting(slow.protocol())
    assert isinstance(acting, Policy)
    assert acting.pace == 0.8


def test_it_guides_and_its_file_is_found_from_anywhere(tmp_path: Path) -> None:
    config = changed(TrainConfig(), {"controllers": (f"{NAME}@0.8",)})
    assert config.controllers == (f"{NAME}@0.8",)
    changed(TrainConfig(), {"controllers": ("learned@0.8",)})
    file = controllers.absolute("a/policy.npz@0.8", tmp_path)
    assert file == f"{tmp_path / 'a' / 'policy.npz'}@0.8"
    assert controllers.absolute(f"steered:{NAME}@0.8", tmp_path) == f"steered:{NAME}@0.8"


@pytest.mark.parametrize("pace", [0, -0.5, 1.01, float("nan"), float("inf"), "0.8", None, True])
def test_what_is_no_pace(dex5: dexctl.HandModel, pace: object) -> None:
    usual = policies.load(NAME, hand=dex5)
    with pytest.raises(InvalidInput, match=r"^pace is .*; expected a number above 0 and at most 1"):
        Policy(dex5, usual.layers, usual.spec, pace=pace)  # type: ignore[arg-type]


@pytest.mark.parametrize("behind", ["@0", "@1.5", "@100"])
def test_what_is_no_pace_behind_a_name(behind: str) -> None:
    number = float(behind[1:])
    with pytest.raises(InvalidInput, match=rf"pace is {number}; expected a number above 0"):
        policies.load(NAME + behind)
    with pytest.raises(InvalidInput, match=rf"pace is {number}; expected a number above 0"):
        changed(TrainConfig(), {"controllers": (NAME + behind,)})


def test_a_folder_that_is_there_is_meant_whatever_it_is_called(tmp_path: Path) -> None:
    run = tmp_path / "run@1"
    run.mkdir()
    shutil.copy(policies.FOLDER / f"{NAME}.npz", run / "policy.npz")
    assert policies.load(run).pace == 1.0
    assert policies.load(f"{run}@0.5").pace == 0.5
    assert controllers.absolute("run@1", tmp_path) == str(run)
    assert controllers.absolute("run@1@0.5", tmp_path) == f"{run}@0.5"


def test_controllers_have_settings_and_no_pace(dex5: dexctl.HandModel) -> None:
    with pytest.raises(InvalidInput, match="^controller is 'igm@0.5'; expected 'igm': only"):
        controllers.resolve("igm@0.5", dex5)


def test_a_guide_that_nobody_has() -> None:
    with pytest.raises(UnknownName, match="nobody@0.8"):
        changed(TrainConfig(), {"controllers": ("nobody@0.8",)})


@pytest.mark.parametrize("name", [f"{NAME}@", f"{NAME}@fast", f"{NAME}@1e-1", "@0.8", "nobody@0.8"])
def test_names_that_nobody_has(dex5: dexctl.HandModel, name: str) -> None:
    with pytest.raises(UnknownName):
        policies.load(name)
    with pytest.raises(UnknownName):
        controllers.resolve(name, dex5)
