"""Limits of set-points: what a hand makes of them, and what may be sent to one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits, limit_goal

LOWER, UPPER = np.array([-1.0, -1.0, -1.0, -1.0]), np.ones(4)


def test_goals_by_hand() -> None:
    found = limit_goal(
        np.array([0.012, 0.5, np.nan, 2.0]), np.array([0.0, 0.0, 0.3, 0.995]), LOWER, UPPER, 0.012
    )
    np.testing.assert_allclose(found.q_target, [0.012, 0.012, 0.3, 1.0])
    assert found.too_fast.tolist() == [False, True, False, False]
    assert found.out_of_range.tolist() == [False, False, False, True]
    assert found.not_finite.tolist() == [False, False, True, False]
    assert found.clamped.tolist() == [False, True, True, True]


@given(
    asked=arrays(float, 4, elements=st.floats(allow_nan=True, allow_infinity=True)),
    previous=arrays(float, 4, elements=st.floats(-1.5, 1.5)),
    step=st.floats(1e-4, 0.1),
)
def test_goals_never_too_far_never_further_out(
    asked: np.ndarray, previous: np.ndarray, step: float
) -> None:
    goal = limit_goal(asked, previous, LOWER, UPPER, step).q_target
    assert np.isfinite(goal).all()
    assert (np.abs(goal - previous) <= step * (1 + 1e-9) + 1e-12).all()
    assert (goal <= np.maximum(UPPER, previous)).all()
    assert (goal >= np.minimum(LOWER, previous)).all()


def test_limits_of_the_real_hand() -> None:
    assert HandLimits.real() == HandLimits(speed_limit=0.6, torque_limit=0.5, action_latency=0.05)
    assert not HandLimits()
    assert HandLimits(action_latency=0.05)
    assert HandLimits(speed_limit=0.6)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"speed_limit": 0.0}, "speed_limit is 0.0; expected a finite number above 0"),
        ({"speed_limit": "fast"}, "speed_limit is 'fast'"),
        ({"torque_limit": float("inf")}, "torque_limit is inf"),
        ({"torque_limit": True}, "torque_limit is True"),
        ({"action_latency": -0.1}, "action_latency is -0.1"),
        ({"action_latency": float("nan")}, "action_latency is nan"),
        ({"action_latency": None}, "action_latency is None"),
        ({"action_latency": 11.0}, "action_latency is 11.0; expected 0 to 10 s"),
    ],
)
def test_bad_limits(values: dict, said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        HandLimits(**values)
