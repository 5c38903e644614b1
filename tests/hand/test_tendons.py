"""Fixed tendons of an MJCF file that couple joints."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl.exceptions import HandModelError
from dexctl.hand import HandModel

XML = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <body name="proximal"><joint name="j3" axis="0 1 0" range="0 1.5"/><geom size="0.01"/>
        <body name="middle" pos="0.04 0 0"><joint name="j2" axis="0 1 0" range="0 1.5"/>
          <geom size="0.01"/>
          <body name="tip" pos="0.03 0 0"><joint name="j1" axis="0 1 0" range="0 1.5"/>
            <geom size="0.01" pos="0.02 0 0"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t" TENDON><joint joint="j2" coef="A"/><joint joint="j1" coef="B"/></fixed>
  </tendon>
  <actuator><position joint="j3"/>ACTUATOR</actuator>
  <equality>EQUALITY</equality>
</mujoco>
"""


def hand(
    folder: Path, a: float, b: float, tendon: str = "", actuator: str = "", equality: str = ""
) -> HandModel:
    path = folder / "hand.xml"
    text = XML.replace('"A"', f'"{a}"').replace('"B"', f'"{b}"').replace("TENDON", tendon)
    path.write_text(text.replace("ACTUATOR", actuator).replace("EQUALITY", equality))
    return HandModel.from_mjcf(path, {"tip": (0.02, 0, 0)})


PULLED = '<position tendon="t" kp="1" ctrlrange="0 3" forcerange="-0.8 0.5" gear="2"/>'


def test_joints_that_one_actuator_pulls_move_together(tmp_path: Path) -> None:
    found = hand(tmp_path, 1.0, 0.5, actuator=PULLED)
    assert found.joint_names == ("j3", "j2")
    assert found.couplings["j1"].master == "j2"
    assert found.couplings["j1"].scale == 0.5
    # the tendon's length is j2 + 0.5 * 0.5 j2, the force 0.8 over a gear of 2
    np.testing.assert_allclose(found.effort, [np.inf, 1.25 * 2 * 0.8])
    q, step = np.array([0.3, 0.5]), np.array([0, 1e-6])
    ahead, behind = found.fingertip_positions(q + step), found.fingertip_positions(q - step)
    slope = (ahead - behind) / 2e-6
    jacobian = found.contact_jacobian(q, found.fingertip_positions(q))
    np.testing.assert_allclose(jacobian[..., 1], slope, atol=1e-9)


def test_the_ratio_is_what_the_simulator_comes_to(tmp_path: Path) -> None:
    """Joints that give alike: springs of one stiffness, pulled by one tendon."""
    hand(tmp_path, 1.0, 0.5, actuator=PULLED)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "hand.xml"))
    for name in ("j1", "j2"):
        joint = spec.joint(name)
        for attribute, value in (("stiffness", 0.1), ("damping", 0.05)):
            old = np.asarray(getattr(joint, attribute), float)  # a number, or it and higher terms
            new = np.zeros_like(old)
            new.flat[0] = value
            setattr(joint, attribute, new if old.ndim else value)
    spec.option.gravity = np.zeros(3)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[1] = 1.0
    mujoco.mj_step(model, data, 5000)
    j1, j2 = (float(data.joint(name).qpos[0]) for name in ("j1", "j2"))
    assert j2 > 0.1
    assert j1 / j2 == pytest.approx(0.5, rel=0.02)


def test_a_tendon_held_at_a_length_couples(tmp_path: Path) -> None:
    """1 j2 - 0.8 j1 is 0.02, within 0.001."""
    found = hand(tmp_path, 1.0, -0.8, tendon='range="0.019 0.021"')
    assert found.joint_names == ("j3", "j2")
    assert found.couplings["j1"].scale == pytest.approx(1.25)
    assert found.couplings["j1"].offset == pytest.approx(-0.02 / 0.8)
    by_equality = hand(
        tmp_path, 1.0, -0.8, equality='<tendon tendon1="t" polycoef="0.02 0 0 0 0"/>'
    )
    assert by_equality.couplings["j1"].scale == pytest.approx(1.25)
    assert by_equality.couplings["j1"].offset == pytest.approx(-0.02 / 0.8)


def test_tendons_that_couple_nothing(tmp_path: Path) -> None:
    assert hand(tmp_path, 1.0, -1.0).nq == 3  # nothing pulls it
    assert hand(tmp_path, 1.0, -1.0, tendon='range="-1 1"').nq == 3  # loose
    driven = '<position joint="j1"/><position joint="j2"/>' + PULLED
    assert hand(tmp_path, 1.0, 1.0, actuator=driven).nq == 3  # each has its own


def test_an_equality_with_another_tendon_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "hand.xml"
    text = XML.replace('"A"', '"1"').replace('"B"', '"1"').replace("TENDON", "")
    text = text.replace("ACTUATOR", "").replace(
        "</tendon>", '<fixed name="u"><joint joint="j3" coef="1"/></fixed></tendon>'
    )
    path.write_text(text.replace("EQUALITY", '<tendon tendon1="t" tendon2="u"/>'))
    with pytest.raises(HandModelError, match="tendon 't' couples joints otherwise.*couplings"):
        HandModel.from_mjcf(path, ["tip"])
