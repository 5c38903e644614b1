"""One HTML file with everything in it: styles, pictures, plots. No scripts, nothing to load."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root { --ink: #1f2933; --faint: #5c6b7a; --line: #d9dee3; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 60rem; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
header { border-bottom: 3px solid var(--accent); margin-bottom: 1.5rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .4rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .3rem; }
p, figcaption { max-width: 46rem; }
header p, figcaption, .note { color: var(--faint); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: .8rem 0;
  font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: right; border-bottom: 1px solid var(--line); }
th { font-weight: 600; border-bottom: 2px solid var(--ink); vertical-align: bottom; }
td { white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
table.facts { width: auto; }
table.facts td { white-space: normal; text-align: left; vertical-align: top; }
table.facts td:first-child { color: var(--faint); white-space: nowrap; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img { width: 100%; height: auto; display: block; }
figure video { width: 100%; max-width: 40rem; display: block; }
figcaption { margin-top: .3rem; }
.strip { display: flex; gap: .4rem; } .strip figure { flex: 1; margin: .4rem 0; }
.strip img { aspect-ratio: 1; object-fit: cover; }
.strip figcaption { font-size: .85rem; }
code { font: .92em ui-monospace, "DejaVu Sans Mono", Menlo, monospace; background: #f1f4f6;
  padding: .1em .3em; border-radius: 3px; }
/* on a phone plots keep a size that can be read, and scroll sideways */
@media screen and (max-width: 44rem) { main { padding: 1rem .9rem 3rem; }
  figure.plot { overflow-x: auto; } figure.plot img { width: 44rem; max-width: none; }
  figure.plot figcaption { position: sticky; left: 0; max-width: calc(100vw - 1.8rem); } }
@media print { figure video { display: none; } main { max-width: none; padding: 0; }
  h2 { break-after: avoid; }
  body { font-size: 11px; } section { break-inside: avoid; } }
"""


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """The whole document; ``sections`` are HTML."""
    body = "\n".join(sections)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<header><h1>{text(title)}</h1><p>{text(subtitle)}</p></header>\n"
        f"{body}\n</main>\n</body>\n</html>\n"
    )


def section(heading: str, *parts: str) -> str:
    """A headed section of HTML parts."""
    return f"<section>\n<h2>{text(heading)}</h2>\n" + "\n".join(parts) + "\n</section>"


def text(value: object) -> str:
    """Plain text, escaped."""
    return html.escape(str(value))


def paragraph(value: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{kind}">{text(value)}</p>' if kind else f"<p>{text(value)}</p>"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of plain text, numbers flush right."""
    head = "".join(f"<th>{text(heading)}</th>" for heading in headings)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """A two-column table: what, and its value."""
    body = "\n".join(f"<tr><td>{text(a)}</td><td>{text(b)}</td></tr>" for a, b in rows)
    return f'<table class="facts"><tbody>{body}</tbody></table>'


def plot(figure: Figure, alt: str, caption: str = "") -> str:
    """A matplotlib figure as an SVG inside the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    drawn = image(buffer.getvalue(), alt, caption, kind="svg+xml")
    return drawn.replace("<figure>", '<figure class="plot">', 1)


def image(content: bytes, alt: str, caption: str = "", kind: str = "png") -> str:
    """A picture file inside the page."""
    data = base64.b64encode(content).decode("ascii")
    below = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{text(alt)}" src="data:image/{kind};base64,{data}">{below}</figure>'


VIDEO_PLACE = "<!-- video -->"
"""Where `with_video` puts a video; nothing is seen of it until then."""


def with_video(document: str, content: bytes, alt: str) -> str:
    """The document with an mp4 file's content at `VIDEO_PLACE`."""
    data = base64.b64encode(content).decode("ascii")
    player = (
        f'<figure><video controls muted loop aria-label="{text(alt)}" '
        f'src="data:video/mp4;base64,{data}"></video></figure>'
    )
    return document.replace(VIDEO_PLACE, player, 1)


def strip(images: Iterable[str]) -> str:
    """Pictures side by side."""
    return '<div class="strip">' + "".join(images) + "</div>"
