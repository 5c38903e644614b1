"""Grasps made of geometry alone, and small hands written for these tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dexctl import GraspState, HandModel

TIP_RADIUS = 0.01
CENTRE = np.array([0.0, 0.0, 0.13])


def round_grasp(hand: HandModel, q: np.ndarray, force: float = 1.0) -> GraspState:
    """Every finger touches an upright round object about the z axis, at its own tip's height."""
    tips = hand.fingertip_positions(q)
    inward = -tips * [1.0, 1.0, 0.0]
    normal = inward / np.linalg.norm(inward, axis=-1, keepdims=True)
    fingers = tips.shape[:-1]
    return GraspState(
        q=q,
        q_target=q.copy(),
        in_contact=np.ones(fingers, bool),
        contact_position=tips + TIP_RADIUS * normal,
        contact_normal=normal,
        contact_force=np.full(fingers, force),
        object_position=np.broadcast_to(CENTRE, (*q.shape[:-1], 3)).copy(),
        object_quaternion=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*q.shape[:-1], 4)).copy(),
    )


@pytest.fixture(scope="session")
def grasp_of() -> Callable[..., GraspState]:
    return round_grasp


@pytest.fixture(scope="session")
def posture(dex5: HandModel) -> np.ndarray:
    """The fingers of dex5 bent inwards, all alike."""
    return np.tile([0.0, 0.5, -0.85], dex5.n_fingers)


_INERTIA = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'


def _finger(i: int, angle: float, joints: int) -> str:
    """A finger on a circle about z: a roll joint about the radius, then flexion joints."""
    x, y = np.cos(angle), np.sin(angle)
    link = 0.14 / max(joints - 1, 1)
    out = (
        f'<body pos="{0.055 * x} {0.055 * y} 0"><joint name="roll{i}" axis="{x} {y} 0"/>{_INERTIA}'
    )
    for j in range(joints - 1):
        height = 0.02 if j == 0 else link
        out += f'<body pos="0 0 {height}"><joint name="flex{i}{j}" axis="{-y} {x} 0"/>{_INERTIA}'
    out += f'<body name="tip{i}" pos="0 0 {link}">{_INERTIA}</body>'
    return out + "</body>" * joints


@pytest.fixture(scope="session")
def make_hand(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., HandModel]:
    """Makes a hand whose fingers have the given numbers of joints, on a wrist or not."""

    def make(joints: tuple[int, ...], *, wrist: bool = False) -> HandModel:
        count = len(joints)
        fingers = "".join(
            _finger(i, 2 * np.pi * i / count, number) for i, number in enumerate(joints)
        )
        palm = f'<joint name="wrist" axis="0 1 1" pos="0 0 -0.05"/>{_INERTIA}' if wrist else ""
        path: Path = tmp_path_factory.mktemp("hand") / "hand.xml"
        path.write_text(
            '<mujoco><compiler angle="radian" autolimits="true"/><default><joint range="-2 2"/>'
            f"</default><worldbody><body>{palm}{fingers}</body></worldbody></mujoco>"
        )
        return HandModel.from_mjcf(path, [f"tip{i}" for i in range(count)])

    return make


@pytest.fixture(scope="session")
def bent() -> Callable[[HandModel, int], np.ndarray]:
    """Joint angles that bend every finger inwards, a little different for every seed."""

    def make(hand: HandModel, seed: int) -> np.ndarray:
        first = {"roll": 0.0, "flex": 0.5}
        angles = []
        for name in hand.joint_names:
            kind = name[:4]
            later = kind == "flex" and not name.endswith("0")
            angles.append(-0.6 if later else first.get(kind, 0.0))
        return np.array(angles) + np.random.default_rng(seed).uniform(-0.1, 0.1, hand.nq)

    return make
