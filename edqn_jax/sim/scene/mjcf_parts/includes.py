"""Files that a world includes, put into its elements; what a static world has no use for, taken out."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf_parts.assets import find_file
from edqn_jax.sim.scene.mjcf_parts.xml import DEEPEST

MOST_INCLUDED = 100
"""Files that a world may include."""

MOST_PIXELS = 1024
"""Along a side of a texture that MuJoCo makes as it is."""

_OF_FILES = ("gridsize", "gridlayout", "content_type")


def insert_includes(tree: ElementTree.Element, path: Path, parse: Callable[[Path], ElementTree.Element]) -> bool:
    """Puts the elements of the files that a world includes, each once, in place of their names.

    Args:
        tree: of the world at `path`.
        path: of the world, in whose folder or below it they lie.
        parse: returns the first element of a file.

    Returns:
        whether there was any.

    Raises:
        ConfigError: if a file is missing, lies elsewhere, cannot be read, or is included twice.
    """
    included: set[Path] = set()
    pending = [(tree, 1)]
    while pending:
        parent, depth = pending.pop()
        if depth > DEEPEST:
            raise ConfigError(f"{path} has more than {DEEPEST} elements within each other with the files it includes")
        at = 0
        while at < len(parent):
            child = parent[at]
            if child.tag != "include":
                pending.append((child, depth + 1))
                at += 1
                continue
            file = find_file(path, "", child.get("file", ""), "include")
            if file in included or file == path.resolve():
                raise ConfigError(f"{path} includes '{child.get('file')}' twice; MuJoCo allows it once")
            included.add(file)
            if len(included) > MOST_INCLUDED:
                raise ConfigError(f"{path} includes more than {MOST_INCLUDED} files; put them together")
            parent[at : at + 1] = list(parse(file))
    return bool(included)


def drop_unused(tree: ElementTree.Element) -> bool:
    """Takes the sizes of MuJoCo's memory and textures that are large or of files, which are not drawn, out of a world.

    Returns:
        whether there was any.
    """
    dropped = [(parent, child) for parent in tree.iter() for child in parent if child.tag == "size"]
    for parent, child in dropped:
        parent.remove(child)
    textures = [each for each in tree.iter("texture") if each.keys() and not _is_small(each)]
    for texture in textures:
        name = Path(texture.get("file", "").replace("\\", "/")).stem
        for key in [key for key in texture.keys() if key.startswith("file") or key in _OF_FILES]:  # noqa: SIM118
            del texture.attrib[key]
        if name:
            texture.attrib.setdefault("name", name)
        for key, value in (("builtin", "flat"), ("width", "2"), ("height", "2")):
            texture.set(key, value)
    return bool(dropped or textures)


def _is_small(texture: ElementTree.Element) -> bool:
    """Returns whether a texture is MuJoCo's own, and of few pixels."""
    sides = [texture.get(key, "0").strip() for key in ("width", "height")]
    if any(key.startswith("file") for key in texture.keys()):  # noqa: SIM118
        return False
    return all(not side.isdecimal() or int(side[:9]) <= MOST_PIXELS for side in sides)
