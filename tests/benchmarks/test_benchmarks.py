"""Every script in benchmarks/ runs with tiny settings, and README shows what was measured."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import changed, to_plain

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "benchmarks"
Here = Callable[..., "int | None"]
PATIENT = ["--patience", "10"]
SHORT = ["--trials", "2", "--seconds", "0.5"]
RUNS: dict[str, list[str]] = {
    "igm_latency.py": ["--count", "10", "--rounds", "2"],
    "force_distribution.py": ["--count", "5", "--rounds", "1", "--contacts", "4", "--hulls", "2"],
    "compiled_or_plain.py": ["--count", "5", "--rounds", "2", "--hands", "1", "4", "--starts", "1"],
    "gait_batch.py": ["--environments", "4", "--steps", "4", "--warm-up", "1"],
    "simulator.py": ["--environments", "4", "--steps", "3", "--rounds", "2"],
    "in_grasp.py": SHORT,
    "reach.py": [*SHORT, "--objects", "cylinder"],
    "touch.py": [*SHORT, "--objects", "cylinder"],
    "touch_tracking.py": [
        *(*SHORT, "--objects", "cylinder", "--steps", "3", "--rounds", "1", "--hands", "2"),
    ],
    "planning.py": [
        *("--seeds", "1", "--slow-seeds", "1", "--objects", "cylinder", "--hard", "cylinder"),
        *("--parts", "kinematic", "large", "random", "literal", "sampling", "--limit", "0.2"),
        *("--large", "300", "--short", "0.1", "--checked", "16", "--steps", "3000"),
        *("--picture", "None"),
    ],
    "gaits.py": [*SHORT, "--objects", "cylinder", "u_shape"],
    "gaits_long.py": [*SHORT, "--objects", "cylinder"],
    "ablation.py": [*SHORT, "--variants", "complete", "no_governor"],
    "hands.py": [
        *(*SHORT, "--hands", "dex5", "none.toml", "--objects", "sphere", "--searches", "1"),
        *("--adds", "1", "--told=--object sphere --turning.grasps 0"),
    ],
    "hands_turning.py": [
        *(*SHORT, "--hands", "wonik_allegro", "--adds", "1"),
        "--told=--object sphere --turning.grasps 0",
    ],
    "hands_learned.py": [*SHORT],
    "learner.py": [
        *("--environments", "4", "--steps", "2", "--rounds", "1", "--warm-up", "2"),
    ],
    "devices.py": [
        *("--algorithms", "dagger", "--devices", "cpu", "--environments", "64"),
        *("--seconds", "0.1"),
    ],
    "learned.py": [*SHORT, "--objects", "cylinder", "sphere"],
    "learning_ablation.py": [
        *(*SHORT, "--steps", "300", "--num-envs", "4", "--jobs", "1"),
        *("--variants", "fast", "no_cloning"),
    ],
    "feedback.py": [
        *(*SHORT, "--steps", "300", "--num-envs", "4", "--jobs", "1"),
        *("--variants", "joints", "touch_before"),
    ],
    "feedback_x.py": [
        *(*SHORT, "--steps", "300", "--num-envs", "4", "--jobs", "1"),
        *("--variants", "joints"),
    ],
    "seen_ablation.py": [
        *(*SHORT, "--steps", "300", "--num-envs", "10", "--jobs", "1"),
        *("--variants", "settled"),
    ],
    "commanded_speed.py": [
        *(*SHORT, "--steps", "300", "--num-envs", "4", "--speeds", "0.5"),
    ],
    "starts.py": [
        *(*SHORT, "--steps", "300", "--ppo-steps", "300", "--num-envs", "4", "--tree-nodes", "60"),
        *("--tasks", "l", "--methods", "rxr_ipt", "tree", "vge_tree", "policy"),
    ],
    "algorithms.py": [
        *("--seeds", "1", "--share", "0.001", "--episodes", "2"),
        *("--only", "pendulum_sac", "hand_ppo"),
    ],
    "bus.py": ["--cycles", "20", "--rounds", "2"],
    "hardware_loop.py": ["--cycles", "20", "--rounds", "2", "--seconds", "0.5", *PATIENT],
    "hardware_grasp.py": [*SHORT, "--trace-seconds", "0.5", "--repeats", "1", *PATIENT],
    "goal_policies.py": [
        *("--steps", "200", "--about-steps", "200", "--last-steps", "200", "--num-envs", "4"),
        *("--gentle-steps", "200"),
        *("--states-seconds", "0.5", "--episodes", "12", "--seconds", "1"),
    ],
    "goals_any_way_up.py": [
        *("--about", "dex5-cube-z", "--across", "dex5-cube-x", "--evaluated", "any"),
        *("--any-steps", "200", "--last-steps", "200", "--num-envs", "4"),
        *("--episodes", "16", "--seconds", "5"),
    ],
    "predictive_sampling.py": [*SHORT],
    "identification.py": ["--trials", "1", "--seconds", "6", "--motions", "chirp"],
    "servo_goals.py": [*SHORT, "--palms", "down"],
    "servo_told.py": [*SHORT, "--palms", "down"],
    "told.py": [*SHORT, "--objects", "cube", "sphere"],
    "servo_hand.py": [*SHORT, "--objects", "cylinder"],
    "reorientation.py": [
        *(*SHORT, "--turning", "1", "--goals", "cube", "--axes=x,-z", "--long", "1"),
        *("--command-seconds", "0.2"),
    ],
    "robustness.py": [*SHORT, "--conditions", "all_noise", "friction_0.6", "untracked"],
    "conditions.py": [
        *(*SHORT, "--conditions", "up", "all", "--objects", "cube", "--picture", "None"),
    ],
    "ranges.py": [
        *(*SHORT, "--varied", "centre_of_mass", "link_friction_range", "--jobs", "2"),
        *("--picture", "None"),
    ],
}

LONGER = {  # than five seconds of processor, however little they are asked for
    "ablation.py", "algorithms.py", "commanded_speed.py", "compiled_or_plain.py", "conditions.py",
    "bus.py", "devices.py", "feedback.py", "feedback_x.py", "gaits.py", "gaits_long.py",
    "goal_policies.py",
    "goals_any_way_up.py", "hands.py",
    "hands_learned.py", "hands_turning.py", "hardware_grasp.py", "hardware_loop.py",
    "identification.py", "in_grasp.py", "learned.py", "learner.py",
    "learning_ablation.py", "planning.py", "predictive_sampling.py", "ranges.py",
    "reach.py", "reorientation.py", "robustness.py", "seen_ablation.py", "servo_goals.py",
    "servo_hand.py", "servo_told.py", "starts.py", "told.py", "touch.py", "touch_tracking.py",
}  # fmt: skip

FIRST_SEEDS = {  # of those that do not begin with 0
    "gaits_long": 100,
    "predictive_sampling": 100,
    "touch_tracking": 1000,
    "servo_goals": 40_000,
    "servo_told": 41_000,
    "told": 1000,
    "conditions": 20_000,
    "hands_learned": 20_000,
    "ranges": 30_000,
}


def run(script: str, *arguments: str | Path, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(FOLDER / script), *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int | None]:
    """Runs a script in this process: to begin another takes longer than what it does here."""

    def run_here(script: str, *arguments: str | Path) -> int | None:
        monkeypatch.syspath_prepend(FOLDER)
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        monkeypatch.setattr(sys, "excepthook", sys.excepthook)  # scripts set it
        return importlib.import_module(Path(script).stem).main()

    return run_here


def test_every_script_is_run_here() -> None:
    scripts = {path.name for path in FOLDER.glob("*.py")} - {"readme.py", "learning_curves.py"}
    assert scripts == set(RUNS)


@pytest.mark.parametrize(
    "script",
    [pytest.param(s, marks=[pytest.mark.slow] if s in LONGER else []) for s in RUNS],
)
def test_script_runs(script: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    arguments = [*RUNS[script], "--out", tmp_path]
    if script in (
        "bus.py",
        "hardware_loop.py",
        "hardware_grasp.py",
        "identification.py",
        "servo_goals.py",
        "servo_hand.py",
        "servo_told.py",
    ):
        pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
    if script in (
        "learner.py", "learned.py", "learning_ablation.py", "algorithms.py", "starts.py",
        "devices.py", "goal_policies.py", "feedback.py", "feedback_x.py", "commanded_speed.py",
        "goals_any_way_up.py", "seen_ablation.py",
    ):  # fmt: skip
        pytest.importorskip("torch", reason="needs the extra 'learning'")
    if script in ("learner.py", "algorithms.py"):
        pytest.importorskip("stable_baselines3", reason="needs the peer, of the extra 'dev'")
    if script in (
        "learning_ablation.py", "feedback.py", "feedback_x.py", "starts.py", "goal_policies.py",
        "commanded_speed.py", "goals_any_way_up.py", "seen_ablation.py",
    ):  # fmt: skip
        arguments += ["--runs", request.getfixturevalue("tmp_path_factory").mktemp("runs")]
    if script == "hands_turning.py":
        arguments += ["--folder", request.getfixturevalue("menagerie")]
    done = run(script, *arguments)
    assert done.returncode == 0, done.stderr
    name = Path(script).stem
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.json"]
    result = json.loads((tmp_path / f"{name}.json").read_text())
    assert result["benchmark"] == name
    assert result["machine"]["versions"]["mujoco"][0].isdigit()
    assert result["settings"]["seed"] == FIRST_SEEDS.get(name, 0)
    assert result["figures"] or result["tables"]
    for table in result["tables"]:
        assert {len(row) for row in table["rows"]} == {len(table["header"])}


def test_learning_curves_are_drawn(tmp_path: Path) -> None:
    done = run("learning_curves.py", "--out", tmp_path / "curves.png")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_ablations_of_trees_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra 'viz' is not installed")
    picture = tmp_path / "ablation.png"
    before = (FOLDER / "results" / "planning.json").read_bytes()
    done = run("planning.py", "--parts", "--picture", picture)
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert (FOLDER / "results" / "planning.json").read_bytes() == before


def test_interrupted_run_goes_on(
    tmp_path: Path, here: Here, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ablation.json"
    arguments = [*SHORT, "--out", tmp_path, "--variants"]
    here("ablation.py", *arguments, "complete")
    assert "complete," in capsys.readouterr().err
    first = json.loads(path.read_text())["trials"]
    here("ablation.py", *arguments, "complete", "no_governor", "--resume")
    assert "complete," not in capsys.readouterr().err  # its rows were there
    rows = json.loads(path.read_text())["trials"]
    assert rows[: len(first)] == first
    assert len(rows) == 2 * len(first)


@pytest.mark.slow
def test_a_row_of_more_episodes_takes_the_place_of_fewer(tmp_path: Path) -> None:
    """All rows of a result had to have as many, so that none could have the 500 of a goal."""
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    arguments = [*SHORT, "--who", "igm", "--objects", "cube", "--picture", "None"]
    arguments += ["--out", tmp_path, "--resume", "--conditions"]
    for trials, conditions, expected in ((2, ("up", "down"), [2, 2]), (3, ("down",), [2, 3])):
        done = run("conditions.py", *arguments, *conditions, "--trials", str(trials))
        assert done.returncode == 0, done.stderr
        rows = json.loads((tmp_path / "conditions.json").read_text())["trials"]
        assert [row["holding"]["of"] for row in rows] == expected
    assert [row["condition"] for row in rows] == ["up", "down"]


@pytest.mark.slow
def test_trainings_of_another_seed_stand_beside_the_first(tmp_path: Path) -> None:
    """They were written over."""
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    arguments = [
        *(*SHORT, "--ppo-steps", "200", "--num-envs", "4", "--tree-nodes", "60"),
        *("--tasks", "l", "--methods", "fi", "--out", tmp_path, "--runs", tmp_path / "runs"),
    ]
    assert run("starts.py", *arguments).returncode == 0
    first = json.loads((tmp_path / "starts.json").read_text())["trials"]
    done = run("starts.py", *arguments, "--seeds", "0", "1", "--resume")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "starts.json").read_text())
    rows = result["trials"]
    assert rows[:2] == first
    assert [row["training_seed"] for row in rows] == [0, 0, 1, 1]
    assert (tmp_path / "runs" / "l-fi-1").is_dir()
    assert all(row["training_s"] >= 0 and row["training_cpu_s"] > 0 for row in rows)
    (figure,) = result["figures"]
    assert figure["measured"].startswith("interquartile mean of 2 seeds' medians")


@pytest.mark.slow
def test_a_training_that_is_there_is_gone_on_with(tmp_path: Path) -> None:
    """Its configuration says the object's mass, which the one that was asked for did not."""
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    arguments = [
        *(*SHORT, "--steps", "200", "--num-envs", "4", "--jobs", "1", "--variants", "joints"),
        *("--out", tmp_path, "--runs", tmp_path / "runs"),
    ]
    for _ in range(2):  # an interrupted one has the run, but not yet its row
        done = run("feedback_x.py", *arguments)
        assert done.returncode == 0, done.stderr
        (row,) = json.loads((tmp_path / "feedback_x.json").read_text())["trials"]
        assert row["steps"] >= 200
        (tmp_path / "feedback_x.json").unlink()


