"""Which of the suggested grasps `dexctl hands add` writes down, and the servos with it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.cli import hands_grasp
from dexctl.cli.hands_add import damped, stiffened
from dexctl.cli.hands_grasp import chosen, further, nearby
from dexctl.cli.hands_trials import Turned, Turning, turned
from dexctl.exceptions import InvalidInput
from dexctl.hand_config import HandConfig, ServoConfig
from dexctl.sim import Scene, SettleFailure, SuggestedGrasp
from dexctl.sim.grasp_score import GraspScore
from dexctl.sim.settle import settle

SCORE = GraspScore(
    total=0.9, margin=4.0, spare=1.0, balance=1.0, isotropy=0.5, dexterity=0.05, reach=1.0,
    swing=0.4, stiffness=300.0, clearance=0.01, fingers=4,
)  # fmt: skip


def grasp_of(hand: dexctl.HandModel, size: float, fingers: int = 4) -> SuggestedGrasp:
    q = np.zeros(hand.nq)
    names = hand.fingertip_names[:fingers]
    return SuggestedGrasp("cube", np.zeros(3), size, 0.0, q, q, names, SCORE, 10.0, 10.0)


def test_turns_count_as_far_as_they_are_held() -> None:
    found = Turned(
        held={"up": 1.0, "down": 0.5},
        rotation={"up": 2.0, "down": 1.0},
        clear={"up": 0.9, "down": 1.0},
        trials=6,
        seconds=20.0,
    )
    assert found.value == pytest.approx(0.81 * 2.0 + 0.5 * 0.25 * 1.0)
    assert found.note == (
        "the coordinated gait, 20 s each: palm up 2.0 rad, 6 of 6 hold; palm down 1.0 rad, 3 of 6 "
        "hold"
    )
    back = Turned({"up": 1.0}, {"up": -2.0}, {"up": 1.0}, trials=6, seconds=20.0)
    assert back.value == 0.0


def test_the_grasp_that_turns_furthest_is_chosen(
    dex5: dexctl.HandModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of five grasps, one of three fingers, two get past the screening; the first of them turns."""
    asked: list[tuple[float, tuple[str, ...], float]] = []
    counts: list[int] = []
    rotation = {0.04: 0.1, 0.05: 0.8, 0.06: 0.9, 0.07: 0.3}

    def trial(
        config: HandConfig,
        name: str,
        palms: tuple[str, ...],
        trials: int,
        seconds: float,
        seed: int,
    ) -> Turned:
        size = config.object.size
        assert size is not None
        asked.append((size, tuple(palms), seconds))
        counts.append(trials)
        held = 0.5 if size == 0.06 else 1.0
        turns = dict.fromkeys(palms, rotation[size] * seconds)
        shares = dict.fromkeys(palms, held if len(palms) > 1 else 1.0)
        return Turned(shares, turns, dict.fromkeys(palms, 1.0), trials, seconds)

    monkeypatch.setattr(hands_grasp, "turned", trial)
    monkeypatch.setattr(hands_grasp, "holds", lambda *_: True)
    grasps = [grasp_of(dex5, size) for size in rotation] + [grasp_of(dex5, 0.08, fingers=3)]
    how = Turning(rounds=0, finalists=2, screening=5.0, screening_trials=3, seconds=20.0)
    said: list[str] = []
    best, found = chosen(dex5, dex5.config, grasps, how, seed=0, say=said.append)
    for way in ("up", "down"):
        assert [one for one in asked if one[1] == (way,)] == [(s, (way,), 5.0) for s in rotation]
    final = [one for one in asked if one[1] == ("up", "down")]
    assert final == [(0.06, ("up", "down"), 20.0), (0.05, ("up", "down"), 20.0)]
    assert best.size == 0.05 and found is not None and found.held["down"] == 1.0
    assert counts == [3] * 8 + [16] * 2
    assert said[0].startswith("turning 4 grasps with the coordinated gait") and len(said) == 3
    # without trials, and where no grasp has a finger to spare, the first is taken
    for few, settings in ((grasps, replace(how, grasps=0)), (grasps[4:], how)):
        best, found = chosen(dex5, dex5.config, few, settings, seed=0, say=said.append)
        assert best is few[0] and found is None


