"""LinkWeights: the torques that hold a hand's own links against gravity."""

from __future__ import annotations

import threading

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.sim.file_settings import lean_model
from dexctl.sim.hand_joints import HandJoints
from dexctl.sim.hand_spec import hand_spec
from dexctl.state import Floats


class LinkWeights:
    """The torques that hold a hand's own links against gravity, at any joints.

    What `dexctl.JointTouch` and `GraspState.from_joint_torques` take off, so that links are not
    taken for forces. Masses are those of the hand's file (of its shapes where it has none); what
    the file counts as balanced (``gravcomp``) weighs nothing.

    Args:
        hand: the hand.
        model: of MuJoCo's, with or without an object; None: it is made of the hand's file.

    Raises:
        SimulationError: MuJoCo cannot compile the file.
    """

    def __init__(self, hand: HandModel, model: mujoco.MjModel | None = None) -> None:
        self.hand = hand
        given = lean_model(hand_spec(hand).spec, hand) if model is None else model
        self._model = given.__copy__()  # its gravity changes
        self._data = mujoco.MjData(self._model)
        self._joints = HandJoints(self._model, hand)
        self._lock = threading.Lock()

    def __call__(self, q: ArrayLike, gravity: ArrayLike) -> Floats:
        """At joints ``(..., d)`` [rad] under ``gravity`` ``(..., 3)`` [m/s^2], ``(..., d)`` [N m].

        Gravity is in the hand's frame; one for all of them, ``(3,)``, will do.

        Raises:
            InvalidInput: arrays of other shapes.
        """
        q, gravity = np.asarray(q, float), np.asarray(gravity, float)
        if q.shape[-1:] != (self.hand.nq,):
            raise InvalidInput(f"q has shape {q.shape}; expected (..., {self.hand.nq})")
        if gravity.shape not in ((3,), (*q.shape[:-1], 3)):
            raise InvalidInput(
                f"gravity has shape {gravity.shape}; expected (3,) or {(*q.shape[:-1], 3)}"
            )
        rows = q.reshape(-1, self.hand.nq)
        pulls = np.broadcast_to(gravity, (*q.shape[:-1], 3)).reshape(-1, 3)
        torque = np.empty_like(rows)
        with self._lock:
            for i, row in enumerate(rows):
                self._model.opt.gravity = pulls[i]
                torque[i] = self._joints.weight(self._data, row)
        return torque.reshape(q.shape)
