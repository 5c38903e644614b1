"""Where and why drops begin, on traces made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import hands
from dexctl.rotations import rotate
from learning.inspection.grasps import examine
from learning.inspection.onset import CAUSES, DropRule, Moments, find_drop

PERIOD, ROWS, ONSET, DROP, FINGERS = 0.05, 60, 40, 46, 5


def moments(**changes: np.ndarray) -> Moments:
    """A sound grasp of five fingers, dropped in row `DROP` for no reason."""
    sound = Moments(
        in_contact=np.ones((ROWS + 1, FINGERS), bool),
        closure=np.ones(ROWS + 1, bool),
        other_contact=np.zeros(ROWS + 1),
        tilt=np.zeros(ROWS + 1),
        slip=np.zeros((ROWS, FINGERS)),
        advance=np.zeros((ROWS, FINGERS)),
        at_limit=np.zeros((ROWS + 1, FINGERS), bool),
        held=np.arange(ROWS + 1) < DROP,
        diverged=np.zeros(ROWS + 1, bool),
    )
    return replace(sound, **changes)


def from_onset(value: float, width: int | None = None) -> np.ndarray:
    """``value`` in the rows after the onset, 0 up to it."""
    shape = (ROWS + 1,) if width is None else (ROWS + 1, width)
    out = np.zeros(shape)
    out[ONSET + 1 :] = value
    return out


def letting_go(finger: int = 2) -> dict[str, np.ndarray]:
    """Three fingers hold, and one of them is lost after the onset."""
    touch = np.ones((ROWS + 1, FINGERS), bool)
    touch[:, 3:] = False
    touch[ONSET + 1 :, finger] = False
    return {"in_contact": touch, "closure": ~from_onset(1.0).astype(bool)}


def before_onset(value: float, finger: int = 2, rows: int = 5) -> np.ndarray:
    """``value`` of a finger spread over the last rows before it lets go."""
    out = np.zeros((ROWS, FINGERS))
    out[ONSET + 1 - rows : ONSET + 1, finger] = value / rows
    return out


def limits(finger: int = 2) -> np.ndarray:
    out = np.zeros((ROWS + 1, FINGERS), bool)
    out[:, finger] = True
    return out


CASES = {
    "slipped": letting_go() | {"slip": before_onset(0.004)},
    "lifted": letting_go() | {"advance": before_onset(-0.004)},
    "out_of_reach": letting_go() | {"at_limit": limits()},
    "lost_touch": letting_go() | {"slip": before_onset(0.002), "advance": before_onset(0.01)},
    "no_closure": {"closure": ~from_onset(1.0).astype(bool)},
    "palm_or_link": {"other_contact": from_onset(0.3)},
    "tilted": {"tilt": from_onset(0.6)},
    "carried_off": {},
    "never_sound": {"closure": np.zeros(ROWS + 1, bool)},
    "broke_down": {"diverged": np.arange(ROWS + 1) >= DROP},
}


def test_every_cause_has_a_case() -> None:
    assert CASES.keys() == CAUSES.keys()


@pytest.mark.parametrize("cause", CASES)
def test_causes(cause: str) -> None:
    drop = find_drop(moments(**CASES[cause]), PERIOD, episode=7)
    assert drop is not None
    assert drop.cause == cause and drop.signs == ()
    assert drop.episode == 7 and drop.drop == DROP
    onset = {"carried_off": DROP - 1, "broke_down": DROP - 1, "never_sound": -1}.get(cause, ONSET)
    assert drop.onset == onset
    lost = cause in ("slipped", "lifted", "out_of_reach", "lost_touch")
    assert drop.fingers == ((2,) if lost else ())
    if lost:
        assert drop.contacts == 2 and not drop.closed
        assert drop.lead == pytest.approx((DROP - ONSET) * PERIOD)
        assert drop.to_dict()["fingers"] == [3]
        assert drop.to_dict()["onset_s"] == pytest.approx(2.0)


def test_no_drop() -> None:
    assert find_drop(moments(held=np.ones(ROWS + 1, bool)), PERIOD) is None


def test_several_causes_at_once() -> None:
    """The first of the rule is the cause, the others are signs."""
    both = letting_go() | {"slip": before_onset(0.004), "advance": before_onset(-0.01)}
    drop = find_drop(moments(**both, other_contact=from_onset(1.0)), PERIOD)
    assert drop is not None
    assert drop.cause == "palm_or_link" and drop.signs == ("lifted", "slipped")


def test_another_finger_does_not_matter() -> None:
    """What fingers did that kept touching, or what happened long before, is no reason."""
    other = letting_go() | {"slip": before_onset(0.02, finger=0), "at_limit": limits(1)}
    drop = find_drop(moments(**other), PERIOD)
    assert drop is not None and drop.cause == "lost_touch"
    early = np.zeros((ROWS, FINGERS))
    early[:30, 2] = 0.01
    drop = find_drop(moments(**letting_go() | {"slip": early}), PERIOD)
    assert drop is not None and drop.cause == "lost_touch"


def test_flickering_on_the_way_down_is_no_sound_spell() -> None:
    closure = ~from_onset(1.0).astype(bool)
    closure[ONSET + 3] = True
    drop = find_drop(moments(closure=closure), PERIOD)
    assert drop is not None and drop.onset == ONSET
    quick = find_drop(moments(closure=closure), PERIOD, DropRule(spell=0.05))
    assert quick is not None and quick.onset == ONSET + 3


@pytest.fixture(scope="module")
def turning():
    """A trace of two steps: hands that stand still, while someone turns the object by 0.02 rad."""
    from dexctl import controllers
    from dexctl.sim import BatchSimulator, Scene, run

    hand = hands.load("dex5")
    scene = Scene.build(hand, "cylinder", "up")
    with BatchSimulator(scene, 2, threads=1, disturbance=0.0) as sim:
        trace = run(controllers.make("hold", hand), sim, 0.1)
    still = {
        name: np.repeat(getattr(trace, name)[:1], 3, axis=0)
        for name in ("q", "q_target", "in_contact", "contact_position", "contact_normal",
                     "object_position", "object_quaternion")
    }  # fmt: skip
    turned = still["object_quaternion"].copy()
    half = 0.01
    turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    from dexctl.rotations import multiply

    turned[1:] = multiply(np.broadcast_to(turn, turned[1:].shape), turned[1:])
    return scene, replace(trace, **{**still, "object_quaternion": turned})


def test_slip_is_what_a_turning_object_does_under_still_fingers(turning) -> None:
    scene, trace = turning
    found = examine(trace, scene)
    arm = trace.contact_position[0] - trace.object_position[0][:, None]
    expected = 0.02 * np.hypot(arm[..., 0], arm[..., 1])  # a cylinder: all of it tangential
    assert found.slip[0] == pytest.approx(expected, rel=1e-3)
    assert found.slip[0].min() > 5e-4
    assert found.slip[1] == pytest.approx(np.zeros((2, 5)), abs=1e-12)
    assert found.advance == pytest.approx(np.zeros((2, 2, 5)), abs=1e-12)
    assert found.tilt == pytest.approx(np.zeros((3, 2)), abs=0.02)
    assert found.closure.all() and np.isnan(found.margin).all()
    assert not found.at_limit.any()


def test_a_carried_object_does_not_slip(turning) -> None:
    """Fingers that make the object's motion themselves do not slide; their set-points advance."""
    scene, trace = turning
    hand, q = scene.hand, trace.q.copy()
    move = np.array([0.001, 0.0, 0.0])
    jacobian = hand.contact_jacobian(q[0], trace.contact_position[0])
    change = np.zeros_like(q[0])
    for i in range(hand.n_fingers):
        own = jacobian[:, i]
        change += np.einsum("njk,k->nj", np.linalg.pinv(own), move)
    q[1:] += change
    position = trace.object_position.copy()
    position[1:] += move
    target = trace.q_target.copy()
    target[1:] += change
    quaternion = np.repeat(trace.object_quaternion[:1], 3, axis=0)
    carried = replace(
        trace, q=q, q_target=target, object_position=position, object_quaternion=quaternion
    )
    found = examine(carried, scene)
    assert found.slip == pytest.approx(np.zeros((2, 2, 5)), abs=2e-5)
    assert found.advance[0] == pytest.approx(trace.contact_normal[0] @ move, abs=2e-5)


def test_tilt_and_limits(turning) -> None:
    scene, trace = turning
    tilted = trace.object_quaternion.copy()
    upright = np.asarray(scene.settled.qpos[scene.object_qpos][3:])
    from dexctl.rotations import multiply

    lean = np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0])
    tilted[:] = multiply(
        np.broadcast_to(lean, tilted.shape), np.broadcast_to(upright, tilted.shape)
    )
    target = trace.q_target.copy()
    target[2, 0, scene.hand.finger_joints[3, 0]] = scene.hand.upper[scene.hand.finger_joints[3, 0]]
    found = examine(replace(trace, object_quaternion=tilted, q_target=target), scene)
    assert found.tilt == pytest.approx(np.full((3, 2), 0.6), abs=1e-6)
    assert found.at_limit[2, 0].tolist() == [False, False, False, True, False]
    assert not found.at_limit[:2].any()
    assert rotate(lean, np.array([0.0, 0, 1]))[2] == pytest.approx(np.cos(0.6))
