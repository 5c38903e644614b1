"""Conditions by name, and from files."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.sim import SceneConfig
from dexctl.sim.conditions import CONDITIONS, under


def test_conditions_add_up() -> None:
    config = under(SceneConfig(object=("cube",)), "everything", "limits", "any-gravity")
    assert config.object == ("cube",)
    assert config.limits.speed_limit == 0.6
    assert config.limits.torque_limit == 0.5
    assert config.limits.action_latency == 0.05
    assert config.randomisation.mass_range == (0.05, 0.25)
    assert config.randomisation.gravity_tilt == pytest.approx(3.14159, abs=1e-4)
    assert config.sensing.force_noise == 0.5


def test_bounded_offsets_are_as_wide_as_normal_ones() -> None:
    normal = under(SceneConfig(), "everything").sensing.joint_offset
    bounded = under(SceneConfig(), "everything", "bounded")
    low, high = bounded.randomisation.joint_offset_range or (0.0, 0.0)
    assert (low, high) == (-0.05, 0.05) and bounded.sensing.joint_offset == 0.0
    assert (high - low) / 12**0.5 == pytest.approx(normal)


def test_noise_is_what_sensors_are_off_by_under_everything() -> None:
    noisy, everything = under(SceneConfig(), "noise"), under(SceneConfig(), "everything")
    assert noisy.sensing == everything.sensing != SceneConfig().sensing
    assert noisy == SceneConfig(sensing=noisy.sensing)


@pytest.mark.parametrize("name", list(CONDITIONS))
def test_each_is_a_scene(name: str) -> None:
    assert (under(SceneConfig(), name) == SceneConfig()) == (name == "nominal")


def test_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        "object_mass = 0.2\nfriction_range = [0.5, 0.6]\ntip_friction_range = [0.7, 1.0]\n"
        "link_friction_range = [0.2, 1]\n[sensing]\njoint_noise = 0.1\n"
    )
    config = under(SceneConfig(), str(path))
    assert config.object_mass == 0.2
    assert config.randomisation.friction_range == (0.5, 0.6)
    assert config.randomisation.tip_friction_range == (0.7, 1.0)
    assert config.randomisation.link_friction_range == (0.2, 1.0)
    assert config.sensing.joint_noise == 0.1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "mine.toml sets nothing; expected settings such as mass_range"),
        ("mass = 1", "unknown setting of .*mine.toml 'mass'; known: hand"),
        ("object_mass = 'x'", "object_mass is 'x'; expected a number"),
        ("object_mass", "is not TOML"),
        ("friction_range = [1.4, 0.6]", "mine.toml: friction_range is .* the lower one first"),
        (None, "cannot read .*: No such file"),
    ],
)
def test_bad_files(tmp_path: Path, content: str | None, said: str) -> None:
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_text(content)
    with pytest.raises((InvalidInput, UnknownName), match=said):
        under(SceneConfig(), str(path))


def test_several_with_commas_between(tmp_path: Path) -> None:
    path = tmp_path / "mine,yours.TOML"
    path.write_text("object_mass = 0.2\n")
    both = under(SceneConfig(), "everything,limits", str(path))
    assert both == under(SceneConfig(object_mass=0.2), "everything", "limits")
    with pytest.raises(UnknownName, match="unknown conditions 'moon'; known: nominal, limits"):
        under(SceneConfig(), "limits,moon")


def test_unknown_conditions() -> None:
    with pytest.raises(UnknownName, match="unknown conditions 'moon'; known: nominal, limits"):
        under(SceneConfig(), "moon")
