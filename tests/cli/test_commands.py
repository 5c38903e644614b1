"""The commands as processes: what they print, and their exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import main
from dexctl.cli.trials import paced
from dexctl.sim import GraspStates, Scene, SceneConfig
from dexctl.sim.sensing import Sensing
from learning import policies

ROOT = Path(__file__).resolve().parents[2]


Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """A command in this process: Python and MuJoCo are there already."""

    def done(*arguments: str) -> subprocess.CompletedProcess[str]:
        code = main(arguments)
        said = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, code, said.out, said.err)

    return done


def dexctl_command(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dexctl", *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """The one line on stderr that a refused command prints."""
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("dexctl: ")
    return line


def test_overview_lists_the_commands() -> None:
    done = dexctl_command("--help")
    assert done.returncode == 0
    for name in ("demo", "rotate", "check-grasp", "hands"):
        assert f"\n  {name} " in done.stdout
    alone = dexctl_command()
    assert alone.returncode == 2
    assert alone.stdout == done.stdout


@pytest.mark.parametrize("name", ["demo", "rotate", "check-grasp", "hands"])
def test_each_command_explains_itself(name: str, run: Run) -> None:
    done = run(name, "--help")
    assert done.returncode == 0
    assert f"usage: dexctl {name}" in done.stdout
    assert "--json" in done.stdout


def test_version() -> None:
    assert dexctl_command("--version").stdout.startswith("dexctl ")


def test_hands_are_listed_without_loading_them() -> None:
    code = (
        "import sys; from dexctl.cli import main; main(['hands']); "
        "print([m for m in ('mujoco', 'casadi', 'torch', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "[]"
    assert "dex5" in done.stdout and "wonik_allegro" in done.stdout


def test_hands_say_whether_their_files_are_here(menagerie: Path, tmp_path: Path) -> None:
    found = json.loads(dexctl_command("hands", "--json", DEXCTL_MENAGERIE=str(menagerie)).stdout)
    dex5, allegro = found["hands"]["dex5"], found["hands"]["wonik_allegro"]
    assert (dex5["fingers"], dex5["joints"], dex5["files"]) == (5, 15, "built in")
    assert (allegro["fingers"], allegro["joints"], allegro["files"]) == (4, 16, "here")
    found = json.loads(dexctl_command("hands", "--json", DEXCTL_MENAGERIE=str(tmp_path)).stdout)
    assert found["hands"]["wonik_allegro"]["files"] == "missing"


def test_rotate_as_json(run: Run) -> None:
    arguments = ("rotate", "--controller", "igm", "--num-envs", "3", "--seconds", "0.5")
    done = dexctl_command(*arguments, "--gravity", "0,0,-9.81", "--seed", "5", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)  # exactly one object, nothing beside it
    assert found["seeds"] == [5, 7]
    assert found["gravity_m_s2"] == [0, 0, -9.81]
    assert found["holding"]["trials"] == len(found["trial_rotation_rad"]) == 3
    assert found["rotation_rad"]["median"] > 0.05
    assert found["time_held_s"]["median"] == pytest.approx(0.5)
    # the same seeds give the same trials, alone or in a batch
    again = run(*arguments[:3], "--num-envs", "1", "--seconds", "0.5", "--seed", "6", "--json")
    alone = json.loads(again.stdout)["trial_rotation_rad"]
    assert alone == pytest.approx(found["trial_rotation_rad"][1:2], abs=1e-6)


def test_rotate_as_a_table_and_into_a_folder(run: Run, tmp_path: Path) -> None:
    done = run(
        "rotate", "--controller", "hold", "--num-envs", "2", "--seconds", "0.2",
        "--out", str(tmp_path / "new" / "folder"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "still holding" in done.stdout and "2 of 2, 100 % (34 to 100 %)" in done.stdout
    folder = tmp_path / "new" / "folder"
    assert sorted(path.name for path in folder.iterdir()) == ["report.html", "rotate.json"]
    assert json.loads((folder / "rotate.json").read_text())["controller"] == "hold"


def test_check_grasp() -> None:
    done = dexctl_command("check-grasp", "--seconds", "0.5", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["contacts"] == [5]
    assert (
        found["force_closure"] == found["static"]["stable"] == found["dynamic"]["stable"] == [True]
    )
    assert found["epsilon_quality"][0] > 0.1
    assert sum(finger["force_n"][0] for finger in found["fingers"]) > 5


def test_check_grasp_says_what_was_tried(run: Run, tmp_path: Path) -> None:
    """A sphere that no friction of this grip can carry."""
    done = run("check-grasp", "--object", "sphere", "--object-mass", "20", "--out", str(tmp_path))
    assert done.returncode == 1, done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("dexctl: dex5 does not hold 'sphere'")
    assert "it weighs 196.2 N, and 5 fingers pressing with 2 N carry 10.0 N" in done.stderr
    assert "11 x" in done.stderr and "from touching" in done.stderr
    found = json.loads((tmp_path / "check-grasp.json").read_text())
    assert found["held"] is False and len(found["attempts"]) >= 11
    assert set(found["fingers"]) == {f"f{i}_tip" for i in range(1, 6)}
    assert (tmp_path / "not_held.png").is_file() or "no picture" in done.stderr


def test_check_grasp_fails_where_the_grasp_does(run: Run) -> None:
    done = run("check-grasp", "--push-force", "30", "--num-envs", "2", "--json")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["dynamic"]["stable"] == [False, False]


@pytest.fixture
def grasps(tmp_path: Path) -> Path:
    """Two grasps of a cylinder, the second of them far from the hand, and one of a cube."""
    scene = Scene.build("dex5", "cylinder")
    settled = scene.settled
    pose = settled.qpos[scene.object_qpos]
    positions = np.tile(pose[:3], (3, 1))
    positions[1, 2] += 1.0
    GraspStates(
        hand="dex5",
        q=np.tile(settled.qpos[scene.qpos_columns], (3, 1)),
        q_target=np.tile(settled.q_target, (3, 1)),
        object_position=positions,
        object_quaternion=np.tile(pose[3:], (3, 1)),
        object=np.array(["cylinder", "cylinder", "cube"]),
        joint_names=np.array(scene.hand.joint_names),
    ).save(tmp_path / "grasps.npz")
    return tmp_path / "grasps.npz"


def test_check_grasp_of_a_file(run: Run, grasps: Path, tmp_path: Path) -> None:
    arguments = ("check-grasp", "--initial-states", str(grasps), "--seconds", "0.5", "--json")
    done = run(*arguments, "--object", "cylinder", "--out", str(tmp_path / "out"))
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["contacts"] == [5, 0]
    assert found["dynamic"]["stable"] == [True, False]
    written = {path.name for path in (tmp_path / "out").iterdir()}
    drawn = set() if "no pictures" in done.stderr else {"grasp_0.png", "grasp_1.png"}
    assert written == {"check-grasp.json", *drawn}
    first = run(*arguments, "--object", "cylinder", "--num-envs", "1")
    assert first.returncode == 0, first.stderr
    for more, said in (
        (("--object", "sphere"), "has none of the object 'sphere', only of cube, cylinder"),
        (("--num-envs", "4"), "--num-envs is 4; --initial-states has 1 of the object 'cube'"),
    ):
        done = run(*arguments, *more)
        assert done.returncode == 2
        assert said in one_line(done)


def test_rotate_tells_poses_as_old_as_a_policy_has_learned_by(dex5: dexctl.HandModel) -> None:
    policy = policies.load("dex5-easy-any", hand=dex5)
    usual = paced(SceneConfig(), policy)
    assert usual.control_period == 0.05 and usual.sensing.tracker_latency == 0.0
    policy.pose_age = 0.1
    for sensing, latency in (
        (Sensing(), 0.1),
        (Sensing(tracker_latency=0.2), 0.2),
        (Sensing(sensor_latency=0.04), 0.06),
        (Sensing(sensor_latency=0.2), 0.0),
        (Sensing(object_pose="touch"), 0.0),
    ):
        late = paced(SceneConfig(sensing=sensing), policy).sensing
        assert late.tracker_latency == pytest.approx(latency)


def test_rotate_about_another_axis_with_limits(run: Run, tmp_path: Path) -> None:
    done = run(
        "rotate", "--controller", "igm", "--object", "cylinder", "--num-envs", "2",
        "--seconds", "1", "--axis=-z", "--as-real", "--action-latency", "0.1",
        "--joint-noise", "0.001", "--push-force", "0.1", "--json", "--out", str(tmp_path),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["axis"] == [0, 0, -1]
    assert found["rotation_rad"]["median"] > 0.1
    limits = {"speed_limit": 0.6, "torque_limit": 0.5, "action_latency": 0.1}
    assert found["scene"]["limits"] == limits
    page = (tmp_path / "report.html").read_text()
    for what, value in (
        ("axis", "-z"),
        ("speed limit", "0.6 rad/s"),
        ("action latency", "0.1 s"),
        ("joint noise", "0.001 rad"),
        ("push force", "0.1 N"),
    ):
        assert f"<td>{what}</td><td>{value}</td>" in page
    assert "--axis=-z --seconds 1.0" in page


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("fly", "unknown command 'fly'; known: demo, rotate, check-grasp, plan, hands"),
        ("rotate --hand claw", "unknown hand 'claw'; known: dex5, "),
        ("rotate --object ball", "unknown object 'ball'; known: cube, sphere, cylinder"),
        ("rotate --controller walk", "unknown controller 'walk'; known: igm, switch, gait"),
        ("rotate --controller dex5-cube-goals", "acts only where it has a goal; expected"),
        ("rotate --gravity left", "unknown gravity 'left'; known: up, down"),
        ("rotate --gravity 0,0", "'0,0' is neither a name nor three finite numbers"),
        ("rotate --gravity 0,0,nan", "'0,0,nan' is neither a name nor three"),
        ("rotate --gravity 0,0,1e300", "gravity is (0.0, 0.0, 1e+300); expected at most 1000"),
        ("rotate --axis w", "unknown axis 'w'; known: x, y, z"),
        ("rotate --axis 0,0,0", "axis is (0.0, 0.0, 0.0); expected three finite numbers"),
        ("rotate --object cube sphere", "--object is cube sphere; this command takes one"),
        ("rotate --object", "object is (); expected a name"),
        ("rotate --initial-states /none.npz", "'/none.npz' cannot be read"),
        ("rotate --sensor-latency -1", "sensor_latency is -1.0"),
        ("rotate --push-seconds 0", "push_seconds is 0.0"),
        ("rotate --control-period 0", "control_period is 0.0"),
        ("rotate --seconds nan", "--seconds is nan; expected a finite number"),
        ("rotate --seconds -1", "--seconds is -1.0"),
        ("rotate --seconds 1e300", "--seconds is 1e+300; expected a finite number of at least"),
        ("rotate --seconds long", "could not convert string to float: 'long'"),
        ("rotate --num-envs -3", "--num-envs is -3; expected a whole number above 0"),
        ("rotate --num-envs 2.5", "--num-envs"),
        ("rotate --colour red", "Unrecognized options: --colour"),
        ("rotate --object-size 0", "object_size is 0.0"),
        ("rotate --action-latency -1", "action_latency is -1.0"),
        ("rotate --action-latency 11", "action_latency is 11.0; expected 0 to 10 s"),
        ("rotate --speed-limit nan", "speed_limit is nan"),
        ("rotate --video", "--video is given without --out"),
        ("check-grasp --num-envs 0", "--num-envs is 0"),
        ("check-grasp --seconds 0", "--seconds is 0.0"),
        ("check-grasp --initial-states /none.npz", "'/none.npz' cannot be read"),
        ("check-grasp --object cube sphere", "this command takes one object"),
        ("check-grasp --out /proc/none", "--out is '/proc/none'; cannot write there"),
        ("check-grasp --object mesh", "a mesh file goes with object 'mesh' only"),
        ("hands --seed 3", "Unrecognized options: --seed, 3"),
        ("demo --seconds inf", "--seconds is inf"),
        ("demo --axis up", "unknown axis 'up'"),
        ("demo --object cube sphere", "this command takes one object"),
        ("demo --out /proc/none/such", "--out is '/proc/none/such'; cannot write there"),
    ],
)
def test_bad_arguments_get_one_line_and_code_2(
    arguments: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("dexctl: ")
    assert said in line


@pytest.mark.parametrize(
    "line",
    [
        "rotate --object none_such",
        "check-grasp --initial-states none_such.npz",
        "demo --object none_such",
    ],
)
def test_a_refused_command_leaves_no_empty_folder(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "there"
    there.mkdir()
    for out in (tmp_path / "deep" / "new", there):
        assert main([*line.split(), "--out", str(out)]) == 2
        assert "none_such" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [there]  # the user's own stays


def test_one_line_where_the_terminal_knows_ascii_only() -> None:
    said = dexctl_command("rotate", "--seconds", "long", PYTHONIOENCODING="ascii")
    assert said.returncode == 2
    assert said.stderr == (
        "dexctl: --seconds: could not convert string to float: 'long' (see dexctl rotate --help)\n"
    )


def test_a_failed_run_gets_one_line_and_code_1(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run("rotate", "--object-mass", "50")  # nothing holds 50 kg
    assert done.returncode == 1
    assert "does not hold 'cube'" in one_line(done)
    monkeypatch.setenv("DEXCTL_MENAGERIE", str(tmp_path))
    done = run("rotate", "--hand", "wonik_allegro")
    assert done.returncode == 1
    assert "wonik_allegro" in one_line(done)
