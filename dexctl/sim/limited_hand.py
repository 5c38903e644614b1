"""LimitedHand: a simulated hand whose set-points take effect as late, slow and weak as real ones.

What a controller does in the simulator and on the servos can only be compared when both see the
same limits; those of the thesis's hand are `dexctl.limits.HandLimits.real`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.plant import Plant
from dexctl.state import Bools, Floats, GraspState


class LimitedHand:
    """A plant in front of another one that puts limits on its set-points.

    Reset the other one first, then call `restart`. Between whole control periods the two
    set-points about the latency are mixed, which delays a steady motion by just that much. The
    torque limit bounds how far set-points may lead the joints, which is exact for joints at rest.

    Args:
        plant: the simulated hand, or hands.
        limits: what they are, of every hand (see `set_limits`).
        stiffness: of the joints' servos, ``(d,)`` or one number [N m/rad] (`Scene.stiffness`);
            None leaves the torque to the plant's own limit.

    Attributes:
        hand, control_period: of the plant.
        limits: as given.
    """

    def __init__(
        self, plant: Plant, limits: HandLimits, stiffness: ArrayLike | None = None
    ) -> None:
        self.hand = plant.hand
        self.control_period = plant.control_period
        self.limits = limits
        self._plant = plant
        self._on_its_way: list[Floats] = []  # set-points of so many periods, the oldest first
        batch = plant.read().q.shape[:-1]
        self.set_limits(
            np.full(batch, _or_infinite(limits.speed_limit)),
            np.full(batch, _or_infinite(limits.torque_limit)),
            np.full(batch, limits.action_latency),
            stiffness,
        )
        self.restart()

    def set_limits(
        self, speed: Floats, torque: Floats, latency: Floats, stiffness: ArrayLike | None = None
    ) -> None:
        """Give each hand of a batch its own limits.

        Args:
            speed, torque, latency: ``(...)`` [rad/s], [N m], [s]; infinite: no limit.
            stiffness: of the joints' servos, ``(d,)``, ``(..., d)`` or one number [N m/rad]; None
                leaves the torque to the plant's own limit.
        """
        periods, part = np.divmod(np.asarray(latency) / self.control_period + 1e-9, 1.0)
        self._periods = periods.astype(int)
        self._part = np.where(part < 1e-6, 0.0, part)[..., None]
        self._step = (np.asarray(speed) * self.control_period)[..., None]
        self._lead: Floats | None = None
        if stiffness is not None:
            stiff = np.asarray(stiffness, float)
            whole = (*np.shape(speed), self.hand.nq)
            if stiff.shape not in ((), whole[-1:], whole) or not (
                np.isfinite(stiff).all() and (stiff > 0).all()
            ):
                raise InvalidInput(
                    f"stiffness is {stiffness}; expected N m/rad above 0, one or ({self.hand.nq},)"
                )
            if np.isfinite(torque).any():
                self._lead = np.asarray(torque)[..., None] / stiff
        missing = int(self._periods.max(initial=0)) + 1 - len(self._on_its_way)
        if missing > 0 and self._on_its_way:
            self._on_its_way = [self._on_its_way[0]] * missing + self._on_its_way

    def restart(self, mask: Bools | None = None) -> None:
        """Forget what is on its way (in the environments chosen); to be called after a reset."""
        now = self._plant.read().q_target
        if mask is None:
            self._sent = self._before = now.copy()
            self._on_its_way = [self._sent] * (int(self._periods.max(initial=0)) + 1)
            return
        rows = mask[:, None]
        self._sent = np.where(rows, now, self._sent)
        self._before = np.where(rows, now, self._before)
        self._on_its_way = [np.where(rows, now, one) for one in self._on_its_way]

    def read(self) -> GraspState:
        """The plant's state; ``q_target`` is what was sent last, though it may be on its way."""
        return replace(self._plant.read(), q_target=self._sent.copy())

    def write(self, q_target: ArrayLike) -> Floats:
        """Take set-points ``(..., d)`` [rad]; returns what the limits leave of them.

        Raises:
            InvalidInput: wrong shape, or not finite.
        """
        wanted = np.asarray(q_target, float)
        if wanted.shape != self._sent.shape or not np.isfinite(wanted).all():
            raise InvalidInput(
                f"q_target has shape {wanted.shape}; expected {self._sent.shape}, all finite"
            )
        if self._lead is not None:
            q = self._plant.read().q
            wanted = np.clip(wanted, q - self._lead, q + self._lead)
        slow = np.clip(wanted, self._before - self._step, self._before + self._step)
        self._sent = self.hand.clip(slow)
        return self._sent.copy()

    def step(self) -> None:
        """Let one control period pass: what was written ``action_latency`` ago takes effect."""
        sent = [*self._on_its_way, self._sent]
        self._on_its_way = sent[1:]
        self._plant.write(self._due(sent))
        self._before = self._sent
        self._plant.step()

    def _due(self, sent: list[Floats]) -> Floats:
        """What takes effect now, of the set-points up to this one."""
        newest = len(sent) - 1
        if not self._periods.any() and not self._part.any():
            return sent[newest]
        every = np.stack(sent)
        hands = np.ix_(*(range(n) for n in self._periods.shape))
        due = every[(newest - self._periods, *hands)]
        late = every[(newest - 1 - self._periods, *hands)]
        return (1.0 - self._part) * due + self._part * late

    def save(self) -> dict[str, Any]:
        """All that decides what is to come, to be given to `restore`."""
        return {
            "sent": self._sent.copy(),
            "before": self._before.copy(),
            "on_its_way": [one.copy() for one in self._on_its_way],
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
        self._sent, self._before = saved["sent"].copy(), saved["before"].copy()
        self._on_its_way = [one.copy() for one in saved["on_its_way"]]


def _or_infinite(limit: float | None) -> float:
    return np.inf if limit is None else limit
