"""Hands written for a test: dex5 with other things in its file, and a URDF of the same fingers.

They are fixtures that are functions, because tests import no other files of theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

import dexctl
from dexctl import HandModel
from dexctl.hand_config import HandConfig, PostureConfig


class ChangedDex5(Protocol):
    """dex5 from a copy of its file in which texts are replaced, and with another config."""

    def __call__(self, *changes: tuple[str, str], **config: Any) -> HandModel: ...


@pytest.fixture
def changed_dex5(tmp_path: Path) -> ChangedDex5:
    def make(*changes: tuple[str, str], **config: Any) -> HandModel:
        dex5 = dexctl.hands.load("dex5")
        text = dex5.path.read_text()
        for old, new in changes:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / "changed.xml"
        path.write_text(text)
        return replace(dex5.config, description=path, **config).build()

    return make


INERTIAL = (
    '<inertial><origin xyz="0 0 0.03"/><mass value="0.03"/>'
    '<inertia ixx="2e-5" iyy="2e-5" izz="3e-6" ixy="0" ixz="0" iyz="0"/></inertial>'
)
TIP = '<collision><geometry><sphere radius="0.014"/></geometry></collision>'


def finger_urdf(
    count: int = 5,
    *,
    base: str = "",
    inertial: str = INERTIAL,
    tip: str = TIP,
    distal: str = "",
    mimic: str = "",
    palm: str = "",
    dynamics: str = "",
) -> str:
    """The XML of a URDF hand with dex5's fingers, turned by ``base`` (rpy); tips are fixed links.

    Args:
        count: of fingers.
        base: rpy of the palm in the root link.
        inertial: of every moving link.
        tip: what is in a fingertip's link.
        distal, palm: put into those links too.
        mimic: put into the third joint of each finger, ``{i}`` being the finger.
        dynamics: put into every joint.
    """
    parts = [
        '<robot name="small"><link name="world"/><link name="palm">'
        '<collision><origin xyz="0 0 -0.024"/><geometry><cylinder radius="0.075" length="0.02"/>'
        f"</geometry></collision>{palm}</link>"
        f'<joint name="mount" type="fixed"><parent link="world"/><child link="palm"/>'
        f'<origin rpy="{base or "0 0 0"}"/></joint>'
    ]
    limits = {"roll": (-0.7, 0.7), "flexion1": (-0.5, 1.4), "flexion2": (-2.2, 0.3)}
    for i in range(1, count + 1):
        angle = 2 * np.pi * (i - 1) / count
        x, y = 0.055 * np.cos(angle), 0.055 * np.sin(angle)
        parent, origin = "palm", f'xyz="{x} {y} 0" rpy="0 0 {angle}"'
        for name, joint, axis, length in (
            ("base", "roll", "1 0 0", 0.02),
            ("proximal", "flexion1", "0 1 0", 0.075),
            ("distal", "flexion2", "0 1 0", 0.065),
        ):
            low, high = limits[joint]
            parts.append(
                f'<link name="f{i}_{name}"><collision><origin xyz="0 0 {length / 2}"/><geometry>'
                f'<cylinder radius="0.008" length="{length}"/></geometry></collision>{inertial}'
                f"{distal if name == 'distal' else ''}</link>"
                f'<joint name="f{i}_{joint}" type="revolute"><parent link="{parent}"/>'
                f'<child link="f{i}_{name}"/><origin {origin}/><axis xyz="{axis}"/>'
                f'<limit lower="{low}" upper="{high}" effort="0.5" velocity="6"/>{dynamics}'
                f"{mimic.format(i=i) if joint == 'flexion2' else ''}</joint>"
            )
            parent, origin = f"f{i}_{name}", f'xyz="0 0 {length if name != "distal" else 0.075}"'
        parts.append(
            f'<link name="f{i}_tip">{tip}</link><joint name="f{i}_fixed" type="fixed">'
            f'<parent link="f{i}_distal"/><child link="f{i}_tip"/><origin {origin}/></joint>'
        )
    return "".join([*parts, "</robot>"])


@pytest.fixture
def urdf_hand(tmp_path: Path) -> Callable[..., HandModel]:
    """The hand of `finger_urdf`, whose parts it takes; its postures and object are dex5's."""

    def make(count: int = 5, *, config: Mapping[str, Any] | None = None, folder: Path = tmp_path,
             **parts: str) -> HandModel:  # fmt: skip
        path = folder / "small.urdf"
        path.write_text(finger_urdf(count, **parts))
        dex5 = dexctl.hands.load("dex5").config
        tips = {f"f{i}_tip": (0.0, 0.0, 0.0) for i in range(1, count + 1)}
        opened = {j: q for j, q in dex5.postures.open.items() if int(j[1]) <= count}
        values = {
            "fingertips": tips, "postures": PostureConfig(open=opened), "object": dex5.object
        }  # fmt: skip
        return HandConfig(description=path, **(values | dict(config or {}))).build()

    return make


@pytest.fixture
def box_stl() -> Callable[[Path, tuple[float, float, float], float], None]:
    """Writes a binary STL of a box with one corner at (corner, corner, corner)."""

    def write(path: Path, size: tuple[float, float, float], corner: float) -> None:
        unit = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        vertices = unit * size + corner
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
        record = np.zeros(len(triangles), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
        record["v"] = vertices[np.array(triangles)]
        path.write_bytes(b"\0" * 80 + np.uint32(len(triangles)).tobytes() + record.tobytes())

    return write
