"""The text of an MJCF world, checked before MuJoCo reads it.

A world may be untrusted, so no files are read but meshes, height fields and MJCF in its own folder (`assets.py`,
`includes.py`), and it declares nothing that takes much memory. MuJoCo gets the checked elements, serialised again,
never a path, so both parse the same.
"""

from __future__ import annotations

import codecs
import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf_parts import xml as mjcf_xml
from edqn_jax.sim.scene.mjcf_parts.assets import FARTHEST, MAX_HEIGHTS, inline_files
from edqn_jax.sim.scene.mjcf_parts.includes import drop_unused, insert_includes

MAX_BYTES = 20_000_000
"""Of a world's file."""

MAX_COPIES = 10_000
"""That `replicate` elements within each other may ask for."""

MAX_NUMBERS = 4096
"""Of a numeric."""

MAX_PARAMETER = 100
"""Of a mesh that MuJoCo makes: the number of its triangles grows with the square."""

_FAR = re.compile(r"(?<![\d.])[1-9]\d{7,}|e\+?0*(?:[7-9]|[1-9]\d)", re.IGNORECASE)
"""In numbers of `FARTHEST` or more, which MuJoCo answers with a page on its standard error."""

FOREIGN = ("model", "attach", "plugin", "extension", "flexcomp", "composite", "skin")
"""Elements that name other files, run other code or make much of little; a static world needs none of them."""


class SceneError(ConfigError):
    """A world that cannot be flown; the message says what to change."""


def load_checked_text(path: Path) -> str:
    """Returns the text of a world's file as XML of its elements alone, with the numbers of the files that it names.

    Raises:
        SceneError: if there is no such file, it is too large or no XML, or it asks for what a world may not have.
    """
    return _checked_text(path, _read(path))


def self_contained_bytes(path: Path) -> bytes:
    """Returns the content of a world's file; if it names other files, as text that holds theirs.

    Raises:
        SceneError: as `load_checked_text`; a file that is no world is returned as it is.
        OSError: if it cannot be read.
    """
    content = path.read_bytes()
    if b"file" not in content:
        return content
    try:
        text = _checked_text(path, content)
        return text.encode() if mjcf_xml.parse_xml(_decoded(path, content))[1] != text else content
    except mjcf_xml.MarkupError:
        return content


def _read(path: Path) -> bytes:
    """Returns the content of a world's file.

    Raises:
        SceneError: if it cannot be read or is too large.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SceneError(f"'{path}' has {size:,} bytes; a world may have {MAX_BYTES:,}")
        return path.read_bytes()
    except (OSError, RuntimeError) as error:
        raise SceneError(f"cannot read the world '{path}': {getattr(error, 'strerror', None) or error}") from None


def _decoded(path: Path, content: bytes) -> str:
    """Returns the text of a file.

    Raises:
        SceneError: if it is of an encoding that MuJoCo does not read.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in content[:4]:
        raise SceneError(f"{path} is not an MJCF that MuJoCo can read: it is UTF-16 or UTF-32 text; save it as UTF-8")
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1")  # MuJoCo asks no name for its encoding


def _checked_text(path: Path, content: bytes) -> str:
    """Returns `load_checked_text` of a file's content."""
    tree, text = _parsed(path, content)
    if tree.tag != "mujoco":
        raise SceneError(f"{path} is not an MJCF: it begins with <{tree.tag}>, not <mujoco>")
    left = MAX_BYTES - len(content)

    def parse(file: Path) -> ElementTree.Element:
        nonlocal left
        more = _read(file)
        left -= len(more)
        if left < 0:
            raise SceneError(f"{path} has more than {MAX_BYTES:,} bytes with the files that it includes; thin them out")
        return _parsed(file, more)[0]

    try:
        is_changed = insert_includes(tree, path, parse)
        is_changed |= drop_unused(tree)
        _check_elements(tree, path)
        _check_copies(tree, path)
        is_changed |= inline_files(tree, path)
    except SceneError:
        raise
    except ConfigError as error:
        raise SceneError(str(error)) from None
    if not is_changed:
        return text
    text = ElementTree.tostring(tree, encoding="unicode")
    if len(text) > MAX_BYTES:
        raise SceneError(f"{path} has {len(text):,} bytes with the files that it names; a world may have {MAX_BYTES:,}")
    return text


def _parsed(path: Path, content: bytes) -> tuple[ElementTree.Element, str]:
    """Returns the first element of a file, and the file as XML of it alone.

    Raises:
        SceneError: if MuJoCo would not read it.
    """
    try:
        return mjcf_xml.parse_xml(_decoded(path, content))
    except mjcf_xml.SubsetError:
        raise SceneError(f"{path} has a <!DOCTYPE> that declares something; a world needs none") from None
    except mjcf_xml.MarkupError as error:
        raise SceneError(f"{path} is not an MJCF that MuJoCo can read: {error}") from None


def _check_elements(tree: ElementTree.Element, path: Path) -> None:
    """Raises SceneError if an element names a file or is not allowed in a world.

    Raises:
        SceneError: names the element.
    """
    for element in tree.iter():
        if element.tag in FOREIGN:
            raise SceneError(f"{path} has <{element.tag}>; a world is static geoms and sites")
        named = [name for name in element.keys() if name.startswith("file")]  # noqa: SIM118
        if named and element.tag not in ("mesh", "hfield"):
            raise SceneError(
                f"{path} names the file '{element.get(named[0])}' in <{element.tag}>; a world names none but those of "
                "meshes and height fields, and worlds to include"
            )
        made = max([0.0, *map(_number, element.get("params", "").split())])
        if element.tag == "mesh" and made > MAX_PARAMETER:
            raise SceneError(f"{path} has <mesh params=...> of more than {MAX_PARAMETER}")
        if element.tag == "mesh" and _FAR.search(element.get("vertex", "")):
            name = element.get("name", "")
            raise SceneError(f"{path} has <mesh name='{name}'> with a vertex {FARTHEST:g} or more away; scale it")
        if element.tag == "hfield" and not element.get("file"):
            rows, columns = _number(element.get("nrow")), _number(element.get("ncol"))
            if not (min(rows, columns) >= 2 and rows * columns <= MAX_HEIGHTS):
                raise SceneError(
                    f"{path} has a height field '{element.get('name', '')}' of {rows:g} x {columns:g}; it must be "
                    f"2 x 2 to {MAX_HEIGHTS:,} heights"
                )
        if element.tag == "numeric" and _number(element.get("size")) > MAX_NUMBERS:
            raise SceneError(f"{path} has <numeric size=...> of more than {MAX_NUMBERS}")


def _check_copies(tree: ElementTree.Element, path: Path) -> None:
    """Raises SceneError if `replicate` elements make more copies than a world may have.

    Raises:
        SceneError: says how many.
    """
    pending, total = [(tree, 1.0)], 0.0
    while pending:
        element, copies = pending.pop()
        if element.tag == "replicate":
            copies *= max(_number(element.get("count")), 1.0)
            total += copies
        if total > MAX_COPIES:
            raise SceneError(f"{path} asks for {total:,.0f} copies by replicate; a world may have {MAX_COPIES:,}")
        pending += [(child, copies) for child in element]


def _number(text: str | None) -> float:
    """Returns an attribute as a number; 0 if it is missing or no number (MuJoCo then reports it)."""
    try:
        value = float(text or 0)
    except ValueError:
        return 0.0
    return 0.0 if math.isnan(value) else value
