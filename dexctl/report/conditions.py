"""The section of a report that says how to get the same figures again."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, get_type_hints

from dexctl import settings
from dexctl.report import html, words
from dexctl.sim import SceneConfig

if TYPE_CHECKING:
    from dexctl.sim import Scene

# Settings that `conditions` says in words of its own, and one that no figure depends on.
_SAID = (
    "hand", "object", "object_size", "object_mass", "gravity", "control_period", "substeps",
    "initial_states", "disturbance", "threads",
)  # fmt: skip


def conditions(
    config: SceneConfig,
    *,
    command: str,
    machine: Mapping[str, Any],
    seed: int,
    scene: Scene | None = None,
    axis: str | Sequence[float] | None = None,
    more: Iterable[tuple[str, str]] = (),
) -> str:
    """The section that says under what conditions a report's figures were found.

    Args:
        config: the settings; those that are not as usual are listed.
        command: what was typed.
        machine: see `dexctl.report.machine`.
        seed: of the first trial.
        scene: what was simulated, for what the settings leave to the hand.
        axis: that rotation is counted about.
        more: further rows, (what, value).
    """
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    gravity = config.palm if scene is None else f"{words.vector(scene.gravity.tolist())} m/s²"
    rows = [
        ("command", command),
        ("hand", config.hand),
        ("object", _object(config, scene)),
        ("gravity", gravity),
    ]
    if axis is not None:
        rows.append(("axis", axis if isinstance(axis, str) else words.vector(axis)))
    rows += [
        ("control", f"{1 / config.control_period:g} Hz, {config.substeps} physics steps each"),
        ("start", _start(config)),
        *not_as_usual(config),
        *more,
        ("seed", str(seed)),
        ("machine", f"{machine['processor']}, {machine['cores']} cores"),
        ("system", f"{machine['system']}, Python {machine['python']}"),
        ("versions", versions),
    ]
    return html.section("Conditions", html.facts(rows))


def not_as_usual(config: SceneConfig) -> list[tuple[str, str]]:
    """The settings that differ from their defaults, as (what, value with unit).

    Those that `conditions` says in words of its own are left out.
    """
    usual, rows = SceneConfig(), []
    for path in settings.paths(SceneConfig):
        value = settings.get(config, path)
        if path in _SAID or value == settings.get(usual, path):
            continue
        unit = units(SceneConfig).get(path, "")
        rows.append(
            (path.rpartition(".")[2].replace("_", " "), f"{setting_text(value)} {unit}".strip())
        )
    return rows


@cache
def units(kind: type) -> Mapping[str, str]:
    """The unit of each setting below ``kind`` by its path: the [...] of the text under it."""
    found = {}
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    for field, text in zip(body.body, body.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            unit = re.search(r"\[([^]]+)\]", str(text.value.value))
            if unit is not None:
                found[field.target.id] = unit[1]
    for name, hint in get_type_hints(kind).items():
        if is_dataclass(hint) and isinstance(hint, type):
            found |= {f"{name}.{path}": unit for path, unit in units(hint).items()}
    return found


def _object(config: SceneConfig, scene: Scene | None) -> str:
    width, mass = (
        (config.object_size, config.object_mass)
        if scene is None
        else (scene.object_width, scene.object_mass)
    )
    said = [", ".join(config.object)]
    said += [f"{width:g} m wide"] if width else []
    said += [f"{mass:g} kg"] if mass else []
    said += [] if scene is None else [f"friction {scene.friction():g}"]
    return ", ".join(said)


def _start(config: SceneConfig) -> str:
    states = config.initial_states
    grasp = "settled grasp" if states is None else f"grasp states of {states}"
    if not config.disturbance:
        return grasp
    return f"{grasp}, set-points disturbed by N(0, {config.disturbance:g} rad)"


def setting_text(value: Any) -> str:
    """The value of a setting, for people."""
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple):
        return ", ".join(setting_text(one) for one in value)
    return "none" if value is None else str(value)
