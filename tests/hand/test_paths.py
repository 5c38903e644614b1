"""What is no path to a hand's file."""

from __future__ import annotations

from typing import Any

import pytest

from dexctl import HandModel, HandModelError

URDF = '<?xml version="1.0"?>\n<robot name="hand">\n' + 200 * "<link/>\n" + "</robot>"


@pytest.mark.parametrize("build", [HandModel.from_mjcf, HandModel.from_urdf])
@pytest.mark.parametrize(
    "text", [URDF, "\ufeff  \n" + URDF, "<mujoco><worldbody/></mujoco>", URDF.encode(), 3, None]
)
def test_the_text_of_a_file_is_no_path(build: Any, text: object) -> None:
    with pytest.raises(HandModelError, match="expected the path of a file") as error:
        build(text, ["tip"])
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


@pytest.mark.parametrize("build", [HandModel.from_mjcf, HandModel.from_urdf])
@pytest.mark.parametrize("name", ["absent.urdf", 5000 * "a", "a\0b"])
def test_a_name_that_no_file_can_have(build: Any, name: str) -> None:
    with pytest.raises(HandModelError, match="no such file"):
        build(name, ["tip"])
