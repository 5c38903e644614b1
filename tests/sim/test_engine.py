"""Loading MuJoCo where the environment keeps it from loading."""

from __future__ import annotations

import os
import subprocess
import sys


def test_a_wrong_mujoco_gl_is_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dexctl", "rotate", "--seconds", "0.1"],
        env={**os.environ, "MUJOCO_GL": "nonsense"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "MUJOCO_GL=nonsense" in done.stderr
