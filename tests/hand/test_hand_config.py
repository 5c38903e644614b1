"""A hand's toml: what it may say, and what it does to the hand."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import HandModel, HandModelError, InvalidInput, UnknownName
from dexctl.cli import main
from dexctl.cli.hands import describe
from dexctl.hand_config import (
    Coupling,
    HandConfig,
    HeldObject,
    PalmConfig,
    PostureConfig,
    ServoConfig,
)
from dexctl.hands import registry

XML = """
<mujoco model="two">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <body name="a1" pos="0 0.02 0">
        <joint name="a_j1" axis="0 1 0" range="-1 1" actuatorfrcrange="-2 2"/>
        <body name="a_tip" pos="0.1 0 0"><joint name="a_j2" axis="0 1 0" range="0 1.5"/>
          <geom size="0.01" pos="0.03 0 0"/></body>
        <geom size="0.01"/>
      </body>
      <body name="b1" pos="0 -0.02 0">
        <joint name="b_j1" axis="0 1 0" range="-1 1"/>
        <body name="b_tip" pos="0.1 0 0"><joint name="b_j2" axis="0 1 0" range="0 1.5"/>
          <geom size="0.01" pos="0.03 0 0"/></body>
        <geom size="0.01"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TIPS = {"a_tip": (0.03, 0.0, 0.0), "b_tip": (0.03, 0.0, 0.0)}


@pytest.fixture
def two(tmp_path: Path) -> Path:
    path = tmp_path / "two.xml"
    path.write_text(XML)
    return path


def toml(folder: Path, text: str) -> Path:
    tips = "[fingertips]\na_tip = [0.03, 0, 0]\nb_tip = [0.03, 0, 0]\n"
    path = folder / "mine.toml"
    path.write_text(f'description = "two.xml"\n{text}\n{"" if "[fingertips]" in text else tips}')
    return path


def test_what_is_written_is_read(two: Path, tmp_path: Path) -> None:
    config = HandConfig(
        description=two,
        name="mine",
        about='a "hand"\\ of two',
        fingertips=TIPS,
        joints=("b_j1", "b_j2", "a_j1"),
        palm=PalmConfig(axis=(0, 0, -1.0), up=(1.0, 0.1, 0)),
        servos=ServoConfig(stiffness=2.5, damping={"a_j1": 0.1}, effort=1e-5),
        postures=PostureConfig(open={"a_j1": 0.1 + 0.2}),
        object=HeldObject(
            centre=(0.1, 0.0, 0.05),
            size=0.06,
            sizes={"cube": 0.05},
            shape="sphere",
            mass=0.05,
            travel=0.6,
        ),
        couplings={"a_j2": Coupling(joint="a_j1", scale=0.5)},
    )
    path = tmp_path / "mine.toml"
    config.write(path, {"": "made by a test", "palm.axis": "first line\nsecond line"})
    found = HandConfig.read(path)
    assert found == config
    assert found.source == path
    text = path.read_text()
    assert text.startswith("# made by a test\n")
    assert "# first line\n# second line\naxis = [0.0, 0.0, -1.0]" in text.replace(
        "0, 0, -1.0", "0.0, 0.0, -1.0"
    )
    assert 'description = "two.xml"' in text  # relative, so that the folder can move