def test_trainings_with_other_settings_are_not_written_over(tmp_path: Path, here: Here) -> None:
    """Their rows were dropped, those of variants that nobody had asked for again too."""
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    path = tmp_path / "feedback.json"
    before = (FOLDER / "results" / "feedback.json").read_bytes()
    path.write_bytes(before)
    arguments = ["--resume", "--variants", "joints", "--jobs", "1", "--out", tmp_path]
    with pytest.raises(InvalidInput, match=r"\(seed 0\) was trained with other settings"):
        here("feedback.py", *arguments, "--steps", "300", "--runs", tmp_path / "runs")
    assert path.read_bytes() == before
    # of the same ones all are there, though settings have come since
    here("feedback.py", *arguments, "--steps", "400000", "--runs", tmp_path / "runs")
    rows = json.loads(path.read_text())["trials"]
    assert [row | {"measured_with": None} for row in json.loads(before)["trials"]] == rows
    assert not (tmp_path / "runs").exists()


def test_settings_of_trees_that_were_not_grown_tell_no_trainings_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("torch", reason="needs the extra 'learning'")
    from learning.config import TrainConfig

    monkeypatch.syspath_prepend(FOLDER)
    same = importlib.import_module("measuring.trainings")._same
    for name, value, alike in (
        ("starts.tree.controllers.gait.in_grasp.reach_margin", 0.03, True),
        ("starts.tree.kinematic.friction", 0.7, False),
        ("steps", 1234, False),
    ):
        assert same(to_plain(changed(TrainConfig(), {name: value})), TrainConfig()) is alike, name


