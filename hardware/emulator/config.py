"""EmulatorConfig: which servos are emulated, and what they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dexctl.sim.scene_config import SceneConfig
from hardware.scene import HOLDING


@dataclass(frozen=True, kw_only=True)
class EmulatorConfig:
    """Emulated servos on a pseudo-terminal."""

    servos: int = 15
    """How many, for first-order joints; the MuJoCo hand brings its own number."""
    models: tuple[str, ...] = ("XM430-W210",)
    """Their models: one for all, or one for each."""
    baudrate: int | None = None
    """The only speed at which they hear [bit/s]; none: any, as a pseudo-terminal does."""
    ids: tuple[int, ...] | None = None
    """Their IDs; default 1 to n."""
    zeros: tuple[int, ...] | None = None
    """Ticks that each shows with its shaft at 0 rad; default 2048, half a turn."""
    signs: tuple[int, ...] | None = None
    """+1 or -1: which way each is mounted."""
    start: tuple[float, ...] | None = None
    """Where first-order joints start [rad]; default 0."""
    dynamics: Literal["first-order", "mujoco"] = "first-order"
    """What the servos move."""
    scene: SceneConfig = HOLDING
    """The hand in MuJoCo and what it holds, object "none" for nothing; of first-order joints only
    the action latency. Gains and limits are those that are written into the servos."""
    seed: int = 0
    """Of random faults and of the scene's random streams."""
    manual: bool = False
    """Time passes only when the side channel says so, so that a busy machine changes nothing."""
    fast: bool = True
    """Whether the servos know fast reads; older firmware does not."""
