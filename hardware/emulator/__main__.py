"""``python -m hardware.emulator``: emulated servos on a pseudo-terminal, until input ends.

Takes an `EmulatorConfig` as JSON, ``'{"servos": 3}'``; prints ``{"port": ...}`` and then answers
the side channel (see `hardware.emulator.server`). By hand: Ctrl-D ends it.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import sys
from functools import partial

import numpy as np

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import from_plain
from hardware.emulator.chain import Chain
from hardware.emulator.config import EmulatorConfig
from hardware.emulator.dynamics import FirstOrderJoints, Joints
from hardware.emulator.server import Server, say
from hardware.models import model

_PRIORITY = 40  # below the runner's


def _joints(config: EmulatorConfig) -> Joints:
    if config.dynamics == "mujoco":
        from hardware.emulator.mujoco_hand import MujocoHand

        return MujocoHand(config.scene, config.seed)
    start = config.start if config.start is not None else (0.0,) * config.servos
    if not start or len(start) > 252 or not np.isfinite(start).all():
        raise InvalidInput(f"{len(start)} joints; expected 1 to 252, at finite angles")
    return FirstOrderJoints(np.array(start))


def _check(config: EmulatorConfig, count: int) -> None:
    for name, allowed in (("ids", range(253)), ("zeros", range(4096)), ("signs", (-1, 1))):
        given = getattr(config, name)
        if given is None:
            continue
        if len(given) != count:
            raise InvalidInput(f"{len(given)} {name}; expected {count}, one for each servo")
        bad = [value for value in given if value not in allowed]
        if bad:
            limits = f"{allowed[0]} to {allowed[-1]}" if name != "signs" else "-1 or 1"
            raise InvalidInput(f"{name} has {bad[0]}; expected {limits}")
    if config.ids is not None and len(set(config.ids)) < count:
        raise InvalidInput(f"ids {config.ids}: two servos share one")


def _chain(config: EmulatorConfig) -> Chain:
    joints = _joints(config)
    _check(config, len(joints.q))
    joints.set_action_latency(config.scene.limits.action_latency)
    names = config.models * (len(joints.q) if len(config.models) == 1 else 1)
    if len(names) != len(joints.q):
        raise InvalidInput(f"{len(names)} models; expected one, or one for each of {len(joints.q)}")
    models = [model(name) for name in names]
    return Chain(joints, config.ids, config.zeros, config.signs, config.fast, models)


def _keep_time() -> None:
    """Go before the machine's other work where that is permitted, as real servos do."""
    if hasattr(os, "SCHED_FIFO"):
        with contextlib.suppress(OSError):
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(_PRIORITY))


def main() -> int:
    """Serve until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for whoever drives the servos
    try:
        config = from_plain(EmulatorConfig, json.loads(sys.argv[1]) if sys.argv[1:] else {})
        server = Server(partial(_chain, config), config.manual, config.seed, config.baudrate)
    except (DexctlError, json.JSONDecodeError) as error:
        say({"error": str(error)})
        return 2
    gc.collect()
    gc.freeze()
    if not config.manual:
        _keep_time()
    say({"port": server.port, "servos": len(server.chain.servos)})
    server.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
