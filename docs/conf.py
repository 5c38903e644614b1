"""Sphinx configuration: pages in Markdown (MyST), the interface from docstrings."""

from __future__ import annotations

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

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3

# `name` in a docstring links to it where it is documented, and is code where it is not
default_role = "py:obj"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True
# type aliases by name: the arrays' shapes are in the docstrings
autodoc_type_aliases = {"Floats": "Floats", "Bools": "Bools", "ArrayLike": "ArrayLike"}
