"""SettleFailure: what was tried where a hand does not hold an object, and what to change."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dexctl.exceptions import SimulationError
from dexctl.sim.checks import listed
from dexctl.sim.servo_gains import ringing
from dexctl.state import Bools, Floats

DIVERGED = "the simulation diverged"
"""Reason of an attempt in which it did."""
_TOUCHING = 0.002  # a fingertip this near to the object counts as touching it [m]
_INSIDE = -0.001  # deeper than soft contacts give way under a grip [m]


class SettleAttempt(NamedTuple):
    """One way of grasping that was tried.

    Attributes:
        how: where the fingers were to touch, for people.
        yaw: how far the object was turned about z [rad].
        reason: why it did not hold.
        gap: between each fingertip and the object when all were to touch, ``(m,)`` [m]; not a
            number where it did not come to that.
        qpos: hand and object then, ``(nq,)``, MuJoCo's order.
    """

    how: str
    yaw: float
    reason: str
    gap: Floats
    qpos: Floats


class SettleFailure(SimulationError):
    """The object does not stay in the hand, whatever was tried.

    Attributes:
        scene: the `Scene` of hand and object.
        attempts: what was tried, in order.
    """

    def __init__(self, scene: Any, attempts: tuple[SettleAttempt, ...]) -> None:
        self.scene = scene
        self.attempts = attempts
        first = attempts[0].reason if attempts else "nothing could be tried"
        width = f"width {scene.object_width:g} m, " if scene.object_width else ""
        super().__init__(
            f"{scene.hand.name} does not hold {scene.object!r} ({width}{scene.object_mass:g} kg) "
            f"at {np.round(scene.grasp_centre, 4).tolist()}: {first}; {self.advice}"
        )

    @property
    def reached(self) -> Bools:
        """Which fingertips came to touch in the `closest` attempt, ``(m,)``."""
        gap = np.full(self.scene.hand.n_fingers, np.nan)
        if self.closest is not None:
            gap = self.closest.gap
        return gap <= _TOUCHING

    @property
    def closest(self) -> SettleAttempt | None:
        """The attempt in which the most fingertips came to touch."""
        if not self.attempts:
            return None
        return min(
            self.attempts, key=lambda one: float(np.nan_to_num(_miss(one.gap), nan=1.0).sum())
        )

    @property
    def too_heavy(self) -> bool:
        """Whether the object weighs more than all fingers carry by friction, wherever it is."""
        return self._weight > self._carried

    @property
    def _weight(self) -> float:
        return self.scene.object_mass * float(np.linalg.norm(self.scene.gravity))

    @property
    def _carried(self) -> float:
        return self.scene.friction() * self.scene.grip * self.scene.hand.n_fingers

    @property
    def ringing(self) -> tuple[str, ...]:
        """Joints whose servos are hardly damped, or too stiff to be simulated."""
        scene = self.scene
        found = ringing(scene.model, scene.hand, scene.stiffness, scene.damping)
        return tuple(np.array(scene.hand.joint_names)[found].tolist())

    @property
    def advice(self) -> str:
        """What to change, in one line."""
        loose = self.ringing
        servos = (
            f"the servos of {listed(loose)} are hardly damped for their stiffness: say another "
            "damping or stiffness ([servos] in the hand's toml; `dexctl hands add` proposes them)"
        )
        if loose and any(one.reason == DIVERGED for one in self.attempts):
            return servos
        best = self.closest
        if best is None or np.isnan(best.gap).all():
            return "give another grasp_centre or open_q, or let Scene.suggest_grasp find them"
        names, miss = self.scene.hand.fingertip_names, _miss(best.gap)
        out = [f"{names[i]} by {1000 * miss[i]:.0f} mm" for i in np.flatnonzero(miss > 0)]
        if out:
            return (
                f"out of reach: {', '.join(out)}; move grasp_centre towards them, take another "
                "object_size, or let Scene.suggest_grasp find both"
            )
        deep = np.flatnonzero(best.gap < _INSIDE)  # it is too wide for the hand
        inside = [f"{names[i]} by {-1000 * best.gap[i]:.0f} mm" for i in deep]
        if inside:
            return (
                f"fingertips inside of it: {', '.join(inside)}; take a smaller object_size, or let "
                "Scene.suggest_grasp find one"
            )
        reasons = " ".join(one.reason for one in self.attempts)
        if "more of the hand" in reasons:
            return "a smaller object_size or a grasp_centre further from the palm keeps links clear"
        scene = self.scene
        if self.too_heavy:
            return (
                f"it weighs {self._weight:.1f} N, and {scene.hand.n_fingers} fingers pressing with "
                f"{scene.grip:g} N carry {self._carried:.1f} N by friction: less object_mass, or "
                "more grip"
            )
        if loose:
            return servos
        return (
            "every fingertip reaches it: a lighter object, more friction, another grip, or the "
            "grasp_centre and object_size of Scene.suggest_grasp may hold"
        )

    @property
    def details(self) -> str:
        """Every attempt, and how far each finger was from touching; several lines."""
        names = self.scene.hand.fingertip_names
        lines = []
        for one in self.attempts:
            lines.append(
                f"fingers {one.how}, object turned by {np.rad2deg(one.yaw):.0f} deg: {one.reason}"
            )
            if not np.isnan(one.gap).all():
                gaps = (
                    f"{name} {1000 * gap:+.1f}" for name, gap in zip(names, one.gap, strict=True)
                )
                lines.append(f"    from touching [mm]: {', '.join(gaps)}")
        return "\n".join(lines)


def _miss(gap: Floats) -> Floats:
    """How far fingertips are from touching ``(m,)`` [m]; 0 where they touch."""
    return np.where(gap > _TOUCHING, gap, 0.0 * gap)
