"""``python -m hardware.emulator``: emulated servos on a pseudo-terminal, until input ends.

Prints ``{"port": ...}`` and then answers the side channel (see `hardware.emulator.server`). By
hand: Ctrl-D ends it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import tyro

from dexctl.exceptions import DexctlError, InvalidInput
from hardware.emulator.chain import Chain
from hardware.emulator.dynamics import FirstOrderJoints, Joints
from hardware.emulator.server import Server, say

_PRIORITY = 40  # below the runner's


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Emulated XM430-W210 servos on a pseudo-terminal."""

    servos: int = 15
    """How many, for first-order joints; the MuJoCo hand brings its own number."""
    ids: tuple[int, ...] | None = None
    """Their IDs; default 1 to n."""
    zeros: tuple[int, ...] | None = None
    """Ticks that each shows with its shaft at 0 rad; default half a turn."""
    signs: tuple[int, ...] | None = None
    """+1 or -1: which way each is mounted."""
    start: tuple[float, ...] | None = None
    """Where first-order joints start [rad]; default 0."""
    dynamics: Literal["first-order", "mujoco"] = "first-order"
    """What the servos move."""
    hand: str = "dex5"
    """The hand in MuJoCo."""
    object: str = "cylinder"
    """What it holds; "none" for nothing."""
    gravity: Literal["up", "down"] = "up"
    """Which way the palm looks."""
    action_latency: float = 0.0
    """From a goal's arrival to its effect [s]."""
    seed: int = 0
    """Of random faults and of the simulated touch."""
    manual: bool = False
    """Time passes only when the side channel says so."""
    no_fast: bool = False
    """Do not know fast reads, like older firmware."""


def _joints(settings: Settings) -> Joints:
    if settings.dynamics == "mujoco":
        from hardware.emulator.mujoco_hand import MujocoHand

        return MujocoHand(settings.hand, settings.object, settings.gravity, settings.seed)
    start = settings.start if settings.start is not None else (0.0,) * settings.servos
    if not start or len(start) > 252 or not np.isfinite(start).all():
        raise InvalidInput(f"{len(start)} joints; expected 1 to 252, at finite angles")
    return FirstOrderJoints(np.array(start))


def _check(settings: Settings, count: int) -> None:
    for name, allowed in (("ids", range(253)), ("zeros", range(4096)), ("signs", (-1, 1))):
        given = getattr(settings, name)
        if given is None:
            continue
        if len(given) != count:
            raise InvalidInput(f"{len(given)} {name}; expected {count}, one for each servo")
        bad = [value for value in given if value not in allowed]
        if bad:
            limits = f"{allowed[0]} to {allowed[-1]}" if name != "signs" else "-1 or 1"
            raise InvalidInput(f"{name} has {bad[0]}; expected {limits}")
    if settings.ids is not None and len(set(settings.ids)) < count:
        raise InvalidInput(f"ids {settings.ids}: two servos share one")


def _chain(settings: Settings) -> Chain:
    joints = _joints(settings)
    _check(settings, len(joints.q))
    joints.set_action_latency(settings.action_latency)
    return Chain(joints, settings.ids, settings.zeros, settings.signs, not settings.no_fast)


def _keep_time() -> None:
    """Go before the machine's other work where that is permitted, as real servos do."""
    if hasattr(os, "SCHED_FIFO"):
        with contextlib.suppress(OSError):
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(_PRIORITY))


def main() -> int:
    """Serve until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for whoever drives the servos
    settings = tyro.cli(Settings, description=__doc__)
    try:
        server = Server(partial(_chain, settings), settings.manual, settings.seed)
    except DexctlError as error:
        say({"error": str(error)})
        return 2
    gc.collect()
    gc.freeze()
    if not settings.manual:
        _keep_time()
    say({"port": server.port, "servos": len(server.chain.servos)})
    server.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
