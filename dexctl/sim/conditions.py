"""Conditions by name: sets of ranges and limits under which hands are tested."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.limits import REAL_LATENCY, REAL_SPEED, REAL_TORQUE
from dexctl.settings import changed
from dexctl.sim.scene_config import SceneConfig

_MOST_OFFSET = 0.05  # of an encoder [rad]
_NOISE: Mapping[str, Any] = {
    "joint_offset": _MOST_OFFSET / 3**0.5,  # as wide as uniform noise of as much each way
    "position_noise": 0.002,
    "normal_noise": 0.1,
    "force_noise": 0.5,
}
CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "nominal": {},
    "limits": {
        "speed_limit": REAL_SPEED,
        "torque_limit": REAL_TORQUE,
        "action_latency": REAL_LATENCY,
    },
    "everything": {
        "friction_range": (0.6, 1.4),
        "mass_range": (0.05, 0.25),
        "stiffness_range": (0.7, 1.3),
        "damping_range": (0.7, 1.3),
        **_NOISE,
        "action_latency": REAL_LATENCY,
    },
    "noise": _NOISE,
    "bounded": {"joint_offset": 0.0, "joint_offset_range": (-_MOST_OFFSET, _MOST_OFFSET)},
    "any-gravity": {"gravity_tilt": 3.141592653589793},
}
"""Settings of `SceneConfig` by name. "limits" are those of the hand in the thesis; "everything" is
what a real hand may be off by, drawn for each episode, and "noise" the part of it that sensors
have. Offsets of encoders are normal in both; behind either "bounded" draws them evenly."""


def under(config: SceneConfig, *conditions: str) -> SceneConfig:
    """``config`` under conditions, one after the other.

    Args:
        conditions: names of `CONDITIONS`, or toml files of settings of `SceneConfig`; several may
            be one text, with commas between.

    Raises:
        UnknownName: no such conditions, and no such file; or a file has no such setting.
        InvalidInput: the file is no toml or sets nothing, or a value is out of range.
    """
    every = [[one] if Path(one).expanduser().is_file() else one.split(",") for one in conditions]
    for name in (name for names in every for name in names):
        if name in CONDITIONS:
            config = changed(config, CONDITIONS[name])
            continue
        try:
            config = changed(config, _settings(name), name)
        except InvalidInput as error:
            said = str(error)
            raise InvalidInput(said if name in said else f"{name}: {said}") from None
    return config


def _settings(name: str) -> Mapping[str, Any]:
    path = Path(name).expanduser()
    if path.suffix.lower() != ".toml":
        raise UnknownName("conditions", name, [*CONDITIONS, "a .toml file"])
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path} is not TOML: {error}") from None
    if not found:  # what is then tested would be called by its name all the same
        raise InvalidInput(
            f"{path} sets nothing; expected settings such as mass_range = [0.05, 0.2]"
        )
    return found