def test_the_surroundings_of_those_turned_furthest_are_tried_too(
    dex5: dexctl.HandModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wider is better here, so that each round ends 20 mm on from where it began.

    What is far behind palm up is not tried palm down.
    """
    asked: list[tuple[float, float | None, int]] = []
    small: list[tuple[str, ...]] = []

    def trial(config: HandConfig, name: str, palms: tuple[str, ...], *rest: Any) -> Turned:
        size = config.object.size
        assert size is not None
        if size < 0.01:
            small.append(tuple(palms))
        one = dict.fromkeys(palms, 1.0)
        return Turned(one, dict.fromkeys(palms, size), one, 8, 9.0)

    def nearby(
        hand: dexctl.HandModel, grasp: SuggestedGrasp, *, size: float | None, seed: int, count: int
    ) -> list[SuggestedGrasp]:
        asked.append((round(grasp.size, 3), size, seed))
        assert count == 2
        return [grasp_of(hand, size) for size in (0.1 * grasp.size, grasp.size + 0.02)]

    monkeypatch.setattr(hands_grasp, "turned", trial)
    monkeypatch.setattr(hands_grasp, "holds", lambda *_: True)
    monkeypatch.setattr(hands_grasp, "nearby", nearby)
    grasps = [grasp_of(dex5, size) for size in (0.04, 0.06, 0.05)]
    how = Turning(rounds=2, around=2, finalists=1)
    best, found = chosen(dex5, dex5.config, grasps, how, 3, lambda _: None, 0.07)
    assert best.size == pytest.approx(0.10) and found is not None
    assert asked == [(0.06, 0.07, 4), (0.05, 0.07, 4), (0.08, 0.07, 5), (0.07, 0.07, 5)]
    assert small == [("up",)] * 4
    assert how.screened(3) == 2 * 12.0 * (3 + 2 * 4)


@pytest.mark.parametrize(
    ("keep", "taken", "tried"),
    [
        ((0.04, 0.05, 0.06), 0.06, (0.06, 0.05)),
        ((0.04, 0.05), 0.05, (0.05, 0.04)),  # the one turned furthest is let go of palm down
        ((0.04,), 0.04, (0.04,)),
        ((), 0.06, (0.06, 0.05)),  # none holds: the one turned furthest, and `check` says so
    ],
)
def test_what_plain_holding_drops_is_not_chosen(
    dex5: dexctl.HandModel,
    monkeypatch: pytest.MonkeyPatch,
    keep: tuple[float, ...],
    taken: float,
    tried: tuple[float, ...],
) -> None:
    asked: list[float] = []

    def trial(config: HandConfig, name: str, palms: tuple[str, ...], *rest: Any) -> Turned:
        size = config.object.size
        assert size is not None
        if len(palms) > 1:
            asked.append(size)
        return Turned(
            dict.fromkeys(palms, 1.0), dict.fromkeys(palms, size), dict.fromkeys(palms, 1.0), 8, 9.0
        )

    def holds(config: HandConfig, name: str, seed: int) -> bool:
        assert seed == 4  # not the one that `dexctl hands check` is given
        return config.object.size in keep

    monkeypatch.setattr(hands_grasp, "turned", trial)
    monkeypatch.setattr(hands_grasp, "holds", holds)
    grasps = [grasp_of(dex5, size) for size in (0.04, 0.05, 0.06)]
    how = Turning(rounds=0, finalists=2)
    best, found = chosen(dex5, dex5.config, grasps, how, seed=3, say=lambda _: None)
    assert best.size == taken and found is not None
    assert tuple(asked) == tried
    # without the gait, the first that holds
    best, found = chosen(
        dex5, dex5.config, grasps[::-1], replace(how, grasps=0), seed=3, say=lambda _: None
    )
    assert best.size == (max(keep) if keep else 0.06) and found is None


def test_nearby_grasps_are_in_the_surroundings(four_fingers: dexctl.HandModel) -> None:
    start = Scene.suggest_grasp(four_fingers, "sphere", count=1)[0]
    found = nearby(four_fingers, start, size=None, seed=1, count=2)
    assert 1 <= len(found) <= 2 and all(one.held_up and one.held_down for one in found)
    for one in found:
        assert 0 < np.linalg.norm(one.centre - start.centre) < 0.05
        assert one.size == pytest.approx(start.size, rel=0.4) and one.size != start.size
    asked = nearby(four_fingers, start, size=1.02 * start.size, seed=1, count=1)
    assert all(one.size == 1.02 * start.size for one in asked)
    away = start._replace(centre=start.centre + 5.0)
    assert nearby(four_fingers, away, size=None, seed=1, count=2) == []


def test_a_grasp_holds_as_the_check_of_a_hand_wants_it(dex5: dexctl.HandModel) -> None:
    assert hands_grasp.holds(dex5.config, "cube", seed=1)
    away = replace(dex5.config, object=replace(dex5.config.object, centre=(0.0, 0.0, 0.6)))
    assert not hands_grasp.holds(away, "cube", seed=1)


@pytest.mark.parametrize(
    ("rotation", "held", "taken"), [(1.2, 1.0, True), (1.05, 1.0, False), (1.4, 0.875, False)]
)
def test_longer_strides_are_written_where_the_gait_gains_by_them(
    dex5: dexctl.HandModel,
    monkeypatch: pytest.MonkeyPatch,
    rotation: float,
    held: float,
    taken: bool,
) -> None:
    """A tenth further, and no trial more dropped: 1.4 rad with a drop in eight are not."""
    usual = Turned({"up": 1.0}, {"up": 1.0}, {"up": 1.0}, trials=8, seconds=20.0)
    found = usual._replace(rotation={"up": rotation}, held={"up": held})
    asked: list[tuple[float | None, str, tuple[str, ...], int, float, int]] = []

    def trial(config: HandConfig, name: str, palms: tuple[str, ...], *rest: Any) -> Turned:
        asked.append((config.object.travel, name, palms, *rest))
        return found

    monkeypatch.setattr(hands_grasp, "turned", trial)
    config, made = further(dex5.config, "cube", usual, Turning(seconds=20.0), seed=3)
    assert asked == [(hands_grasp.FURTHER, "cube", ("up",), 16, 20.0, 3)]
    assert (config.object.travel, made) == (
        (hands_grasp.FURTHER, found) if taken else (None, usual)
    )


def test_trials_are_those_of_the_gait(dex5: dexctl.HandModel) -> None:
    found = turned(dex5.config, "cylinder", ("up",), trials=2, seconds=2.0, seed=0)
    assert found.held == {"up": 1.0}
    assert 0.1 < found.rotation["up"] < 2.0
    # what does not settle is held for no time
    away = replace(dex5.config, object=replace(dex5.config.object, centre=(0.0, 0.0, 0.6)))
    found = turned(away, "cube", ("down",), trials=1, seconds=1.0, seed=0)
    assert found.held == {"down": 0.0} and found.rotation == {"down": 0.0}


@pytest.mark.parametrize("changes", [{"trials": 0}, {"seconds": 0.0}, {"finalists": 0}])
def test_settings_that_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match=next(iter(changes))):
        Turning(**changes)  # pyright: ignore[reportArgumentType]


def test_servos_without_damping_are_damped(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    assert damped(dex5) == {}
    text = dex5.path.read_text()
    for old, new in (
        ('kv="0.15" forcerange="-0.5 0.5"', 'kv="0"'),
        ('damping="0.02" armature="0.002"', 'damping="0"'),
    ):
        assert len(re.findall(old, text)) == 1
        text = text.replace(old, new)
    path = tmp_path / "loose.xml"
    path.write_text(text)
    loose = replace(dex5.config, description=path).build()
    found = damped(loose)
    assert set(found) == set(dex5.joint_names)
    # twice the stiffness over the natural frequency, which is 8 Hz: the links are light
    assert found["f1_flexion2"] == pytest.approx(2 * 3 / (2 * np.pi * 8), rel=0.01)
    stiff = replace(loose.config, servos=ServoConfig(stiffness=1e6, damping=1.0)).build()
    assert set(damped(stiff)) == set(dex5.joint_names)  # runs away from the steps of 5 ms
    usual = Scene.build(dex5, "cube")
    grasp = usual.settled.qpos[usual.qpos_columns]
    with pytest.raises(SettleFailure, match="servos of f1_roll.* are hardly damped for their stif"):
        settle(Scene.build(stiff, "cube", grasp_q=grasp), thorough=False)
    tame = replace(loose.config, servos=ServoConfig(damping=found)).build()
    assert damped(tame) == {}
    settle(Scene.build(tame, "cube", grasp_q=grasp), thorough=False)


def test_joints_beside_others_that_yield_are_damped(tmp_path: Path) -> None:
    """Light links on critically damped servos: each stable by itself, in a finger they diverge."""
    link = '<geom type="capsule" size="0.008" fromto="0 0 0 0 0 {length}" mass="0.02"/>'
    finger = (
        '<body pos="{x} {y} 0"><joint name="roll{i}" axis="0 0 1" range="-0.6 0.6"/>{a}'
        '<body pos="0 0 0.03"><joint name="near{i}" axis="{axis}" range="-1 1.4"/>{b}'
        '<body name="tip{i}" pos="0 0 0.04"><joint name="far{i}" axis="{axis}" range="-1 1.4"/>{c}'
        "</body></body></body>"
    )
    bodies, servos = "", ""
    for i, turn in enumerate(2 * np.pi * np.arange(3) / 3):
        bodies += finger.format(
            i=i, x=0.05 * np.cos(turn), y=0.05 * np.sin(turn),
            axis=f"{-np.sin(turn)} {np.cos(turn)} 0", a=link.format(length=0.03),
            b=link.format(length=0.04), c=link.format(length=0.035),
        )  # fmt: skip
        servos += "".join(
            f'<position joint="{joint}{i}" kp="3" dampratio="1" forcerange="-1 1"/>'
            for joint in ("roll", "near", "far")
        )
    path = tmp_path / "light.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="palm">'
        f'<geom type="cylinder" size="0.05 0.01" mass="0.3"/>{bodies}</body></worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )
    hand = dexctl.HandModel.from_mjcf(path, {f"tip{i}": (0, 0, 0.035) for i in range(3)})
    found = damped(hand)
    assert set(found) == {f"{joint}{i}" for joint in ("roll", "far") for i in range(3)}
    mended = replace(hand.config, servos=ServoConfig(damping=found)).build()
    assert damped(mended) == {}


def test_servos_too_soft_to_press_are_stiffened(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    assert stiffened(dex5) == {}
    text = dex5.path.read_text()
    assert len(re.findall('kp="3"', text)) == 1
    path = tmp_path / "soft.xml"
    path.write_text(text.replace('kp="3"', 'kp="0.5"'))
    soft = replace(dex5.config, description=path).build()
    found = stiffened(soft)
    assert set(found) == set(dex5.joint_names)
    # 2 N at the fingertip with the set-point 0.1 rad ahead, by the longest lever of the joint
    tips = dex5.fingertip_positions(dex5.posture({}))
    lever = np.linalg.norm(dex5.contact_jacobian(dex5.posture({}), tips), axis=1).max(axis=0)
    assert list(found.values()) == pytest.approx((2.0 * lever / 0.1).tolist(), rel=0.01)
