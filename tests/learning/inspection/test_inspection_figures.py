"""Angles between actions and gait statistics, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from learning.config import TrainConfig
from learning.inspection import action_angle, gait_statistics
from learning.inspection.gait import runs, steady
from learning.inspection.report.training_plots import guide_title, learning_figure
from learning.inspection.rollout import _sum_of_last
from learning.inspection.training import TrainingLog
from learning.training.log import COLUMNS


def test_angles_by_hand() -> None:
    a = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [3, 0, 0], [1, 1, 0], [0, 0, 0]])
    b = np.array([[2.0, 0, 0], [0, 5, 0], [-1, 0, 0], [1, 1, 0], [0, 1, 1], [1, 0, 0]])
    angle = np.rad2deg(action_angle(a, b))
    assert angle[:5] == pytest.approx([0, 90, 180, 45, 60])
    assert np.isnan(angle[5])  # a zero action has no direction
    assert np.isnan(action_angle(np.zeros(3), np.zeros(3)))


def test_small_angles_are_exact() -> None:
    """The arc cosine would give 0 for angles below 1e-8."""
    angle = action_angle([1.0, 0.0], [1.0, 1e-10])
    assert angle == pytest.approx(1e-10, rel=1e-6)


def test_angles_of_some_joints() -> None:
    a, b = np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 4.0])
    assert action_angle(a, b, np.array([True, True, False])) == pytest.approx(np.pi / 2)
    assert action_angle(a, b, np.array([True, False, False])) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(action_angle(a, b, np.array([False, False, True])))
    with pytest.raises(InvalidInput, match=r"shapes \(3,\) and \(2,\)"):
        action_angle(a, b[:2])


def test_motions_are_sums_of_the_last_actions() -> None:
    actions = np.array([[1.0], [2.0], [4.0], [8.0]])
    found = _sum_of_last(actions, 2)
    assert np.isnan(found[0, 0]) and found[1:, 0].tolist() == [3.0, 6.0, 12.0]


def row(text: str) -> np.ndarray:
    return np.array([c == "#" for c in text])


def test_runs_and_chatter() -> None:
    assert runs(row(".##..#")) == [(1, 3), (5, 6)]
    assert runs(row("....")) == []
    clean, taken = steady(row("###.####..#...##"), 2)  # a gap of one, then a touch of one
    assert "".join(".#"[int(x)] for x in clean) == "########......##" and taken == 2
    clean, taken = steady(row(".###."), 2)  # nobody knows how long the ends are
    assert clean.tolist() == row(".###.").tolist() and taken == 0


def test_a_gait_by_hand() -> None:
    """Three fingers lift in turn for 4 rows of 0.05 s each, then 3 rows all touch; three rounds."""
    one = ["....#################", "#######....##########", "##############....###"]
    touch = np.stack([row(text * 6) for text in one], axis=1)[:, None]  # (T, 1, 3)
    gait = gait_statistics(touch, np.ones(touch.shape[:2], bool), 0.05)
    assert gait.seconds == pytest.approx(6.3)
    assert gait.duty == pytest.approx([17 / 21] * 3)
    assert gait.lifts.tolist() == [5, 6, 6]  # the first begins off
    assert gait.lift_rate == pytest.approx(np.array([5, 6, 6]) / 6.3)
    assert gait.stance == pytest.approx([17 * 0.05] * 3)
    assert gait.swing == pytest.approx([0.2] * 3)
    assert gait.contacts == pytest.approx([0, 0, 12 / 21, 9 / 21])
    assert gait.order.tolist() == [[0, 5, 0], [0, 0, 6], [5, 0, 0]]
    assert gait.steps_round == pytest.approx([0, 1, 0])
    assert gait.reference == 1
    assert gait.phase == pytest.approx([2 / 3, 0, 1 / 3])
    assert gait.regularity == pytest.approx([1, 1, 1])
    assert gait.cycles.tolist() == [5, 5, 5]
    assert gait.chatter.sum() == 0


def test_what_comes_after_a_drop_does_not_count() -> None:
    touch = np.zeros((10, 2, 2), bool)
    touch[:5] = True
    touch[:, 1, 0] = True
    held = np.zeros((10, 2), bool)
    held[:4, 0] = held[:8, 1] = True
    gait = gait_statistics(touch, held, 0.1)
    assert gait.seconds == pytest.approx(1.2)
    assert gait.lifts.tolist() == [0, 1]  # the lift of the first episode comes after its drop
    assert gait.duty == pytest.approx([1.0, 9 / 12])
    assert gait.contacts == pytest.approx([0, 3 / 12, 9 / 12])
    assert gait.reference == -1 and np.isnan(gait.phase).all()
    assert np.isnan(gait.swing).all()


def test_fingers_without_order_have_no_regular_phase() -> None:
    rng = np.random.default_rng(0)
    touch = np.ones((4000, 1, 2), bool)
    for start in range(10, 3960, 40):
        touch[start : start + 4, 0, 0] = False
        at = start + int(rng.integers(0, 36))
        touch[at : at + 4, 0, 1] = False
    gait = gait_statistics(touch, np.ones((4000, 1), bool), 0.05)
    assert gait.cycles[1] > 80
    assert gait.regularity[1] < 0.25
    assert gait.regularity[0] == pytest.approx(1.0)


def test_a_guide_is_told_with_its_objects() -> None:
    assert guide_title("cube,sphere=igm") == "cube, sphere: in-grasp manipulation"
    assert guide_title("coordinated") == "coordinated gait"


_CRITIC, _VALUE = "Critic loss", "Mean value of the policy's actions"
_HELD = "The policy's own episodes that would hold"


@pytest.mark.parametrize(
    ("kept", "titles"),
    [
        (("critic_loss", "q_mean", "held"), (_CRITIC, _VALUE)),
        (("critic_loss", "q_mean", "bc_loss"), (_CRITIC, _VALUE)),
        (("critic_loss", "held"), (_CRITIC, _HELD)),
        (("bc_loss", "held"), ("Cloning loss", _HELD)),
        ((), (_CRITIC, _VALUE)),
    ],
    ids=["sac", "sac cloned", "ppo", "dagger", "nothing yet"],
)
def test_the_last_panels_are_of_what_an_algorithm_has(
    kept: tuple[str, ...], titles: tuple[str, ...]
) -> None:
    """Those of a distilled policy were two empty ones about critics."""
    names = ("return", "rotation", "dropped", "length", *COLUMNS)
    empty = {name: np.full(3, np.nan) for name in names}
    log = TrainingLog(
        empty | {name: np.array([0.9, 0.5, 0.7]) for name in ("step", *kept)}, TrainConfig()
    )
    panels = learning_figure(log).axes
    assert tuple(one.get_title() for one in panels[4:6]) == titles
    assert [len(one.lines) for one in panels[4:6]] == ([1, 1] if kept else [0, 0])
    assert len(panels) == (7 if "bc_loss" in kept and "q_mean" in kept else 6)
