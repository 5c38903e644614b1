"""Controller, Superposition, and the checks that controllers share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

import dexctl
from dexctl import Controller, GraspState, HandModel, InvalidInput, Superposition
from dexctl.controller import check_action
from dexctl.state import Floats


class Constant(Controller):
    """Moves every joint by a step that each call doubles."""

    def __init__(self, hand: HandModel, step: float, **options: Any) -> None:
        super().__init__(hand, **options)
        self.step = self.start = step

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.step = self.start

    def act(self, state: GraspState) -> Floats:
        action = np.full_like(state.q, self.step)
        self._diagnostics = {"step": self.step}
        self.step *= 2
        return action


@pytest.fixture
def state(dex5: HandModel) -> GraspState:
    return GraspState(
        q=np.zeros((2, 15)),
        q_target=np.zeros((2, 15)),
        in_contact=np.zeros((2, 5), bool),
        contact_position=np.zeros((2, 5, 3)),
        contact_normal=np.zeros((2, 5, 3)),
        contact_force=np.zeros((2, 5)),
    )


def test_superposition_adds_and_resets_and_gathers(dex5: HandModel, state: GraspState) -> None:
    both = Superposition([Constant(dex5, 0.1), Constant(dex5, 1.0)])
    np.testing.assert_allclose(both.act(state), np.full((2, 15), 1.1))
    np.testing.assert_allclose(both.act(state), np.full((2, 15), 2.2))
    assert dict(both.diagnostics) == {"0.step": 0.2, "1.step": 2.0}
    both.reset()
    np.testing.assert_allclose(both.act(state), np.full((2, 15), 1.1))


def test_superposition_refuses_what_does_not_go_together(dex5: HandModel) -> None:
    with pytest.raises(InvalidInput, match="at least one"):
        Superposition([])
    with pytest.raises(InvalidInput, match="controller 1 has a control_period of 0.1 s; .* 0.05"):
        Superposition([Constant(dex5, 1), Constant(dex5, 1, control_period=0.1)])
    other = replace(dex5.config, joints=dex5.joint_names[::-1]).build()
    with pytest.raises(InvalidInput, match="controller 1 is for joints in the order 'f5_"):
        Superposition([Constant(dex5, 1), Constant(other, 1)])
    with pytest.raises(InvalidInput, match="controller 0 is 'igm'; expected a Controller"):
        Superposition(["igm"])  # type: ignore[list-item]
    Superposition([Constant(dex5, 1), Constant(dexctl.hands.load("dex5"), 1)])  # the same joints


@pytest.mark.parametrize("period", [0, -0.1, np.nan, np.inf])
def test_a_control_period_that_is_none_is_an_error(dex5: HandModel, period: float) -> None:
    with pytest.raises(InvalidInput, match="control_period is .*expected seconds above 0"):
        Constant(dex5, 1, control_period=period)


def test_diagnostics_are_for_reading(dex5: HandModel, state: GraspState) -> None:
    controller = Constant(dex5, 1)
    assert dict(controller.diagnostics) == {}
    controller.act(state)
    with pytest.raises(TypeError):
        controller.diagnostics["step"] = 3  # type: ignore[index]


def test_an_action_that_is_not_finite_names_the_environments() -> None:
    action = np.zeros((3, 15))
    assert check_action(action) is action
    action[1, 4] = np.nan
    with pytest.raises(InvalidInput, match=r"not finite in environments \[1\]"):
        check_action(action)
    with pytest.raises(InvalidInput, match="the state is not finite:"):
        check_action(action[1])


def test_controllers_must_have_both_methods(dex5: HandModel) -> None:
    class Half(Controller):
        def act(self, state: GraspState) -> Floats:
            return state.q

    with pytest.raises(TypeError, match="reset"):
        Half(dex5)  # type: ignore[abstract]
