"""Perturbation: forces that pull at the object in changing directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexctl.state import Bools, Floats
from dexctl.streams import Streams, StreamsState
from dexctl.validation import check_numbers


@dataclass(frozen=True, kw_only=True)
class Push:
    """A force of constant size at the object's centre, each time in another direction.

    Directions are uniform on the sphere, a stream of them for each environment. The thesis gives
    the size of its perturbation forces (1 N, the weight of the object) and nothing else.

    Raises:
        InvalidInput: a number out of range.
    """

    push_force: float = 0.0
    """Size of the force that pulls at the object [N]."""
    push_seconds: float = 1.0
    """How long it pulls into one direction, rounded to control periods [s]."""

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("push_force",), positive=("push_seconds",))

    def __bool__(self) -> bool:
        return self.push_force > 0


class Pusher:
    """Keeps the forces on N objects up to date.

    Args:
        push: how they are pushed.
        streams: of the directions, ``(N,)``.
        control_period: [s].

    Attributes:
        size: of the forces, ``(N,)`` [N].
        force: now, ``(N, 3)`` [N], world frame.
    """

    def __init__(self, push: Push, streams: Streams, control_period: float) -> None:
        self._push, self.streams = push, streams
        self._every = max(round(push.push_seconds / control_period), 1)
        self.size = np.full(streams.batch_shape, push.push_force)
        self.force = np.zeros((*streams.batch_shape, 3))

    def __call__(self, step: np.ndarray) -> Floats:
        """The forces ``(N, 3)`` [N] of control steps ``step`` ``(N,)``, counted from the reset."""
        due: Bools = step % self._every == 0
        if due.any():
            direction = self.streams.normal((3,), due)
            length = np.sqrt((direction * direction).sum(axis=-1, keepdims=True))
            drawn = self.size[:, None] * direction / np.maximum(length, 1e-12)
            self.force = np.where(due[:, None], drawn, self.force)
        return self.force

    def save(self) -> dict[str, object]:
        """All that decides what is to come, to be given to `restore`."""
        return {"streams": self.streams.save()._asdict(), "force": self.force.copy()}

    def restore(self, saved: dict) -> None:
        """Go on from what `save` returned."""
        self.streams.restore(StreamsState(**saved["streams"]))
        self.force = saved["force"].copy()
