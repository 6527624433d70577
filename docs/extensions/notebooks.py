"""Notebooks on the site: copied into `docs/` with the outputs that they have, not run.

The repository stores them without outputs. A site with pictures takes them from a folder in which they were run:
`sphinx-build -D notebooks=FOLDER ...` (.ci/run).
"""

from __future__ import annotations

import shutil
from pathlib import Path

from sphinx.application import Sphinx

SHOWN = "notebooks"
"""Folder of the copies in `docs/`; git ignores it."""


def copied(app: Sphinx) -> None:
    """Copies the notebooks that have changed, and removes copies whose notebook is gone."""
    found = Path(app.config.notebooks or Path(app.srcdir).parent / "notebooks")
    shown = Path(app.srcdir) / SHOWN
    shown.mkdir(exist_ok=True)
    for copy in shown.glob("*.ipynb"):
        if not (found / copy.name).is_file():
            copy.unlink()
    for file in sorted(found.glob("*.ipynb")):
        copy = shown / file.name
        if not copy.is_file() or copy.read_bytes() != file.read_bytes():
            shutil.copyfile(file, copy)


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers it."""
    app.add_config_value("notebooks", "", "env", [str])
    app.connect("builder-inited", copied)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