def test_no_shared_module_hides_one_of_the_standard_library() -> None:
    """One of them runs as a script, by whose folder others are found first."""
    shared = {path.stem for path in (FOLDER / "measuring").glob("[!_]*.py")}
    assert shared and not shared & sys.stdlib_module_names


def test_hands_without_their_files_are_said_so(tmp_path: Path) -> None:
    done = run("hands_turning.py", *SHORT, "--out", tmp_path, "--folder", tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "hands_turning.json").read_text())["trials"]
    assert [row["hand"] for row in rows] == ["wonik_allegro", "leap_hand", "shadow_hand"]
    assert all("not here" in row["missing"] for row in rows)


def test_what_it_takes_to_add_a_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    adding = importlib.import_module("measuring.adding")
    held = {
        palm: adding.counted("16 of 16 disturbed grasps of the cube") for palm in ("up", "down")
    }
    assert adding.counted("the hand does not hold it") is None
    quick = {"hand": "mine/quick.urdf", "seed": 0, "load": 1.2, "error": None, "grasp": "cube"}
    quick |= {"wall_s": 180.0, "cpu_s": 192.0, "holds": held}
    busy = quick | {"seed": 1, "load": 6.0, "wall_s": 1500.0, "cpu_s": 240.0}
    slow = quick | {"hand": "slow.xml", "wall_s": 660.0, "cpu_s": 600.0}
    down = adding.counted("14 of 16 disturbed grasps of the cube")
    drops = quick | {"hand": "drops.xml", "holds": {"up": held["up"], "down": down}}
    none = quick | {"hand": "none.xml", "error": "no place is in reach"}
    del none["holds"]
    away = {"hand": "away", "missing": "not here: away.xml is not there"}
    # by the clock, unless it had to wait: then by the processor
    assert [adding.minutes(one) for one in (quick, busy, slow)] == [3.0, 4.0, 11.0]
    runs = adding.in_order([quick, slow, drops, none, away, busy])
    assert [run.get("seed") for run in runs] == [0, 1, 0, 0, 0, None]
    figures = adding.figures_of_adding(runs)
    # in time and held palm up; held both ways
    met = [(True, True), (False, True), (True, False), (False, False)]
    assert [(one.met, two.met) for one, two in zip(figures[::2], figures[1::2], strict=True)] == met
    assert figures[0].measured == ("4.0 min of processor, 25.0 by the clock at a load of 6; 2 of 2")
    assert figures[1].measured == "palm up 32 of 32, palm down 32 of 32"
    assert figures[5].measured == "palm up 16 of 16, palm down 14 of 16"  # 88 %, 90 % are asked
    assert figures[7].measured == "palm up 0 of 0, palm down 0 of 0"
    lines = adding.table_of_adding(runs)["rows"]
    assert {len(line) for line in lines} == {8}
    assert lines[3][-1] == "14 of 16" and lines[4][5] == "no place is in reach"
    assert lines[5][:2] == ["away", "not here: away.xml is not there"]


