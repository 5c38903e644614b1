"""From arguments to a command and back again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest
import tyro

from dexctl.cli.command_line import command_line
from dexctl.cli.parsing import Switch, parse
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.limits import HandLimits
from dexctl.settings import NESTED, Vector
from dexctl.sim import SceneConfig
from dexctl.sim.randomisation import Randomisation


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Who acts."""

    method: Literal["rl", "fge"] = "rl"
    """How."""
    layers: tuple[int, ...] | None = None
    """Widths of the layers."""
    cloned: Literal["acted", "visited"] | None = None
    """What is cloned."""
    average: bool = True
    """Whether to average."""


@dataclass(kw_only=True)
class Learn:
    """Learn something."""

    short: ClassVar[Mapping[str, str]] = {"--method": "--guidance.method"}

    what: tyro.conf.Positional[str] = "all"
    """What is learned."""
    recipe: str = "fast"
    """Settings that belong together."""
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)
    guidance: Guidance = field(default_factory=Guidance)
    axis: Vector = "z"
    """Of the hand."""
    overlap: bool = False
    """Whether to overlap."""
    json: Switch = False
    """Print one JSON object."""

    deciding: ClassVar[tuple[str, ...]] = ("--recipe",)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Learn:
        if "thesis" not in arguments:
            return cls()
        scene = SceneConfig(object_mass=0.2, limits=HandLimits(speed_limit=2.0))
        return cls(recipe="thesis", scene=scene, guidance=Guidance(method="fge"))


@dataclass(kw_only=True)
class Needs:
    """Wants a path."""

    path: tyro.conf.Positional[Path]
    """Which."""
    seconds: float = 1.0
    """How long."""


def learn(*words: str) -> Learn:
    found = parse(Learn, "dexctl learn", words)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ((), {}),
        (("--no-overlap",), {}),
        (("--overlap", "--json"), {"overlap": True, "json": True}),
        (("--method", "fge"), {"guidance": Guidance(method="fge")}),
        (("--method=fge",), {"guidance": Guidance(method="fge")}),
        (("--guidance.no-average",), {"guidance": Guidance(average=False)}),
        (("--guidance.layers", "3", "4"), {"guidance": Guidance(layers=(3, 4))}),
        (("--guidance.cloned", "none"), {}),
        (("--axis", "-z"), {"axis": "-z"}),
        (("--axis=-x",), {"axis": "-x"}),
        (("--mass-range", "0.05,0.25"), {
            "scene": SceneConfig(randomisation=Randomisation(mass_range=(0.05, 0.25)))}),
        (("--axis", "-1,0,0.5"), {"axis": (-1.0, 0.0, 0.5)}),
        (("some", "--object", "cube", "l_shape"), {
            "what": "some", "scene": SceneConfig(object=("cube", "l_shape"))}),
        (("--object-size", "None", "--speed-limit", "2"), {
            "scene": SceneConfig(limits=HandLimits(speed_limit=2.0))}),
    ],
)  # fmt: skip
def test_words_and_what_they_mean(words: tuple[str, ...], command: dict[str, Any]) -> None:
    assert learn(*words) == Learn(**command)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "dexctl learn"),
        (("--json", "--no-overlap", "--seed-of-nothing"), None),
        (("--recipe", "thesis"), "dexctl learn --recipe thesis"),
        (("--guidance.method", "fge"), "dexctl learn --method fge"),
        (("--recipe", "thesis", "--method", "fge"), "dexctl learn --recipe thesis"),
        (
            ("--recipe", "thesis", "--method", "rl", "--speed-limit", "none", "a b"),
            "dexctl learn 'a b' --recipe thesis --speed-limit none --method rl",
        ),
        (("--gravity", "-1,0,2.5", "--axis", "-z"), "dexctl learn --gravity=-1,0,2.5 --axis=-z"),
    ],
)
def test_a_command_says_what_was_typed(words: tuple[str, ...], said: str | None) -> None:
    if said is None:
        with pytest.raises(InvalidInput, match="--seed-of-nothing"):
            learn(*words)
        return
    assert command_line(learn(*words), "learn") == said
    assert learn(*shlex.split(said)[2:]) == learn(*words)


def test_options_without_a_default_are_always_said() -> None:
    assert command_line(Needs(path=Path("runs/1")), "group needs") == "dexctl group needs runs/1"


def test_the_recipe_comes_before_what_is_given() -> None:
    found = learn("--recipe", "thesis", "--object-mass", "0.3")
    assert found.guidance.method == "fge"
    assert found.scene == SceneConfig(object_mass=0.3, limits=HandLimits(speed_limit=2.0))


def test_help_is_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse(Learn, "dexctl learn", ["--help"]) is None
    said = capsys.readouterr().out
    assert "{None}" not in said
    assert "--object-size FLOAT" in said
    assert "--overlap, --no-overlap" in said
    assert "--no-json" not in said
    assert said.splitlines()[-1].split() == ["--method", "is", "--guidance.method"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--gravity 1,2", "'1,2' is neither a name nor three finite numbers"),
        ("--mass-range 1", "'1' is no range; expected two numbers, low,high"),
        ("--mass-range 2,1", "mass_range is (2.0, 1.0); expected two finite numbers above 0 on"),
        ("--gravity 1,2,x", "'1,2,x' is neither a name nor three"),
        ("--gravity 1,2,nan", "'1,2,nan' is neither a name nor three"),
        ("--axis -1,2", "'-1,2' is neither a name nor three finite numbers"),
        ("--method walk", "invalid choice 'walk'"),
        ("--object-mass heavy", "could not convert string to float: 'heavy'"),
        ("--object-mass 0", "object_mass is 0.0"),
        ("--guidance.layers 2.5", "2.5"),
        ("--no-json", "Unrecognized options: --no-json"),
        ("--seed 1", "Unrecognized options: --seed, 1"),
    ],
)
def test_bad_words_are_one_line(words: str, said: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        learn(*words.split())
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "Error parsing" not in str(caught.value)  # the parser's own words


def test_unknown_names_are_those_of_the_configuration() -> None:
    with pytest.raises(UnknownName, match="unknown hand 'claw'; known: dex5"):
        learn("--hand", "claw")
    with pytest.raises(UnknownName, match="unknown gravity 'left'; known: up, down"):
        learn("--gravity", "left")