def test_the_palm_turns_the_kinematics(two: Path, tmp_path: Path) -> None:
    plain = HandModel.from_mjcf(two, TIPS)
    np.testing.assert_array_equal(plain.base_rotation, np.eye(3))
    # the palm looks along the file's x, the fingers point along its z
    hand = HandModel.load(toml(tmp_path, "[palm]\naxis = [2, 0, 0]\nup = [1, 0, 3]"))
    expected = np.array([[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    np.testing.assert_allclose(hand.base_rotation, expected, atol=1e-15)
    q = np.array([0.3, 0.4, -0.2, 1.0])
    np.testing.assert_allclose(
        hand.fingertip_positions(q), plain.fingertip_positions(q) @ expected.T, atol=1e-12
    )
    jacobian = plain.contact_jacobian(q, plain.fingertip_positions(q))
    np.testing.assert_allclose(
        hand.contact_jacobian(q, hand.fingertip_positions(q)), expected @ jacobian, atol=1e-12
    )
    again = pickle.loads(pickle.dumps(hand))
    np.testing.assert_array_equal(again.fingertip_positions(q), hand.fingertip_positions(q))
    assert again.name == "mine"


def test_limits_and_couplings_of_the_owner(two: Path, tmp_path: Path) -> None:
    text = """[servos]
effort = {b_j1 = 0.7}
velocity = 3
[couplings.a_j2]
joint = "a_j1"
scale = 0.5
offset = 0.1
"""
    hand = HandModel.load(toml(tmp_path, text))
    assert hand.joint_names == ("a_j1", "b_j1", "b_j2")
    np.testing.assert_array_equal(hand.effort, [2.0, 0.7, np.inf])  # the file's where none is said
    np.testing.assert_array_equal(hand.velocity, [3, 3, 3])
    plain = HandModel.from_mjcf(two, TIPS)
    np.testing.assert_allclose(
        hand.fingertip_positions([0.4, 0.2, 0.3]),
        plain.fingertip_positions([0.4, 0.3, 0.2, 0.3]),
        atol=1e-12,
    )


def test_a_joint_that_is_held(two: Path, tmp_path: Path) -> None:
    hand = HandModel.load(toml(tmp_path, "[couplings.a_j1]\noffset = 0.25"))
    assert hand.joint_names == ("a_j2", "b_j1", "b_j2")
    assert hand.couplings["a_j1"].master is None
    plain = HandModel.from_mjcf(two, TIPS)
    np.testing.assert_allclose(
        hand.fingertip_positions([0.4, 0.2, 0.3]),
        plain.fingertip_positions([0.25, 0.4, 0.2, 0.3]),
        atol=1e-12,
    )


def test_a_posture_by_names(two: Path) -> None:
    hand = HandModel.from_mjcf(two, TIPS)
    np.testing.assert_allclose(hand.posture({"b_j1": 0.2, "a_j2": 9}), [0, 1.5, 0.2, 0.75])
    with pytest.raises(UnknownName, match="unknown joint 'c'; known: a_j1"):
        hand.posture({"c": 0.0})


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("fingers = 3", UnknownName, "unknown setting of mine.toml 'fingers'; known: description"),
        ("[palm]\naxis = [0, 0]", InvalidInput, "mine.toml: palm.axis is .0, 0.; expected 3 val"),
        ("[palm]\naxis = [0, 0, 0]", HandModelError, "palm.axis is .*not all zero"),
        ("[palm]\nup = [0, 0, -2]", HandModelError, "palm.up is .*along palm.axis"),
        ("[servos]\neffort = 0", HandModelError, "servos.effort is 0.* above 0"),
        ("[servos]\neffort = {a_j1 = nan}", HandModelError, "servos.effort.a_j1 is nan"),
        ("[servos]\neffort = {c = 1}", UnknownName,
         "unknown joint in servos.effort of mine.toml 'c'; known: a_j1"),
        ("[servos]\nstiffness = {c = 1}", UnknownName,
         "joint in servos.stiffness of mine.toml 'c'"),
        ("[postures.open]\nc = 1", UnknownName,
         "joint in postures.open of mine.toml 'c'; known: a_j1"),
        ("[fingertips]\nc = [0, 0, 0]", UnknownName, "unknown fingertip of mine.toml 'c'; known: "),
        ("[fingertips]\na_tip = [1e9, 0, 0]", HandModelError, "metres, at most 100"),
        ("[object]\nsize = -1", HandModelError, "object.size is -1"),
        ("[object]\nsize = 1e300", HandModelError, "size is 1e.300; .* above 0, at most 100"),
        ("[object.sizes]\ncube = 0.0", HandModelError, "object.sizes.cube is 0.0"),
        ("[object]\nsizes = 0.06", InvalidInput, "object.sizes is 0.06; expected a table by name"),
        ("[object]\nmass = 0", HandModelError, "object.mass is 0.0; expected a finite number"),
        ("[couplings.a_j2]\nscale = 2", HandModelError, "has the scale 2, but lacks joint"),
        ("[couplings.a_j9]\njoint = 'a_j1'", UnknownName,
         "joint in couplings of mine.toml 'a_j9'; known: a_j1"),
        ("[fingertips]\na_tip = [0, nan, 0]", HandModelError, "'a_tip' has the offset"),
        ("[fingertips]\n", HandModelError, "fingertips is empty"),
        ("[fingertips", HandModelError, "mine.toml: not a TOML file"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    two: Path, tmp_path: Path, text: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        HandModel.load(toml(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["x", 1j, np.zeros(3) + 0j, 10**400, [[1.0], [1.0, 2.0]]])
def test_what_is_no_number_is_named_where_code_gives_it(value: Any) -> None:
    given = dict(description=Path("two.xml"), fingertips={"a_tip": (0.0, 0.0, 0.0)})
    calls: dict[str, Callable[[], object]] = {
        "palm.axis": lambda: PalmConfig(axis=value),
        "servos.effort": lambda: ServoConfig(effort=value),
        "servos.effort.a_j1": lambda: ServoConfig(effort={"a_j1": value}),
        "postures.open": lambda: PostureConfig(open=value),
        "postures.open.a_j1": lambda: PostureConfig(open={"a_j1": value}),
        "the scale of a coupling": lambda: Coupling(joint="a_j1", scale=value),
        "fingertip_radius": lambda: HandConfig(**{**given, "fingertip_radius": value}),
        "fingertips": lambda: HandConfig(**{**given, "fingertips": value}),
    }
    for name, call in calls.items():
        with pytest.raises(HandModelError, match=f"^{name} is .*; expected") as error:
            call()
        assert "\n" not in str(error.value) and len(str(error.value)) < 200


def test_a_toml_without_description_and_a_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text("")
    with pytest.raises(InvalidInput, match=r"empty.toml: lacks description, fingertips"):
        HandModel.load(path)
    with pytest.raises(HandModelError, match=r"none.toml: no such file"):
        HandModel.load(tmp_path / "none.toml")
    with pytest.raises(HandModelError, match=r"two.xml: no such file"):
        HandModel.load(toml(tmp_path, ""))


def test_other_packages_add_hands(
    two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Point:
        def __init__(self, name: str, found: object) -> None:
            self.name, self.value, self.found = name, f"theirs:{name}", found

        def load(self) -> object:
            if isinstance(self.found, Exception):
                raise self.found
            return self.found

    path = toml(tmp_path, "")
    made = HandConfig(description=two, name="made", fingertips=TIPS)
    points = [Point("by_path", path), Point("made", made), Point("wrong", 3), Point("dex5", path)]
    points.append(Point("gone", ImportError("No module\nnamed 'theirs'")))
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points)
    registry._added.cache_clear()
    try:
        assert {"by_path", "made", "dex5"} <= set(dexctl.hands.names())
        assert dexctl.hands.load("by_path").nq == dexctl.hands.load("made").nq == 4
        assert dexctl.hands.load("dex5").nq == 15  # dexctl's own comes first
        with pytest.raises(HandModelError, match="theirs:wrong is 3; expected the path"):
            dexctl.hands.load("wrong")
        said = "'gone' cannot be loaded from theirs:gone: ImportError: No module named 'theirs'"
        with pytest.raises(HandModelError, match=said):
            dexctl.hands.load("gone")
        listed = {name: describe(name) for name in dexctl.hands.names()}
        assert listed["gone"]["files"] == listed["wrong"]["files"] == "broken"
        assert said in listed["gone"]["description"]
        assert listed["by_path"]["joints"] == 4
        assert main(["hands"]) == 0
    finally:
        registry._added.cache_clear()


@pytest.mark.parametrize("hand", [None, 5, "<mujoco>" + 300 * "<body/>" + "</mujoco>", "a\n.xml"])
def test_what_is_neither_a_name_nor_a_path(hand: object) -> None:
    with pytest.raises(InvalidInput, match=r"hand is .*; expected a name \(dex5.*path") as caught:
        HandModel.load(hand)  # type: ignore[arg-type]
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)
    with pytest.raises(HandModelError, match="no such file"):
        HandModel.load(300 * "a" + ".xml")


@pytest.mark.parametrize("posture", ["open", "grasp"])
def test_postures_are_finite(two: Path, tmp_path: Path, posture: str) -> None:
    said = rf"postures\.{posture}\.a_j1 is nan; expected a finite number"
    with pytest.raises(HandModelError, match=said):
        HandModel.load(toml(tmp_path, f"[postures.{posture}]\na_j1 = nan"))
    with pytest.raises(HandModelError, match="open.a_j1 is 'far'; expected"):
        PostureConfig(open={"a_j1": "far"})  # type: ignore[dict-item]
    with pytest.raises(InvalidInput, match="angle of joint 'a_j1' is nan; expected a finite"):
        HandModel.load(toml(tmp_path, "")).posture({"a_j1": np.nan})


def test_what_is_no_setting_is_not_among_the_known(two: Path, tmp_path: Path) -> None:
    for line in ("nam = 'a'", "source = 'a.toml'"):
        with pytest.raises(UnknownName) as caught:
            HandModel.load(toml(tmp_path, line))
        assert "source" not in caught.value.known and "fingertips" in caught.value.known
