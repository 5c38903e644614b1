"""`import dexctl`: what it loads, what it costs, and what it finds later."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

import dexctl

HEAVY = ("casadi", "mujoco", "mink", "torch", "matplotlib", "imageio", "rich", "tyro")


def python(code: str) -> str:
    """What a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded(code: str) -> list[str]:
    """Those of the heavy packages that are loaded after ``code``."""
    report = f"import sys, json; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    return json.loads(python(f"{code}; {report}"))


def test_heavy_engines_wait_for_their_first_use() -> None:
    assert loaded("import dexctl") == []
    rooms = "dexctl.grasp.stability_forces; dexctl.GraspState; dexctl.InGraspManipulation"
    assert loaded(f"import dexctl; {rooms}; dexctl.ContactSwitch; dexctl.FingerGaiting") == []


def test_configurations_load_no_engine() -> None:
    configs = "dexctl.sim.scene_config, dexctl.sim.sensing, dexctl.sim.pushes, dexctl.limits"
    learners = "learning.config, learning.algorithms.config, learning.envs.config"
    assert loaded(f"import learning, {configs}, {learners}") == ["tyro"]


def test_a_training_that_is_refused_loads_no_torch() -> None:
    told = "from dexctl.cli.app import main; main(['train', '--env.object', 'nosuch'])"
    assert "torch" not in loaded(told)


def test_what_runs_a_policy_needs_no_torch() -> None:
    hidden = "import sys; sys.modules.update(dict.fromkeys(['torch', 'stable_baselines3']))"
    modules = "learning.policies, learning.envs.vector, learning.evaluation.rollout"
    python(f"{hidden}; import {modules}; import learning; learning.load_policy('dex5-cylinder')")


def test_brings_a_few_small_modules_beside_what_it_stands_on() -> None:
    """A sixth more modules: 40 for 233. A count does not vary with the machine's load."""
    new = json.loads(
        python(
            "import sys, json, numpy, scipy, pinocchio; before = set(sys.modules); import dexctl; "
            "print(json.dumps(sorted(set(sys.modules) - before)))"
        )
    )
    packages = {name.partition(".")[0] for name in new}
    assert packages - sys.stdlib_module_names <= {"dexctl", "numpy"}
    assert len(new) <= 60


def test_costs_at_most_half_more_than_what_it_stands_on() -> None:
    """About a quarter. Both are timed in one process, which others slow alike."""
    code = (
        "from time import process_time as t; a = t(); import numpy, scipy, pinocchio; b = t(); "
        "import dexctl; print((t() - b) / (b - a))"
    )
    assert min(float(python(code)) for _ in range(5)) <= 0.5


STEPS = """
import sys
import numpy as np
import dexctl
from dexctl.grasp.closure import balanced_shares

hand = dexctl.hands.load("dex5")
tip = hand.fingertip_positions(np.zeros(15))
inward = -tip * [1, 1, 0] / np.linalg.norm(tip[:, :2], axis=1, keepdims=True)
state = dexctl.GraspState(
    q=np.zeros(15), q_target=np.zeros(15), in_contact=np.ones(5, bool), contact_position=tip,
    contact_normal=inward, contact_force=np.ones(5),
)
made = [
    dexctl.InGraspManipulation(hand, engine="plain"),
    dexctl.ContactSwitch(hand, kind="guarded", pause=0.0),
    dexctl.FingerGaiting(hand),
    dexctl.CoordinatedGait(hand, least_travel=0.0),
]
before = set(sys.modules)
for controller in made:
    for _ in range(10):
        controller.act(state)
# what the gaits' guard asks where round-off leaves the answer open
balanced_shares(np.eye(6, 8))
print(sorted(set(sys.modules) - before))
"""


def test_a_control_step_does_not_wait_for_an_import() -> None:
    assert python(STEPS).strip() == "[]"


def test_every_public_name_is_found() -> None:
    for name in dexctl.__all__:
        assert getattr(dexctl, name) is not None
        assert name in dir(dexctl)
    assert dexctl.InGraspManipulation is dexctl.igm.InGraspManipulation
    assert dexctl.ContactSwitch is dexctl.switch.ContactSwitch
    assert dexctl.FingerGaiting is dexctl.gait.FingerGaiting
    for name in ("InGraspManipulation", "ContactSwitch", "FingerGaiting"):
        assert issubclass(getattr(dexctl, name), dexctl.Controller)


def test_names_are_lazy_and_complete() -> None:
    """Each name by itself, in an interpreter that has loaded nothing else."""
    names = [name for name in dexctl.__all__ if name in dexctl._LAZY]
    checks = "; ".join(f"assert dexctl.{name}" for name in reversed(names))
    python(f"import dexctl; {checks}")


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'InGrasp'"):
        dexctl.InGrasp  # noqa: B018


def test_version() -> None:
    assert dexctl.__version__[0].isdigit()
