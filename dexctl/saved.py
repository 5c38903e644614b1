"""Saved states: nested dictionaries of arrays and plain values, checked before they are loaded.

Whatever has a state that a run can be resumed from gives it as such a dictionary, so that a file
of it holds data only. An object names the arrays that it keeps; they say themselves what belongs
into a saved state, of which kind and shape.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput


def copies(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The arrays as a state to save: later changes of them do not show in it."""
    return {name: np.array(array) for name, array in arrays.items()}


def check_names(whose: str, saved: object, names: Iterable[str]) -> Mapping[str, Any]:
    """``saved``; InvalidInput where it is not a mapping of exactly these names."""
    found = list(saved) if isinstance(saved, Mapping) else []
    wanted = list(names)
    if not isinstance(saved, Mapping) or sorted(map(str, found)) != sorted(wanted):
        raise InvalidInput(
            f"the saved state of {whose} holds {', '.join(map(str, found)) or 'nothing'}; expected "
            f"{', '.join(wanted) or 'nothing'}"
        )
    return saved


def batch_shape(whose: str, saved: object, name: str) -> tuple[int, ...]:
    """``()`` or ``(N,)``, the shape of the array ``name``, which has one number for each hand."""
    array = saved.get(name) if isinstance(saved, Mapping) else None
    if not isinstance(array, np.ndarray) or array.ndim > 1:
        raise InvalidInput(f"the saved state of {whose} lacks {name}, one number for each hand")
    return array.shape


def fill(whose: str, arrays: Mapping[str, np.ndarray], saved: Mapping[str, Any]) -> None:
    """Copy saved arrays into ``arrays``; what else ``saved`` holds is the caller's.

    Raises:
        InvalidInput: one is missing or has another kind or shape; then nothing has been copied.
    """
    for name, array in arrays.items():
        found = saved.get(name)
        if not isinstance(found, np.ndarray):
            raise InvalidInput(f"the saved state of {whose} lacks the array {name}")
        if found.shape != array.shape or found.dtype.kind != array.dtype.kind:
            raise InvalidInput(
                f"{name} in the saved state of {whose} is {found.dtype} of shape {found.shape}; "
                f"expected {array.dtype} of shape {array.shape}"
            )
    for name, array in arrays.items():
        array[...] = saved[name]
