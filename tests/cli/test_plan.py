"""`dexctl plan` and `plan show`: a tree in a folder, resumed, interrupted, drawn."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexctl.cli import main
from dexctl.cli.plan import Plan, refusals, time_left
from dexctl.cli.trials import simulation
from dexctl.exceptions import InvalidInput
from dexctl.planning import Progress, Tree, grow, sample_grasps
from dexctl.planning.parts import part_file, part_seed
from dexctl.sim import GraspStates, SceneConfig, Simulation

SMALL = ["--expand", "random", "--random.batch", "8", "--object", "cylinder", "--threads", "1"]


@pytest.fixture(autouse=True)
def few_held(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a tree grown without physics a few nodes are held, where that is not what is tested."""
    if "holds" not in request.fixturenames:
        monkeypatch.setattr("dexctl.cli.plan._CHECKED", 8)


@pytest.fixture
def holds() -> None:
    """As many nodes are held as usual."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of some ten nodes."""
    folder = tmp_path_factory.mktemp("plan")
    assert main(["plan", *SMALL, "--nodes", "10", "--seed", "3", "--out", str(folder)]) == 0
    return folder


def test_a_tree_is_grown_and_described(folder: Path) -> None:
    tree = Tree.load(folder / "tree.npz")
    found = json.loads((folder / "plan.json").read_text())
    assert found["nodes"] == len(tree) >= 10
    assert found["rotation_rad"] == tree.rotation.max()
    assert found["settings"]["expansion"]["batch"] == 8 and found["seed"] == 3
    assert found["scene"]["object"] == ["cylinder"] and found["machine"]["cores"]
    assert 0 < found["accepted"] < 1


