"""Hands by name."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import HandModelError, UnknownName
from dexctl.hand import HandModel
from dexctl.hands import config, load, names


def test_an_unknown_hand_lists_the_known() -> None:
    with pytest.raises(UnknownName, match="unknown hand 'dex6'; known: dex5, .*wonik_allegro"):
        dexctl.hands.load("dex6")


@pytest.mark.parametrize("name", names())
def test_tomls_fit_their_hands(name: str, hand_of: Callable[[str], dexctl.HandModel]) -> None:
    known = config(name)
    assert known.name == name
    hand = hand_of(name)
    assert hand.name == name
    assert hand.config == known
    assert hand.fingertip_names == tuple(known.fingertips)
    for angles in (known.postures.open, known.postures.grasp):
        q = hand.posture(angles)  # knows all the names
        for joint, angle in angles.items():  # and does not have to clip
            assert q[hand.joint_names.index(joint)] == pytest.approx(angle, abs=1e-4), joint
    # the open hand can hold something there: its fingertips are around it
    opened = hand.posture(known.postures.open)
    assert known.object.centre is not None
    reach = np.linalg.norm(hand.fingertip_positions(opened) - known.object.centre, axis=-1)
    assert (reach < 0.15).all()
    assert known.object.size is not None and 0.02 < known.object.size < 0.2


def test_the_menagerie_folder_by_variable_and_by_argument(
    menagerie: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEXCTL_MENAGERIE", str(menagerie))
    by_variable = load("wonik_allegro")
    monkeypatch.setenv("DEXCTL_MENAGERIE", "nowhere")
    by_argument = load("wonik_allegro", folder=menagerie)
    assert by_variable.path == by_argument.path
    assert by_variable.nq == 16


def test_a_folder_without_the_hand_is_named(tmp_path: Path) -> None:
    with pytest.raises(HandModelError, match=r"wonik_allegro: .*right_hand\.xml is not there"):
        load("wonik_allegro", folder=tmp_path)


def test_without_folder_and_package_the_error_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("DEXCTL_MENAGERIE", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)  # as if it were not installed
    with pytest.raises(HandModelError, match="pip install.*DEXCTL_MENAGERIE"):
        load("wonik_allegro")


def test_dex5_fingers_are_one_finger_turned(dex5: HandModel) -> None:
    """Turning finger 1 about z by 72 degrees gives finger 2, and so on."""
    q = np.tile(np.array([0.3, 0.8, -1.1]), 5)
    tips = dex5.fingertip_positions(q)
    angle = 2 * np.pi / 5
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    np.testing.assert_allclose(np.roll(tips, -1, axis=0), tips @ turn.T, atol=1e-8)
