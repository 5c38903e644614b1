"""AsReal: a simulated hand with the latency, speed and torque limits of the servo hand.

What a controller does in the simulator and on the servos can only be compared when both see the
same limits. The defaults are those of the hand in the thesis.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.limits import REAL_LATENCY, REAL_SPEED, REAL_TORQUE
from dexctl.plant import Plant
from dexctl.state import Floats, GraspState


class AsReal:
    """A plant in front of another one that makes its set-points late, slow and weak.

    Reset the other one first, then call `restart`.

    Args:
        plant: the simulated hand, or hands.
        speed: fastest set-point [rad/s]; None is no limit.
        latency: from a write to its effect [s]; between whole control periods the two set-points
            about it are mixed, which delays a steady motion by just that much.
        torque: largest joint torque [N m]; it bounds how far set-points may lead the joints, which
            is exact for joints at rest. None is no limit but the plant's own.
        stiffness: of the joints' servos, ``(d,)`` or one number [N m/rad] (`Scene.stiffness`);
            None leaves the torque to the plant's own limit.

    Attributes:
        hand, control_period: of the plant.
        latency: as given [s].
    """

    def __init__(
        self,
        plant: Plant,
        *,
        speed: float | None = REAL_SPEED,
        latency: float = REAL_LATENCY,
        torque: float | None = REAL_TORQUE,
        stiffness: ArrayLike | None = None,
    ) -> None:
        for name, value, unit in (("speed", speed, "rad/s"), ("torque", torque, "N m")):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InvalidInput(f"{name} is {value}; expected {unit} above 0")
        if not (np.isfinite(latency) and 0 <= latency <= 10):
            raise InvalidInput(f"latency is {latency}; expected 0 to 10 s")
        self.hand = plant.hand
        self.control_period = plant.control_period
        self.latency = latency
        self._periods, self._part = divmod(latency / plant.control_period + 1e-9, 1.0)
        self._plant = plant
        self._step = np.inf if speed is None else speed * plant.control_period
        self._lead: Floats | None = None
        if stiffness is not None:
            stiff = np.asarray(stiffness, float)
            if stiff.shape not in ((), (plant.hand.nq,)) or not (
                np.isfinite(stiff).all() and (stiff > 0).all()
            ):
                raise InvalidInput(
                    f"stiffness is {stiffness}; expected N m/rad above 0, one or ({plant.hand.nq},)"
                )
            if torque is not None:
                self._lead = np.broadcast_to(torque / stiff, (plant.hand.nq,))
        self.restart()

    def restart(self) -> None:
        """Forget what is on its way; call it after the plant was reset."""
        self._sent = self._before = self._plant.read().q_target.copy()
        self._on_its_way = deque([self._sent] * (int(self._periods) + 1))

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
        """Let one control period pass: what was written ``latency`` ago takes effect."""
        self._on_its_way.append(self._sent)
        late, part = self._on_its_way.popleft(), self._part
        due = self._on_its_way[0]
        self._plant.write(due if part < 1e-6 else (1.0 - part) * due + part * late)
        self._before = self._sent
        self._plant.step()
