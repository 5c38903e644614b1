"""Closing: fingers that do not feel the object go on towards it, so far and no further."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from dexctl.sim import BatchSimulator, Scene
from dexctl.state import GraspState
from hardware.closing import Closing
from hardware.log import read_log


@pytest.fixture(scope="module")
def settled() -> GraspState:
    with BatchSimulator(Scene.build("dex5", "cube"), disturbance=0.0) as sim:
        return sim.read()


def felt(state: GraspState, force: list[float]) -> GraspState:
    return replace(state, contact_force=np.array(force), in_contact=np.array(force) > 0)


def test_only_fingers_that_do_not_press_go_on_and_inwards(
    dex5: dexctl.HandModel, settled: GraspState
) -> None:
    closing = Closing(dex5, control_period=0.05)
    change = closing(felt(settled, [2.0, 0.0, 2.0, 1.0, 2.0]))
    still = dex5.moves[[0, 2, 4]].any(axis=0)
    assert not change[still].any()
    tips, there = dex5.fingertip_positions(settled.q), dex5.fingertip_positions(settled.q + change)
    middle = tips.mean(axis=0)
    for finger in (1, 3):
        inwards = (middle - tips[finger]) / np.linalg.norm(middle - tips[finger])
        moved = there[finger] - tips[finger]
        assert moved @ inwards == pytest.approx(0.001, rel=0.1)  # 20 mm/s for 50 ms
        assert np.linalg.norm(moved - (moved @ inwards) * inwards) < 0.0003
    assert not closing.done
    np.testing.assert_allclose(closing.travelled, [0, 0.001, 0, 0.001, 0])


def test_it_ends_where_all_press_or_have_gone_far_enough(
    dex5: dexctl.HandModel, settled: GraspState
) -> None:
    closing = Closing(dex5, control_period=0.05)
    assert not closing(felt(settled, [2.0] * 5)).any() and closing.done
    closing = Closing(dex5, control_period=0.05, travel=0.005)
    state = felt(settled, [2.0, 2.0, 2.0, 2.0, 0.0])
    steps = [closing(state) for _ in range(6)]
    assert all(step.any() for step in steps[:5]) and not steps[5].any() and closing.done
    np.testing.assert_allclose(closing.travelled, [0, 0, 0, 0, 0.005])


def test_a_finger_whose_sensor_is_silent_stays(dex5: dexctl.HandModel, settled: GraspState) -> None:
    closing, unfelt = Closing(dex5, control_period=0.05), np.arange(5) == 1
    change = closing(felt(settled, [2.0, 0.0, 0.0, 2.0, 2.0]), unfelt)
    assert not change[dex5.moves[1]].any() and change[dex5.moves[2]].any()
    assert not closing(felt(settled, [2.0, 0.0, 2.0, 2.0, 2.0]), unfelt).any() and closing.done


def test_bad_input(dex5: dexctl.HandModel, settled: GraspState) -> None:
    with pytest.raises(InvalidInput, match="travel is -1; expected"):
        Closing(dex5, control_period=0.05, travel=-1)
    with pytest.raises(InvalidInput, match="batch shape"):
        Closing(dex5, control_period=0.05)(settled[None] if settled.batch_shape == () else settled)


@pytest.mark.slow
def test_encoders_that_are_off_no_longer_leave_fingers_in_the_air(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seed 3: two fingers touched, nobody let the object go, and nothing ever turned."""
    words = ["--emulate", "--object", "cube", "--seconds", "2", "--seed", "3", "--json"]
    words += ["--joint-offset", "0.03", "--action-latency", "0.05", "--patience", "5"]
    assert main(["hardware", "run", "coordinated", *words, "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["outcome"] == "idle"
    ticks = read_log(tmp_path / "run.mcap").ticks
    first = int(np.flatnonzero(ticks["state"] == "run")[0])
    assert ticks["in_contact"][first].all()
