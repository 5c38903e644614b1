"""Every script in examples/ runs, and is short enough to copy from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
# Short settings, and a word that must come out.
RUNS: dict[str, tuple[list[str], str]] = {
    "hold_and_turn.py": (["0.5"], "fingers touch"),
    "batch_gait.py": (["3", "0.5"], "still holding"),
    "moving_hand.py": (["1.0"], "gravity in the hand's frame"),
    "goal_by_touch.py": (["0.5"], "by touch: 0."),
    "own_hand.py": (["{menagerie}", "0.5"], "turned a sphere"),
    "learn_from_paths.py": (["300", "200", "1"], "rad in 1 s"),
    "plan_turn.py": (["0.5"], "starts are in starts.npz"),
    "plan_forces.py": ([], "force closure: True"),
    "own_plant.py": ([], "sent 0.05 rad"),
}


LONGER = ("learn_from_paths.py",)  # than five seconds of processor


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in LONGER else []) for n in EXAMPLES]
)
def test_example_runs(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    arguments, expected = RUNS[name]
    if name.startswith("learn_"):
        pytest.importorskip("torch", reason="needs the extra 'learning'")
    if "{menagerie}" in arguments:
        arguments = [str(request.getfixturevalue("menagerie")), *arguments[1:]]
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / name), *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_is_short(name: str) -> None:
    lines = (ROOT / "examples" / name).read_text().splitlines()
    assert len(lines) < 40
    assert lines[0].startswith('"""')
