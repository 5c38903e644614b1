"""Sphinx configuration: pages in Markdown (MyST), the interface from docstrings."""

from __future__ import annotations

import re
from typing import Any

import dexctl

project = "dexctl"
author = "The dexctl contributors"
copyright = f"2026, {author}"  # noqa: A001 (Sphinx reads this name)
release = version = dexctl.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"dexctl {release}"
html_static_path = ["_static"]
html_css_files = ["custom.css"]

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3

# `name` in a docstring links to it where it is documented, and is code where it is not
default_role = "py:obj"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]  # a plain list, not "Variables"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True
# type aliases by name: the arrays' shapes are in the docstrings
autodoc_type_aliases = {"Floats": "Floats", "Bools": "Bools", "ArrayLike": "ArrayLike"}


def _skip_named_tuple_fields(
    app: Any, what: str, name: str, member: Any, skip: bool, options: Any
) -> bool | None:
    """The fields of named tuples stand in their docstrings, with shapes and units."""
    return True if (getattr(member, "__doc__", None) or "").startswith("Alias for field") else None


def _plain_bars(
    app: Any, what: str, name: str, member: Any, options: Any, lines: list[str]
) -> None:
    """Absolute values, |x| <= y: reStructuredText would take |x| for a substitution."""
    for i, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[i] = "".join(parts)


_properties: dict[str, list[str]] = {}


def _keep_property(
    app: Any, what: str, name: str, member: Any, options: Any, lines: list[str]
) -> None:
    """Before napoleon: it reads "What was found: a mapping" as a type and its description."""
    if what == "property":
        _properties[name] = list(lines)


def _restore_property(
    app: Any, what: str, name: str, member: Any, options: Any, lines: list[str]
) -> None:
    if any(line.startswith(":type:") for line in lines):
        lines[:] = _properties.get(name, lines)


def _plain_aliases(
    app: Any, what: str, name: str, member: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Type aliases by name also where they are part of a union."""
    alias = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
    if signature is None:
        return None
    return alias.sub(r"\1", signature), alias.sub(r"\1", returns) if returns else returns


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-skip-member", _skip_named_tuple_fields)
    app.connect("autodoc-process-docstring", _keep_property, priority=100)
    app.connect("autodoc-process-docstring", _restore_property, priority=800)
    app.connect("autodoc-process-docstring", _plain_bars, priority=900)
    app.connect("autodoc-process-signature", _plain_aliases)
