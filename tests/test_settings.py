"""Nested configurations as plain values, by leaf name, and what is wrong with them in one line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import (
    BY_PATH,
    NESTED,
    Vector,
    absolute,
    by_path,
    changed,
    difference,
    differing,
    from_plain,
    get,
    leaves,
    only,
    paths,
    to_plain,
)
from learning.envs import EnvConfig


@dataclass(frozen=True, kw_only=True)
class Noise:
    joint: float = 0.0
    rate: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Scene:
    object: tuple[str, ...] = ("cube",)
    gravity: Vector = "up"
    size: float | None = None
    file: Path | None = None
    noise: Annotated[Noise, NESTED] = Noise()


@dataclass(frozen=True, kw_only=True)
class Run:
    scene: Annotated[Scene, NESTED] = Scene()
    kind: Literal["a", "b"] = "a"
    count: int = 3
    quick: bool = False
    rate: float = 0.5


BALL = Scene(object=("ball",), noise=Noise(rate=2.0))


@dataclass(frozen=True, kw_only=True)
class Command:
    scene: Annotated[Scene, only(BALL, "gravity", "noise.joint")] = BALL


def test_only_some_settings_are_options(capsys: pytest.CaptureFixture[str]) -> None:
    made = tyro.cli(Command, args=["--gravity", "down", "--joint", "0.5"]).scene
    assert to_plain(made) == to_plain(changed(BALL, {"gravity": "down", "joint": 0.5}))
    assert differing(made, BALL) == ["gravity", "noise.joint"]
    for hidden in ("--size", "--rate", "--object"):
        with pytest.raises(SystemExit):
            tyro.cli(Command, args=[hidden, "3"])
        assert f"Unrecognized options: {hidden}" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        tyro.cli(Command, args=["--help"])
    said = capsys.readouterr().out
    assert "--joint" in said and "--size" not in said


def test_leaves_have_paths_and_repeated_names_have_none() -> None:
    assert leaves(Run)["joint"] == "scene.noise.joint"
    assert "rate" not in leaves(Run)
    assert list(paths(Scene))[-2:] == ["noise.joint", "noise.rate"]
    assert get(Run(), "scene.noise.rate") == 1.0


@dataclass(frozen=True, kw_only=True)
class Way:
    size: float = 1.0
    far: float = 2.0


@dataclass(frozen=True, kw_only=True)
class Planned:
    scene: Scene = Scene()
    way: Annotated[Way, BY_PATH] = Way()


@dataclass(frozen=True, kw_only=True)
class Whole:
    planned: Planned = Planned()


def test_settings_that_go_by_their_paths_take_no_name_from_others() -> None:
    assert leaves(Whole)["size"] == "planned.scene.size"
    assert "far" not in leaves(Whole) and "planned.way.far" in paths(Whole)
    made = changed(Whole(), {"size": 3, "planned.way.size": 4})
    assert (made.planned.scene.size, made.planned.way.size) == (3.0, 4.0)
    assert from_plain(Whole, to_plain(made)) == made
    with pytest.raises(UnknownName, match="setting 'far'"):
        changed(Whole(), {"far": 1.0})


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "object": st.lists(st.sampled_from("abc"), min_size=1),
            "gravity": st.one_of(st.just("down"), st.tuples(*[st.floats(-9, 9)] * 3)),
            "size": st.one_of(st.none(), st.floats(0, 1)),
            "file": st.one_of(st.none(), st.just("x/y.npz")),
            "joint": st.floats(0, 1),
            "scene.noise.rate": st.floats(0, 1),
            "rate": st.integers(0, 3),
            "kind": st.sampled_from("ab"),
            "quick": st.booleans(),
        },
    )
)
def test_what_is_given_by_any_name_goes_through_json(values: dict[str, Any]) -> None:
    made = from_plain(Run, values)
    assert from_plain(Run, json.loads(json.dumps(to_plain(made)))) == made
    assert changed(Run(), values) == made
    for name, value in values.items():
        path = name if "." in name or name in Run.__dataclass_fields__ else leaves(Run)[name]
        found = get(made, path)
        assert found == (tuple(value) if isinstance(value, list) else
                         Path(value) if name == "file" and value else value)  # fmt: skip


def test_tables_and_leaves_together() -> None:
    made = from_plain(Run, {"scene": {"size": 1, "noise": {"rate": 2}}, "joint": 0.1})
    assert made.scene == Scene(size=1.0, noise=Noise(joint=0.1, rate=2.0))
    assert from_plain(Run, {"object": "ball"}).scene.object == ("ball",)
    other = changed(made, {"scene": {"noise": {"joint": 0.3}}})
    assert other.scene.noise == Noise(joint=0.3, rate=2.0)
    assert other.scene.size == 1.0


def test_tables_can_be_put_together_by_path() -> None:
    values = {"scene": {"noise": {"rate": 2}, "size": 1}, "joint": 0.1, "rate": 3}
    assert by_path(Run, values) == {
        "scene.noise.rate": 2.0, "scene.size": 1.0, "scene.noise.joint": 0.1, "rate": 3.0,
    }  # fmt: skip
    for wrong, said in (
        ({"scene.noise": 3}, "a.scene.noise is 3"), ({"joint": "x"}, "a.scene.noise.jo"),
    ):  # fmt: skip
        with pytest.raises(InvalidInput, match=said):
            by_path(Run, wrong, "a")


def test_the_first_difference_is_named() -> None:
    a, b = to_plain(Run()), to_plain(changed(Run(), {"joint": 0.5, "count": 4}))
    assert difference(a, b) == "scene.noise.joint was 0.0, is 0.5"
    assert difference(a, a) is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 1.5}, "train.count is 1.5; expected a whole number"),
        ({"count": True}, "train.count is True; expected a whole number"),
        ({"quick": 1}, "train.quick is 1; expected true or false"),
        ({"size": "big"}, "train.scene.size is 'big'; expected a number or none"),
        ({"joint": True}, "train.scene.noise.joint is True; expected a number"),
        ({"gravity": [1, 2]}, "expected a text or 3 values, each a number"),
        ({"object": [1]}, "expected a list, each a text"),
        ({"kind": "c"}, "train.kind is 'c'; expected 'a' or 'b'"),
        ({"scene": 3}, "train.scene is 3; expected a table of settings"),
        ({"scene": {"noise": []}}, "expected a table of settings"),
    ],
)
def test_bad_values(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        from_plain(Run, values, "train")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["obiect", "scene.obiect", "count.size", "noise.joint", ""])
def test_unknown_names(name: str) -> None:
    with pytest.raises(
        UnknownName, match="unknown setting (of scene )?.*; known: (scene, kind|object, grav)"
    ):
        changed(Run(), {name: 1})


def test_a_hand_from_a_file_is_absolute_and_one_by_name_stays(tmp_path: Path) -> None:
    for hand, expected in (
        ("dex5", "dex5"),
        ("mine.toml", str(tmp_path / "mine.toml")),
        ("hands/mine.urdf", str(tmp_path / "hands" / "mine.urdf")),
    ):
        config = from_plain(EnvConfig, {"hand": hand})
        assert absolute(config, tmp_path).scene.hand == expected
