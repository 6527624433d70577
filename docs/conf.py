"""Configuration of the documentation's site: `sphinx-build -W --keep-going docs build/site`."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "edqn_jax"
author = "The edqn-jax contributors"
copyright = author
release = version = metadata.version("edqn-jax")
html_title = f"{project} {release}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinxcontrib.mermaid",
    "extensions.pages",
    "extensions.docstrings",
    "extensions.fields",
]
exclude_patterns = ["images/README.md", "extensions", "_templates", "_static"]
templates_path = ["_templates"]

# Pages are read on GitHub too, so they have nothing that only Sphinx shows: math between dollars, diagrams as fences.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["mermaid"]
myst_heading_anchors = 4

# A name in single backticks leads to its documentation where it has some, and is code where not.
default_role = "py:obj"
autosummary_generate = True
autosummary_ignore_module_all = True
autosummary_imported_members = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_display_short_literal_types = True
maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
