"""How a benchmark has the object's pose known, by name: exactly, late and with noise, or felt."""

from __future__ import annotations

from typing import Any, Literal

Pose = Literal["tracked", "late", "touch", "odometry"]
LATE = {"tracker_latency": 0.1, "tracker_position_noise": 0.003, "tracker_rotation_noise": 0.05}
"""A tracker as a camera is one: 100 ms late, each pose 3 mm and 0.05 rad off."""


def by_tracker(late: float, place: float, turn: float) -> str:
    """What a tracker is like, for people: how late [s], and how far its poses are off [m, rad]."""
    return f"by a tracker {1e3 * late:g} ms late, {1e3 * place:g} mm, {turn:g} rad"


BY_LATE = by_tracker(*LATE.values())


def known(pose: Pose) -> dict[str, Any]:
    """Settings of the scene's sensing, beside those of a subject's own protocol."""
    return {"object_pose": "tracked", **LATE} if pose == "late" else {"object_pose": pose}