def test_what_hands_add_proposes_counts_where_every_run_of_it_is_turned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    turning = importlib.import_module("hands_turning")

    def row(hand: str, seed: int | None, palm: str, count: int) -> dict[str, Any]:
        toml = {} if seed is None else {"toml": turning.added(seed)}
        found = {"count": count, "of": 20, "share": count / 20}
        about = {"hand": hand, "palm": palm, "controller": turning.GAIT}
        return {**about, **toml, "reached_and_holding": found}

    rows = [
        row("leap_hand", None, "up", 0),  # of the toml that ships
        *(row("leap_hand", seed, "up", 20) for seed in (1, 2)),
        row("wonik_allegro", 1, "up", 20), row("wonik_allegro", 2, "up", 18),
        row("wonik_allegro", 1, "down", 16), row("wonik_allegro", 2, "down", 20),
        row("mine.urdf", 1, "up", 20),  # not one of the three
    ]  # fmt: skip
    up, down = turning.over_proposed(rows, 60.0)
    assert up.measured.startswith("1 of 2 (leap_hand 20 of 20 (100 %), 20 of 20 (100 %); wonik")
    assert (up.met, down.met) == (False, True)
    assert turning.over_proposed(rows[:1], 60.0) == []
    # and one that found no grasp is not turned
    none = {"hand": "leap_hand", "toml": turning.added(3), "error": "no place is in reach"}
    up, _ = turning.over_proposed([*rows, none], 60.0)
    assert up.measured.startswith("0 of 2 (leap_hand 20 of 20 (100 %), 20 of 20 (100 %), no grasp;")


