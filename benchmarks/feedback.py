"""What a policy has to feel: the same training with more or less in its observation.

The parts that the thesis holds out (chapter 3, observations on feedback), binary touch, as servo
hands have it, and what was observed a little earlier. Critics see the object in all of them, and
the guide sees everything.
"""

from __future__ import annotations

from learning_ablation import Ablation, Options, Variant
from measuring.settings import settings

POSITION, NORMAL, FORCE = "contact_position", "contact_normal", "contact_force"


def observing(title: str, *parts: str, history: tuple[int, ...] = ()) -> Variant:
    """The recipe `fast` with other parts of the observation."""
    return Variant(title, changes={"parts": ("q", *parts), "history": history})


VARIANTS = {
    "all": observing("joints, set-points, contacts", "q_target", POSITION, NORMAL, FORCE),
    "joints": observing("no contacts", "q_target"),
    "touch": observing("binary touch for contacts", "q_target", "touch"),
    "free": observing("no set-points", POSITION, NORMAL, FORCE),
    "no_force": observing("no set-points, no forces", POSITION, NORMAL),
    "no_position": observing("no set-points, no contact positions", NORMAL, FORCE),
    "no_normal": observing("no set-points, no normals", POSITION, FORCE),
    "normal": observing("joints and normals only", NORMAL),
    "joints_before": observing("no contacts, history of 1 and 4 steps", "q_target", history=(1, 4)),
    "touch_before": observing(
        "binary touch, history of 1 and 4 steps", "q_target", "touch", history=(1, 4)
    ),
}  # fmt: skip


def main() -> None:
    given = settings(Options, __doc__)
    Ablation("feedback", "The recipe `fast` with other feedback", VARIANTS).run(given)


if __name__ == "__main__":
    main()
