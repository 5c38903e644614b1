"""A sweep's table and figure, from files written by hand."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput
from learning.cli.sweep import Sweep
from learning.cli.sweep_display import Progress, line, of_rows
from learning.cli.sweep_figure import draw
from learning.sweep.config import Cell
from learning.sweep.curves import Log, over_seeds, read_log
from learning.sweep.jobs import outcome, write_failure, write_result
from learning.sweep.reading import parse_sweep
from learning.sweep.results import collect, write_csv
from learning.sweep.run import prepare
from learning.sweep.table import caption, markdown_table
from learning.training.log import COLUMNS

GIVEN: dict[str, Any] = {
    "name": "by hand",
    "methods": ["rl", "vge"],
    "controllers": ["gait", "igm"],
    "seeds": 4,
    "train": {"steps": 1000, "env": {"object": "cylinder"}},
    "evaluation": {"episodes": 3, "seconds": 2, "controllers": ["igm"]},
    "criterion": {"rotation": 2.0},
}


def figures(rotation: float, returns: float, dropped: float) -> dict[str, Any]:
    """What an evaluation says of one object."""

    def one(value: float) -> dict[str, float]:
        return {"value": value, "low": value - 0.1, "high": value + 0.1, "count": 3}

    return {
        "rotation_median_rad": one(rotation),
        "speed_mean_rad_s": one(rotation / 2),
        "return_mean": one(returns),
        "share_dropped": one(dropped),
    }


def finish(folder: Path, *values: float, kind: str = "cylinder") -> None:
    folder.mkdir(parents=True)
    write_result(folder, {"objects": {kind: figures(*values)}, "steps": 1000})


def log(folder: Path, rows: Sequence[tuple[float, float | None, float]]) -> None:
    """A progress.csv of (step, return, seconds)."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "progress.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        for step, value, seconds in rows:
            row: dict[str, Any] = {"step": step, "seconds": seconds}
            if value is not None:
                row |= {"return": value, "rotation": value / 10, "dropped": 0.25}
            writer.writerow(row)


@pytest.fixture
def half_done(tmp_path: Path) -> Path:
    """VGE with gait: four seeds; with igm: one failed, one at work; RL: one of four."""
    out = tmp_path / "out"
    out.mkdir()
    prepare(parse_sweep(GIVEN), out)
    for seed, values in enumerate([(1.0, 10, 1.0), (2.0, 20, 0.5), (3.0, 30, 0.0), (9.0, 80, 0.5)]):
        finish(out / "runs" / f"vge-gait-{seed}", *values)
    write_failure(out / "runs" / "vge-igm-0", "training diverged:\nnot finite")
    (out / "runs" / "vge-igm-1").mkdir()
    finish(out / "runs" / "rl-0", 0.5, -3, 1.0)
    finish(out / "controllers" / "igm", 1.5, 25, 0.0)
    return out


def test_statistics_by_hand(half_done: Path) -> None:
    found = collect(parse_sweep(GIVEN), half_done)
    rl, gait, igm = found["cells"]
    # 3 of 4: Wilson 0.3006 to 0.9544
    assert gait["learned"] == pytest.approx(
        {"value": 0.75, "low": 0.3006, "high": 0.9544, "count": 4}, abs=1e-4
    )
    # of four, the least and the greatest are cut off
    assert gait["rotation_iqm_rad"]["value"] == pytest.approx(2.5)
    assert gait["return_iqm"]["value"] == pytest.approx(25.0)
    assert 1.0 <= gait["rotation_iqm_rad"]["low"] < 2.5 < gait["rotation_iqm_rad"]["high"] <= 9.0
    assert gait["dropped_mean"]["value"] == pytest.approx(0.5)
    # one seed has no interval over seeds; its share has Wilson's
    assert rl["rotation_iqm_rad"] == {"value": 0.5, "low": None, "high": None, "count": 1}
    assert rl["learned"] == pytest.approx(
        {"value": 0.0, "low": 0.0, "high": 0.7935, "count": 1}, abs=1e-4
    )
    assert rl["seeds"] == {
        "finished": [0], "failed": [], "unfinished": [], "not started": [1, 2, 3],
    }  # fmt: skip
    # what is missing is nothing, not zero
    assert igm["seeds"] == {
        "finished": [], "failed": [0], "unfinished": [1], "not started": [2, 3],
    }  # fmt: skip
    assert [igm[name] for name in ("learned", "rotation_iqm_rad", "return_iqm")] == [None] * 3


