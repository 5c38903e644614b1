"""Random streams: one per environment, drawn for all environments at once.

A batch of N environments must give each of them the numbers that it would get alone. numpy's
generators would need a Python loop over environments for that, so the streams are counter based:
number k of a stream is a hash (SplitMix64: Steele, Lea, Flood, "Fast splittable pseudorandom
number generators", 2014) of the stream's key and k. The whole state is two integers an
environment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.saved import check_names
from dexctl.validation import shown

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)


class StreamsState(NamedTuple):
    """All that decides the numbers to come: ``key`` and ``counter``, uint64 of batch shape."""

    key: NDArray[np.uint64]
    counter: NDArray[np.uint64]


def _wrapped(seed: ArrayLike) -> NDArray[np.uint64]:
    """Seeds as they count: modulo 2^64."""
    # as Python's integers, whose remainder is right for negative and for huge seeds
    seeds = np.asarray(seed, object)
    if not all(isinstance(one, (int, np.integer)) for one in seeds.flat):
        raise InvalidInput(f"seed is {seed!r}; expected an integer, or one for each environment")
    return np.array([int(one) % 2**64 for one in seeds.flat], np.uint64).reshape(seeds.shape)


def _mix(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * _MIX1
    z = (z ^ (z >> np.uint64(27))) * _MIX2
    return z ^ (z >> np.uint64(31))


class Streams:
    """Independent random streams, one per environment.

    Environment i of a batch seeded with the integer s draws what a single environment seeded
    with s + i draws.

    Args:
        seed: one integer, or one per environment (an array of the batch shape).
        batch_shape: ``()`` for one environment, ``(N,)`` for N.

    Raises:
        InvalidInput: a seed is no integer, or their number is not the batch's.
    """

    def __init__(self, seed: ArrayLike, batch_shape: tuple[int, ...] = ()) -> None:
        self.batch_shape = batch_shape
        self._key = self._keys(seed)
        self._counter = np.zeros(batch_shape, np.uint64)

    def _keys(self, seed: ArrayLike) -> NDArray[np.uint64]:
        seeds = _wrapped(seed)
        if seeds.shape not in ((), self.batch_shape):
            raise InvalidInput(
                f"seed is {seed!r}; expected an integer, or integers of shape {self.batch_shape}"
            )
        if seeds.ndim == 0:
            seeds = seeds + np.arange(int(np.prod(self.batch_shape)), dtype=np.uint64)
        # in one dimension, where numpy lets integers wrap without a warning
        return _mix(_mix(seeds.ravel() + _GOLDEN) + _GOLDEN).reshape(self.batch_shape)

    def reseed(self, seed: ArrayLike, mask: NDArray[np.bool_] | None = None) -> None:
        """Start the streams (of the environments in ``mask``) anew."""
        chosen = np.ones(self.batch_shape, bool) if mask is None else np.asarray(mask, bool)
        self._key = np.where(chosen, self._keys(seed), self._key)
        self._counter = np.where(chosen, np.uint64(0), self._counter)

    def uniform(
        self, shape: tuple[int, ...] = (), mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Numbers in [0, 1) of shape ``(*batch, *shape)``.

        Only the streams in ``mask`` move on; the numbers of the others are to be thrown away.
        """
        count = int(np.prod(shape))
        index = np.arange(1, count + 1, dtype=np.uint64)
        with np.errstate(over="ignore"):
            bits = _mix(self._key[..., None] + (self._counter[..., None] + index) * _GOLDEN)
            step = np.uint64(count)
            moved = self._counter + step
            self._counter = moved if mask is None else np.where(mask, moved, self._counter)
        fraction = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
        return fraction.reshape(self.batch_shape + shape)

    def normal(
        self, shape: tuple[int, ...] = (), mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Standard normal numbers of shape ``(*batch, *shape)`` (Box-Muller, two draws each)."""
        pair = self.uniform((*shape, 2), mask)
        radius = np.sqrt(-2.0 * np.log1p(-pair[..., 0]))
        return radius * np.cos(2.0 * np.pi * pair[..., 1])

    def save(self) -> StreamsState:
        """The state of the streams, to be given to :meth:`restore`."""
        return StreamsState(self._key.copy(), self._counter.copy())

    def restore(self, saved: StreamsState) -> None:
        """Continue from a saved state.

        Raises:
            InvalidInput: it is not of this batch shape.
        """
        for name, array in saved._asdict().items():
            if not isinstance(array, np.ndarray):
                raise InvalidInput(
                    f"the saved {name} of the random streams is {shown(array)}; expected an array"
                )
            if array.shape != self.batch_shape or array.dtype != np.uint64:
                raise InvalidInput(
                    f"the saved {name} of the random streams is of shape {array.shape} and "
                    f"kind {array.dtype}; expected {self.batch_shape} and uint64"
                )
        self._key, self._counter = saved.key.copy(), saved.counter.copy()


class LateStreams:
    """Streams of a batch whose shape shows at the first draw; a new shape starts them anew."""

    def __init__(self) -> None:
        self._seed: ArrayLike = 0
        self._streams: Streams | None = None

    def reset(self, seed: ArrayLike | None, mask: NDArray[np.bool_] | None = None) -> None:
        """Start the streams (of the environments in ``mask``) anew; None lets them go on."""
        if seed is None:
            return
        if mask is None:
            self._seed, self._streams = seed, None
        else:
            self.of(mask.shape).reseed(seed, mask)

    def of(self, batch_shape: tuple[int, ...]) -> Streams:
        """The streams of this batch shape."""
        if self._streams is None or self._streams.batch_shape != batch_shape:
            self._streams = Streams(self._seed, batch_shape)
        return self._streams

    def state_dict(self) -> dict[str, Any]:
        """All that decides the numbers to come; key and counter are None before the first draw."""
        drawn = None if self._streams is None else self._streams.save()
        key, counter = (None, None) if drawn is None else drawn
        return {"seed": _wrapped(self._seed), "key": key, "counter": counter}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is not of streams.
        """
        found = check_names("random streams", saved, ("seed", "key", "counter"))
        drawn: Any = found["key"], found["counter"]
        streams = None
        if any(part is not None for part in drawn):
            streams = Streams(0, getattr(drawn[0], "shape", ()))
            streams.restore(StreamsState(*drawn))
        self._seed, self._streams = _wrapped(found["seed"]), streams
