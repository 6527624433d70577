"""The files that an MJCF world is made of, checked before MuJoCo opens any of them.

A world may come from a stranger: what it includes must lie in its own folder, and what it declares must be small enough
to be held.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from edqn_jax.errors import ConfigError

MOST_BYTES = 20_000_000
"""Of a world's files together."""

MOST_COPIES = 10_000
"""That `replicate` elements within each other may ask for."""


class SceneError(ConfigError):
    """A world that cannot be flown; the message says what to change."""


def files_of(path: Path) -> list[Path]:
    """Returns the file of a world, and every file that it includes or names, each once.

    Raises:
        SceneError: if one lies outside the world's folder, is missing or no XML, or all are too large.
    """
    root = path.resolve().parent
    found: dict[Path, None] = {}
    _collect(path.resolve(), root, found)
    size = sum(file.stat().st_size for file in found)
    if size > MOST_BYTES:
        raise SceneError(f"'{path}' and what it includes have {size:,} bytes; a world may have {MOST_BYTES:,}")
    return list(found)


def _collect(file: Path, root: Path, found: dict[Path, None]) -> None:
    """Adds a file of MJCF and all that it names."""
    if file in found:
        return
    if not file.is_file():
        raise SceneError(f"there is no file '{file}'")
    if file.stat().st_size > MOST_BYTES:
        raise SceneError(f"'{file}' has {file.stat().st_size:,} bytes; a world may have {MOST_BYTES:,}")
    found[file] = None
    try:
        tree = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError, OSError) as error:
        raise SceneError(f"{file} is not an MJCF that MuJoCo can read: {error}") from None
    except RecursionError:
        raise SceneError(f"{file} is nested too deeply for a world") from None
    _check_copies(tree, file)
    folders = {"": Path(), **dict(_folders(tree))}
    for element in tree.iter():
        named = element.get("file")
        if named is None:
            continue
        inside = _inside(file.parent / folders.get(_kind(element), folders["asset"]) / named, root, file)
        if element.tag in ("include", "model"):
            _collect(inside, root, found)
        elif inside.is_file():  # MuJoCo says best what is wrong with those that are not
            found[inside] = None


def _folders(tree: ElementTree.Element) -> Iterator[tuple[str, Path]]:
    """Yields the folders of a `compiler` element by the kind of asset that they are for."""
    yield "asset", Path()
    for element in tree.iter("compiler"):
        for kind in ("asset", "mesh", "texture"):
            folder = element.get(f"{kind}dir")
            if folder is not None:
                yield kind, Path(folder)


def _kind(element: ElementTree.Element) -> str:
    """Returns which of the compiler's folders an element's file is in; none for included files."""
    if element.tag in ("include", "model"):
        return ""
    return {"mesh": "mesh", "hfield": "mesh", "texture": "texture"}.get(element.tag, "asset")


def _inside(named: Path, root: Path, file: Path) -> Path:
    """Returns the whole path of a named file.

    Raises:
        SceneError: if it is not in the world's folder, links included.
    """
    whole = named.resolve()
    if not whole.is_relative_to(root):
        raise SceneError(f"'{file}' names '{named}', which is outside of the world's folder '{root}'")
    return whole


def _check_copies(tree: ElementTree.Element, file: Path) -> None:
    """Raises if `replicate` elements ask for more copies than a world can have.

    Raises:
        SceneError: says how many.
    """
    pending = [(tree, 1.0)]
    total = 0.0
    while pending:
        element, copies = pending.pop()
        if element.tag == "replicate":
            try:
                copies *= max(float(element.get("count", "1")), 1.0)
            except ValueError:
                copies = math.nan  # MuJoCo says what is wrong
            total += 0.0 if math.isnan(copies) else copies
        if total > MOST_COPIES:
            raise SceneError(f"'{file}' asks for {total:,.0f} copies by replicate; a world may have {MOST_COPIES:,}")
        pending += [(child, copies) for child in element]
