"""What makes the coordinated gait work: the gait with one ingredient taken away at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

from measuring.settings import Settings, settings
from measuring.trials import PALMS, measure_in_scenes, trials

import dexctl
from dexctl.gait import CoordinatedGait, CoordinatedGaitConfig
from dexctl.sim import SceneConfig, Trace

SCENES = tuple(product(("cube", "dodecahedron"), PALMS))
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

    trials: int = 16
    """Per object, palm direction and variant."""
    seconds: float = 60.0
    """Simulated, each trial."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which."""


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load("dex5")

    def measure(variant: str, config: SceneConfig) -> Trace:
        controller = CoordinatedGait(hand, VARIANTS[variant][1](CoordinatedGaitConfig()))
        return trials(controller, config, given.seconds, given.trials, seed=given.seed)

    measure_in_scenes(
        "ablation",
        given,
        "variant",
        {name: text for name, (text, _) in VARIANTS.items()},
        given.variants,
        SCENES,
        "Coordinated gait with one ingredient taken away",
        measure,
    )


if __name__ == "__main__":
    main()
