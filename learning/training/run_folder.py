"""Run folders: what a run is kept in, and the only place that knows the names of its files.

A run folder holds ``config.json``, ``hand.json`` (which hand is trained), ``progress.csv`` with
TensorBoard's files in ``tensorboard``, ``checkpoint.bin``, and ``policy.npz`` with its card
``policy.json``; where starts were planned for the run, ``starts.npz``. Everything in it is written
aside and renamed, so a run that is killed at any moment leaves whole files, and at most what it was
writing beside them.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl.exceptions import InvalidInput
from dexctl.files import write_text
from dexctl.hands.identity import identity
from dexctl.locking import locked
from learning.training import checkpoint
from learning.training.checkpoint import CheckpointError
from learning.training.log import read_rows

if TYPE_CHECKING:
    from dexctl.hand import HandModel
    from dexctl.sim import SceneConfig
    from learning.config import TrainConfig

_WIDTHS = "widths"  # in the file of the hand
_EARLIER_CHECKPOINT = "checkpoint.pt"
_PART = re.compile(r"\..+\.(\d+)\.part(\.[^.]+)?")
"""Names that `dexctl.files.aside` writes to, with the number of the process."""


class RunFolder:
    """The folder of one run.

    Nothing is read or made before a method is called that says so.

    Args:
        path: of the folder, which need not be there yet.

    Attributes:
        config_path, hand_path, progress_path, tensorboard_path, checkpoint_path, policy_path,
            starts_path: where the parts of the run are, or will be.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_path = path / "config.json"
        self.hand_path = path / "hand.json"
        self.progress_path = path / "progress.csv"
        self.tensorboard_path = path / "tensorboard"
        self.checkpoint_path = path / "checkpoint.bin"
        self.policy_path = path / "policy.npz"
        self.starts_path = path / "starts.npz"
        self._held = False

    @staticmethod
    def is_run(path: Path) -> bool:
        """Whether a folder holds a run, however far it came."""
        return RunFolder(path).config_path.exists()

    def check_new(self) -> None:
        """Raise InvalidInput where the folder holds a run already."""
        if self.config_path.exists() or self.checkpoint_path.exists():
            raise InvalidInput(
                f"{self.path} holds a run already; resume it, or take another folder"
            )

    def create(self, config: TrainConfig | Mapping[str, Any]) -> None:
        """Make the folder of a new run, with its configuration.

        Raises:
            InvalidInput: it holds a run already.
        """
        self.check_new()
        if not isinstance(config, Mapping):
            from dexctl.settings import to_plain

            config = to_plain(config)
        self._make()
        write_text(self.config_path, json.dumps(config, indent=2) + "\n")

    def forget(self) -> None:
        """Take back `create` and `note_hand`, for a run that cannot begin."""
        for path in (self.config_path, self.hand_path):
            path.unlink(missing_ok=True)

    def note_hand(self, hand: HandModel, scene: SceneConfig) -> None:
        """Keep which hand is trained; where it is kept already, it has to be the same.

        How wide the scene's objects are is kept beside it: the digest leaves that out.

        Raises:
            InvalidInput: the hand's files are others than when the run began, or its objects
                have another width.
        """
        before, known = self._kept_hand()
        own = scene.object if scene.object_size is None else ()
        found = {name: hand.config.object.width(name) for name in own}
        widths = {name: width for name, width in found.items() if width is not None}
        if before is None:
            kept = {**identity(hand), _WIDTHS: widths}
            write_text(self.hand_path, json.dumps(kept, indent=2) + "\n")
            return
        if before != hand.digest:
            raise InvalidInput(
                f"the files of the hand {hand.name} have changed since the run began (sha256 was "
                f"{before[:12]}, is {hand.digest[:12]}); put them back, or begin anew"
            )
        for name, width in (known or {}).items():
            if widths.get(name, width) != width:
                raise InvalidInput(
                    f"the hand {hand.name} now holds a {name} of {widths[name]:g} m; expected "
                    f"{width:g} m, as when the run began: put it back into the hand's toml, or "
                    "begin anew"
                )

    def hand_digest(self) -> str | None:
        """The sha256 of the hand's files when the run began; None where it is not kept.

        Raises:
            InvalidInput: it cannot be read.
        """
        return self._kept_hand()[0]

    def hand_widths(self) -> dict[str, float] | None:
        """How wide the run's objects were when it began [m]; None where it is not kept.

        Raises:
            InvalidInput: it cannot be read.
        """
        return self._kept_hand()[1]

    def _kept_hand(self) -> tuple[str | None, dict[str, float] | None]:
        """The digest and the widths, each None where it is not kept."""
        try:
            kept = json.loads(self.hand_path.read_text(encoding="utf-8"))
            widths = kept.get(_WIDTHS)  # None in folders of earlier versions
            if widths is not None:
                widths = {str(name): float(width) for name, width in widths.items()}
            return str(kept["sha256"]), widths
        except FileNotFoundError:
            return None, None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInput(f"cannot read {self.hand_path}: {error}") from None

    def config(self) -> TrainConfig:
        """The configuration of the run.

        Raises:
            InvalidInput: there is none, or it is wrong.
        """
        from dexctl.settings import from_plain
        from learning.config import TrainConfig

        return from_plain(TrainConfig, self.config_values(), str(self.config_path))

    def config_values(self) -> dict[str, Any]:
        """The configuration of the run as JSON has it, whatever its settings are.

        Raises:
            InvalidInput: there is none, or it is no JSON object.
        """
        path = self.config_path
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InvalidInput(f"there is no run in {self.path}: no {path.name}") from None
        except OSError as error:
            raise InvalidInput(f"cannot read {path}: {error.strerror or error}") from None
        except UnicodeDecodeError as error:
            raise InvalidInput(f"{path} is not UTF-8: byte {error.start}") from None
        except ValueError as error:
            raise InvalidInput(f"{path} is not JSON: {error}") from None
        except RecursionError:
            raise InvalidInput(f"{path} is nested too deeply for a configuration") from None
        if not isinstance(values, dict):
            raise InvalidInput(f"{path} is not a JSON object: it is {type(values).__name__}")
        return values

    def write_checkpoint(self, content: Mapping[str, Any]) -> None:
        """Put a checkpoint in place of the one before; see `checkpoint.write`.

        Raises:
            CheckpointError: it cannot be written; the one before is left.
        """
        checkpoint.write(self.checkpoint_path, content)

    def read_checkpoint(self) -> dict[str, Any] | None:
        """The content of the last checkpoint; None where there is none yet.

        Raises:
            CheckpointError: it is damaged, or of another version.
        """
        if self.checkpoint_path.exists():
            return checkpoint.read(self.checkpoint_path)
        earlier = self.path / _EARLIER_CHECKPOINT
        if earlier.exists():
            raise CheckpointError(
                f"{earlier} is of an earlier version, which this one cannot read; begin anew"
            )
        return None

    def progress(self) -> list[dict[str, float]]:
        """The rows of the log, NaN where a row has no number; none where there is no log yet.

        A row that is being written, or that a kill cut short, is left out. The columns are
        `learning.training.log.columns`.

        Raises:
            InvalidInput: the file is no log.
        """
        rows = read_rows(self.progress_path)
        return [{name: float(v) if v else math.nan for name, v in row.items()} for row in rows]

    @contextmanager
    def lock(self, wait: float = 0.0) -> Iterator[None]:
        """Hold the folder in this block, so that no other process works in it; made if need be.

        Args:
            wait: for whom holds it to let go [s].

        Raises:
            InvalidInput: somebody else holds it.
        """
        self._make()
        with locked(self.path, wait):
            self._held = True
            try:
                yield
            finally:
                self._held = False

    def clean(self) -> None:
        """Remove what killed runs were writing.

        That is all of it while this holds the folder's lock; otherwise only what is of processes
        that are no more.
        """
        for path in self.path.iterdir() if self.path.is_dir() else ():
            part = _PART.fullmatch(path.name)
            if part is not None and (self._held or not _alive(int(part[1]))):
                path.unlink(missing_ok=True)

    def _make(self) -> None:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInput(f"cannot make the folder {self.path}: {error.strerror}") from None


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
