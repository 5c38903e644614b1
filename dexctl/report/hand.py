"""The page of a hand: what was guessed and why, pictures, checks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dexctl.report import html
from dexctl.report.picture import png


def build(
    name: str,
    source: str,
    *,
    pictures: Mapping[str, np.ndarray],
    guesses: Iterable[tuple[str, str, str]] = (),
    checks: Iterable[tuple[str, str, str]] = (),
    notes: Iterable[str] = (),
) -> str:
    """The page as HTML.

    Args:
        name: of the hand.
        source: which file it is from.
        pictures: by what they show.
        guesses: setting, value and reason.
        checks: what was checked, yes or no, what was found.
        notes: what was changed for the simulator.
    """
    sections = []
    drawn = [html.image(png(picture), what, what) for what, picture in pictures.items()]
    if drawn:
        legend = (
            "Orange: the links that fingertips are on; red balls: their points. Blue arrow: where "
            "the palm looks. Green arrow: where the fingers point. What is wrong can be mended in "
            "the toml."
        )
        sections.append(html.section("Pictures", html.paragraph(legend), *drawn))
    guessed = list(guesses)
    if guessed:
        rows = [(f"{setting}: {value}", reason) for setting, value, reason in guessed]
        sections.append(html.section("What was guessed", html.facts(rows)))
    checked = list(checks)
    if checked:
        rows = [(what, f"{good}: {said}") for what, good, said in checked]
        sections.append(html.section("Checks", html.facts(rows)))
    lines = list(notes)
    if lines:
        sections.append(html.section("In the simulator", *map(html.paragraph, lines)))
    return html.page(name, source, sections)
