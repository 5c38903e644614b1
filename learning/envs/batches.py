"""Batches of states and of seeds, taken apart and put together by environment."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, GraspState


def merged(chosen: Bools, state: GraspState, other: GraspState) -> GraspState:
    """``state`` in the environments chosen ``(N,)``, ``other`` elsewhere."""
    if chosen.all():
        return state
    values = {}
    for field in fields(GraspState):
        if getattr(state, field.name) is None:  # an object that nothing tracks
            continue
        a, b = np.asarray(getattr(state, field.name)), np.asarray(getattr(other, field.name))
        values[field.name] = np.where(chosen.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
    return replace(state, **values)


def spread_seeds(seed: ArrayLike, count: int) -> np.ndarray:
    """The seed of each environment, ``(count,)`` of Python's integers, which do not overflow.

    Raises:
        InvalidInput: neither an integer nor one for each environment.
    """
    seeds = np.asarray(seed, object)
    whole = all(isinstance(one, (int, np.integer)) for one in seeds.flat)
    if not whole or seeds.shape not in ((), (count,)):
        raise InvalidInput(f"seed is {seed!r}; expected an integer, or {count} of them")
    numbers = np.array([int(one) for one in seeds.flat], object)
    return numbers[0] + np.arange(count).astype(object) if seeds.ndim == 0 else numbers


def random_seed() -> int:
    """One from the system's entropy."""
    return int(np.random.SeedSequence().generate_state(1)[0])
