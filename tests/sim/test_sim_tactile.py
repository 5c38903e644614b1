"""Tactile readings against MuJoCo's list of contacts, one contact at a time."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexctl.sim import Scene
from dexctl.sim.tactile import TouchSensors


@pytest.mark.parametrize("name", ["cube", "sphere", "dodecahedron", "l_shape"])
def test_sensors_agree_with_the_contact_list(name: str) -> None:
    scene = Scene.build("dex5", name, "up")
    model, m = scene.model, scene.hand.n_fingers
    data = mujoco.MjData(model)
    data.qpos[:] = scene.settled.qpos
    data.ctrl[:] = scene.settled.q_target
    mujoco.mj_forward(model, data)
    sensors = TouchSensors(model, m)
    reading = sensors.read(data.sensordata[None, sensors.columns], 0.05)

    force, position, normal = np.zeros(m), np.zeros((m, 3)), np.zeros((m, 3))
    net = np.zeros((m, 3))
    tips = [model.body(body).id for body in scene.hand.fingertip_bodies]
    held = model.body("object").id
    for i in range(data.ncon):
        contact, wrench = data.contact[i], np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        bodies = model.geom_bodyid[contact.geom]
        if held not in bodies:
            continue
        finger = tips.index(bodies[0] if bodies[1] == held else bodies[1])
        sign = 1.0 if bodies[1] == held else -1.0  # MuJoCo's normal points from geom 1 to geom 2
        force[finger] += wrench[0]
        position[finger] += wrench[0] * contact.pos
        normal[finger] += wrench[0] * sign * contact.frame[:3]
        net[finger] += sign * contact.frame.reshape(3, 3).T @ wrench[:3]
    assert (force > 0.05).all()
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(reading.force[0], force, atol=1e-9)
    np.testing.assert_allclose(reading.position[0], position / force[:, None], atol=1e-9)
    np.testing.assert_allclose(reading.normal[0], normal, atol=1e-9)
    assert reading.other_contact[0] == 0.0
    np.testing.assert_allclose(reading.net_force[0], net, atol=1e-9)
    weight = model.body("object").mass[0] * 9.81
    np.testing.assert_allclose(net.sum(axis=0), [0.0, 0.0, weight], atol=0.05 * weight)


def test_threshold_silences_weak_fingers() -> None:
    scene = Scene.build("dex5", "cube", "up")
    sensors = TouchSensors(scene.model, 5)
    data = scene.settled.sensordata[None, sensors.columns]
    strong = sensors.read(data, 0.05)
    middle = float(np.sort(strong.force[0])[1:3].mean())
    weak = sensors.read(data, middle)
    np.testing.assert_array_equal(weak.in_contact, strong.force >= middle)
    gone = ~weak.in_contact
    assert gone.any()
    assert not weak.force[gone].any()
    assert not weak.position[gone].any()
    assert not weak.normal[gone].any()