def test_the_guide_as_measure(half_done: Path) -> None:
    """igm itself turns 1.5 rad, gait has not been evaluated."""
    config = parse_sweep({**GIVEN, "criterion": {"rotation": "guide"}})
    rl, gait, igm = collect(config, half_done)["cells"]
    assert (gait["learned_at_rad"], gait["learned"]) == (None, None)
    assert (rl["learned_at_rad"], igm["learned_at_rad"]) == (None, 1.5)
    finish(half_done / "controllers" / "gait", 2.5, 25, 0.0)
    rl, gait, igm = collect(config, half_done)["cells"]
    assert (gait["learned_at_rad"], gait["learned"]["value"]) == (2.5, 0.5)
    # without controllers of its own: the best of all
    assert (rl["learned_at_rad"], rl["learned"]["value"]) == (2.5, 0.0)


def test_the_table_by_hand(half_done: Path) -> None:
    found = collect(parse_sweep(GIVEN), half_done)
    interval = found["cells"][1]["rotation_iqm_rad"]
    returns = found["cells"][1]["return_iqm"]
    lines = markdown_table(json.loads(json.dumps(found))).splitlines()
    assert lines == [
        "| Method | Controllers | Seeds | Learned | Rotation, rad | Return | Dropped |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| RL | - | 1 of 4 (3 not started) | 0/1 (0 to 79 %) | 0.50 | -3 | 100 % |",
        "| VGE | gaiting, random finger | 4 | 3/4 (30 to 95 %) "
        f"| 2.50 ({interval['low']:.2f} to {interval['high']:.2f}) "
        f"| 25 ({returns['low']:.0f} to {returns['high']:.0f}) | 50 % (12 to 88) |",
        "| VGE | in-grasp manipulation | 0 of 4 (1 failed, 1 unfinished, 2 not started) "
        "| - | - | - | - |",
        "| no learning | in-grasp manipulation | - | - | 1.50 | 25 | 0 % |",
    ]
    said = caption(found)
    assert "1,000 environment steps; cylinder, palm up" in said
    assert "3 episodes of 2 s" in said
    assert "at least 2 rad" in said
    evaluation = {"axis": "x", "sensor_latency": 0.05}
    other = collect(parse_sweep({**GIVEN, "evaluation": evaluation}), half_done)
    assert "cylinder, palm up, sensor_latency 0.05, axis x. Each policy: 100" in caption(other)


def test_several_objects_are_rows_of_their_own(half_done: Path) -> None:
    both = {**GIVEN, "evaluation": {"object": ["cube", "cylinder"]}}
    result = {"objects": {"cube": figures(3.0, 1, 0), "cylinder": figures(1.0, 2, 0)}}
    write_result(half_done / "runs" / "vge-igm-0", result)
    for folder in half_done.glob("runs/*-gait-*"):
        write_result(folder, result)
    write_result(half_done / "runs" / "rl-0", result)
    lines = markdown_table(collect(parse_sweep(both), half_done)).splitlines()
    igm = [line for line in lines if "in-grasp" in line]
    assert "| cube | 1 of 4 (1 unfinished, 2 not started) | 1/1 (21 to 100 %) | 3.00" in igm[0]
    assert "| cylinder | 1 of 4 (1 unfinished, 2 not started) | 0/1 (0 to 79 %) | 1.00" in igm[1]


def test_a_row_for_each_run(half_done: Path, tmp_path: Path) -> None:
    path = tmp_path / "runs.csv"
    write_csv(path, collect(parse_sweep(GIVEN), half_done))
    with path.open(newline="") as file:
        rows = {
            (row["method"], row["controllers"], row["seed"]): row for row in csv.DictReader(file)
        }
    assert len(rows) == 12
    done, failed = rows["vge", "gait", "1"], rows["vge", "igm", "0"]
    assert (done["rotation_median_rad"], done["state"], done["object"]) == (
        "2.0",
        "finished",
        "cylinder",
    )
    assert (failed["rotation_median_rad"], failed["share_dropped"]) == ("", "")
    assert failed["error"] == "training diverged: not finite"


def test_results_of_the_first_format_have_their_table() -> None:
    """Pages are generated of results that were measured before the evaluation had a scene."""
    folder = Path(__file__).parents[3] / "benchmarks" / "results" / "learning_table"
    found = json.loads((folder / "results.json").read_text())
    assert found["format"] == 1
    text = f"{markdown_table(found)}\n\n{caption(found)}\n"
    assert text == (folder / "table.md").read_text()


