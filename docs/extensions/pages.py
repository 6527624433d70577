"""Pages that the site takes from elsewhere, and links that lead out of `docs/`.

Markdown is written for GitHub, where a link to `../edqn_jax/sim/sensors/events.py#event_count` opens the file. On the
site the same link leads to the function's documentation.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from sphinx.application import Sphinx

from extensions.notebooks import SHOWN

ELSEWHERE = {
    "CONTRIBUTING.md": "contributing",
    "CHANGELOG.md": "changelog",
    "edqn_jax/policies/pretrained/README.md": "pretrained",
    "edqn_jax/policies/pretrained-looks/README.md": "pretrained-looks",
    "edqn_jax/policies/pretrained-late/README.md": "pretrained-late",
    "edqn_jax/policies/pretrained-body/README.md": "pretrained-body",
}
"""Page of the site that shows Markdown from outside of `docs/`; in the repository it has a link alone."""

LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")
"""Path and fragment of a relative Markdown link."""

LISTED = {"decisions/README": "0*", "howto/README": "*"}
"""Pages below a page that lists them itself, as a table of contents that GitHub would show as code."""


def linked(text: str, folder: str) -> str:
    """Returns Markdown whose links out of `docs/` lead to pages of the site.

    Args:
        text: Markdown of a page.
        folder: where the page stands, from the root of the repository, with slashes.
    """

    def replaced(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, link[1]))
        fragment = link[2] or ""
        if path in ELSEWHERE:
            return f"/{ELSEWHERE[path]}.md{fragment}"
        if path.startswith("edqn_jax/") and path.endswith(".py"):
            module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
            return "#" + ".".join([module, *fragment.split("#")[1:]])
        if path.startswith("notebooks/") and path.endswith(".ipynb"):
            return f"/{path}{fragment}"
        if path.startswith("docs/"):
            # Of a folder GitHub shows its README.
            page = path if posixpath.splitext(path)[1] else f"{path}/README.md"
            return f"/{page.removeprefix('docs/')}{fragment}"
        return link[0]

    return LINK.sub(replaced, text)


def read_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Changes the text of a page after it was read from its file."""
    file = Path(app.env.doc2path(page))
    root = Path(app.srcdir).parent
    if file.suffix == ".ipynb":
        source[0] = linked(source[0], SHOWN)
        return
    if file.suffix != ".md":
        return
    for path, name in ELSEWHERE.items():
        if page == name:
            app.env.note_dependency(root / path)
            file = root / path
            source[0] = file.read_text(encoding="utf-8")
    source[0] = linked(source[0], file.parent.relative_to(root).as_posix())
    if page in LISTED:
        source[0] += f"\n\n```{{toctree}}\n:hidden:\n:glob:\n\n{LISTED[page]}\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers it."""
    app.connect("source-read", read_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
