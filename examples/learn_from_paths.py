"""For learners: a sphere turned about x, from starts on the paths of a tree; judged from others.

Ten minutes of one core; the guides are used in the first two thirds of the steps.
"""

from __future__ import annotations

import sys
from pathlib import Path

from dexctl.planning import Kinematic, grow, path_states
from dexctl.settings import changed
from dexctl.sim import SceneConfig
from learning.config import recipe
from learning.evaluation import evaluate, open_subject
from learning.training.trainer import train


def main(steps: int = 600_000, nodes: int = 20_000, seconds: float = 60.0) -> None:
    settings = {"object": "sphere", "axis": "x", "controllers": ("gait", "igm"), "steps": steps}
    starts = {"start_from": "paths", "tree_nodes": nodes, "hard_stop": 2 * steps // 3}
    train(changed(recipe("fast", "vge"), settings | starts), Path("run"))

    # Starts that were held out: of a tree that was grown with another seed.
    (scene,) = SceneConfig(object=("sphere",)).scenes()
    tree = grow(scene, Kinematic(), nodes=nodes, axis=(1, 0, 0), seed=1)
    path_states(tree, 500, goals="even", scene=scene).save("held_out.npz")

    subject = open_subject("run")
    found = evaluate(subject, subject.protocol(initial_states="held_out.npz", seconds=seconds))
    turned = found.figures()["rotation_median_rad"]
    print(f"median {turned.value:.1f} ({turned.low:.1f} to {turned.high:.1f}) rad in {seconds:g} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
