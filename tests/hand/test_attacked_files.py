"""Description files that are broken, or larger than any hand: one clear line, in bounded time."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from dexctl.exceptions import HandModelError
from dexctl.hand import MOST_JOINTS, HandModel


def chain(path: Path, links: int, kind: str = "revolute") -> Path:
    names = [f"l{i}" for i in range(links)]
    bodies = "".join(f'<link name="{name}"/>' for name in names)
    joints = "".join(
        f'<joint name="j{i}" type="{kind if i else "revolute"}"><parent link="l{i}"/>'
        f'<child link="l{i + 1}"/><origin xyz="0.001 0 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for i in range(links - 1)
    )
    path.write_text(f'<robot name="chain">{bodies}{joints}</robot>')
    return path


@pytest.mark.parametrize("links", [1_000, 10_000])
def test_a_long_chain_of_joints_is_no_hand(tmp_path: Path, links: int) -> None:
    path = chain(tmp_path / "chain.urdf", links)
    began = time.process_time()
    with pytest.raises(
        HandModelError, match=f"{links - 1} joints move the fingertip 'l{links - 1}"
    ):
        HandModel.from_urdf(path, [f"l{links - 1}"])
    assert time.process_time() - began < 10  # 0.4 s on a quiet machine


def test_as_many_joints_as_there_may_be(tmp_path: Path) -> None:
    path = chain(tmp_path / "chain.urdf", MOST_JOINTS + 1)
    assert HandModel.from_urdf(path, [f"l{MOST_JOINTS}"]).nq == MOST_JOINTS


@pytest.mark.parametrize("links", [1_000, 10_000])
def test_a_long_chain_of_fixed_links(tmp_path: Path, links: int) -> None:
    hand = HandModel.from_urdf(chain(tmp_path / "chain.urdf", links, "fixed"), [f"l{links - 1}"])
    began = time.process_time()
    assert hand.fingertip_positions([0.0])[0, 0] == pytest.approx(0.001 * (links - 1))
    assert time.process_time() - began < 10


def test_an_mjcf_chain(tmp_path: Path) -> None:
    for links in (100, 400, 10_000):
        path = tmp_path / f"chain{links}.xml"
        opened = "".join(
            f'<body name="l{i}" pos="0 0 0.01"><joint name="j{i}"/><geom size="0.01"/>'
            for i in range(links)
        )
        path.write_text(f"<mujoco><worldbody>{opened}{'</body>' * links}</worldbody></mujoco>")
        if links == 100:
            assert HandModel.from_mjcf(path, ["l99"]).nq == 100
        else:
            with pytest.raises(HandModelError, match="joints move|deeper than MuJoCo") as caught:
                HandModel.from_mjcf(path, [f"l{links - 1}"])
            assert "\n" not in str(caught.value)


URDF = """<?xml version="1.0" encoding="ENCODING"?>
<robot name="h"><link name="base"/><link name="tip"><inertial><mass value="MASS"/>
<origin xyz="0 0 CENTRE"/><inertia ixx="MOMENT" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><sphere radius="RADIUS"/></geometry></collision></link>
<joint name="j" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0.1 0 ORIGIN"/>
<axis xyz="0 1 0"/><limit lower="LOWER" upper="1" effort="1" velocity="1"/></joint></robot>"""
GOOD = {
    "ENCODING": "utf-8", "MASS": "0.1", "CENTRE": "0.01", "RADIUS": "0.01", "ORIGIN": "0",
    "LOWER": "-1", "MOMENT": "1e-5",
}  # fmt: skip


@pytest.mark.parametrize(
    ("what", "value", "message"),
    [
        ("ORIGIN", "inf", "joint 'j' has xyz='0.1 0 inf' in <origin>; expected 3 finite"),
        ("ORIGIN", "nan", "joint 'j' has xyz='0.1 0 nan'"),
        ("ORIGIN", "1e300", "joint 'j' has xyz='0.1 0 1e[+]300' in <origin>; expected metres, at"),
        ("LOWER", "2", "joint 'j' has the lower limit 2 above the upper, 1"),
        ("LOWER", "nan", "joint 'j' has lower='nan'"),
        ("MASS", "nan", "link 'tip' has the mass 'nan'; expected a finite number"),
        ("MASS", "-1", "link 'tip' has the mass '-1'"),
        ("MASS", "heavy", "link 'tip' has the mass 'heavy'"),
        (
            "MOMENT",
            "nan",
            "link 'tip' has ixx='nan' in the <inertia> of its <inertial>; expected a",
        ),
        ("CENTRE", "inf", "link 'tip' has xyz='0 0 inf' in the <origin> of its <inertial>; exp"),
        ("RADIUS", "wide", "link 'tip' has radius='wide' in the <sphere> of its <collision>; exp"),
        ("RADIUS", "1 2", "radius='1 2' in the <sphere> .* expected a finite number$"),
        ("ENCODING", "klingon", "not well-formed XML: unknown encoding"),
        ("ENCODING", "shift_jis", "not well-formed XML: multi-byte encodings"),
    ],
)
def test_broken_values_of_a_urdf(tmp_path: Path, what: str, value: str, message: str) -> None:
    path = tmp_path / "h.urdf"

    def text(values: dict[str, str]) -> str:
        found = URDF
        for name, one in values.items():
            found = found.replace(name, one)
        return found

    path.write_text(text(GOOD))
    assert HandModel.from_urdf(path, ["tip"]).nq == 1
    path.write_text(text({**GOOD, what: value}))
    with pytest.raises(HandModelError, match=message) as caught:
        HandModel.from_urdf(path, ["tip"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("what", "value", "message"),
    [
        ('pos="0 0 0.1"', 'pos="0 0 inf"', "cannot compile|expected finite numbers"),
        ('pos="0 0 0.1"', 'pos="0 0 nan"', "<body> 'tip' has pos='0 0 nan': not a number"),
        ('pos="0 0 0.1"', 'pos="0 0 1e300"', "body 'tip' has the pos .*expected metres, at most"),
        ('mass="0.1"', 'mass="nan"', "<geom> of the body 'tip' has mass='nan': not a number"),
        ('range="-1 1"', 'range="1 -1"', "<joint> 'j' has range='1 -1': a lower limit above"),
        ("<mujoco>", '<?xml version="1.0" encoding="klingon"?><mujoco>', "unknown encoding"),
    ],
)
def test_broken_values_of_an_mjcf(tmp_path: Path, what: str, value: str, message: str) -> None:
    xml = (
        '<mujoco><compiler autolimits="true"/><worldbody><body name="tip" pos="0 0 0.1">'
        '<joint name="j" range="-1 1"/><geom size="0.01" mass="0.1"/></body></worldbody></mujoco>'
    )
    path = tmp_path / "h.xml"
    path.write_text(xml)
    assert HandModel.from_mjcf(path, ["tip"]).nq == 1
    path.write_text(xml.replace(what, value))
    with pytest.raises(HandModelError, match=rf"h\.xml: .*({message})") as caught:
        HandModel.from_mjcf(path, ["tip"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("attribute", ["effort", "velocity"])
def test_limits_of_motors_are_not_negative(tmp_path: Path, attribute: str) -> None:
    path = chain(tmp_path / "chain.urdf", 3)
    path.write_text(path.read_text().replace(f'{attribute}="1"', f'{attribute}="-1"', 1))
    with pytest.raises(HandModelError, match=f"joint 'j0' has {attribute}=-1 in <limit>; expected"):
        HandModel.from_urdf(path, ["l2"])
    path.write_text(path.read_text().replace(f'{attribute}="-1"', f'{attribute}="0"', 1))
    assert getattr(HandModel.from_urdf(path, ["l2"]), attribute)[0] == float("inf")  # not known
