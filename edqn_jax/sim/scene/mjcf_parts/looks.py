"""What a world looks like, in MJCF: its light, and the numbers of its patterns, for which MJCF has no words.

    <custom><numeric name="surface:box1" data="3 0.5 ..."/></custom>

A numeric `surface:` with the name of a geom holds the `SURFACE_NUMBERS` numbers of its pattern (`surface.py`), and one
named `daylight` the direction to the sun, the ambient share of the light and the sky's RGB. MuJoCo shows neither;
`painting/materials.py` of the camera makes pictures of patterns. Light is written as MuJoCo's own too, so that it
shades as the package's camera does, and is read from the numeric alone.
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import jax.numpy as jnp
import mujoco
import numpy as np

from edqn_jax.sim.scene.mjcf_parts.files import SceneError
from edqn_jax.sim.scene.scene import Scene, Shape
from edqn_jax.sim.scene.surface import CONTRAST, KIND, PATTERNS, SURFACE_NUMBERS, Daylight, Surface

PREFIX, DAYLIGHT = "surface:", "daylight"
"""Names of numerics: the first is followed by the name of a geom."""

_NEAR_M = 0.05
"""Nothing nearer to a camera than this is drawn by MuJoCo; well within the drone's body."""


def numbers_text(values: object) -> str:
    """Formats numbers with enough digits to restore a float32."""
    return " ".join(f"{float(value):.9g}" for value in np.asarray(values).ravel())


def add_visuals(root: ElementTree.Element, scene: Scene) -> ElementTree.Element:
    """Adds to an MJCF what MuJoCo's pictures need of a world: how far they reach, sky and ambient light.

    Returns:
        its `<asset>`.
    """
    lower, upper = np.asarray(scene.volume)
    extent = np.max(upper - lower) / 2
    daylight = scene.daylight
    head = {"ambient": "0.35 0.35 0.35", "diffuse": "0.4 0.4 0.4"}
    sky = {"rgb1": "0.45 0.62 0.85", "rgb2": "0.85 0.9 0.95"}
    if daylight is not None:
        head = {"ambient": numbers_text([daylight.ambient] * 3), "diffuse": "0 0 0", "specular": "0 0 0"}
        sky = {"rgb1": numbers_text(daylight.sky), "rgb2": numbers_text(daylight.sky)}
    reach = {"znear": numbers_text([_NEAR_M / extent]), "zfar": "50"}
    if daylight is not None:
        reach["haze"] = "0.001"  # the sky's colour does not spread over the ground
    visual = ElementTree.SubElement(root, "visual")
    ElementTree.SubElement(visual, "headlight", head)
    ElementTree.SubElement(visual, "map", reach)
    middle = numbers_text((lower + upper) / 2)
    ElementTree.SubElement(root, "statistic", center=middle, extent=numbers_text([extent]))
    asset = ElementTree.SubElement(root, "asset")
    gradient = {"type": "skybox", "builtin": "gradient", "width": "256", "height": "256"}
    ElementTree.SubElement(asset, "texture", gradient | sky)
    return asset


def add_sun(world: ElementTree.Element, scene: Scene) -> None:
    """Adds the sun to the body of an MJCF's world."""
    lower, upper = np.asarray(scene.volume)
    above = numbers_text([*(lower[:2] + upper[:2]) / 2, upper[2] + 50.0])
    light = {"dir": "0.5 0.3 -0.8"}
    if scene.daylight is not None:
        diffuse = numbers_text([1 - np.asarray(scene.daylight.ambient)] * 3)
        light = {"dir": numbers_text(-np.asarray(scene.daylight.sun)), "diffuse": diffuse, "specular": "0 0 0"}
        light["castshadow"] = "false"
    ElementTree.SubElement(world, "light", {"directional": "true", "pos": above} | light)


def add_numbers(custom: ElementTree.Element, scene: Scene, shapes: Sequence[tuple[str, Shape]]) -> None:
    """Adds the numbers of a world's looks to the `<custom>` of an MJCF; none where it has none of its own.

    Args:
        custom: the element.
        scene: one world.
        shapes: its shapes, each after the name of its geom.
    """
    light = scene.daylight
    if light is not None:
        data = numbers_text([*np.asarray(light.sun), light.ambient, *np.asarray(light.sky)])
        ElementTree.SubElement(custom, "numeric", name=DAYLIGHT, data=data)
    for name, shape in shapes:
        surface = getattr(shape, "surface", None)
        if surface is not None:
            ElementTree.SubElement(custom, "numeric", name=f"{PREFIX}{name}", data=numbers_text(surface.numbers))


def daylight_of(model: mujoco.MjModel, title: str) -> Daylight | None:
    """Returns the light of a world; None where its file has no numeric `daylight`.

    Raises:
        SceneError: if its numbers are no light.
    """
    found = _numerics(model).get(DAYLIGHT)
    if found is None:
        return None
    whole = len(found) == 7 and np.all(np.isfinite(found))
    if not whole or abs(np.linalg.norm(found[:3]) - 1) > 1e-3 or np.any(found[3:] < 0) or np.any(found[3:] > 1):
        raise SceneError(
            f"{title}: the numeric '{DAYLIGHT}' must have a direction of length 1, and four numbers from 0 to 1"
        )
    sun, ambient, sky = (jnp.asarray(part, jnp.float32) for part in (found[:3], found[3], found[4:]))
    return Daylight(sun, ambient, sky)


def with_surfaces(model: mujoco.MjModel, shapes: Sequence[Shape], names: Sequence[str], title: str) -> list[Shape]:
    """Returns single shapes with the patterns that the numerics of their geoms say, blank where others have some.

    Args:
        model: of the world.
        shapes: without surfaces.
        names: of their geoms.
        title: of the world in messages.

    Raises:
        SceneError: if a numeric names no geom of these, or its numbers are no pattern.
    """
    rows = {name.removeprefix(PREFIX): row for name, row in _numerics(model).items() if name.startswith(PREFIX)}
    for name, row in rows.items():
        if name not in names:
            raise SceneError(f"{title}: the numeric '{PREFIX}{name}' names no solid geom '{name}'")
        if len(row) != SURFACE_NUMBERS or not np.all(np.isfinite(row)):
            raise SceneError(f"{title}: the numeric '{PREFIX}{name}' must have {SURFACE_NUMBERS} finite numbers")
        if row[KIND] not in range(len(PATTERNS)) or not 0 <= row[CONTRAST] <= 1:
            raise SceneError(
                f"{title}: the numeric '{PREFIX}{name}' must begin with a pattern, 0 to {len(PATTERNS) - 1}, and a "
                "contrast from 0 to 1"
            )
    used = {int(row[KIND]) for row in rows.values()}
    patterns = tuple(pattern for number, pattern in enumerate(PATTERNS) if number in used)
    found = []
    for shape, name in zip(shapes, names, strict=True):
        if name in rows and hasattr(shape, "surface"):
            shape = dataclasses.replace(shape, surface=Surface(np.asarray(rows[name], np.float32), patterns))
        found.append(shape)
    return found


def _numerics(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    found = {}
    for i in range(model.nnumeric):
        begin, count = model.numeric_adr[i], model.numeric_size[i]
        found[model.numeric(i).name] = model.numeric_data[begin : begin + count]
    return found
