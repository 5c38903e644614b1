"""CoordinatedGait: turns objects on the simulated hand, and never lets go of what it holds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from dexctl import GraspState, HandModel
from dexctl.exceptions import HandModelError, InvalidInput
from dexctl.gait import CoordinatedGait, CoordinatedGaitConfig
from dexctl.gait.selection import Grasps, choose, holds_without
from dexctl.grasp import is_force_closure
from dexctl.hand_config import HeldObject
from dexctl.igm import InGraspManipulationConfig
from dexctl.sim import BatchSimulator, Scene, SceneConfig, Sensing, Simulation
from dexctl.sim.trial import Trace, rotation_about, run
from dexctl.switch import GuardedSwitchConfig, Phase


def starts(phase: np.ndarray, wanted: int) -> np.ndarray:
    """(step, environment) of every time that ``wanted`` began."""
    return np.argwhere((phase[1:] == wanted) & (phase[:-1] != wanted)) + np.array([1, 0])


def trace(scene: Scene, seconds: float, count: int = 4, rate: float = 20.0, **settings) -> Trace:
    sim = BatchSimulator(scene, count, control_period=1 / rate, substeps=round(200 / rate))
    return run(CoordinatedGait(scene.hand, control_period=1 / rate, **settings), sim, seconds)


@pytest.fixture(scope="module")
def turned_cube(cube) -> Trace:
    return trace(cube, 12.0)


def test_turns_the_cube_and_holds_it(turned_cube):
    assert not turned_cube.dropped.any() and not turned_cube.diverged.any()
    assert (turned_cube.final_rotation > 1.0).all()
    phase = turned_cube.diagnostics["phase"]
    landed = starts(phase, Phase.LOAD)
    assert (np.bincount(landed[:, 1], minlength=4) >= 5).all()
    fingers = turned_cube.diagnostics["finger"][tuple(landed.T)]
    assert set(fingers.tolist()) == set(range(5))  # all take their turn


def test_the_rest_is_a_force_closure_whenever_a_finger_lifts(turned_cube):
    finger = turned_cube.diagnostics["finger"]
    lifts = starts(turned_cube.diagnostics["phase"], Phase.LIFT)
    assert len(lifts) >= 20
    for step, env in lifts:
        others = turned_cube.in_contact[step, env].copy()
        others[finger[step, env]] = False
        assert others.sum() >= 3
        assert is_force_closure(
            turned_cube.contact_position[step, env],
            turned_cube.contact_normal[step, env],
            others,
            turned_cube.object_position[step, env],
            CoordinatedGaitConfig().friction,
        )


@pytest.mark.parametrize("lost_after", [1.0, 100.0])
def test_a_finger_that_finds_nothing_is_put_down_anew(cube, lost_after):
    """Only after it has closed in for a while, and while the others hold."""
    sim = BatchSimulator(cube, 1)
    sim.reset(0)
    still = InGraspManipulationConfig(twist=(0.0, 0.0, 0.0, 0.0, 0.0, 1e-9))
    gait = CoordinatedGait(cube.hand, in_grasp=still, swing=0.0, lost_after=lost_after)
    begun = []
    for step in range(60):
        state = sim.read()
        blind = np.array(state.in_contact)
        blind[:, 3] = False
        sim.write(state.q_target + gait.act(replace(state, in_contact=blind)))
        sim.step()
        if gait.diagnostics["phase"][0] != Phase.IDLE:
            begun.append((step, int(gait.diagnostics["finger"][0])))
    if lost_after == 100.0:
        assert not begun
    else:
        assert begun[0][0] in (19, 20) and {finger for _, finger in begun} == {3}
    gait.reset()
    for _ in range(25):  # nothing holds: nothing is lifted
        gait.act(replace(sim.read(), in_contact=np.zeros((1, 5), bool)))
    assert gait.diagnostics["phase"][0] == Phase.IDLE


def test_one_finger_at_a_time(turned_cube):
    """Four of five hold on while one is on its way."""
    phase = turned_cube.diagnostics["phase"]
    swinging = (phase >= Phase.LIFT) & (phase <= Phase.PLACE)
    assert np.mean(turned_cube.in_contact[:-1].sum(axis=-1)[swinging] >= 4) > 0.95


def test_carried_fingers_do_not_knock_against_the_corners_of_a_cube() -> None:
    scene = Scene.build("dex5", "cube", "down")
    done = trace(scene, 40.0)
    step, env = np.nonzero(done.diagnostics["phase"] == Phase.CARRY)
    force = done.contact_force[step, env, done.diagnostics["finger"][step, env]]
    assert len(force) > 500
    assert (np.nan_to_num(force) > 0.3).mean() < 0.005  # 0.045 where they passed within reach


@pytest.mark.parametrize("follow", [True, False])
def test_fingers_land_clear_of_the_ones_behind_that_came_on_meanwhile(cylinder, follow) -> None:
    """A tip that comes down on another one touches no object, and is given up in the air."""
    done = trace(cylinder, 20.0, swing=1.2, follow=follow)  # as far back as there is room
    phase = done.diagnostics["phase"]
    assert len(starts(phase, Phase.LOAD)) > 35
    assert not ((phase[:-1] == Phase.PLACE) & (phase[1:] == Phase.IDLE)).any()


@pytest.mark.parametrize("follow", [True, False])
def test_landings_follow_the_object_only_where_they_are_to(cylinder, follow) -> None:
    state = BatchSimulator(cylinder, 1).read()
    gait = CoordinatedGait(cylinder.hand, least_travel=0.0, spacing=0.0, follow=follow)
    while gait.switch.phase.sum() != Phase.LIFT:
        gait.act(state)
        unloading = np.arange(5) == gait.switch.finger[0]
        state = replace(state, in_contact=state.in_contact & ~unloading)
    before = gait.switch.state_dict()["landing_tip"]
    gait.act(replace(state, object_position=state.object_position + np.array([0.0, 0.0, 0.004])))
    after = gait.switch.state_dict()["landing_tip"]
    np.testing.assert_allclose(after - before, [[0.0, 0.0, 0.004 * follow]], atol=1e-12)


def test_a_u_is_turned_past_the_gap_between_its_legs() -> None:
    done = trace(Scene.build("dex5", "u_shape", "up"), 30.0)
    assert not done.dropped.any() and (done.final_rotation > 2.0).all()


def test_turns_the_other_way_too(cylinder):
    back = InGraspManipulationConfig(twist=(0.0, 0.0, 0.0, 0.0, 0.0, -0.35))
    found = trace(cylinder, 8.0, in_grasp=back)
    assert not found.dropped.any() and (found.final_rotation < -0.7).all()


def test_an_untracked_object_is_turned_all_the_same(cylinder, loop):
    def untracked(state: GraspState) -> GraspState:
        return replace(state, object_position=None, object_quaternion=None)

    sim = BatchSimulator(cylinder, 4)
    poses = [sim.read().object_quaternion]

    def see(state: GraspState) -> GraspState:
        poses.append(state.object_quaternion)
        return untracked(state)

    found = loop(CoordinatedGait(cylinder.hand), sim, 200, see)
    away = np.linalg.norm(np.asarray(sim.read().object_position) - sim.start_position, axis=-1)
    assert (away < 0.05).all()
    assert (rotation_about(np.array(poses), np.array([0.0, 0.0, 1.0]))[-1] > 0.8).all()
    assert len(starts(found.of("phase"), Phase.LOAD)) >= 8


def test_twice_the_control_rate(cylinder):
    slow, fast = (trace(cylinder, 10.0, rate=rate) for rate in (20.0, 40.0))
    assert slow.held.all() and fast.held.all()
    np.testing.assert_allclose(fast.final_rotation, slow.final_rotation, rtol=0.2)
    counts = [len(starts(one.diagnostics["phase"], Phase.LOAD)) for one in (slow, fast)]
    assert abs(counts[0] - counts[1]) <= 0.35 * max(counts)


@pytest.mark.parametrize(
    "switch",
    [GuardedSwitchConfig(path="planned"), GuardedSwitchConfig(far_distance=1e-3)],
    ids=["planned", "inverse kinematics"],
)
def test_swings_through_joint_angles_land_too(cylinder, switch):
    found = trace(cylinder, 8.0, count=2, switch=switch)
    assert not found.dropped.any() and (found.final_rotation > 0.5).all()
    landed = starts(found.diagnostics["phase"], Phase.LOAD)
    assert len(landed) >= 4
    before = found.diagnostics["phase"][landed[:, 0] - 1, landed[:, 1]]
    assert (before == Phase.PLACE).all()


def test_no_finger_moves_where_the_others_would_not_hold(cube):
    """Without friction to count on, no four contacts of a cube are a closure."""
    found = trace(cube, 4.0, friction=1e-4)
    assert not found.diagnostics["phase"].any()
    assert not found.dropped.any()


def test_the_object_waits_where_no_finger_may_switch(cylinder):
    """It slows down before the furthest finger runs out of reach, and stops."""
    settings: dict[str, Any] = {"friction": 1e-6, "most_travel": 0.3, "slow_down": 0.2}
    found = trace(cylinder, 6.0, **settings)
    assert not found.diagnostics["phase"].any()
    angle = found.diagnostics["azimuth"]
    assert angle.max() < 0.3 + 0.03
    assert (found.diagnostics["pace"][-1] < 0.1).all()
    speed = np.diff(found.rotation[-40:], axis=0) / 0.05
    assert np.abs(speed.mean(axis=0)).max() < 0.02


def test_closure_lost_while_unloading_stops_the_lift(cube):
    """Four others hold when a finger starts to unload, and two when it is about to lift."""
    controller = CoordinatedGait(cube.hand, least_travel=0.0)
    state = BatchSimulator(cube, 3).read()
    controller.act(state)
    finger = controller.diagnostics["finger"]
    assert (controller.diagnostics["phase"] == Phase.UNLOAD).all()
    touch = np.zeros((3, 5), bool)
    for row, f in enumerate(finger):
        touch[row, [f, (f + 1) % 5, (f + 2) % 5]] = True
    lost = replace(state, in_contact=touch, contact_force=np.full((3, 5), 0.1))
    seen = set()
    for _ in range(30):
        controller.act(lost)
        seen |= set(controller.diagnostics["phase"].ravel().tolist())
    assert seen == {Phase.UNLOAD, Phase.LOAD, Phase.IDLE}


def test_the_finger_that_came_furthest_goes_first(cylinder):
    """And of those that have not come far enough, none."""
    state = BatchSimulator(cylinder, 2, disturbance=0.0).read()
    patient = CoordinatedGait(cylinder.hand, swing=0.0, least_travel=0.2, residual_weight=0.0)
    patient.act(state)
    assert not patient.diagnostics["phase"].any()
    q = state.q.copy()
    hand = cylinder.hand
    # finger 3 has gone further round than the others
    roll = np.flatnonzero(hand.moves[3])[0]
    base = hand.fingertip_positions(q[0])[3]
    step = hand.contact_jacobian(q[0], hand.fingertip_positions(q[0]))[3][:, roll]
    sign = np.sign(base[0] * step[1] - base[1] * step[0])
    q[1, roll] += sign * 0.35
    patient.act(replace(state, q=q, q_target=q))
    assert patient.diagnostics["finger"].tolist() == [-1, 3]
    assert patient.diagnostics["azimuth"][1].argmax() == 3


def test_few_fingers_turn_what_they_can(cylinder):
    """With three in touch none can be spared: in-grasp manipulation alone, no error."""
    controller = CoordinatedGait(cylinder.hand, least_travel=0.0)
    state = BatchSimulator(cylinder, 2).read()
    touch = np.array([[True, False, True, False, True]] * 2)
    for _ in range(20):
        action = controller.act(replace(state, in_contact=touch))
    assert action.any() and not controller.diagnostics["phase"].any()
    nothing = replace(state, in_contact=np.zeros((2, 5), bool))
    assert np.isfinite(controller.act(nothing)).all()


@pytest.mark.slow
def test_a_full_turn_of_the_cylinder(cylinder):
    found = trace(cylinder, 60.0, count=16)
    assert np.mean(found.final_rotation >= 2 * np.pi) >= 0.8


@pytest.mark.slow
def test_two_fingers_do_not_come_to_carry_all() -> None:
    """With a least force of 0.15 they did, and the dodecahedron fell at 378 s as one lifted."""
    with Simulation(SceneConfig(object=("dodecahedron",), gravity="down"), 1, 109) as sim:
        found = run(CoordinatedGait(sim.hand), sim, 400.0)
    away = np.linalg.norm(found.object_position - found.object_position[0], axis=-1)
    assert away.max() < 0.01


# -- settings -----------------------------------------------------------------------------------

POSITIVE = ("most_travel", "slow_down", "friction", "residual_limit")
NOT_NEGATIVE = (
    "swing",
    "least_travel",
    "cradle",
    "pause",
    "lost_after",
    "hold_force",
    "residual_weight",
)


@pytest.mark.parametrize("field", [*POSITIVE, *NOT_NEGATIVE])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, "far", None, True], ids=repr)
def test_settings_are_checked(dex5, field, value):
    settings: dict[str, Any] = {field: value}
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        CoordinatedGaitConfig(**settings)
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        CoordinatedGait(dex5, **{field: value})


@pytest.mark.parametrize("field", POSITIVE)
def test_zero_where_it_makes_no_sense(field):
    settings: dict[str, Any] = {field: 0.0}
    with pytest.raises(InvalidInput, match=f"^{field} is 0"):
        CoordinatedGaitConfig(**settings)


def test_a_gait_needs_a_rotation(dex5):
    still = InGraspManipulationConfig(twist=(0.01, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidInput, match="a gait needs a rotation"):
        CoordinatedGait(dex5, in_grasp=still)


def test_another_batch_shape_needs_a_reset(cylinder):
    controller = CoordinatedGait(cylinder.hand)
    state = BatchSimulator(cylinder, 3).read()
    controller.act(state)
    for other in (state[:2], state[0]):
        with pytest.raises(InvalidInput, match=r"call reset\(\) before the batch shape changes"):
            controller.act(other)
    controller.reset()
    assert controller.act(state[0]).shape == (15,)


@pytest.mark.parametrize(
    "field", ["q", "q_target", "object_position", "contact_position", "contact_force"]
)
def test_states_that_are_not_finite_are_refused(cylinder, field):
    controller = CoordinatedGait(cylinder.hand)
    state = BatchSimulator(cylinder, 3).read()
    controller.act(state)
    broken = np.array(getattr(state, field))
    broken[1] = np.nan
    with np.errstate(invalid="ignore"), pytest.raises(InvalidInput, match=r"not finite.*\[1"):
        controller.act(replace(state, **{field: broken}))


def test_an_object_that_has_fallen_out_of_sight_is_no_error(cube):
    """In a batch the others go on; palm down it falls 17 km in a minute."""
    sim = BatchSimulator(cube, 2)
    state = sim.read()
    far = state.object_position + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 17e3]])
    gone = replace(
        state, object_position=far, in_contact=state.in_contact & np.array([[True], [False]])
    )
    assert np.isfinite(CoordinatedGait(cube.hand).act(gone)).all()


def test_landings_make_up_for_the_height_by_which_a_finger_missed_the_centre(cube: Scene) -> None:
    sim = BatchSimulator(cube, 2)
    gait = CoordinatedGait(cube.hand, level=0.5, residual_weight=1.0)
    gait.act(sim.read())
    lever = np.zeros((2, 5, 3))
    lever[0, 1], lever[1, 3] = (0.03, 0.0, 0.01), (0.0, 0.03, 0.01)
    gait.switch.finger[:] = (1, 3)
    expected = np.zeros((2, 5))
    for height in (-0.005, -0.01, -0.015, -0.02, -0.02):  # half of what it missed, within limits
        gait._level(np.array([True, False]), lever, np.zeros(2))
        expected[0, 1] = height
        np.testing.assert_allclose(gait.state_dict()["met"]["height"], expected, atol=1e-15)
    # the next landing is that much lower
    state = sim.read()
    flat = (state.contact_position - state.object_centre()[:, None]) * [1.0, 1.0, 0.0]
    angle = np.where(np.arange(5) == 1, 0.6, 0.0) * np.ones((2, 1))
    grasps = Grasps(
        state.contact_position,
        state.contact_normal,
        state.in_contact,
        state.in_contact,
        np.asarray(state.object_position),
        gait.config.guarded(state),
    )
    gait.switch.clear(np.ones(2, bool))
    gait._wait[:] = 0.0
    gait._begin_and_aim(grasps, angle, flat, np.zeros(2))
    assert gait.switch.finger.tolist() == [1, 1]
    landing = gait.switch.state_dict()["landing_tip"]
    np.testing.assert_allclose((landing - grasps.origin)[:, 2], [-0.02, 0.0], atol=1e-12)


@pytest.mark.parametrize("palm", ["up", "down"])
def test_objects_that_nothing_tells_of_are_cradled(dex5: HandModel, palm: str) -> None:
    """Landings lie below the centre, seen from gravity, where normals are guessed."""
    sim = BatchSimulator(Scene.build(dex5, "cube", gravity=palm), 2)
    state = replace(sim.read(), object_position=None, object_quaternion=None)
    gravity = np.broadcast_to(sim.scene.gravity, (2, 3))
    below = {
        "guessed": replace(state, normals_felt=False, gravity=gravity),
        "one of them": replace(state, normals_felt=np.array([True, False]), gravity=gravity),
        "felt": replace(state, gravity=gravity),
        "gravity not known": replace(state, normals_felt=False, gravity=None),
        "tracked": replace(sim.read(), normals_felt=False, gravity=gravity),
    }
    sign = {"up": -1.0, "down": 1.0}[palm]
    expected = {"guessed": [0.01, 0.01], "one of them": [0.0, 0.01]}
    for name, seen in below.items():
        gait = CoordinatedGait(dex5, least_travel=0.0, residual_weight=0.0)
        gait.act(seen)
        begun = replace(seen, q=seen.q + 1e-3)  # some travel, so that a switch begins
        gait.act(begun)
        heights = gait.switch.state_dict()["landing_tip"] @ gait.axis
        middle = gait.switch.state_dict()["anchor"] @ gait.axis
        assert (gait.switch.phase == Phase.UNLOAD).all(), name
        np.testing.assert_allclose(
            heights - middle, sign * np.array(expected.get(name, [0.0, 0.0])), atol=1e-9
        )


def test_fingers_go_less_far_where_normals_are_guessed(cube: Scene) -> None:
    state = BatchSimulator(cube, 2).read()
    gait = CoordinatedGait(
        cube.hand, most_travel=0.4, unfelt_travel=0.1, slow_down=0.2, least_travel=9.0
    )
    for felt, pace in (
        (True, [1.0, 1.0]),
        (np.array([True, False]), [1.0, 0.5]),
        (False, [0.5] * 2),
    ):
        gait.reset()
        gait.act(replace(state, normals_felt=felt))
        np.testing.assert_allclose(gait.diagnostics["pace"], pace, atol=1e-12)


@pytest.mark.parametrize("travel", [0.0, np.nan])
def test_a_travel_that_is_none(dex5: HandModel, travel: float) -> None:
    with pytest.raises(InvalidInput, match="unfelt_travel"):
        CoordinatedGait(dex5, unfelt_travel=travel)
    with pytest.raises(HandModelError, match="object.travel is .*; expected radians above 0"):
        HeldObject(travel=travel)


@pytest.mark.parametrize("touch", ["binary", "joint-torque"])
def test_a_dodecahedron_does_not_slip_down_unseen(touch: Literal["binary", "joint-torque"]) -> None:
    """Its faces lean; with fingers at the height of their own middle it sank 10 mm in 9 s."""
    sensing = Sensing(touch=touch, object_pose="unknown")
    config = SceneConfig(object=("dodecahedron",), sensing=sensing)
    with Simulation(config, 8, 100) as sim:
        trace = run(CoordinatedGait(sim.hand), sim, 9.0)
    sunk = trace.object_position[0, :, 2] - trace.object_position[-1, :, 2]
    assert np.median(sunk) < 0.004
    assert (trace.final_rotation > 1.0).all()


def test_four_fingers_do_not_wait_for_a_thumb_that_the_others_could_spare(
    four_fingers: HandModel,
) -> None:
    """The grasp in which one trial in ten of a LEAP hand stood still for good."""
    around = np.radians([-72.0, -2.0, 52.0, -150.0])
    lever = np.stack([np.cos(around), np.sin(around), np.zeros(4)], axis=-1)
    touch = np.ones((1, 4), bool)
    contacts = (0.045 * lever[None], -lever[None], touch, touch, np.zeros((1, 3)))
    # the thumb has come all the way, the others have just been put back
    travel = np.array([[0.13, 0.07, 0.0, 0.58]])
    few = replace(four_fingers.config, description=four_fingers.path, object=HeldObject())
    config = CoordinatedGaitConfig.suiting(few.build())
    found = choose(
        Grasps(*contacts, np.array([config.friction])),
        travel,
        least_travel=config.least_travel,
        residual_weight=config.residual_weight,
        residual_limit=config.residual_limit,
        push_friction=config.in_grasp.friction,
    )
    assert found.found.all() and found.finger.tolist() == [3]


def test_the_next_best_finger_where_the_best_cannot_be_spared() -> None:
    """A cube on which the Allegro hand stood still: the thumb alone opposes two of the others."""
    around = np.array([-1.25, 0.58, 1.44, -2.4])
    normal = np.array([[-0.8, 0.6, 0.0], [-0.6, -0.8, 0.0], [-0.6, -0.8, 0.0], [0.6, 0.8, 0.0]])
    lever = 0.024 * np.stack([np.cos(around), np.sin(around), np.zeros(4)], axis=-1)
    touch = np.ones((1, 4), bool)
    grasps = Grasps(lever[None], normal[None], touch, touch, np.zeros((1, 3)), np.array([0.65]))

    def chosen(travel: list[float]) -> tuple[bool, int]:
        found = choose(
            grasps,
            np.array([travel]),
            least_travel=0.16,
            residual_weight=0.0,
            residual_limit=9.0,
            push_friction=0.2,
        )
        return bool(found.found[0]), int(found.finger[0])

    assert chosen([0.18, 0.59, 0.0, 0.82]) == (True, 1)
    assert not chosen([0.0, 0.0, 0.0, 0.82])[0]


def test_the_guard_is_bolder_where_the_weight_goes_into_the_hand(cylinder) -> None:
    down = np.array([[0, 0, -9.81], [0, 0, 9.81], [9.81, 0, 0], [0, -5.0, -5.0], [0, 0, 0]])
    state = replace(BatchSimulator(cylinder, 5).read(), gravity=down)
    config = CoordinatedGaitConfig(friction=0.6, resting_friction=0.8)
    half = 0.6 + 0.2 * np.sqrt(0.5)
    assert config.guarded(state) == pytest.approx(np.array([0.8, 0.6, 0.6, half, 0.6]))
    assert (config.guarded(replace(state, gravity=None)) == 0.6).all()
    assert (CoordinatedGaitConfig(friction=0.6).guarded(state) == 0.6).all()


@pytest.mark.parametrize("friction", [0.0, -1.0, np.nan, np.inf, "far", True], ids=repr)
def test_a_resting_friction_that_is_none(friction) -> None:
    with pytest.raises(InvalidInput, match="^resting_friction is .*expected"):
        CoordinatedGaitConfig(resting_friction=friction)


def test_a_finger_is_lifted_palm_up_that_is_not_palm_down() -> None:
    """The cube on which the Allegro hand stands still: the thumb opposes two of the others."""
    around = np.array([-1.25, 0.58, 1.44, -2.4])
    normal = np.array([[-0.8, 0.6, 0.0], [-0.6, -0.8, 0.0], [-0.6, -0.8, 0.0], [0.6, 0.8, 0.0]])
    lever = 0.024 * np.stack([np.cos(around), np.sin(around), np.zeros(4)], axis=-1)
    one = (np.tile(lever, (2, 1, 1)), np.tile(normal, (2, 1, 1)))
    touch = np.ones((2, 4), bool)
    grasps = Grasps(*one, touch, touch, np.zeros((2, 3)), np.array([0.65, 1.6]))
    assert holds_without(grasps, np.array([3, 3])).tolist() == [False, True]


def test_what_suits_a_hand(dex5: HandModel, four_fingers: HandModel) -> None:
    assert CoordinatedGaitConfig.suiting(dex5) == CoordinatedGaitConfig()
    config = replace(four_fingers.config, description=four_fingers.path)
    broad = CoordinatedGaitConfig.suiting(replace(config, finger_width=0.04).build())
    assert broad.spacing == pytest.approx(1.4 * 0.04)  # links are wider than fingertips
    few = CoordinatedGaitConfig.suiting(replace(config, object=HeldObject()).build())
    assert (few.swing, few.most_travel, few.level) == (0.25, 0.33, 0.5)
    far = HeldObject(reach=0.2, travel=0.6)  # measured, so it counts before what reach suggests
    measured = CoordinatedGaitConfig.suiting(replace(config, object=far).build())
    assert (measured.most_travel, measured.unfelt_travel) == pytest.approx((0.6, 0.22))
    close = HeldObject(reach=0.2)
    near = CoordinatedGaitConfig.suiting(replace(config, object=close).build())
    found = (near.swing, near.most_travel, near.least_travel, near.slow_down)
    assert found == pytest.approx((0.2, 0.22, 0.13, 0.07))
    assert near.in_grasp == few.in_grasp and near.switch == few.switch
