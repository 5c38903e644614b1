"""Pictures of a hand and of its grasp, and the page with them."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexctl.cli.checks import make_folder
from dexctl.cli.hand_checks import HandCheck
from dexctl.exceptions import DexctlError, SimulationError
from dexctl.files import write_bytes, write_text

if TYPE_CHECKING:
    from dexctl.sim import Scene


def hand_page(
    folder: Path,
    scene: Scene | None,
    *,
    title: str,
    source: str,
    guesses: Iterable[tuple[str, str, str]] = (),
    checks: Iterable[HandCheck] = (),
    failure: DexctlError | None = None,
    grasp: bool = True,
) -> list[str]:
    """Write PNG files and ``report.html``; their paths.

    Args:
        folder: where; made if need be.
        scene: with the hand in it; None: no pictures.
        title: of the page.
        source: which file the hand is from.
        guesses: setting, value, reason.
        checks: as `check_hand` yields them.
        failure: why there is no grasp.
        grasp: whether the scene has one, or an attempt at one, to draw.

    Raises:
        SimulationError: there is no OpenGL to draw with.
        MissingExtra: matplotlib is not installed.
    """
    from dexctl.report import hand as report
    from dexctl.report.picture import png

    pictures: dict[str, np.ndarray] = {}
    if scene is not None:
        from dexctl.sim.hand_pictures import grasp_picture, hand_pictures

        stretched = np.clip(0.0, scene.hand.lower, scene.hand.upper)
        for view, picture in hand_pictures(scene, stretched).items():
            pictures[f"the hand, stretched, {view}"] = picture
        for view, picture in hand_pictures(scene, scene.open_q).items():
            pictures[f"the hand, open, {view}"] = picture
        what = "the grasp" if failure is None else "the attempt that came closest"
        if grasp:
            with suppress(SimulationError):  # it does not settle, as `failure` says
                pictures[what] = grasp_picture(scene, failure)
    words = {True: "yes", False: "no", None: "not checked"}
    said = ["no grasp was found: " + str(failure)] if failure is not None else []
    page = report.build(
        title,
        source,
        pictures=pictures,
        guesses=guesses,
        checks=[(one.name, words[one.good], one.said) for one in checks],
        notes=[*said, *(scene.notes if scene is not None else ())],
    )
    make_folder(folder)
    written = []
    for what, picture in pictures.items():
        path = folder / (what.replace(",", "").replace(" ", "_") + ".png")
        write_bytes(path, png(picture))
        written.append(str(path))
    write_text(folder / "report.html", page)
    return [*written, str(folder / "report.html")]
