"""Limits of a servo hand: on by default, and never off."""

from __future__ import annotations

import pytest

from dexctl.exceptions import InvalidInput
from hardware.limits import Limits


def test_patience_by_hand() -> None:
    found = Limits().patient(5.0)
    assert (found.command_age, found.state_age, found.watchdog) == (0.5, 0.5, 0.5)
    assert found.overruns == (0.25, 1.0)
    assert (found.speed_limit, found.torque_limit) == (0.6, 0.5)
    for factor in (0.9, 11.0, float("nan")):
        with pytest.raises(InvalidInput, match=f"patience is {factor}; expected 1 to 10"):
            Limits().patient(factor)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"speed_limit": 0.0}, "speed_limit is 0.0"),
        ({"speed_limit": 4.0}, "speed_limit is 4.0; expected at most 3.0"),
        ({"torque_limit": float("nan")}, "torque_limit is nan"),
        ({"torque_limit": float("inf")}, "torque_limit is inf"),
        ({"torque_limit": None}, "torque_limit is None"),
        ({"voltage": (12.0, 10.0)}, "voltage is"),
        ({"overruns": (0.5, 0.2)}, "overruns is"),
        ({"command_age": -1.0}, "command_age is -1.0"),
        ({"command_age": 1e9}, "command_age is 1000000000.0; expected at most 10"),
        ({"state_age": 1e9}, "state_age is 1000000000.0; expected at most 10"),
        ({"temperature": 1e9}, "temperature is 1000000000.0; expected at most 100"),
        ({"voltage": (1e-9, 1e9)}, "voltage is .*; expected .* of 1 to 60 V"),
        # in the servo's register it would be 0, which is off
        ({"watchdog": 0.009}, "watchdog is 0.009; expected 0.02 s or more"),
        ({"watchdog": 3.0}, "watchdog is 3.0; expected at most 2.54"),
    ],
)
def test_limits_cannot_be_switched_off(values: dict, said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        Limits(**values)
