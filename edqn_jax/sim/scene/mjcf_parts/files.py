"""The text of an MJCF world, checked before MuJoCo reads it.

A world may be untrusted, so it is one file without references, and it declares nothing that takes much memory.
MuJoCo gets the checked elements, serialised again, never a path, so both parse the same.
"""

from __future__ import annotations

import codecs
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf_parts import xml as mjcf_xml

MAX_BYTES = 20_000_000
"""Of a world's file."""

MAX_COPIES = 10_000
"""That `replicate` elements within each other may ask for."""

MAX_PIXELS = 4096
"""Width and height of a texture, which is not drawn."""

MAX_PARAMETER = 100
"""Of a mesh that MuJoCo makes: the number of its triangles grows with the square."""

FOREIGN = ("include", "model", "attach", "plugin", "extension", "flexcomp", "composite", "hfield", "skin", "size")
"""Elements that name other files, run other code or make much of little; a static world needs none of them."""


class SceneError(ConfigError):
    """A world that cannot be flown; the message says what to change."""


def load_checked_text(path: Path) -> str:
    """Returns the text of a world's file as XML of its elements alone.

    Raises:
        SceneError: if there is no such file, it is too large or no XML, or it asks for what a world may not have.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SceneError(f"'{path}' has {size:,} bytes; a world may have {MAX_BYTES:,}")
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:
        raise SceneError(f"cannot read the world '{path}': {getattr(error, 'strerror', None) or error}") from None
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in content[:4]:
        raise SceneError(f"{path} is not an MJCF that MuJoCo can read: it is UTF-16 or UTF-32 text; save it as UTF-8")
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = content.decode("latin-1")  # MuJoCo asks no name for its encoding
    try:
        tree, text = mjcf_xml.parse_xml(text)
    except mjcf_xml.SubsetError:
        raise SceneError(f"{path} has a <!DOCTYPE> that declares something; a world needs none") from None
    except mjcf_xml.MarkupError as error:
        raise SceneError(f"{path} is not an MJCF that MuJoCo can read: {error}") from None
    if tree.tag != "mujoco":
        raise SceneError(f"{path} is not an MJCF: it begins with <{tree.tag}>, not <mujoco>")
    _check_elements(tree, path)
    _check_copies(tree, path)
    return text


def _check_elements(tree: ElementTree.Element, path: Path) -> None:
    """Raises SceneError if an element names a file or is not allowed in a world.

    Raises:
        SceneError: names the element.
    """
    for element in tree.iter():
        if element.tag in FOREIGN:
            raise SceneError(f"{path} has <{element.tag}>; a world is one file of static geoms and sites")
        named = [name for name in element.keys() if name.startswith("file")]  # noqa: SIM118
        if named:
            raise SceneError(
                f"{path} names the file '{element.get(named[0])}' in <{element.tag}>; a world is one file, and colours "
                "are those of its geoms"
            )
        made = max([0.0, *map(_number, element.get("params", "").split())])
        if element.tag == "mesh" and made > MAX_PARAMETER:
            raise SceneError(f"{path} has <mesh params=...> of more than {MAX_PARAMETER}")
        if element.tag in ("texture", "numeric"):
            for name in ("width", "height", "size"):
                if _number(element.get(name)) > MAX_PIXELS:
                    raise SceneError(f"{path} has <{element.tag} {name}=...> of more than {MAX_PIXELS}")


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
