"""Contacts between links that lie inside each other by construction."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.description import root_tag
from dexctl.hand import HandModel, random_configurations
from dexctl.sim.checks import listed
from dexctl.sim.hand_joints import HandJoints

_POSTURES = 20  # in which links must overlap to be excluded


def exclude_neighbours(
    spec: mujoco.MjSpec, model: mujoco.MjModel, hand: HandModel, notes: list[str]
) -> None:
    """Exclude contacts of links that overlap where nothing is wrong with the hand.

    Links that overlap wherever the hand's joints are (in its middle posture and in random ones)
    never collide. Nor do links that one joint connects: of a URDF, which has no other way to say
    so, all of them; of an MJCF those that overlap in the middle posture, as MuJoCo has it itself
    unless the link above is fixed to the world.
    """
    solid = [b for b in range(model.nbody) if _touches(model, b)]
    group, above = model.body_weldid, model.body_parentid
    adjacent = set()
    for a in solid:
        for b in solid:
            if group[a] == group[above[group[b]]] and group[a] != group[b]:
                adjacent.add((min(a, b), max(a, b)))
    touching = _touching(model, hand)
    always = set.intersection(*touching)
    usual = adjacent if root_tag(hand.path) == "robot" else set()
    pairs = always | usual | (adjacent & touching[0])
    for a, b in sorted(pairs):
        spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)
    if pairs - usual:
        named = (f"{model.body(a).name} and {model.body(b).name}" for a, b in sorted(pairs - usual))
        notes.append(f"links that lie in each other, whose contacts are excluded: {listed(named)}")


def _touches(model: mujoco.MjModel, body: int) -> bool:
    own = model.geom_bodyid == body
    return bool((model.geom_contype[own] | model.geom_conaffinity[own]).any())


def _touching(model: mujoco.MjModel, hand: HandModel) -> list[set[tuple[int, int]]]:
    """Pairs of bodies that touch in each of some postures, the middle one first."""
    data, joints = mujoco.MjData(model), HandJoints(model, hand)
    found = []
    for q in (hand.posture({}), *random_configurations(hand, _POSTURES - 1, seed=0)):
        joints.place(data, q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        found.append({(int(a), int(b)) for a, b in bodies})
    return found
