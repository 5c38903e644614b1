"""The coordinated gait where sensing and physics are not what they were tuned with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from measuring.settings import Settings, settings
from measuring.trials import measure_in_scenes, trials
from numpy.typing import ArrayLike

import dexctl
from dexctl.controller import Controller
from dexctl.gait import CoordinatedGait
from dexctl.sim import SceneConfig, Sensing, Trace
from dexctl.state import Floats, GraspState


class Untracked(Controller):
    """A controller that is not told where the object is."""

    def __init__(self, controller: Controller) -> None:
        super().__init__(controller.hand, control_period=controller.control_period)
        self.controller = controller

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.controller.reset(seed, mask)

    def act(self, state: GraspState) -> Floats:
        return self.controller.act(replace(state, object_position=None, object_quaternion=None))


@dataclass(frozen=True)
class Condition:
    """How a trial differs from the standard ones.

    Attributes:
        text: for people.
        sensing: how the hand senses.
        parameters: of the physics, by name.
        tracked: whether the controller knows the object's pose.
    """

    text: str
    sensing: Sensing = field(default_factory=Sensing)
    parameters: dict[str, float] = field(default_factory=dict)
    tracked: bool = True


CONDITIONS: dict[str, Condition] = {
    "standard": Condition("standard (friction 1.0, 0.1 kg, exact touch)"),
    "position_1mm": Condition("contact position +-1 mm", Sensing(position_noise=0.001)),
    "position_2mm": Condition("contact position +-2 mm", Sensing(position_noise=0.002)),
    "position_3mm": Condition("contact position +-3 mm", Sensing(position_noise=0.003)),
    "normal": Condition("contact normal +-0.1 rad", Sensing(normal_noise=0.1)),
    "force": Condition("force +-0.5 N (20 % of the grip)", Sensing(force_noise=0.5)),
    "all_noise": Condition(
        "all three: 2 mm, 0.1 rad, 0.5 N",
        Sensing(position_noise=0.002, normal_noise=0.1, force_noise=0.5),
    ),
    "latency": Condition("sensors 0.05 s late", Sensing(sensor_latency=0.05)),
    "friction_0.6": Condition("friction 0.6", parameters={"friction": 0.6}),
    "friction_0.8": Condition("friction 0.8", parameters={"friction": 0.8}),
    "friction_1.2": Condition("friction 1.2", parameters={"friction": 1.2}),
    "mass_0.05": Condition("object of 0.05 kg", parameters={"object_mass": 0.05}),
    "mass_0.2": Condition("object of 0.2 kg", parameters={"object_mass": 0.2}),
    "untracked": Condition("object not tracked", tracked=False),
    "untracked_noise": Condition(
        "object not tracked, all three noises, 0.05 s late",
        Sensing(position_noise=0.002, normal_noise=0.1, force_noise=0.5, sensor_latency=0.05),
        tracked=False,
    ),
}
SCENES = (("cylinder", "up"), ("cube", "down"))


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 32
    """Per condition, object and palm direction."""
    seconds: float = 60.0
    """Simulated, each trial."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Which."""


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load("dex5")

    def measure(chosen: str, config: SceneConfig) -> Trace:
        condition, gait = CONDITIONS[chosen], CoordinatedGait(hand)
        return trials(
            gait if condition.tracked else Untracked(gait),
            replace(config, sensing=condition.sensing),
            given.seconds,
            given.trials,
            seed=given.seed,
            parameters=condition.parameters,
        )

    measure_in_scenes(
        "robustness",
        given,
        "condition",
        {name: condition.text for name, condition in CONDITIONS.items()},
        given.conditions,
        SCENES,
        "Coordinated gait under other conditions",
        measure,
    )


if __name__ == "__main__":
    main()