def test_results_of_something_else() -> None:
    with pytest.raises(
        InvalidInput, match="results of 'evaluate' in format None; expected 'sweep'"
    ):
        markdown_table({"command": "evaluate"})


def test_a_result_that_is_no_json_is_made_again(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text('{"objects"')
    assert outcome(tmp_path).state == "unfinished"


def test_curves_by_hand() -> None:
    cell = Cell("vge", ("gait",))
    logs = [
        Log(np.array([100.0, 300.0]), np.array([1.0, 3.0])),
        Log(np.array([100.0, 200.0, 400.0]), np.array([3.0, 4.0, 8.0])),
        Log(np.zeros(0), np.zeros(0)),  # has not written anything yet
    ]
    curve = over_seeds(cell, logs, 4)
    assert curve.step.tolist() == [100, 200, 300, 400]
    assert curve.mean.tolist() == [2.0, 3.0, 4.5, 8.0]
    assert curve.low.tolist() == [1.0, 2.0, 3.0, 8.0]
    assert curve.high.tolist() == [3.0, 4.0, 6.0, 8.0]
    assert curve.count.tolist() == [2, 2, 2, 1]
    assert curve.planned == 4
    assert len(over_seeds(cell, [], 2).step) == 0


def test_logs_have_gaps(tmp_path: Path) -> None:
    log(tmp_path, [(100, None, 1.0), (200, 5.0, 2.0), (300, 6.0, 3.0)])
    with (tmp_path / "progress.csv").open("a") as file:
        file.write("400,1,2,7")  # being written
    found = read_log(tmp_path, "return")
    assert (found.step.tolist(), found.value.tolist()) == ([200, 300], [5.0, 6.0])
    assert len(read_log(tmp_path / "none", "return").step) == 0


def test_time_left_by_hand(tmp_path: Path) -> None:
    # the first rows were fast (controllers only); of the last six, 100 steps take 2 s
    slow = [(100 + 100 * k, 4.0, 0.1 + 2.0 * k) for k in range(8)]
    log(tmp_path, slow)
    now = of_rows(tmp_path, 1000)
    assert (now.step, now.total, now.doing) == (800, 1000, "training")
    assert now.seconds_left == pytest.approx(4.0)
    assert line("vge-gait-0", now) == (
        "vge-gait-0", "training", "800 / 1,000", "4.0", "0.40", "25 %", "0:00:04",
    )  # fmt: skip
    assert of_rows(tmp_path, 800).doing == "evaluating"
    assert of_rows(tmp_path / "none", 1000) == Progress(0, 1000, {}, None)
    assert line("rl-0", Progress(0, 1000, {}, None))[1:] == (
        "starting", "0 / 1,000", "-", "-", "-", "-",
    )  # fmt: skip


def test_the_figure(half_done: Path) -> None:
    pytest.importorskip("matplotlib")
    config = parse_sweep(GIVEN)
    assert draw(config, half_done) == []  # nothing logged, no empty axes
    for seed in range(3):
        rows = [(100 * k, float(seed + k), float(k)) for k in range(1, 6 + 2 * seed)]
        log(half_done / "runs" / f"vge-gait-{seed}", rows)
    log(half_done / "runs" / "rl-0", [(100, 1.0, 1.0)])
    png, svg = draw(config, half_done)
    assert png.read_bytes().startswith(b"\x89PNG") and png.stat().st_size > 10_000
    before = svg.read_bytes()
    assert ET.fromstring(before).tag.endswith("svg")
    draw(config, half_done)
    assert svg.read_bytes() == before  # the same logs give the same file


def test_reports_at_any_time(half_done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = parse(Sweep, "dexctl sweep", [str(half_done), "--report-only"])
    assert command is not None
    assert command.run() == 1  # a run has failed
    said = capsys.readouterr()
    assert "1 of 4" in said.out
    assert "dexctl: runs/vge-igm-0 failed: training diverged: not finite" in said.err
    found = json.loads((half_done / "results.json").read_text())
    assert markdown_table(found) in (half_done / "table.md").read_text()
    assert found["machine"]["versions"]["mujoco"]
    assert found["settings"]["vge-gait"]["guidance"]["method"] == "vge"
    assert len((half_done / "results.csv").read_text().splitlines()) == 13
    command = parse(Sweep, "dexctl sweep", [str(half_done), "--report-only", "--json"])
    assert command is not None
    command.run()
    assert json.loads(capsys.readouterr().out) == json.loads(
        (half_done / "results.json").read_text()
    )
