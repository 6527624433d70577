"""Files that are kept from one command to the next: whole or not at all, and a damaged one is told apart."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from pathlib import Path

_DIGEST = 32  # bytes


def read_kept(file: Path) -> bytes | None:
    """Returns what `write_kept` wrote; None if there is no such file, or it is damaged."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    return content[_DIGEST:] if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST] else None


def write_kept(file: Path, content: bytes) -> None:
    """Keeps the content, if that is possible. Commands side by side may write the same file."""
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        made = Path(scratch) / file.name
        made.write_bytes(hashlib.sha256(content).digest() + content)
        made.replace(file)


def name_of(*parts: bytes) -> str:
    """Returns 32 letters and digits that tell apart what is made of these parts."""
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()[:32]
