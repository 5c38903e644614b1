"""Contacts between links that lie inside each other by construction."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.hand import HandModel, random_configurations
from dexctl.sim.hand_joints import HandJoints

_POSTURES = 20  # in which links must overlap to be excluded


def exclude_neighbours(
    spec: mujoco.MjSpec, model: mujoco.MjModel, hand: HandModel, notes: list[str]
) -> None:
    """Exclude contacts that a URDF cannot exclude by itself.

    Links that one joint connects never collide with each other; neither do links that overlap
    wherever the hand's joints are (in its middle posture and in random ones).
    """
    solid = [b for b in range(model.nbody) if _touches(model, b)]
    group, above = model.body_weldid, model.body_parentid
    pairs = set()
    for a in solid:
        for b in solid:
            if group[a] == group[above[group[b]]] and group[a] != group[b]:
                pairs.add((min(a, b), max(a, b)))
    adjacent = len(pairs)
    pairs |= _always_touching(model, hand) - pairs
    for a, b in sorted(pairs):
        spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)
    if len(pairs) > adjacent:
        notes.append(
            f"{len(pairs) - adjacent} more pairs of links overlap in every posture: their "
            "contacts are excluded"
        )


def _touches(model: mujoco.MjModel, body: int) -> bool:
    own = model.geom_bodyid == body
    return bool((model.geom_contype[own] | model.geom_conaffinity[own]).any())


def _always_touching(model: mujoco.MjModel, hand: HandModel) -> set[tuple[int, int]]:
    data, joints = mujoco.MjData(model), HandJoints(model, hand)
    postures = [hand.posture({}), *random_configurations(hand, _POSTURES - 1, seed=0)]
    found: set[tuple[int, int]] | None = None
    for q in postures:
        joints.place(data, q)
        mujoco.mj_fwdPosition(model, data)
        bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        touching = {(int(a), int(b)) for a, b in bodies}
        found = touching if found is None else found & touching
    return found or set()
