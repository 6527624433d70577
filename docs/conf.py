"""Configuration of the documentation's site: `sphinx-build -W --keep-going docs build/site`."""

from __future__ import annotations

import re
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
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "extensions.pages",
    "extensions.notebooks",
    "extensions.docstrings",
    "extensions.fields",
    "extensions.formulas",
]
exclude_patterns = ["images/README.md", "extensions", "_templates", "_static"]
templates_path = ["_templates"]

# Pages are read on GitHub too, which shows math between dollars and in fences, as Sphinx does.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
html_math_renderer = "mathml"
myst_heading_anchors = 4
nb_execution_mode = "off"
nb_merge_streams = True

# A name in single backticks leads to its documentation where it has some, and is code where not.
default_role = "py:obj"
smartquotes = False  # [...] is a shape
autosummary_generate = True
autosummary_ignore_module_all = True
autosummary_imported_members = False
add_module_names = False
autodoc_member_order = "bysource"
# What extras install and the package imports only where it is used; the site is the same with and without.
sources = "".join(file.read_text(encoding="utf-8") for file in Path(__file__).parents[1].glob("edqn_jax/**/*.py"))
autodoc_mock_imports = sorted({*re.findall(r'require\("(\w+)', sources)} - {"edqn_jax", "gymnasium"})
del sources
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_display_short_literal_types = True
maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
