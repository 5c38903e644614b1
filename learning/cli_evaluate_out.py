"""What `dexctl evaluate` leaves in a folder, and says as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dexctl.cli.output import notes, to_json
from dexctl.exceptions import MissingExtra
from dexctl.files import write_text
from dexctl.report.machine import machine
from learning import cli_evaluate_figures as figures
from learning import evaluation_files as files
from learning.evaluate import Evaluation, Protocol
from learning.transfer import Trained, Transfer


def described(
    trained: Sequence[Trained],
    protocol: Protocol,
    found: Sequence[Evaluation],
    matrix: Transfer | None,
) -> dict[str, Any]:
    """Everything that was found, and how."""
    first = trained[0].controller
    cards = [getattr(one.controller, "card", None) for one in trained]
    if matrix is not None:
        what: dict[str, Any] = {"transfer": matrix.to_dict(), "cards": cards}
    else:
        what = {"policy": trained[0].name, "card": cards[0]}
        what["results"] = [
            {
                "object": one.object,
                "noise": asdict(one.protocol.noise),
                "push_N": one.protocol.push.force,
                **one.to_dict(),
            }
            for one in found
        ]
    return {
        "hand": first.hand.path.stem,
        "gravity": protocol.gravity,
        "axis": protocol.direction,
        "object_size_m": protocol.object_size,
        "object_mass_kg": protocol.object_mass,
        "latency_s": protocol.latency,
        "episodes": protocol.episodes,
        "seconds": protocol.seconds,
        "control_period_s": first.control_period,
        "seeds": [protocol.seed, protocol.seed + protocol.episodes - 1],
        **what,
        "machine": machine(),
    }


def write(
    folder: Path, result: Mapping[str, Any], found: Sequence[Evaluation], matrix: Transfer | None
) -> None:
    """CSV files, figures and, last of all, ``evaluate.json``."""
    if matrix is not None:
        files.write_transfer(folder / "transfer.csv", matrix)
    else:
        files.write_figures(folder / "figures.csv", found)
        files.write_curves(folder / "curves.csv", found)
        files.write_episodes(folder / "episodes.csv", found)
    try:
        _draw(folder, found, matrix)
    except MissingExtra as error:  # the numbers are worth more than the figures
        notes().print(f"dexctl: {error}; no figures are drawn", markup=False)
    write_text(folder / "evaluate.json", to_json(result) + "\n")
    notes().print(f"written: {folder / 'evaluate.json'}, with CSV files and figures beside it")


def _draw(folder: Path, found: Sequence[Evaluation], matrix: Transfer | None) -> None:
    if matrix is not None:
        figures.draw_transfer(folder / "transfer.png", matrix)
        return
    undisturbed = [one for one in found if not (one.protocol.noise or one.protocol.push)]
    figures.draw_rotation(folder / "rotation.png", undisturbed)
    if len(undisturbed) < len(found):
        figures.draw_robustness(folder / "robustness.png", found)
