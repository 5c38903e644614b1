"""Settings as keywords of controllers: what type checkers know, and what a wrong one is told."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import pytest

import dexctl
from dexctl.gait import (
    CoordinatedGait,
    CoordinatedGaitChanges,
    CoordinatedGaitConfig,
    FingerGaiting,
    FingerGaitingChanges,
    FingerGaitingConfig,
    GoalGait,
    GoalGaitChanges,
    GoalGaitConfig,
    GoalSequence,
    GoalSequenceChanges,
    GoalSequenceConfig,
    GoalSteering,
    GoalSteeringChanges,
    GoalSteeringConfig,
)
from dexctl.igm import (
    InGraspManipulation,
    InGraspManipulationChanges,
    InGraspManipulationConfig,
)
from dexctl.switch import ContactSwitch, ContactSwitchChanges, ContactSwitchConfig
from dexctl.validation import CONSTRUCTOR

ROOT = Path(__file__).resolve().parents[2]
CONTROLLERS: list[tuple[Any, Any, Any]] = [
    (InGraspManipulation, InGraspManipulationConfig, InGraspManipulationChanges),
    (ContactSwitch, ContactSwitchConfig, ContactSwitchChanges),
    (FingerGaiting, FingerGaitingConfig, FingerGaitingChanges),
    (CoordinatedGait, CoordinatedGaitConfig, CoordinatedGaitChanges),
    (GoalGait, GoalGaitConfig, GoalGaitChanges),
    (GoalSequence, GoalSequenceConfig, GoalSequenceChanges),
    (GoalSteering, GoalSteeringConfig, GoalSteeringChanges),
]


@pytest.mark.parametrize(("controller", "config", "changes"), CONTROLLERS)
def test_keywords_are_the_fields_of_the_settings(controller, config, changes) -> None:
    own = [field for field in fields(config) if field.name not in CONSTRUCTOR]
    body = "\n".join(f"    {field.name}: {field.type}" for field in own)
    hints = get_type_hints(config)
    assert get_type_hints(changes) == {field.name: hints[field.name] for field in own}, (
        f"{changes.__name__} is to hold what {config.__name__} holds:\n{body}"
    )
    assert not changes.__required_keys__
    hint = controller.__init__.__annotations__["changes"]
    assert hint == f"Unpack[{changes.__name__}]"


@pytest.mark.parametrize(("controller", "config", "changes"), CONTROLLERS)
def test_a_misspelt_keyword_is_told_the_known_ones(dex5, controller, config, changes) -> None:
    with pytest.raises(dexctl.InvalidInput, match="no setting 'frictoin'") as error:
        controller(dex5, frictoin=0.5)
    for name in ("control_period", "axis", *(field.name for field in fields(config))):
        assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_a_misspelt_keyword_of_the_thesis_settings() -> None:
    wrong: dict[str, Any] = {"grip": 2.0}
    with pytest.raises(dexctl.InvalidInput, match="no setting 'grip'; known .*grip_force"):
        InGraspManipulationConfig.thesis(**wrong)


@pytest.mark.parametrize(("controller", "config", "changes"), CONTROLLERS)
def test_a_hand_by_name_and_settings_of_another_controller(
    dex5, controller, config, changes
) -> None:
    with pytest.raises(dexctl.InvalidInput, match=r"hand is 'dex5'; expected a HandModel, .*load"):
        controller("dex5")
    for wrong in (0.05, {}, object()):
        with pytest.raises(
            dexctl.InvalidInput, match=f"config is .*; expected a {config.__name__}"
        ):
            controller(dex5, wrong)


CODE = """
import dexctl

hand = dexctl.hands.load("dex5")
dexctl.InGraspManipulation(hand, grip_force=2.0, axis="z")
dexctl.ContactSwitch(hand, kind="guarded", pause=1.0)
dexctl.FingerGaiting(hand, duration=0.5)
dexctl.CoordinatedGait(hand, swing=0.4, control_period=0.02)
dexctl.InGraspManipulation(hand, grip=2.0)  # wrong: grip
dexctl.ContactSwitch(hand, paus=1.0)  # wrong: paus
dexctl.FingerGaiting(hand, duraton=0.5)  # wrong: duraton
dexctl.CoordinatedGait(hand, swings=0.4)  # wrong: swings
dexctl.igm.InGraspManipulationConfig.thesis(grip=2.0)  # wrong: grip
dexctl.InGraspManipulation("dex5")  # wrong: HandModel
dexctl.CoordinatedGait(hand, swing="far")  # wrong: float
"""


@pytest.mark.slow
def test_pyright_refuses_misspelt_keywords(tmp_path: Path) -> None:
    """About ten seconds."""
    program = Path(sys.executable).with_name("pyright")
    pyright = str(program) if program.exists() else shutil.which("pyright")
    if pyright is None:
        pytest.skip("pyright is not installed")
    file = tmp_path / "keywords.py"
    file.write_text(CODE)
    settings = {"include": ["keywords.py"], "extraPaths": [str(ROOT)], "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    done = subprocess.run(
        [pyright, "--project", str(tmp_path), "--pythonpath", sys.executable, "--outputjson"],
        capture_output=True,
        text=True,
        check=False,
    )
    found = {
        one["range"]["start"]["line"]: one["message"]
        for one in json.loads(done.stdout)["generalDiagnostics"]
    }
    expected = {
        i: line.split("# wrong: ")[1]
        for i, line in enumerate(CODE.splitlines())
        if "# wrong" in line
    }
    assert found.keys() == expected.keys(), found
    for line, word in expected.items():
        assert word in found[line]
