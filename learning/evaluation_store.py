"""Finished evaluations in a folder, so that a series that was killed goes on where it stopped.

Each evaluation has a file of its own, written aside and then renamed. Its name holds a digest of
everything that decides the numbers, so nothing is ever taken for something else: with another
policy, protocol or version the evaluation is simply made anew.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import dexctl
from dexctl.controller import Controller
from dexctl.files import aside
from learning.evaluate import Evaluation, Protocol, evaluate
from learning.policies import Policy
from learning.robustness import disturbance

FORMAT = 1
_ARRAYS = ("rotation", "time_held", "dropped", "diverged", "returns", "moments", "rotations")


class EvaluationStore:
    """`evaluate` that keeps what is finished, and does not do it again.

    Args:
        folder: where; it is made when there is something to keep.

    Attributes:
        found: how many evaluations were there already.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self.found = 0

    def __call__(
        self,
        controller: Controller,
        object: str,  # noqa: A002 (the field's name for it)
        protocol: Protocol | None = None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Evaluation:
        """The evaluation; see `learning.evaluate.evaluate`."""
        protocol = protocol if protocol is not None else Protocol()
        about = json.dumps(_about(controller, object, protocol), sort_keys=True)
        path = self._path(object, protocol, about)
        kept = _read(path, about, object, protocol)
        if kept is not None:
            self.found += 1
            if progress is not None:
                progress(protocol.seconds)
            return kept
        made = evaluate(controller, object, protocol, progress=progress)
        self._folder.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {name: getattr(made, name) for name in _ARRAYS}
        with aside(path) as part, part.open("wb") as stream:
            np.savez_compressed(stream, about=np.array(about), **arrays)
        return made

    def _path(self, name: str, protocol: Protocol, about: str) -> Path:
        kind, level = disturbance(protocol)
        disturbed = f"-{kind}-{level:g}" if kind else ""
        digest = hashlib.sha256(about.encode()).hexdigest()[:16]
        return self._folder / f"{name}{disturbed}-{digest}.npz"


def fingerprint(controller: Controller) -> str:
    """A digest of what decides a controller's actions."""
    if isinstance(controller, Policy):
        digest = hashlib.sha256(json.dumps(controller.spec._asdict(), sort_keys=True).encode())
        for layer in controller.layers:
            for array in layer:
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
    config = repr(getattr(controller, "config", None))
    kind = type(controller)
    return hashlib.sha256(f"{kind.__module__}.{kind.__qualname__} {config}".encode()).hexdigest()


def _about(controller: Controller, name: str, protocol: Protocol) -> dict[str, Any]:
    how = asdict(protocol)
    del how["threads"]  # changes nothing
    return {
        "format": FORMAT,
        "dexctl": dexctl.__version__,
        "controller": fingerprint(controller),
        "hand": controller.hand.path.stem,
        "control_period": controller.control_period,
        "object": name,
        "protocol": how,
    }


def _read(path: Path, about: str, name: str, protocol: Protocol) -> Evaluation | None:
    """What was kept; None where there is nothing that can be read."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["about"]) != about:
                return None
            return Evaluation(name, protocol, **{key: stored[key] for key in _ARRAYS})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
