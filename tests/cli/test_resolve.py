"""Whatever a command takes for a controller: one resolver, whichever it is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import dexctl
from dexctl.cli import main
from dexctl.controllers import Hold, resolve
from dexctl.exceptions import InvalidInput, UnknownName
from learning import policies

SHIPPED = policies.FOLDER / "dex5-cylinder.npz"


pytestmark = pytest.mark.usefixtures("learned")


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "runs" / "a:b"  # a colon does not make it a module
    folder.mkdir(parents=True)
    shutil.copy(SHIPPED, folder / "policy.npz")
    return folder


def plain(hand: dexctl.HandModel, control_period: float = 0.02) -> dexctl.Controller:
    return Hold(hand, control_period=control_period)


def about(hand: dexctl.HandModel, **options: Any) -> dexctl.Controller:
    made = Hold(hand)
    made.options = options  # type: ignore[attr-defined]
    return made


def wants_a_period(hand: dexctl.HandModel, *, control_period: float) -> dexctl.Controller:
    return Hold(hand, control_period=control_period)


def no_controller(hand: dexctl.HandModel) -> str:
    return "paw"


def test_controllers_by_name(dex5: dexctl.HandModel) -> None:
    igm: Any = resolve("igm", dex5, axis=(1.0, 0.0, 0.0))
    assert isinstance(igm, dexctl.InGraspManipulation)
    assert igm.config.twist[3] > 0 == igm.config.twist[5]
    assert igm.control_period == dexctl.InGraspManipulation(dex5).control_period
    assert resolve("hold", dex5, control_period=0.01).control_period == 0.01


def test_policies(dex5: dexctl.HandModel, run_folder: Path) -> None:
    for name in ("learned", "dex5-cylinder", str(SHIPPED), str(run_folder)):
        policy = resolve(name, dex5, axis=(0.0, 0.0, 1.0))
        assert isinstance(policy, policies.Policy), name
        assert policy.hand is dex5
        assert policy.control_period == 0.05
    with pytest.raises(InvalidInput, match="control_period is 0.02; .* trained with 0.05"):
        resolve(str(run_folder), dex5, control_period=0.02)


def test_functions(dex5: dexctl.HandModel) -> None:
    assert resolve(f"{__name__}:plain", dex5).control_period == 0.02
    turned = resolve(f"{__name__}:plain", dex5, control_period=0.1, axis=(0.0, 0.0, 1.0))
    assert turned.control_period == 0.1
    with pytest.raises(InvalidInput, match=r"plain takes no axis, so it turns about z; got \(1"):
        resolve(f"{__name__}:plain", dex5, axis=(1.0, 0.0, 0.0))
    made: Any = resolve(f"{__name__}:about", dex5, control_period=0.1, axis=(1.0, 0.0, 0.0))
    assert made.options == {"control_period": 0.1, "axis": (1.0, 0.0, 0.0)}


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    {
        "word": ("walk", UnknownName, "'walk'; known: igm, .*dex5-easy, .*module:function"),
        "no file": ("gone.npz", InvalidInput, "'gone.npz': no such file"),
        "no run": (str(policies.FOLDER), InvalidInput, "there is no policy.npz in it"),
        "no module": ("no_such_module:make", InvalidInput, "cannot be loaded: No module"),
        "no function": (f"{__name__}:gone", InvalidInput, "cannot be loaded: .*no attribute"),
        "neither": (":", InvalidInput, "cannot be loaded"),
        "no callable": (f"{__name__}:SHIPPED", InvalidInput, "cannot be loaded: .*not a callable"),
        "no period": (f"{__name__}:wants_a_period", InvalidInput, r"called as \(hand\): missing"),
        "no controller": (f"{__name__}:no_controller", InvalidInput, "made a str; expected a"),
    }.values(),
)
def test_what_it_is_not(
    dex5: dexctl.HandModel, name: str, kind: type[Exception], message: str
) -> None:
    with pytest.raises(kind, match=message) as caught:
        resolve(name, dex5)
    assert "\n" not in str(caught.value)


def test_policies_without_an_installation(
    dex5: dexctl.HandModel, registered: Callable[..., None]
) -> None:
    registered()
    for name in ("learned", str(SHIPPED)):
        with pytest.raises(InvalidInput, match="policies need dexctl to be installed"):
            resolve(name, dex5)
    with pytest.raises(UnknownName, match="'walk'; known: igm"):
        resolve("walk", dex5)


def test_rotate_takes_them(
    run_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run_folder.parent)  # MuJoCo writes a log file where it stands
    rotate = ["rotate", "--object", "cylinder", "--seconds", "0.2", "--num-envs", "2", "--json"]
    for name in ("learned", "dex5-cylinder", str(run_folder)):
        assert main([*rotate, "--controller", name]) == 0
        assert json.loads(capsys.readouterr().out)["controller"] == name
    for name, code in (("dex5-pen", 2), ("gone.npz", 2)):
        assert main([*rotate, "--controller", name]) == code
        assert name in capsys.readouterr().err
