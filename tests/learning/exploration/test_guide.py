"""Who acts, on environments of a few numbers."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from learning.exploration import GuidanceConfig, Guide, Guiding, commitment
from learning.exploration.config import check_controllers

HAND = dexctl.hands.load("dex5")
D = HAND.nq


class Counting:
    """A vector environment that counts: environment i's episodes have i + 2 steps.

    The observation is (steps in the episode, index of the environment). Episodes of even
    environments terminate, of odd ones are truncated. Resets in the same step.
    """

    render_mode = None

    def __init__(self, num_envs: int = 4) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (D,), np.float32)
        self.count = np.zeros(num_envs, int)

    @property
    def state(self) -> dexctl.GraspState:
        n, m = self.num_envs, HAND.n_fingers
        return dexctl.GraspState(
            q=np.zeros((n, D)),
            q_target=np.zeros((n, D)),
            in_contact=np.zeros((n, m), bool),
            contact_position=np.zeros((n, m, 3)),
            contact_normal=np.zeros((n, m, 3)),
            contact_force=np.zeros((n, m)),
            time=self.count.astype(float),
        )

    def change_to_action(self, change: np.ndarray) -> np.ndarray:
        return np.clip(change / 0.1, -1.0, 1.0)

    def observe(self) -> np.ndarray:
        return np.stack([self.count, np.arange(self.num_envs)], axis=1).astype(np.float32)

    def reset(self, seed: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.count[:] = 0
        return self.observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        assert actions.shape == (self.num_envs, D)
        self.count += 1
        index = np.arange(self.num_envs)
        done = self.count >= index + 2
        info = {
            "final_obs": self.observe(),
            "episode_return": self.count * 0.5,
            "episode_length": self.count.copy(),
        }
        self.count[done] = 0
        even = index % 2 == 0
        return self.observe(), np.full(self.num_envs, 0.5), done & even, done & ~even, info

    def close(self) -> None: ...


class Constant(Controller):
    """Asks for the same change in every joint, and counts what it is told."""

    def __init__(self, change: float, duration: float | None = None) -> None:
        super().__init__(HAND, control_period=0.05)
        self.change, self.calls = change, 0
        self.resets: list[Any] = []
        if duration is not None:
            self.config = type("Config", (), {"duration": duration})()

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        self.resets.append(mask)

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        self.calls += 1
        return np.full(state.q.shape, self.change)


def zeros(_rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
    return np.zeros(actions.shape[:2])


def learner(num_envs: int = 4) -> np.ndarray:
    return np.full((num_envs, D), 0.25, np.float32)


def prefer(candidate: int) -> Any:
    def values(_rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
        found = np.zeros(actions.shape[:2])
        found[candidate] = 1e3
        return found

    return values


def test_the_candidate_of_highest_value_acts() -> None:
    guides = [Constant(0.05), Constant(-0.05)]
    for candidate, action in ((0, 0.25), (1, 0.5), (2, -0.5)):
        guide = Guide(Counting(), guides, GuidanceConfig(method="vge", horizon=3), 0)
        found = guide.act(0, learner(), prefer(candidate))
        assert (found.actor == candidate).all() and found.action == pytest.approx(action)
        assert (found.guided == (candidate > 0)).all()
        assert guide.acted.tolist() == [4 * (candidate == i) for i in range(3)]


def test_the_critic_is_asked_where_a_choice_is_due() -> None:
    guide = Guide(Counting(), [Constant(0.05)], GuidanceConfig(method="vge", horizon=3), 0)
    asked = []

    def values(rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
        asked.append(rows.tolist())
        assert actions.shape == (2, len(rows), D)
        return np.zeros(actions.shape[:2])

    for step in range(4):
        guide.act(step, learner(), values)
        guide.after_step(np.array([step == 0, False, False, False]))
    assert asked == [[0, 1, 2, 3], [0], [1, 2, 3]]


@pytest.mark.parametrize("method", ["vge", "fge"])
def test_where_the_policy_is_alone_no_controller_acts(method: str) -> None:
    config = GuidanceConfig(method=method, horizon=2, alone=0.5, hard_stop=100)  # type: ignore[arg-type]
    guide = Guide(Counting(), [Constant(0.05)], config, 0)
    assert guide.alone.tolist() == guide.own(99).tolist() == [False, True, False, True]
    assert guide.own(100).all()
    for _ in range(3):
        found = guide.act(0, learner(), prefer(1))
        assert found.actor.tolist() == [1, 0, 1, 0] == found.guided.tolist()
        guide.after_step(np.zeros(4, bool))
    plain = Guide(Counting(), [Constant(0.05)], GuidanceConfig(method="rl+bc"), 0)
    assert plain.own(0).all()


def test_hard_stop() -> None:
    controller = Constant(0.05)
    guide = Guide(Counting(), [controller], GuidanceConfig(method="vge", hard_stop=10), 0)
    assert (guide.act(9, learner(), prefer(1)).actor == 1).all()
    assert controller.calls == 1
    found = guide.act(10, learner(), prefer(1))
    assert controller.calls == 1 and (found.actor == 0).all() and not found.guided.any()
    assert found.action == pytest.approx(0.25)


def test_fge_follows_its_schedule_whatever_the_values() -> None:
    config = GuidanceConfig(method="fge", horizon=1, hard_stop=1000, fixed_start=0.8)
    guide = Guide(Counting(2000), [Constant(0.05)], config, 0)
    for step, share in ((0, 0.8), (500, 0.4)):
        found = guide.act(step, learner(2000), prefer(0))
        assert (found.actor == 1).mean() == pytest.approx(share, abs=0.04)
        guide.after_step(np.zeros(2000, bool))


def test_rl_bc_labels_what_the_policy_visits() -> None:
    guide = Guide(Counting(), [Constant(0.05)], GuidanceConfig(method="rl+bc"), 0)
    found = guide.act(0, learner(), prefer(1))
    assert found.action == pytest.approx(0.25) and (found.actor == 0).all()
    assert found.guided.all() and found.label == pytest.approx(0.5)


def test_beta_falls_linearly_to_the_hard_stop() -> None:
    config = GuidanceConfig(method="vge+bc", beta=0.2, hard_stop=100)
    guide = Guide(Counting(), [Constant(0.05)], config, 0)
    assert [guide.beta(step) for step in (0, 50, 100, 200)] == pytest.approx([0.2, 0.1, 0, 0])
    config = GuidanceConfig(method="vge", beta=0.2)
    assert Guide(Counting(), [Constant(0.05)], config, 0).beta(0) == 0.0


def test_a_choice_holds_as_long_as_the_controllers_own_motion() -> None:
    own, other = Constant(0.05, duration=0.3), Constant(0.05)
    assert commitment(own) == 6 and commitment(other) is None
    make = controllers.make
    assert commitment(make("gait", HAND)) == 20 == commitment(make("switch", HAND))
    assert commitment(make("igm", HAND)) is None is commitment(make("coordinated", HAND))
    assert commitment(make("switch", HAND, kind="guarded")) is None
    guide = Guide(Counting(), [own], GuidanceConfig(method="vge"), 0)
    assert guide.lengths.tolist() == [6, 6]
    # it starts its motion anew at each choice, and nowhere else
    own.resets.clear()
    for step in range(7):
        guide.act(step, learner(), prefer(1))
        guide.after_step(np.zeros(4, bool))
    assert [mask.tolist() for mask in own.resets] == [[True] * 4, [True] * 4]


def test_the_end_of_an_episode_resets_the_controllers_there() -> None:
    controller = Constant(0.05)
    guide = Guide(Counting(), [controller], GuidanceConfig(method="vge"), 0)
    controller.resets.clear()
    guide.after_step(np.array([False, True, False, False]))
    assert [mask.tolist() for mask in controller.resets] == [[False, True, False, False]]


def test_one_environment_chooses_as_it_would_in_a_batch() -> None:
    def actors(num_envs: int, seed: int) -> np.ndarray:
        config = GuidanceConfig(method="vge", horizon=2)
        guide = Guide(Counting(num_envs), [Constant(0.05)], config, seed)
        found = []
        for step in range(20):
            found.append(guide.act(step, learner(num_envs), zeros).actor)
            guide.after_step(np.zeros(num_envs, bool))
        return np.stack(found)

    assert (actors(4, 5)[:, 2] == actors(1, 7)[:, 0]).all()


@pytest.mark.parametrize(("cloned", "labelled"), [("acted", 0), ("visited", 4)])
def test_states_that_the_policy_visits_are_labelled(cloned: Any, labelled: int) -> None:
    config = GuidanceConfig(method="vge+bc", cloned=cloned, horizon=2)
    guide = Guide(Counting(), [Constant(0.05)], config, 0)
    choice = guide.act(0, learner(), prefer(0))  # nobody else acts
    assert (choice.actor == 0).all() and (choice.action == 0.25).all()
    assert choice.guided.sum() == labelled
    if labelled:
        assert choice.label == pytest.approx(0.5)


def test_beta_falls_to_its_end() -> None:
    config = GuidanceConfig(method="vge+bc", beta=10, beta_end=2, beta_stop=100, hard_stop=1000)
    guide = Guide(Counting(), [Constant(0.0)], config, 0)
    assert [guide.beta(step) for step in (0, 50, 100, 5000)] == [10, 6, 2, 2]


def test_a_controller_that_gives_no_state_begins_anew_and_that_is_said() -> None:
    guide = Guide(Counting(), [Constant(0.0)], GuidanceConfig(), 0)
    guide.act(0, learner(), zeros)
    other = Guide(Counting(), [Constant(0.0)], GuidanceConfig(), 0)
    assert other.load_state_dict(guide.state_dict()) == [
        "Constant does not give its state: it begins anew"
    ]
    assert (other.segments.actor == guide.segments.actor).all()
    with pytest.raises(InvalidInput, match="has 1 controllers and 4 environments; this one has 2"):
        Guide(Counting(), [Constant(0.0)] * 2, GuidanceConfig(), 0).load_state_dict(
            guide.state_dict()
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "dagger"}, "unknown method 'dagger'; known: rl, rl\\+bc"),
        ({"horizon": 0}, "horizon is 0"),
        ({"fixed_start": 2}, "fixed_start is 2"),
        ({"cloned": "some"}, "'some'; known: None, acted, visited"),
        ({"cloning": "fast"}, "'fast'; known: likelihood, squared"),
        ({"cloning_weight": "heavy"}, "'heavy'; known: value, equal, better"),
        ({"method": "rl+bc", "cloned": "acted"}, "no controller acts"),
        ({"beta_stop": 0}, "beta_stop is 0"),
        ({"hard_stop": -1}, "hard_stop is -1"),
    ],
)
def test_bad_guidance(options: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=message):
        GuidanceConfig(**options)


def test_without_a_hard_stop_controllers_are_asked_to_the_end() -> None:
    config = GuidanceConfig(method="rl+bc", hard_stop=None, beta=0.3)
    guide = Guide(Counting(), [Constant(0.05)], config, 0)
    found = guide.act(10**9, learner(), zeros)
    assert guide.asks(10**9) and found.guided.all() and found.label == pytest.approx(0.5)
    assert guide.beta(10**9) == 0.3


WHERE = [[True, False, False, False], [True, True, False, True]]


def test_labels_are_of_the_first_that_guides_there() -> None:
    config = GuidanceConfig(method="rl+bc", hard_stop=None)
    guide = Guide(Counting(), [Constant(0.05), Constant(-0.05)], config, 0, WHERE)
    found = guide.act(0, learner(), zeros)
    assert found.guided.tolist() == [True, True, False, True]
    assert found.label[:, 0] == pytest.approx([0.5, -0.5, 0.25, -0.5])
    assert found.action == pytest.approx(0.25) and not found.actor.any()


@pytest.mark.parametrize("method", ["vge", "fge"])
def test_nobody_acts_where_it_does_not_guide(method: Any) -> None:
    config = GuidanceConfig(method=method, horizon=1, hard_stop=None)
    guides = [Constant(0.05), Constant(-0.05)]
    guide = Guide(Counting(), guides, config, 0, WHERE)
    actors = set()
    for step in range(100):
        found = guide.act(step, learner(), prefer(1))
        guide.after_step(np.zeros(4, bool))
        actors |= set(enumerate(found.actor.tolist()))
    if method == "vge":  # the others have values alike
        assert actors == {(0, 1), (1, 0), (1, 2), (2, 0), (3, 0), (3, 2)}
        assert guide.chances / 100 == pytest.approx([2.0, 1.0, 1.0])
    else:  # a share of 1 for those that are there
        assert actors == {(0, 1), (0, 2), (1, 2), (2, 0), (3, 2)}
        assert guide.chances / 100 == pytest.approx([1.0, 0.5, 2.5])


def test_where_fits_controllers_and_environments() -> None:
    with pytest.raises(InvalidInput, match=r"where has shape \(2, 3\); expected \(1, 4\)"):
        Guide(Counting(), [Constant(0.0)], GuidanceConfig(), 0, np.ones((2, 3), bool))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("gait", ("gait", ())),
        ("cube=dex5-easy", ("dex5-easy", ("cube",))),
        ("cube,l_shape=commanded:a,b", ("commanded:a,b", ("cube", "l_shape"))),
        ("commanded:a=b", ("commanded:a=b", ())),
        ("runs/a=b/policy.npz", ("runs/a=b/policy.npz", ())),
    ],
)
def test_who_guides_with_what(text: str, found: tuple[str, tuple[str, ...]]) -> None:
    assert Guiding.of(text) == found


def test_labels_by_several_need_an_object_each() -> None:
    check_controllers("rl+bc", ("cube=gait", "sphere,cylinder=igm"))
    for names in (("gait", "igm"), ("cube=gait", "igm"), ("cube=gait", "sphere,cube=igm")):
        with pytest.raises(InvalidInput, match="at once; it takes one, or one for each object"):
            check_controllers("rl+bc", names)


def test_a_guide_needs_controllers() -> None:
    with pytest.raises(InvalidInput, match="got no controllers"):
        Guide(Counting(), [], GuidanceConfig(method="vge"))
