"""Where a MuJoCo model has a hand's joints, and those that follow them or are held."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.hand import HandModel
from dexctl.state import Floats


class HandJoints:
    """The joints of a hand in a model of MuJoCo's.

    Args:
        model: the hand, with or without an object.
        hand: its kinematics.

    Attributes:
        expand: how the model's joints move with the d joints of the hand, ``(nv, d)``.
    """

    def __init__(self, model: mujoco.MjModel, hand: HandModel) -> None:
        order = {name: j for j, name in enumerate(hand.joint_names)}
        names = (*hand.joint_names, *hand.couplings)
        joints = [model.joint(name).id for name in names]
        self._columns = model.jnt_qposadr[joints]
        self._scale, self._offset = np.zeros((len(names), hand.nq)), np.zeros(len(names))
        self._scale[: hand.nq] = np.eye(hand.nq)
        for i, name in enumerate(hand.couplings, hand.nq):
            coupling = hand.couplings[name]
            self._offset[i] = coupling.offset
            if coupling.master is not None:
                self._scale[i, order[coupling.master]] = coupling.scale
        self._model = model
        self.expand = np.zeros((model.nv, hand.nq))
        self.expand[model.jnt_dofadr[joints]] = self._scale

    def place(self, data: mujoco.MjData, q: Floats) -> None:
        """Set the hand's joints ``(d,)`` [rad] in ``data.qpos``, and those that go with them."""
        data.qpos[self._columns] = self._scale @ q + self._offset

    def weight(self, data: mujoco.MjData, q: Floats) -> Floats:
        """Torques that hold the links at ``q`` ``(d,)`` [rad] under the model's gravity, ``(d,)``.

        What the file counts as balanced (``gravcomp``) weighs nothing.
        """
        model, torque = self._model, np.zeros(self._model.nv)
        self.place(data, q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_rne(model, data, 0, torque)  # at rest: nothing but gravity
        if model.ngravcomp:
            mujoco.mj_passive(model, data)
            torque -= data.qfrc_gravcomp
        return torque @ self.expand