@pytest.mark.slow
def test_hands_that_are_not_here_keep_what_was_measured_of_them(tmp_path: Path) -> None:
    path, arguments = tmp_path / "hands.json", ["hands.py", *SHORT, "--out", str(tmp_path)]
    assert run(*arguments, "--hands", "none.toml").returncode == 0
    result = json.loads(path.read_text())
    held = {"count": 1, "of": 2, "share": 0.5, "wilson95": [0.1, 0.9]}
    kinds = ("palm_up", "palm_down", "best_palm_up", "best_palm_down")
    row = {"hand": "leap_hand", "object": "sphere", "search_cpu_s": {"median": 8.5}}
    result["trials"] = [row | dict.fromkeys(kinds, held) | {"measured_with": 0}]
    path.write_text(json.dumps(result | {"runs": []}))
    done = run(*arguments, "--hands", "leap_hand", "--resume", DEXCTL_MENAGERIE=str(tmp_path))
    assert done.returncode == 0, done.stderr
    after = json.loads(path.read_text())
    assert after["trials"] == result["trials"]  # and no row beside it that it is not here
    assert [row["hand"] for row in after["runs"]] == ["leap_hand"]
    assert "not here" in after["runs"][0]["missing"]


@pytest.mark.parametrize(
    ("script", "arguments", "said"),
    [
        ("in_grasp.py", "--trials 0", "num_envs is 0"),
        ("ablation.py", "--variants none", "unknown variant 'none'; known: complete, "),
        ("conditions.py", "--conditions none", "unknown conditions 'none'; known: up, late"),
        ("conditions.py", "--who nobody", "unknown controller 'nobody'; known: igm, "),
        ("planning.py", "--parts none", "unknown part 'none'; known: kinematic, "),
    ],
)
def test_bad_settings_are_refused_in_one_line(
    script: str, arguments: str, said: str, tmp_path: Path, here: Here
) -> None:
    with pytest.raises(DexctlError) as refused:
        here(script, *arguments.split(), "--out", tmp_path)
    assert said in str(refused.value) and "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_a_damaged_result_is_not_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "ablation.json"
    path.write_text('{"settings": {')
    done = run("ablation.py", *SHORT, "--resume", "--out", tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert f"{path} is no result to go on with: " in line
    assert path.read_text() == '{"settings": {'


def test_rows_keep_the_settings_that_they_were_measured_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    results, ranges = (importlib.import_module(name) for name in ("measuring.results", "ranges"))
    given = [ranges.Options(out=tmp_path, resume=True, object=name) for name in ("cube", "sphere")]

    def objects_of_rows() -> list[str | None]:
        found = json.loads(path.read_text())
        numbers = [row["measured_with"] for row in found["trials"]]
        known = found["measured_with"]
        return [None if number is None else known[number]["object"] for number in numbers]

    path = tmp_path / "some.json"
    results.write("some", given[0], [], trials=[{"row": 0}, {"row": 1}], say=False)
    assert objects_of_rows() == ["cube", "cube"]
    for _ in range(2):  # what is taken over twice stays the same
        rows = [*results.earlier("some", given[1])[:2], {"row": 2}]
        results.write("some", given[1], [], trials=rows, say=False)
        assert objects_of_rows() == ["cube", "cube", "sphere"]
        found = json.loads(path.read_text())
        assert len(found["measured_with"]) == 2
        assert found["settings"]["object"] == "sphere"
    for row in found["trials"]:  # as they were before rows had it
        del row["measured_with"]
    del found["measured_with"]
    path.write_text(json.dumps(found))
    rows = [*results.earlier("some", given[0]), {"row": 3}]
    results.write("some", given[0], [], trials=rows, say=False)
    assert objects_of_rows() == [None, None, None, "cube"]


def test_other_settings_do_not_write_over_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    results, ranges = (importlib.import_module(name) for name in ("measuring.results", "ranges"))
    results.write("some", ranges.Options(out=tmp_path, trials=3), [], trials=[{}], say=False)
    given = ranges.Options(out=tmp_path, trials=4, resume=True)
    with pytest.raises(InvalidInput, match="was measured with --trials 3; expected these, or no"):
        results.earlier("some", given)
    assert len(results.earlier("some", replace(given, trials=3))) == 1


def test_results_are_there() -> None:
    measured_elsewhere = {"faults"}  # by tests/hardware/test_runner_campaign.py
    assert {path.stem for path in (FOLDER / "results").glob("*.json")} == measured_elsewhere | {
        Path(script).stem for script in RUNS
    }


def test_readme_and_page_show_the_results(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    assert here("readme.py", "--check") == 0, capsys.readouterr().err


def test_readme_is_small() -> None:
    assert (ROOT / "README.md").stat().st_size <= 6 * 1024


def test_figures_are_renewed_between_their_comments(
    tmp_path: Path, here: Here, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = {"--readme": tmp_path / "README.md", "--measured": tmp_path / "measured.md"}
    for path in paths.values():
        path.write_text("head\n<!-- figures:begin -->\nstale\n<!-- figures:end -->\ntail\n")
    given = [word for pair in paths.items() for word in pair]
    assert here("readme.py", *given, "--check") == 1
    assert "README.md, measured.md" in capsys.readouterr().err
    assert all("stale" in path.read_text() for path in paths.values())
    assert here("readme.py", *given) == 0
    few, everything = (path.read_text() for path in paths.values())
    for text in (few, everything):
        assert text.startswith("head\n<!-- figures:begin -->\n")
        assert text.endswith("<!-- figures:end -->\ntail\n")
        assert "stale" not in text
    assert few.count("\n| ") == 1 + 1 + 6  # header, rule and six figures
    shown = [line.strip("| ") for line in few.splitlines() if line.startswith("| ")][2:]
    assert all(figure in everything for figure in shown)
    results = [json.loads(path.read_text()) for path in (FOLDER / "results").glob("*.json")]
    met = [figure["met"] for result in results for figure in result.get("figures", [])]
    shown = [f"{result['benchmark']}.py" in everything for result in results if "figures" in result]
    assert all(shown), "a benchmark is not in HEADINGS of benchmarks/readme.py"
    assert everything.count("**no**") == met.count(False)  # what falls short stays in sight
    assert here("readme.py", *given, "--check") == 0


def test_readme_without_comments_is_an_error(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("<!-- figures:end --> <!-- figures:begin -->")
    done = run("readme.py", "--readme", readme)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "expected one <!-- figures:begin -->" in line


def test_trials_by_another_pose_are_not_taken_for_those_that_are_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows from before there was a choice are by touch; they kept those by a tracker undone."""
    monkeypatch.syspath_prepend(FOLDER)
    servo, servo_goals = (
        importlib.import_module(name) for name in ("measuring.servo", "servo_goals")
    )
    old = {"who": "a", "palm": "up", "seed": 40_000}
    monkeypatch.setattr(servo, "earlier", lambda *_: [old])
    monkeypatch.setattr(servo, "progress", lambda *_: None)
    for pose, tried in (("late", 1), ("touch", 0)):
        given = servo_goals.Options(who=("a",), palms=("up",), trials=1, pose=pose, out=tmp_path)
        kept: list[int] = []
        servo.measure_by_palm(
            "servo_goals", given, (),
            lambda who, palm, number, given: {"who": who, "palm": palm, "pose": given.pose},
            lambda rows, given, say, kept=kept: kept.append(len(rows)),
        )  # fmt: skip
        assert kept[-1] - 1 == tried
