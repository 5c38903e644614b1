"""What is proposed of a hand's file: fingertips, palm, what is held; hands built by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.description import read
from dexctl.description.geometry import body_points, find_mesh, vertices
from dexctl.exceptions import HandModelError, UnknownName
from dexctl.hands.proposals import closing, propose

FOUR_FINGERS = Path(__file__).resolve().parents[1] / "hands" / "four_fingers.xml"
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="5"/>'


def link(name: str, shape: str = "", at: str = "0 0 0") -> str:
    solid = f'<collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision>'
    return f'<link name="{name}">{solid if shape else ""}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    at: str,
    axis: str = "0 1 0",
    limits: tuple[float, float] | None = (0, 1.5),
    rpy: str = "0 0 0",
) -> str:
    limit = "" if limits is None else LIMIT.format(*limits)
    kind = "fixed" if limits is None else "revolute"
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def urdf(folder: Path, prefix: str = "", world: str = "") -> str:
    """Three fingers along z that bend towards x, a thumb across, a lamp, a knob; on a wrist.

    The last links are boxes 16 mm wide and 40 mm long, with a bare frame fixed to their ends.
    """
    p = prefix
    text = [link(f"{p}arm"), link(f"{p}palm", '<box size="0.03 0.1 0.1"/>', "0 0 0.05")]
    text.append(joint(f"{p}wrist", f"{p}arm", f"{p}palm", "0 0 0.1", "0 1 0", (-0.5, 0.4)))
    for i, y in enumerate((-0.03, 0.0, 0.03)):
        f = f"{p}f{i}"
        text += [
            link(f"{f}_side"),
            link(f"{f}_low", '<box size="0.016 0.016 0.05"/>', "0 0 0.025"),
            link(f"{f}_end", '<box size="0.016 0.016 0.04"/>', "0 0 0.02"),
            link(f"{f}_frame"),
            joint(f"{f}_spread", f"{p}palm", f"{f}_side", f"0 {y} 0.1", "1 0 0", (-0.3, 0.3)),
            joint(f"{f}_1", f"{f}_side", f"{f}_low", "0 0 0"),
            joint(f"{f}_2", f"{f}_low", f"{f}_end", "0 0 0.05"),
            joint(f"{f}_f", f"{f}_end", f"{f}_frame", "0 0 0.04", limits=None),
        ]
    text += [
        link(f"{p}t_low", '<box size="0.016 0.016 0.05"/>', "0 0 0.025"),
        link(f"{p}t_end", '<sphere radius="0.01"/>', "0 0 0.03"),
        joint(
            f"{p}t_1", f"{p}palm", f"{p}t_low", "0.01 -0.06 0.02", "1 0 0", (-1.5, 0.1), "1.2 0 0"
        ),
        joint(f"{p}t_2", f"{p}t_low", f"{p}t_end", "0 0 0.05", "0 1 0", (0, 1.2)),
        link(f"{p}lamp"),
        joint(f"{p}lamp_joint", f"{p}palm", f"{p}lamp", "0 0 0.1"),
        link(f"{p}knob", '<sphere radius="0.004"/>'),
        joint(f"{p}knob_joint", f"{p}palm", f"{p}knob", "0 0 0.03"),
    ]
    if world:
        text.append(joint(f"{p}stand", "world", f"{p}arm", world, limits=None))
    return "".join(text)


@pytest.fixture
def hand_file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.urdf"
    path.write_text(f"<robot name='mine'>{urdf(tmp_path)}</robot>")
    return path


def test_fingers_palm_and_wrist_of_a_urdf(hand_file: Path) -> None:
    found = propose(hand_file)
    assert list(found.config.fingertips) == ["f0_end", "f1_end", "f2_end", "t_end"]
    # a box of 16 mm: its half-width inside of its end, on its middle line
    np.testing.assert_allclose(found.config.fingertips["f0_end"], [0, 0, 0.04 - 0.008], atol=1e-4)
    assert found.config.fingertip_radius == pytest.approx(0.008, abs=1e-4)  # tips are inside by it
    assert "half-width" in found.reasons["fingertip_radius"]
    assert found.config.finger_width == pytest.approx(0.016, abs=1e-4)  # and the link before it
    np.testing.assert_allclose(found.config.fingertips["t_end"], [0, 0, 0.03], atol=5e-3)
    assert found.config.palm.axis == (1.0, 0.0, 0.0)
    assert found.config.palm.up == (0.0, 0.0, 1.0)
    assert list(found.config.couplings) == ["wrist"]
    assert "lamp (no geometry)" in found.reasons["fingertips"]
    assert "knob (" in found.reasons["fingertips"]
    assert "wrist" in found.reasons["couplings"]
    hand = dexctl.hands.load(hand_file)
    assert hand.nq == 3 * 3 + 2
    tips = hand.fingertip_positions(np.clip(0, hand.lower, hand.upper))
    assert (tips[:3, 0] > 0.2).all()  # the fingers point along x of the hand's frame
    bent = hand.fingertip_positions(hand.posture({}))
    assert (bent[:3, 2] > tips[:3, 2]).all()  # and bend along its z


def test_the_toml_that_is_written_says_why(hand_file: Path, tmp_path: Path) -> None:
    config, reasons, _ = propose(hand_file)
    config.write(tmp_path / "mine.toml", reasons)
    text = (tmp_path / "mine.toml").read_text()
    assert "# The ends of the tree that carry geometry" in text
    assert (
        "# Where f0_end, f1_end, f2_end point when they are stretched.\nup = [0.0, 0.0, 1.0]"
        in text
    )
    read_back = dexctl.hands.load(tmp_path / "mine.toml")
    np.testing.assert_array_equal(read_back.base_rotation, config.palm.rotation)
    assert read_back.couplings["wrist"].master is None


def test_fingertips_of_ones_own(hand_file: Path) -> None:
    found = propose(hand_file, ["f0_frame", "t_end"])
    assert list(found.config.fingertips) == ["f0_frame", "t_end"]
    end = propose(hand_file).config.fingertips["f0_end"]
    np.testing.assert_allclose(
        np.add(found.config.fingertips["f0_frame"], (0, 0, 0.04)), end, atol=2e-4
    )
    with pytest.raises(UnknownName, match="unknown body 'f9'"):
        propose(hand_file, ["f9"])


def drawn_ends(path: Path, *, without: bool = False) -> Path:
    """`hand_file` with last links that are only drawn, or have no shape at all."""
    text = path.read_text()
    for end in ("f0_end", "f1_end", "f2_end", "t_end"):
        before, name, after = text.partition(f'<link name="{end}">')
        old, close, rest = after.partition("</link>")
        new = "" if without else old.replace("collision", "visual")
        text = before + name + new + close + rest
    changed = path.with_name("drawn.urdf")
    changed.write_text(text)
    return changed


@pytest.mark.parametrize("tips", [(), ("f0_end", "f1_end", "f2_end", "t_end")])
def test_last_links_that_are_only_drawn_are_measured(hand_file: Path, tips: Sequence[str]) -> None:
    whole, drawn = propose(hand_file).config, propose(drawn_ends(hand_file), tips)
    assert drawn.config.fingertips == whole.fingertips
    assert drawn.config.fingertip_radius == whole.fingertip_radius
    assert (
        "for want of collision geometry: f0_end, f1_end, f2_end, t_end"
        in (drawn.reasons["fingertips"])
    )


def test_last_links_without_a_shape_say_what_to_write(hand_file: Path) -> None:
    path = drawn_ends(hand_file, without=True)
    with pytest.raises(HandModelError, match="fingertip 'f0_end' has no geometry .* fixed to it"):
        propose(path, ["f0_end", "f1_end"])
    found = propose(path, ["f0_frame", "f1_frame"]).config  # a link stands for its origin
    assert found.fingertips == {"f0_frame": (0.0, 0.0, 0.0), "f1_frame": (0.0, 0.0, 0.0)}


def test_two_hands_in_one_file(tmp_path: Path) -> None:
    path = tmp_path / "both.urdf"
    right, left = urdf(tmp_path, "r_", "0 -0.3 0"), urdf(tmp_path, "l_", "0 0.3 0")
    path.write_text(f"<robot name='both'><link name='world'/>{right}{left}</robot>")
    with pytest.raises(
        HandModelError, match="2 hands, below 'r_.*' and 'l_.*dexctl hands add both.urdf --base r_"
    ):
        propose(path)
    found = propose(path, base="l_palm")
    assert list(found.config.fingertips) == ["l_f0_end", "l_f1_end", "l_f2_end", "l_t_end"]
    assert list(found.config.couplings) == ["l_wrist"]
    assert found.config.palm.axis == (1.0, 0.0, 0.0)


def test_a_file_without_geometry_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "bare.urdf"
    path.write_text(
        f"<robot name='b'>{link('a')}{link('b')}{joint('j', 'a', 'b', '0 0 0')}</robot>"
    )
    with pytest.raises(HandModelError, match="no end of the tree carries geometry.*fingertips"):
        propose(path)


def mjcf(folder: Path, base: str = "", joint: str = 'type="hinge" axis="0 1 0"') -> Path:
    """Three fingers of two joints, the second of the first one given; a ball that lies about."""
    fingers = "".join(
        f'<body name="f{i}" pos="0 {0.04 * i} 0.05"><joint name="a{i}" axis="0 1 0" range="0 90"/>'
        '<geom type="box" size=".006 .006 .02" pos="0 0 .02"/>'
        f'<body name="f{i}_end" pos="0 0 .04"><joint name="b{i}" {other}/>'
        f'<geom type="box" size=".006 .006 .02" pos="0 0 .02"/><site name="t{i}" pos="0 .002 .03"/>'
        "</body></body>"
        for i, other in enumerate((joint, *2 * ('axis="0 1 0" range="0 90"',)))
    )
    path = folder / "three.xml"
    path.write_text(
        f'<mujoco><worldbody><body name="palm">{base}<geom size=".01"/>{fingers}</body>'
        '<body name="toy" pos="1 0 0"><freejoint name="toy"/><geom size=".02"/></body>'
        "</worldbody></mujoco>"
    )
    return path


def test_joints_that_fingers_cannot_have_are_named(tmp_path: Path) -> None:
    assert len(propose(mjcf(tmp_path)).config.fingertips) == 3  # the toy is not in the way
    with pytest.raises(HandModelError, match="'f0_end' moves on the ball joint 'b0'; "):
        propose(mjcf(tmp_path, joint='type="ball"'))
    with pytest.raises(HandModelError, match="'f0_end' moves on the ball joint 'b0'; "):
        dexctl.hands.load(mjcf(tmp_path, joint='type="ball"'))
    with pytest.raises(HandModelError, match="fixed base; .*f2_end: moves on the free joint 'fly'"):
        propose(mjcf(tmp_path, base='<freejoint name="fly"/>'))
    path = tmp_path / "floating.urdf"
    text = urdf(tmp_path).replace('name="wrist" type="revolute"', 'name="wrist" type="floating"')
    path.write_text(f"<robot name='floating'>{text}</robot>")
    with pytest.raises(HandModelError, match="moves on the floating joint 'wrist'"):
        propose(path)


def test_sites_as_fingertips(tmp_path: Path) -> None:
    found = propose(mjcf(tmp_path), ["t1", "f0_end", "t2"])
    assert found.config.fingertips["t1"] == (0.0, 0.0, 0.0)
    assert "a site, which is the tip itself" in found.reasons["fingertips"]
    assert found.config.fingertip_radius == 0 and "fingertip_radius" not in found.reasons
    hand = found.config.build()
    assert hand.fingertip_bodies == ("f1_end", "f0_end", "f2_end")
    np.testing.assert_allclose(hand.fingertip_offsets[0], [0, 0.002, 0.03])


@pytest.mark.parametrize(
    ("tips", "said"),
    [
        (["f0_end", "f1_end", "f0_end"], "the fingertip 'f0_end' is named twice"),
        (["f0_end", "t_end", "f0_frame"], "'f0_end' and 'f0_frame' move as one; name one for each"),
        (["arm", "f1_end"], "no joint moves the fingertip 'arm'"),
    ],
)
def test_fingertips_that_are_none(tips: list[str], said: str, hand_file: Path) -> None:
    with pytest.raises(HandModelError, match=f"mine.urdf: .*{said}"):
        propose(hand_file, tips)


@pytest.mark.parametrize("hand", ["dex5", "four_fingers"])
def test_hands_of_which_more_is_known(hand: str) -> None:
    path = dexctl.hands.config("dex5").description if hand == "dex5" else FOUR_FINGERS
    known = dexctl.hands.config("dex5" if hand == "dex5" else "wonik_allegro")
    found = propose(path).config
    assert list(found.fingertips) == list(known.fingertips)
    assert found.palm == known.palm
    assert not found.couplings


def test_which_way_joints_bend(dex5: dexctl.HandModel) -> None:
    np.testing.assert_array_equal(closing(dex5), np.tile([0, 1, -1], 5))


def test_meshes_are_found_and_read(tmp_path: Path) -> None:
    (tmp_path / "robot" / "meshes").mkdir(parents=True)
    (tmp_path / "robot" / "urdf").mkdir()
    file = tmp_path / "robot" / "meshes" / "tip.obj"
    file.write_text("v 0 0 0\nv 0.01 0 0\nv 0 0.02 0\nv 0 0 0.03\nf 1 2 3\n")
    path = tmp_path / "robot" / "urdf" / "hand.urdf"
    for name in ("package://robot/meshes/tip.obj", "../meshes/tip.obj", "../meshes/tip.dae"):
        assert find_mesh(path, name) is not None, name
    assert find_mesh(path, "package://robot/meshes/none.stl") is None
    assert vertices(file).max(axis=0).tolist() == [0.01, 0.02, 0.03]
    facet = np.arange(12, dtype="<f4").tobytes() + b"\0\0"
    stl = tmp_path / "one.stl"
    stl.write_bytes(b"\0" * 80 + (1).to_bytes(4, "little") + facet)
    np.testing.assert_array_equal(vertices(stl), np.arange(3, 12).reshape(3, 3))
    stl.write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 1 2 3\nvertex 4 5 6\nvertex 7 8 9\n"
    )
    np.testing.assert_array_equal(vertices(stl), np.arange(1, 10).reshape(3, 3))
    path.write_text(
        '<robot name="r"><link name="l"><collision><origin xyz="0 0 1" rpy="0 0 1.5707963267949"/>'
        '<geometry><mesh filename="package://robot/meshes/tip.obj" scale="1 1 2"/></geometry>'
        "</collision></link></robot>"
    )
    ((points,), _) = body_points(read(path))
    np.testing.assert_allclose(points[1], [0, 0.01, 1], atol=1e-12)
    np.testing.assert_allclose(points[3], [0, 0, 1.06], atol=1e-12)
