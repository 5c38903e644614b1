"""What makes the coordinated gait work: the gait with one ingredient taken away at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from common import (
    PALMS,
    Figure,
    Settings,
    outcome,
    percent_interval,
    progress,
    settings,
    trials,
    write,
)

import dexctl
from dexctl.gait import CoordinatedGait, CoordinatedGaitConfig
from dexctl.sim import Scene

OBJECTS = ("cube", "dodecahedron")
Change = Callable[[CoordinatedGaitConfig], CoordinatedGaitConfig]


def _igm(**changes: float) -> Change:
    return lambda config: replace(config, in_grasp=replace(config.in_grasp, **changes))


def _switch(**changes: float) -> Change:
    return lambda config: replace(config, switch=replace(config.switch, **changes))


def _gait(**changes: float) -> Change:
    return lambda config: replace(config, **changes)


VARIANTS: dict[str, tuple[str, Change]] = {
    "complete": ("the gait as it is", lambda config: config),
    "no_push_through_centre": ("fingers push along the normals only", _igm(friction=0.0)),
    "no_least_force": ("no least force of holding fingers", _igm(min_force=0.0)),
    "no_regulation": (
        "height, centring and tilt not regulated",
        _igm(height_gain=0.0, centring_gain=0.0, tilt_gain=0.0),
    ),
    "no_closing_in": ("fingers that lost touch do not close in", _igm(closing_speed=0.0)),
    "no_yielding": (
        "an unloading finger's set-point does not yield to the finger",
        _switch(yield_rate=1e-6),
    ),
    "no_unloading": (
        "a finger lifts at once, loaded",
        _switch(unload_time=1e-6, unloaded_force=1e3),
    ),
    "no_residual_guard": (
        "the wrench that the others leave does not count",
        _gait(residual_weight=0.0, residual_limit=1e6),
    ),
    "no_governor": (
        "the object does not wait for fingers near their end",
        _gait(most_travel=1e6, slow_down=1e-3),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 32
    """Per object, palm direction and variant."""
    seconds: float = 60.0
    """Simulated, each trial."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which."""


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load("dex5")
    scenes = [(name, palm, Scene.build(hand, name, palm)) for name in OBJECTS for palm in PALMS]
    rows, lines = [], []
    for variant in given.variants:
        text, change = VARIANTS[variant]
        cells = [text]
        for name, palm, scene in scenes:
            controller = CoordinatedGait(hand, change(CoordinatedGaitConfig()))
            trace = trials(controller, scene, given.seconds, given.trials, seed=given.seed)
            row = {"variant": variant, "object": name, "palm": palm, **outcome(trace)}
            rows.append(row)
            cells.append(
                f"{row['rotation_rad']['median']:.1f} rad, {percent_interval(row['holding'])}"
            )
        progress(f"{variant}: " + " | ".join(cells[1:]))
        lines.append(cells)
    figures: list[Figure] = []
    table = {
        "title": f"Coordinated gait with one ingredient taken away: median rotation in "
        f"{given.seconds:g} s, share still holding (95 % interval), {given.trials} trials each",
        "header": ["", *(f"{name}, palm {palm}" for name, palm, _ in scenes)],
        "rows": lines,
    }
    write("ablation", given, figures, [table], trials=rows)


if __name__ == "__main__":
    main()
