"""Set-points within range and speed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dexctl.exceptions import InvalidInput
from hardware.limits import Limits, limit_goal

LOWER, UPPER = np.array([-1.0, -1.0, -1.0, -1.0]), np.ones(4)


def test_by_hand() -> None:
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
def test_never_too_far_never_further_out(
    asked: np.ndarray, previous: np.ndarray, step: float
) -> None:
    goal = limit_goal(asked, previous, LOWER, UPPER, step).q_target
    assert np.isfinite(goal).all()
    assert (np.abs(goal - previous) <= step * (1 + 1e-9) + 1e-12).all()
    assert (goal <= np.maximum(UPPER, previous)).all()
    assert (goal >= np.minimum(LOWER, previous)).all()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"speed": 0.0}, "speed is 0.0"),
        ({"speed": 4.0}, "speed is 4.0; expected at most 3.0"),
        ({"torque": float("nan")}, "torque is nan"),
        ({"torque": float("inf")}, "torque is inf"),
        ({"voltage": (12.0, 10.0)}, "voltage is"),
        ({"command_age": -1.0}, "command_age is -1.0"),
    ],
)
def test_limits_cannot_be_switched_off(values: dict, said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        Limits(**values)
