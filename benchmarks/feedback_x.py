"""What a policy has to feel to turn a cube about x, by pivoting it between fingers.

The thesis's observations on feedback (chapter 3) for its other axis, with and without set-points.
What guides about x drops the cube, so these trainings go on alone for most of their steps.
"""

from __future__ import annotations

from dataclasses import replace

from feedback import VARIANTS
from learning_ablation import Ablation, Options
from measuring.settings import settings
from starts import TASKS

_TASK = TASKS["cube_x"]
_WITHOUT = ("joints_before", "touch_before")


def main() -> None:
    given = settings(Options, __doc__)
    Ablation(
        "feedback_x",
        "Value guided exploration with other feedback",
        {
            name: replace(variant, method="vge")
            for name, variant in VARIANTS.items()
            if name not in _WITHOUT
        },
        {**_TASK.protocol, "controllers": _TASK.guides},
        _TASK.title,
        guided=0.4,
    ).run(given)


if __name__ == "__main__":
    main()
