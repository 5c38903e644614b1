"""The curriculum: hand-computed judgements, and its part in a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed, from_plain, to_plain
from learning.cli.train import Train
from learning.config import TrainConfig
from learning.training.curriculum import Curriculum, CurriculumConfig
from learning.training.log import read_rows
from learning.training.run_folder import RunFolder
from learning.training.trainer import resume, train

CONFIG = CurriculumConfig(
    level_start=0.2, level_step=0.1, level_steps=100, widen_above=0.8, narrow_below=0.2
)


def judged(curriculum: Curriculum, drops: int) -> float:
    """The level after 100 steps of the policy with so many drops, and as many that do not count."""
    own = np.array([True, False])
    for i in range(100):
        assert curriculum.add(own, np.array([i < drops, i < 50])) == (i == 99)
    return curriculum.level


def test_it_widens_where_the_policy_holds_and_narrows_where_it_does_not() -> None:
    curriculum = Curriculum(CONFIG, 20)
    assert curriculum.held is None and curriculum.level == 0.2
    assert judged(curriculum, 1) == pytest.approx(0.3)  # exp(-20 / 100) = 0.82
    assert curriculum.held == pytest.approx(np.exp(-0.2))
    assert judged(curriculum, 2) == pytest.approx(0.3)  # 0.67
    assert judged(curriculum, 9) == pytest.approx(0.2)  # 0.17
    assert judged(curriculum, 50) == pytest.approx(0.2)  # never below its start
    for _ in range(20):
        judged(curriculum, 0)
    assert curriculum.level == 1.0


def test_it_goes_on_from_what_was_saved() -> None:
    one, other = Curriculum(CONFIG, 20), Curriculum(CONFIG, 20)
    judged(one, 0)
    one.add(np.ones(60, bool), np.zeros(60, bool))
    other.restore(one.save())
    assert other.level == pytest.approx(0.3) and other.held == 1.0
    assert other.add(np.ones(40, bool), np.zeros(40, bool))


def test_without_a_curriculum_the_level_stays() -> None:
    curriculum = Curriculum(CurriculumConfig(level_steps=100), 20)
    assert judged(curriculum, 50) == 1.0 and curriculum.held == pytest.approx(np.exp(-10.0))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"level_start": 1.5}, "level_start is 1.5; expected a number from 0 to 1"),
        ({"level_step": 0.0}, "level_step is 0.0; expected a finite number above 0"),
        ({"widen_above": 0.1}, "narrow_below is 0.2 and widen_above 0.1"),
        (
            {"level_start": 0.0, "level_schedule": {"friction": (0.0, 0.5)}},
            "unknown range of level_schedule 'friction'; known: friction_range, tip_friction_",
        ),
        (
            {"level_start": 0.0, "level_schedule": {"gravity_tilt": (0.7, 0.5)}},
            r"level_schedule of gravity_tilt is \(0.7, 0.5\); expected two levels from 0 to 1",
        ),
        (
            {"level_start": 0.0, "level_schedule": {"gravity_tilt": (0.0, np.nan)}},
            "level_schedule of gravity_tilt is",
        ),
        (
            {"level_schedule": {"gravity_tilt": (0.0, 0.5)}},
            "level_schedule is of gravity_tilt and level_start 1; expected a level_start below 1",
        ),
    ],
)
def test_bad_settings(changes: dict[str, Any], text: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=text):
        CurriculumConfig(**changes)


def test_ranges_go_by_the_words_of_the_command_line_too() -> None:
    found = CurriculumConfig(level_start=0.0, level_schedule={"mass-range": (0.0, 0.5)})
    assert found.level_schedule == {"mass_range": (0.0, 0.5)}


def test_nothing_to_widen() -> None:
    with pytest.raises(InvalidInput, match="no ranges to widen"):
        TrainConfig(curriculum=CONFIG)
    settings = {"level_start": 0.0, "mass_range": (0.05, 0.2), "gravity_tilt": 1.0}
    changed(TrainConfig(), settings | {"level_schedule": {"mass_range": (0.0, 0.5)}})
    with pytest.raises(
        InvalidInput,
        match="names push_range, by which nothing is drawn; drawn: mass_range, gravity_tilt",
    ):
        changed(TrainConfig(), settings | {"level_schedule": {"push_range": (0.0, 0.5)}})


def test_in_a_run_it_sets_the_level_and_is_logged_and_resumed(
    tmp_path: Path, small: Callable[..., TrainConfig]
) -> None:
    config = small(  # nobody drops anything within two steps
        method="rl",
        mass_range=(0.05, 0.2),
        gravity_tilt=3.0,
        episode_steps=2,
        level_start=0.0,
        level_step=0.25,
        level_steps=8,
        log_every=4,
        steps=48,
    )
    train(config, tmp_path / "whole")
    train(replace(config, steps=20), tmp_path / "part")
    levels = [float(row["level"]) for row in read_rows(tmp_path / "whole" / "progress.csv")]
    assert levels[:8] == [0.0, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75, 1.0] and set(levels[8:]) == {1.0}
    resume(tmp_path / "part", 48)
    whole, part = (
        [(row["level"], row["held"]) for row in read_rows(tmp_path / name / "progress.csv")]
        for name in ("whole", "part")
    )
    assert part == whole


SCHEDULE = {"mass_range": (0.5, 1.0), "gravity_tilt": (0.0, 0.0)}


def test_each_range_of_a_run_has_its_schedule_and_a_resumed_one_goes_on_with_it(
    tmp_path: Path, small: Callable[..., TrainConfig]
) -> None:
    config = small(
        method="rl", mass_range=(0.05, 0.25), gravity_tilt=3.0, friction_range=(0.6, 1.4),
        level_start=0.75, level_steps=1000, level_schedule=SCHEDULE, steps=48,
    )  # fmt: skip
    train(config, tmp_path / "whole")
    train(replace(config, steps=20), tmp_path / "part")
    assert RunFolder(tmp_path / "part").config().curriculum.level_schedule == SCHEDULE
    resume(tmp_path / "part", 48)
    whole, part = (RunFolder(tmp_path / name).read_checkpoint() for name in ("whole", "part"))
    assert whole is not None and part is not None
    drawn = [one["env"]["simulation"]["randomiser"]["drawn"] for one in (whole, part)]
    for name, value in drawn[0].items():
        np.testing.assert_array_equal(drawn[1][name], value, name)
    # at 0.75: half of the mass's range, from 0.1 kg, three quarters of friction's, from 1
    assert 0.075 <= drawn[0]["object_mass"].min() < drawn[0]["object_mass"].max() <= 0.175
    assert 0.7 <= drawn[0]["friction"].min() < drawn[0]["friction"].max() <= 1.3


def test_a_run_from_before_there_were_schedules_goes_on(
    tmp_path: Path, small: Callable[..., TrainConfig]
) -> None:
    train(small(method="rl", mass_range=(0.05, 0.2), level_start=0.5, steps=20), tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    saved, values = folder.read_checkpoint(), folder.config_values()
    assert saved is not None
    for config in (saved["config"], values):
        del config["curriculum"]["level_schedule"]
    folder.config_path.write_text(json.dumps(values))
    folder.write_checkpoint(saved)
    assert resume(tmp_path / "run", 40)["steps"] == 40


def test_a_schedule_is_given_by_names() -> None:
    words = "--level-start 0 --env.mass-range 0.05,0.2 --env.gravity-tilt 3 --level-schedule"
    command = parse(Train, "dexctl train", [*words.split(), "mass_range=0.5,1", "gravity_tilt=0,0"])
    assert command is not None and command.config.curriculum.level_schedule == SCHEDULE
    plain = json.loads(json.dumps(to_plain(command.config)))
    assert from_plain(TrainConfig, plain) == command.config
