"""Finished evaluations in a folder, so that a series that was killed goes on where it stopped.

Each evaluation has a file of its own, written aside and then renamed. Its name holds a digest of
everything that decides the numbers, so that nothing is taken for something else: with another
policy, protocol or version the evaluation is simply made anew. Nothing is kept of who cannot be
told from another (`fingerprint`), such as a controller made with a function.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import dexctl
from dexctl.controller import Controller
from dexctl.files import DAMAGED, aside
from dexctl.settings import changed, get, paths, to_plain
from learning.evaluation.figures import Evaluation
from learning.evaluation.fingerprint import fingerprint, of_file
from learning.evaluation.protocol import Protocol
from learning.evaluation.robustness import levels_of
from learning.evaluation.rollout import Progress, evaluate, one_object
from learning.evaluation.subject import Subject

FORMAT = 5
_ARRAYS = [field.name for field in fields(Evaluation) if field.name not in ("object", "protocol")]


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
        who: Subject | Controller,
        protocol: Protocol | None = None,
        *,
        object: str | None = None,  # noqa: A002
        progress: Progress | None = None,
    ) -> Evaluation:
        """The evaluation; see `learning.evaluation.evaluate`."""
        if protocol is None:
            protocol = who.protocol() if isinstance(who, Subject) else Protocol()
        name = one_object(protocol) if object is None else object
        controller = who.acting(protocol) if isinstance(who, Subject) else who
        who_it_is = fingerprint(controller)
        if who_it_is is None:
            return evaluate(controller, protocol, object=name, progress=progress)
        about = json.dumps(_about(controller, who_it_is, name, protocol), sort_keys=True)
        path = self._path(name, protocol, about)
        kept = _read(path, about, name, protocol)
        if kept is not None:
            self.found += 1
            if progress is not None:
                progress(protocol.seconds)
            return kept
        made = evaluate(controller, protocol, object=name, progress=progress)
        self._folder.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {name: getattr(made, name) for name in _ARRAYS}
        with aside(path) as part, part.open("wb") as stream:
            np.savez_compressed(stream, about=np.array(about), **arrays)
        return made

    def _path(self, name: str, protocol: Protocol, about: str) -> Path:
        noises = levels_of(protocol).items()
        disturbed = "".join(f"-{kind}-{level:g}" for kind, level in noises if level)
        digest = hashlib.sha256(about.encode()).hexdigest()[:16]
        return self._folder / f"{name}{disturbed}-{digest}.npz"


def _about(controller: Controller, who_it_is: str, name: str, protocol: Protocol) -> dict[str, Any]:
    """What decides the numbers: the files that a protocol names count by what is in them."""
    how = changed(protocol, {"object": (name,), "threads": None})  # threads change nothing
    how = replace(how, scene=how.scene.with_mass(controller.hand.config))
    files = {path: get(how, path) for path in paths(Protocol)}
    return {
        "format": FORMAT,
        "dexctl": dexctl.__version__,
        "controller": who_it_is,
        "hand": controller.hand.digest,
        "width": controller.hand.config.object.sizes.get(name),  # which the digest leaves out
        "control_period": controller.control_period,
        "protocol": to_plain(how),
        "files": {path: of_file(file) for path, file in files.items() if isinstance(file, Path)},
    }


def _read(path: Path, about: str, name: str, protocol: Protocol) -> Evaluation | None:
    """What was kept; None where there is nothing that can be read."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["about"]) != about:
                return None
            arrays = {key: stored[key] for key in _ARRAYS}
            return Evaluation(object=name, protocol=protocol, **arrays)
    except DAMAGED:
        return None
