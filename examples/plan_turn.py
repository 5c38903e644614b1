"""For planners and learners: a tree that turns an L all the way round, and where episodes start."""

from __future__ import annotations

import sys

import numpy as np

from dexctl.planning import Kinematic, grow, holding, path_states
from dexctl.sim import Scene


def main(until_rotation: float = 2 * np.pi) -> None:
    scene = Scene.build("dex5", "l_shape", "up")

    # Without physics, in seconds; the file is whole at any moment, and Ctrl-C keeps it.
    tree = grow(scene, Kinematic(), until_rotation=until_rotation, seed=0, path="tree.npz")
    (path,) = tree.paths(1)
    print(f"{len(tree)} grasps, turned by {tree.rotation.max():.2f} rad in {len(path) - 1} steps")

    # Which grasps of the best path does the simulation hold for two seconds?
    held = holding(scene, tree, path)
    print(f"hold in simulation: {held.sum()} of {len(path)}")

    # Grasps on its paths that hold: dexctl train --env.initial-states starts.npz
    starts = path_states(tree, 200, scene=scene)
    starts.save("starts.npz")
    print(f"{len(starts)} starts are in starts.npz")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
