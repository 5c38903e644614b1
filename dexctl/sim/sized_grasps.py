"""SizedGrasps: the settled grasps of objects of several sizes, for episodes that draw a size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.sim.scene import Scene
from dexctl.sim.scene_config import SceneConfig
from dexctl.state import Floats


class SizedGrasps(NamedTuple):
    """Settled grasps of N environments' objects, at K sizes each.

    Attributes:
        sizes: factors, ``(K,)``.
        q, q_target: ``(N, K, d)`` [rad].
        position, quaternion: of the object, ``(N, K, 3)`` [m] and ``(N, K, 4)``.
    """

    sizes: Floats
    q: Floats
    q_target: Floats
    position: Floats
    quaternion: Floats

    @classmethod
    def find(cls, config: SceneConfig, groups: Sequence[tuple[Scene, int]]) -> SizedGrasps:
        """Settle every object at every size.

        Args:
            config: what the scenes are of; its randomisation has the sizes.
            groups: the scenes, each with its number of environments.

        Raises:
            InvalidInput: an object has no width to scale.
            SimulationError: the hand does not hold an object of some size.
        """
        sizes = config.randomisation.sizes
        rows = []
        for scene, count in groups:
            if len(sizes) > 1 and not scene.object_width:
                raise InvalidInput(
                    f"size_range is given and the object {scene.object!r} has no size; give "
                    "object_size, its width [m]"
                )
            found = [_settled(config, scene, float(size)) for size in sizes]
            rows += [[np.stack(part) for part in zip(*found, strict=True)]] * count
        return cls(sizes, *(np.stack(part) for part in zip(*rows, strict=True)))

    def of(self, size: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """q, q_target, position and quaternion ``(N, ...)`` at sizes ``(N,)`` of `sizes`."""
        k = np.abs(size[:, None] - self.sizes).argmin(axis=1)
        rows = np.arange(len(size))
        return tuple(part[rows, k] for part in self[1:])  # type: ignore[return-value]


def _settled(config: SceneConfig, scene: Scene, size: float) -> tuple[Floats, ...]:
    sized = scene
    if size != 1.0:
        one = replace(config, object=(scene.object,), object_size=size * scene.object_width)
        (sized,) = one.scenes(scene.hand)
        sized.hold_as(scene)
    grasp = sized.settled
    pose = grasp.qpos[sized.object_qpos]
    return grasp.qpos[sized.qpos_columns], grasp.q_target, pose[:3], pose[3:]
