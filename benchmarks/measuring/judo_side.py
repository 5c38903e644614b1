"""Predictive sampling of judo-rai (MIT) on a scene of ours: one trial, as a process of its own.

It needs another version of MuJoCo than ours, so an interpreter of its own runs this, with nothing
of dexctl: what it gets is a model's file and the settings of `predictive_sampling.py`. It prints
one JSON object.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from judo.controller import Controller, ControllerConfig
from judo.optimizers.ps import PredictiveSampling, PredictiveSamplingConfig
from judo.tasks.base import Task, TaskConfig


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions, wxyz ``(..., 4)``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - (av * bv).sum(-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def since(quaternion: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn about the world's z and tilt ``(...)`` [rad] since ``start``, the turn in (-pi, pi]."""
    turn = multiplied(quaternion, start * np.array([1.0, -1.0, -1.0, -1.0]))
    flat = np.hypot(turn[..., 0], turn[..., 3])
    angle = 2.0 * np.arctan2(turn[..., 3], turn[..., 0])
    yaw = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return yaw, 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:3], axis=-1), flat)


@dataclass
class TurningConfig(TaskConfig):
    """Weights of the reward; the position's is that of judo's own task for a cube in a hand."""

    w_turn: float = 1.0
    w_pos: float = 100.0
    w_tilt: float = 0.5


class Turning(Task[TurningConfig]):
    """The object is to be turned about z, and to stay where it is."""

    name = "turning"
    config_t = TurningConfig

    def __init__(self, settings: dict[str, Any]) -> None:  # its own would fetch judo's meshes
        self.config = TurningConfig(**settings["weights"])
        self.model = mujoco.MjModel.from_xml_path(settings["model"])
        self.sim_model = self.model
        self.data = mujoco.MjData(self.model)
        self.ctrl = np.array(settings["ctrl"])
        self.qpos, self.qvel = np.array(settings["qpos"]), np.zeros(self.model.nv)
        self.place = slice(settings["object_qpos"], settings["object_qpos"] + 3)
        self.turned = slice(settings["object_qpos"] + 3, settings["object_qpos"] + 7)
        self.start = self.qpos[self.place].copy()
        self.upright = self.qpos[self.turned].copy()
        self.reset()

    def reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.ctrl[:] = self.qpos, self.ctrl
        mujoco.mj_forward(self.model, self.data)

    def optimizer_warm_start(self) -> np.ndarray:
        return self.ctrl

    def reward(
        self,
        states: np.ndarray,
        sensors: np.ndarray,
        controls: np.ndarray,
        system_metadata: dict[str, Any] | None = None,
    ) -> np.ndarray:
        w = self.config
        yaw, tilt = since(states[..., self.turned], self.upright)
        gained = np.unwrap(yaw, axis=-1)
        away = np.square(states[..., self.place] - self.start).sum(-1)
        costs = 0.5 * (w.w_pos * away + w.w_tilt * tilt**2)
        return w.w_turn * (gained[:, -1] - gained[:, 0]) - costs.mean(-1)


def trial(settings: dict[str, Any]) -> dict[str, Any]:
    """One episode: how far the object is turned before it is dropped, and what that took."""
    np.random.seed(settings["seed"])  # noqa: NPY002 (judo draws from it)
    task = Turning(settings)
    optimizer = PredictiveSampling(PredictiveSamplingConfig(**settings["sampling"]), task.model.nu)
    controller = Controller(ControllerConfig(**settings["controller"]), task, optimizer)
    data, step = task.data, task.model.opt.timestep
    per_plan = round(settings["period"] / step)
    turned, before = 0.0, 0.0
    planning = wall = 0.0
    plans, dropped = 0, False
    while data.time < settings["seconds"] - 1e-9 and not dropped:
        controller.current_state = np.concatenate([data.qpos, data.qvel])
        controller.time = data.time
        old = controller.spline
        processor, clock = time.process_time(), time.perf_counter()
        controller.update_action()
        took = time.perf_counter() - clock
        planning += time.process_time() - processor
        wall, plans = wall + took, plans + 1
        late = settings["real_time"]
        follow, count = (old, round(took / step)) if late else (controller.spline, per_plan)
        for _ in range(max(count, 1)):
            data.ctrl[:] = follow(data.time)
            mujoco.mj_step(task.model, data)
            yaw, _ = since(data.qpos[task.turned], task.upright)
            turned += (yaw - before + np.pi) % (2.0 * np.pi) - np.pi
            before = yaw
            dropped = np.linalg.norm(data.qpos[task.place] - task.start) > settings["drop_distance"]
            if dropped or data.time >= settings["seconds"]:
                break
    return {
        "rotation_rad": float(turned),
        "time_held_s": float(data.time),
        "dropped": bool(dropped),
        "processor_s": planning,
        "plan_s": wall / plans,
        "plans": plans,
        "versions": {"mujoco": mujoco.__version__, "numpy": np.__version__},
    }


if __name__ == "__main__":
    print(json.dumps(trial(json.loads(Path(sys.argv[1]).read_text()))))