def test_it_is_resumed_and_not_written_over(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again"
    out.mkdir()
    (out / "tree.npz").write_bytes((folder / "tree.npz").read_bytes())
    before = len(Tree.load(out / "tree.npz"))
    line = ["plan", *SMALL, "--nodes", "20", "--out", str(out)]
    assert main(line) == 2
    assert "is there already; expected --resume" in capsys.readouterr().err
    assert main([*line, "--resume", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nodes"] >= 20 > before
    assert main([*line, "--resume", "--ray", "auto"]) == 2
    assert "is of one process, which goes on without it" in capsys.readouterr().err
    assert main([*line, "--resume", "--gravity", "down"]) == 2
    assert "the tree is of the gravity" in capsys.readouterr().err
    assert len(Tree.load(out / "tree.npz")) >= 20


def test_what_killed_processes_left_is_not_deleted(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = [tmp_path / f".tree.{i}.npz" for i in range(2)]
    for part in parts:
        part.write_bytes((folder / "tree.npz").read_bytes())
    line = ["plan", *SMALL, "--nodes", "12", "--out", str(tmp_path)]
    assert main(line) == 2
    assert "has the trees of 2 processes of a run that was killed; expected --resume" in (
        capsys.readouterr().err
    )
    assert main(["plan", "states", str(tmp_path)]) == 2
    assert "makes one of them with --resume" in capsys.readouterr().err
    assert all(part.exists() for part in parts)
    assert main([*line, "--resume"]) == 0
    assert len(Tree.load(tmp_path)) >= 12


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_leaves_a_tree_that_loads(
    number: signal.Signals,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And so does SIGTERM, as whoever limits its time sends it."""
    # a shell lets what it starts in the background ignore it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))

    def interrupted(*arguments, progress, **keywords):
        def stop(now):
            progress(now)
            signal.raise_signal(number)

        return grow(*arguments, progress=stop, **keywords)

    monkeypatch.setattr("dexctl.cli.plan.grow", interrupted)
    assert main(["plan", *SMALL, "--nodes", "500", "--out", str(tmp_path)]) == 130
    assert "with --resume goes on" in capsys.readouterr().err
    assert len(Tree.load(tmp_path / "tree.npz")) > 1
    assert not (tmp_path / ".lock").exists()


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked")
def test_ctrl_c_in_the_first_seconds_is_one_line(tmp_path: Path) -> None:
    """Sent to all processes at once, as a terminal does, while the children begin."""
    words = [*SMALL[:-2], "--seconds", "600", "--jobs", "2", "--out", str(tmp_path)]
    program = "import sys; from dexctl.cli import main; sys.exit(main(sys.argv[1:]))"
    with subprocess.Popen(
        [sys.executable, "-c", program, "plan", *words],
        stderr=subprocess.PIPE, text=True, start_new_session=True,
        # a shell lets what it starts in the background ignore it
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as run:  # fmt: skip
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children")
        if not children.exists():
            run.kill()
            pytest.skip("this system does not say which children there are")
        while run.poll() is None and len(children.read_text().split()) < 3:
            time.sleep(0.02)  # the two, and multiprocessing's own
        os.killpg(run.pid, signal.SIGINT)
        try:
            said = run.communicate(timeout=100)[1]
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            raise
    assert run.returncode == 130 and "Traceback" not in said, said
    last = said.strip().splitlines()[-1]
    if (tmp_path / "tree.npz").exists():
        assert "with --resume goes on" in last and len(Tree.load(tmp_path)) >= 1
    else:
        assert last == "dexctl: interrupted before there was a tree"


@pytest.mark.usefixtures("holds")
def test_a_tree_without_physics_is_checked_in_simulation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--expand", "kinematic", "--object", "cylinder", "--nodes", "200", "--kinematic.batch"]
    assert main(["plan", *words, "32", "--threads", "1", "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["physics_steps"] == 0 and found["nodes"] >= 200
    assert found["holds"]["of"] >= 200 and found["holds"]["share"] > 0.9


def test_a_seed_goes_on_with_its_tree(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was passed over: what was asked for was not what grew on."""
    whole = (folder / "tree.npz").read_bytes()
    line = ["plan", *SMALL, "--nodes", "5", "--resume", "--json", "--out"]
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "tree.npz").write_bytes(whole)
    assert main([*line, str(tmp_path / "one"), "--seed", "4"]) == 2
    said = capsys.readouterr().err
    assert "--seed is 4; the tree in" in said and "was grown with 3, expected the same" in said
    for more in ([], ["--seed", "3"]):
        assert main([*line, str(tmp_path / "one"), *more]) == 0
        assert json.loads(capsys.readouterr().out)["seed"] == 3
    (tmp_path / "two").mkdir()
    for number in (0, 1):
        tree = Tree.load(folder)
        tree.header.seed = part_seed(3, number)
        tree.save(part_file(tmp_path / "two" / "tree.npz", number))
    command = Plan(out=tmp_path / "two", resume=True)
    path = tmp_path / "two" / "tree.npz"
    assert command._seed(path, None) == 3
    for other in ("3", "another one"):
        assert replace(command, seed=3)._seed(path, None) == 3
        for seed in (4, 0):
            with pytest.raises(InvalidInput, match=f"--seed is {seed}; .* with {other}, expected"):
                replace(command, seed=seed)._seed(path, None)
        part_file(path, 0).unlink(missing_ok=True)  # of a run that was killed


def test_goals_are_reached_or_it_says_which_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["plan", "--expand", "kinematic", "--object", "cube", "--kinematic.batch", "32"]
    words += ["--threads", "1", "--json", "--goals.orientations", "0.9553,0,0,0.2955"]
    assert main([*words, "--out", str(tmp_path / "yaw")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["goal_away_rad"][0] <= 0.2
    assert found["settings"]["goals"]["orientations"] == [[0.9553, 0, 0, 0.2955]]
    # a second one that no tree of some hundred nodes gets to
    words += ["0.5403,0.8415,0,0", "--nodes", "300", "--out", str(tmp_path / "tilt")]
    assert main(words) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["goal_away_rad"][1] > 0.2
    assert "goal (0.54, 0.842, 0, 0) is not reached: the nearest of" in said.err
    wrong = ["--goals.orientations", "1,1,0,0", "--out", str(tmp_path / "no")]
    assert main(["plan", *wrong]) == 2
    why = "a goal is (1, 1, 0, 0); expected a unit quaternion, wxyz"
    assert why in " ".join(capsys.readouterr().err.split())


def test_what_is_not_reached_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["plan", "--expand", "kinematic", "--kinematic.batch", "32", "--threads", "1"]
    words += ["--object", "cylinder"]
    for i, (more, code, why) in enumerate((
        (["--nodes", "40", "--until-rotation", "6"], 1, "--until-rotation 6.00 is not"),
        (["--nodes", "500000", "--seconds", "0.2"], 1, "--nodes 500000 is not reached: there are"),
        (["--nodes", "500000", "--until-rotation", "0.1"], 0, "written"),
        (["--seconds", "0.2"], 0, "written"),
    )):  # fmt: skip
        assert main([*words, *more, "--out", str(tmp_path / str(i))]) == code
        assert why in capsys.readouterr().err
    words[-1], out = "dodecahedron", tmp_path / "stone"
    assert main([*words, "--seconds", "0.2", "--out", str(out)]) == 1
    said = capsys.readouterr()
    assert "no grasp of the dodecahedron was reached" in said.err and "100 %" not in said.out
    out = tmp_path / "again"
    assert main([*words, "--nodes", "600", "--out", str(out)]) == 2
    assert "no grasp of the dodecahedron was reached" in capsys.readouterr().err
    assert len(Tree.load(out)) == 1


GOAL = ["--goals.orientations", "0.9553,0,0,0.2955"]


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ([], (2 * np.pi, 600.0)),
        (["--until-rotation", "3"], (3.0, 600.0)),
        (["--nodes", "5"], (None, None)),
        pytest.param(["--seconds", "0.2"], (None, 0.2), marks=pytest.mark.slow),
        pytest.param(GOAL, (None, 60.0), marks=pytest.mark.slow),
        pytest.param(["--until-rotation", "6", *GOAL], (6.0, 600.0), marks=pytest.mark.slow),
    ],
)
def test_a_full_turn_has_some_minutes_where_nobody_says(
    more: list[str],
    wanted: tuple[float | None, float | None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What could not be turned so far was tried for ever."""
    ends: list[tuple[float | None, float | None]] = []

    def soon(*arguments, **keywords):
        ends.append((keywords["until_rotation"], keywords["seconds"]))
        return grow(*arguments, **{**keywords, "seconds": 0.2})

    monkeypatch.setattr("dexctl.cli.plan.grow", soon)
    words = ["plan", "--expand", "kinematic", "--object", "cylinder", "--threads", "1"]
    main([*words, *more, "--out", str(tmp_path / "plan")])
    said = " ".join(capsys.readouterr().err.split())
    assert ends.pop() == wanted
    if not more:
        assert "--until-rotation 6.28 is not reached in 600 s: the greatest" in said
        assert "% of the candidates accepted" in said


def test_the_line_below_the_bar_says_why_candidates_are_refused() -> None:
    refused = {"bounds": 3, "reach": 0, "clearance": 40, "closure": 30, "residual": 7}
    assert refusals(Progress(21, 9, 0.5, 1.0, refused, 0, 1)) == (
        "20 % of the candidates accepted; refused for clearance 40 %, closure 30 %, residual 7 %"
    )
    for nodes in (0, 1):
        assert refusals(Progress(nodes, 0, 0.0, 1.0, {}, 0, nodes)) == ""


def test_what_fails_leaves_no_folder_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a" / "b"
    for words in (
        ["--nodes", "-1"],
        ["--expand", "followed", "--followed.tree", "no.npz"],
        ["--until-rotation", "30"],
        ["--nodes", "3", "--seed", "-1"],
        ["--resume"],
        ["--object", "cube", "--object-mass", "5", "--threads", "1"],
    ):
        assert main(["plan", *words, "--out", str(out)]) != 0
        assert capsys.readouterr().err.count("\n") == 1
        assert not any(tmp_path.iterdir())


def test_what_several_processes_left_can_be_deleted(tmp_path: Path) -> None:
    line = ["plan", *SMALL[:-2], "--nodes", "12", "--jobs", "2", "--out", str(tmp_path)]
    assert main(line) == 0
    for part in tmp_path.glob(".tree.*.npz"):
        part.unlink()
    before = len(Tree.load(tmp_path))
    more = [*line[:-4], "--out", str(tmp_path), "--resume"]
    more[more.index("12")] = "20"
    assert main(more) == 0
    assert len(Tree.load(tmp_path)) >= 20 > before


def test_episodes_start_from_a_tree(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tree = Tree.load(folder / "tree.npz")
    config = SceneConfig(object=("cylinder",), initial_states=folder, disturbance=0.0, threads=1)
    assert config.initial_states == folder / "tree.npz" and len(GraspStates.load(folder))
    with Simulation(config, 4, 0) as sim:
        start = sim.state
        assert start.object_quaternion is not None
        for row in start.q:
            assert np.abs(tree.nodes.q - row).max(axis=1).min() < 1e-12
    for gravity, told in (("up", False), ("down", True)):
        simulation(replace(config, gravity=gravity), 1, 0).close()
        assert ("planned under gravity (0, 0, -9.81)" in capsys.readouterr().err) == told


def test_what_plan_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, why in (
        (["--expand", "magic"], "unknown --expand 'magic'; known: kinematic, controllers, random"),
        (["--object", "cube", "sphere"], "this command takes one object"),
        (["--nodes", "-1"], "nodes is -1; expected a number above 0"),
        (["--goals.orientations", "1,0,0"], "'1,0,0' is no orientation; expected w,x,y,z (see"),
        (["--until-rotation", "30"], "until_rotation is 30"),
        (["--resume"], "has no tree to go on with; expected"),
        (["--expand", "followed", "--followed.tree", "no.npz", "--jobs", "2"], "no.npz' cannot be"),
    ):
        assert main(["plan", *words, "--out", str(tmp_path)]) == 2
        assert why in capsys.readouterr().err
    assert main(["plan", "film"]) == 2
    assert "unknown dexctl plan command 'film'; known: show" in capsys.readouterr().err


def test_settings_that_planning_does_not_use_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "none"
    for command in (["plan"], ["plan", "sample"]):
        for option, value, usual in (
            ("--initial-states", "no.npz", "None"),
            ("--joint-noise", "0.01", "0.0"),
            ("--disturbance", "0.5", "0.02"),
            ("--sensor-latency", "0.1", "0.0"),
            ("--push-force", "1.0", "0.0"),
            ("--torque-limit", "0.5", "None"),
            ("--mass-range", "0.1,0.2", "None"),
            ("--touch", "binary", "full"),
        ):
            assert main([*command, option, value, "--out", str(out)]) == 2
            said = capsys.readouterr().err
            assert f"{option} is" in said and said.count("\n") == 1
            assert f"planning does not use it, expected its default, {usual}" in said
    assert not out.exists()


def test_show_draws_the_tree_and_films_its_path(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra 'viz' is not installed")
    code = main(["plan", "show", str(folder), "--out", str(tmp_path), "--json"])
    said = capsys.readouterr()
    if code == 1 and "OpenGL" in said.err:
        pytest.skip("no OpenGL to draw with")
    assert code == 0
    tree, found = Tree.load(folder / "tree.npz"), json.loads(said.out)
    assert found["path"] == tree.paths(1)[0].tolist()
    assert (tmp_path / "tree.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "path.mp4").stat().st_size > 2000


def test_ctrl_c_keeps_sampled_grasps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments, progress, **keywords):
        def stop(now):
            progress(now)
            if now:  # as Ctrl-C, which tests of trees have
                signal.raise_signal(signal.SIGTERM)

        return sample_grasps(*arguments, progress=stop, **keywords)

    monkeypatch.setattr("dexctl.cli.plan_states.sample_grasps", interrupted)
    words = ["--object", "cylinder", "--sampling.batch", "32", "--threads", "1"]
    path = tmp_path / "grasps.npz"
    assert main(["plan", "sample", *words, "--count", "99", "--out", str(path)]) == 130
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    states = GraspStates.load(path)
    assert f"interrupted; {len(states)} of 99 grasps are in {path}" in capsys.readouterr().err
    assert json.loads(states.meta)["scene"]["object"] == ["cylinder"]


def test_starts_from_a_tree_and_from_samples(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "made" / "starts.npz"
    words = ["--count", "6", "--out", str(file), "--threads", "1", "--json"]
    assert main(["plan", "states", str(folder), *words]) == 0
    said = json.loads(capsys.readouterr().out)
    states = GraspStates.load(file)
    assert said["states"] == len(states) >= 6
    assert states.parent is not None and states.weight is not None
    assert main(["plan", "sample", "--object", "cylinder", "--sampling.batch", "32", *words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["states"] == len(GraspStates.load(file)) == 6 and said["tried"] >= 6
    for line, why in (
        (["states", "none.npz"], "tree 'none.npz' cannot be read"),
        (["states", str(file)], "lacks joint_velocity"),
        (["states", str(folder), "--count", "0"], "--count is 0"),
        (["sample", "--object", "cube", "sphere"], "this command takes one object"),
    ):
        assert main(["plan", *line]) == 2
        err = capsys.readouterr().err
        assert why in err and err.count("\n") == 1


def test_time_left_is_that_of_what_grew_since() -> None:
    """Not of what a tree that is gone on with had before."""
    now = Progress(
        nodes=300, expansions=900, rotation=1.0, seconds=10.0, refused={}, physics_steps=0,
        first=100,
    )  # fmt: skip
    assert time_left(now, 700, None) == "about 20 s more"
    assert time_left(now, 700, 15.0) == "about 20 s more, at most 5 s more"
    assert time_left(now._replace(first=300), 700, None) == ""  # it has not begun
    assert time_left(now, None, 60.0) == "at most 50 s more"
