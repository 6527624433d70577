"""The code blocks of the documentation's pages."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)

SHELL = ("", "sh", "bash")
"""Languages of blocks that a shell runs; a block without a language is one, too."""


def blocks_of(page: Path, *languages: str) -> list[str]:
    """Returns the code blocks of a page in these languages."""
    return [code for language, code in FENCE.findall(page.read_text(encoding="utf-8")) if language in languages]


def name_of(page: Path) -> str:
    """Returns a page's path within the repository."""
    return page.relative_to(ROOT).as_posix()
