"""The code blocks of the documentation's pages."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)

SHELL = ("", "sh", "bash")
"""Languages of blocks that a shell runs; a block without a language is one, too."""


def blocks_of(page: Path, *languages: str) -> list[str]:
    """Returns the code blocks of a page in these languages."""
    return [code for language, code in FENCE.findall(page.read_text(encoding="utf-8")) if language in languages]


def empty_module(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Returns the names of an imported module for code to run in; flax looks there for types of fields."""
    module = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    return vars(module)


def name_of(page: Path) -> str:
    """Returns a page's path within the repository."""
    return page.relative_to(ROOT).as_posix()
