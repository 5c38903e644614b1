"""The simulator behind the environments, built from their configuration."""

from __future__ import annotations

import numpy as np

from dexctl import hands
from dexctl.exceptions import InvalidInput, UnknownName
from learning.envs.config import EnvConfig


def check_count(config: EnvConfig, num_envs: object) -> int:
    """The number of environments.

    Raises:
        InvalidInput: it is no whole number, or less than there are objects.
    """
    least = len(config.objects)
    if not isinstance(num_envs, (int, np.integer)) or isinstance(num_envs, bool):
        raise InvalidInput(f"num_envs is {num_envs!r}; expected a whole number")
    if num_envs < least:
        raise InvalidInput(
            f"num_envs is {num_envs}; expected at least {least}, one for each of "
            f"{', '.join(config.objects)}"
        )
    return int(num_envs)


def shares(count: int, kinds: int) -> list[int]:
    """``count`` split into ``kinds`` parts that differ by one at most, larger ones first."""
    least, more = divmod(count, kinds)
    return [least + (i < more) for i in range(kinds)]


def build_simulator(config: EnvConfig, num_envs: int, seed: int):
    """A `dexctl.sim.GroupedSimulator` of ``num_envs`` environments, one group for each object.

    Raises:
        UnknownName: no such object.
        SimulationError: the hand does not hold the object.
    """
    from dexctl.sim import GroupedSimulator, Scene, object_names

    for name in config.objects:
        if name not in object_names():
            raise UnknownName("object", name, object_names())
    hand = hands.load(config.hand)
    scenes = [
        Scene.build(
            hand,
            name,
            config.gravity,
            object_mass=config.object_mass,
            object_size=config.object_size,
        )
        for name in config.objects
    ]
    return GroupedSimulator(
        list(zip(scenes, shares(num_envs, len(scenes)), strict=True)),
        control_period=config.control_period,
        substeps=config.substeps,
        threads=config.threads,
        disturbance=config.disturbance,
        seed=np.asarray(seed, object) + np.arange(num_envs).astype(object),
    )
