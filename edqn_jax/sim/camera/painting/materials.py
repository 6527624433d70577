"""Materials of a world for renderers that know pictures alone, as MuJoCo's does: each pattern baked onto its shape.

A solid gets a cube texture in OpenGL's order, which MuJoCo lays on the geom scaled to unit size, so that each texel has
its place in metres on the surface. A plane has no end: it gets one square tile, which repeats beyond.
"""

from __future__ import annotations

import dataclasses
import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig
from edqn_jax.files import write_atomically, write_error
from edqn_jax.sim.camera.raycast import daylight_of
from edqn_jax.sim.camera.surfaces import Phase, relative_albedo
from edqn_jax.sim.camera.texture import WAVES
from edqn_jax.sim.scene.mjcf import mjcf_of, named_shapes
from edqn_jax.sim.scene.mjcf_parts.geoms import geom_of
from edqn_jax.sim.scene.scene import Scene, Shape
from edqn_jax.sim.scene.shapes.kind import Geom
from edqn_jax.sim.scene.surface import CONTRAST, PATTERNS, PHASES, Surface

TEXELS_A_METRE = 32
"""Of a solid's face; a texel shows the average over its area."""

FEWEST_TEXELS, MOST_TEXELS = 16, 256
"""Of a solid's face along each side."""

TILE_TEXELS = 2048
"""Of a plane's tile along each side."""

_CHUNK = 1 << 15  # points at a time

_SPLIT = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    np.float32,
)
"""[6, 3, 3]: of each face of a cube the directions to the right and down in its picture, and outwards."""


@dataclasses.dataclass(frozen=True)
class Material:
    """What one geom is painted with."""

    geom: str
    faces: NDArray[np.uint8]
    """[6, n, n, 3] of a cube in OpenGL's order, or [1, n, n, 3] of a plane's tile; row 0 is at texture coordinate 0."""
    tile_m: float | None
    """Side of a plane's tile; None of a solid."""

    @property
    def repeat(self) -> float:
        """Returns MuJoCo's `texrepeat`: an endless plane's texture is repeated once for each two metres."""
        return 2.0 / self.tile_m if self.tile_m else 1.0


def painted_spec(config: CameraConfig, scene: Scene) -> mujoco.MjSpec:
    """Returns one world as it looks in the package's camera at time 0: patterns, sun, ambient light and sky.

    Geometry and names are those of `mjcf_of`. A geom with a pattern has its colour in its texture, and white `rgba`.

    Args:
        config: whose plaid and light a world has that has none of its own.
        scene: one world.
    """
    text = mjcf_of(_lit(config, scene))
    spec = mujoco.MjSpec.from_string(text)
    for material in _bake(config, scene, text):
        side = material.faces.shape[1]
        texture = spec.add_texture(
            name=material.geom,
            type=mujoco.mjtTexture.mjTEXTURE_2D if material.tile_m else mujoco.mjtTexture.mjTEXTURE_CUBE,
            width=side,
            height=side * len(material.faces),
            nchannel=3,
        )
        texture.data = material.faces.tobytes()
        painted = spec.add_material(
            name=material.geom, specular=0.0, texrepeat=[material.repeat] * 2, texuniform=material.tile_m is not None
        )
        painted.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material.geom
        geom = spec.geom(material.geom)
        geom.material, geom.rgba = material.geom, [1.0, 1.0, 1.0, 1.0]
    return spec


def write_painted(config: CameraConfig, scene: Scene, file: Path, *, title: str = "world") -> None:
    """Writes `painted_spec` as an MJCF file NAME.xml with its textures, PNGs in the folder NAME_textures beside it.

    The file is for MuJoCo and what else reads MJCF. It names other files, so that the package does not read it back;
    that of `write_scene` it does.

    Raises:
        ConfigError: if a file cannot be written.
    """
    from PIL import Image  # no other world needs it

    text = mjcf_of(_lit(config, scene), title=title)
    root = ElementTree.fromstring(text)
    asset, geoms = root.find("asset"), {geom.get("name"): geom for geom in root.iter("geom")}
    assert asset is not None
    materials = _bake(config, scene, text)
    folder = file.with_name(f"{file.stem}_textures")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise write_error(folder, error.strerror) from None
    for material in materials:
        name, picture = material.geom, io.BytesIO()
        Image.fromarray(material.faces.reshape(-1, *material.faces.shape[2:])).save(picture, format="PNG")
        write_atomically(folder / f"{name}.png", picture.getvalue())
        named = {"name": name, "file": f"{folder.name}/{name}.png", "type": "2d"}
        if material.tile_m is None:
            named |= {"type": "cube", "gridsize": "6 1", "gridlayout": "RLUDFB"}
        ElementTree.SubElement(asset, "texture", named)
        attributes = {"texrepeat": f"{material.repeat:.9g} {material.repeat:.9g}", "texuniform": "true"}
        ElementTree.SubElement(
            asset,
            "material",
            {"name": name, "texture": name, "specular": "0"} | (attributes if material.tile_m else {}),
        )
        geoms[name].set("material", name)
        geoms[name].set("rgba", "1 1 1 1")
    ElementTree.indent(root)
    write_atomically(file, ElementTree.tostring(root, encoding="unicode") + "\n")


def _lit(config: CameraConfig, scene: Scene) -> Scene:
    return dataclasses.replace(scene, daylight=daylight_of(config, scene.daylight))


def _bake(config: CameraConfig, scene: Scene, text: str) -> list[Material]:
    """Returns the material of each shape with a pattern; `text` is the world's MJCF."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for name, shape in named_shapes(scene):
        geom = geom_of(model, data, model.geom(name).id)
        surface = _surface_of(config, shape, geom)
        if not surface.numbers[CONTRAST]:
            continue
        if geom.kind == "plane":
            corners, rolled, side = _tile(geom, scene)
            tile = np.roll(_paint(surface, shape, corners), rolled, axis=(1, 2))
            found.append(Material(name, tile, side))
        elif geom.kind in _ON_UNIT:
            found.append(Material(name, _paint(surface, shape, _cube(geom)), None))
    return found


def _surface_of(config: CameraConfig, shape: Shape, geom: Geom) -> Surface:
    """Returns the surface of a single shape; the plaid, which is one of four waves, where it has none."""
    own = getattr(shape, "surface", None)
    if own is not None:
        return own
    k = np.array([np.divide(wave.direction, config.texture_period_m * wave.octave) for wave in WAVES])
    phases = np.concatenate([k, (k @ geom.position)[:, None]], axis=1)
    numbers = [PATTERNS.index("waves"), config.texture_contrast, *(wave.weight for wave in WAVES), *phases.ravel()]
    return Surface(np.array(numbers, np.float32), ("waves",))


def _paint(surface: Surface, shape: Shape, corners: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Returns the colours [F, n, n, 3] of texels, from their corners [F, n + 1, n + 1, 3], metres from the centre."""
    corners = corners.astype(np.float32)
    upper, lower = corners[:, :-1], corners[:, 1:]
    right = (upper[:, :, 1:] - upper[:, :, :-1] + lower[:, :, 1:] - lower[:, :, :-1]) / 2
    down = (lower[:, :, :-1] - upper[:, :, :-1] + lower[:, :, 1:] - upper[:, :, 1:]) / 2
    middle = (upper[:, :, :-1] + upper[:, :, 1:] + lower[:, :, :-1] + lower[:, :, 1:]) / 4
    points = np.stack([middle, right, down], axis=3).reshape(-1, 3, 3)
    padded = np.pad(points, ((0, -len(points) % _CHUNK), (0, 0), (0, 0))).reshape(-1, _CHUNK, 3, 3)
    numbers = jnp.asarray(surface.numbers, jnp.float32)
    factor = np.concatenate([np.asarray(_factors(surface.patterns, numbers, each)) for each in padded])
    colours = factor[: len(points), None] * np.asarray(shape.albedo, np.float32)
    return np.round(255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8).reshape(*middle.shape[:3], 3)


@partial(jax.jit, static_argnums=0)
def _factors(patterns: tuple[str, ...], numbers: Array, points: Array) -> Array:
    """Returns the factor [K] on the albedo of texels [K, 3, 3]: middles, and sides to the right and down."""
    rows = numbers[PHASES:].reshape(4, 4)
    phases = []
    for row in rows:
        at, right, down = (points @ row[:3]).T
        phases.append(Phase(row[3] + at, right, down))
    return relative_albedo(patterns, list(numbers[:PHASES]), phases)


# ----------------------------------------------------------------------- places of texels


def _cube(geom: Geom) -> NDArray[np.floating]:
    """Returns the places [6, n + 1, n + 1, 3] of texels' corners on a solid, metres from its centre, world axes."""
    reach = {"sphere": geom.size[[0, 0, 0]], "cylinder": geom.size[[0, 0, 1]], "capsule": geom.size[[0, 0, 1]]}
    size = reach.get(geom.kind, geom.size)
    wanted = 2 * float(size.max()) * TEXELS_A_METRE
    n = int(2 ** np.clip(np.ceil(np.log2(wanted)), np.log2(FEWEST_TEXELS), np.log2(MOST_TEXELS)))
    at = np.linspace(-1.0, 1.0, n + 1, dtype=np.float32)
    right, down, out = (_SPLIT[:, i, None, None, :] for i in range(3))
    towards = out + at[None, None, :, None] * right + at[None, :, None, None] * down
    return _ON_UNIT[geom.kind](towards, size.astype(np.float32)) @ geom.rotation.T.astype(np.float32)


def _on_capsule(towards: NDArray[np.floating], size: NDArray[np.floating]) -> NDArray[np.floating]:
    """Returns points of a capsule: MuJoCo scales its cylinder to unit size, and its ends apart."""
    wide, high = np.hypot(towards[..., 0], towards[..., 1]), np.abs(towards[..., 2])
    within = high <= wide
    # The end is the unit sphere around 1: |s d - (0, 0, 1)| = 1.
    end = 2 * high / np.maximum(wide**2 + high**2, 1e-12)
    point = towards * np.where(within, 1 / np.maximum(wide, 1e-12), end)[..., None]
    z = np.abs(point[..., 2])
    height = np.where(within, size[2] * z, size[2] + size[0] * (z - 1))
    return np.concatenate([size[0] * point[..., :2], (np.sign(point[..., 2]) * height)[..., None]], axis=-1)


def _on_cylinder(towards: NDArray[np.floating], size: NDArray[np.floating]) -> NDArray[np.floating]:
    return size * towards / np.maximum(np.hypot(towards[..., 0], towards[..., 1]), np.abs(towards[..., 2]))[..., None]


def _on_ball(towards: NDArray[np.floating], size: NDArray[np.floating]) -> NDArray[np.floating]:
    return size * towards / np.linalg.norm(towards, axis=-1, keepdims=True)


_ON_UNIT: dict[str, Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.floating]]] = {
    "box": lambda towards, size: size * towards,
    "cylinder": _on_cylinder,
    "capsule": _on_capsule,
    "sphere": _on_ball,
    "ellipsoid": _on_ball,
}
"""Directions [..., 3] within a unit solid and its half extents [3] to points [..., 3] of its surface, metres."""


def _tile(geom: Geom, scene: Scene) -> tuple[NDArray[np.floating], tuple[int, int], float]:
    """Returns the places of a plane's texels, by how many they are rolled in its picture, and the tile's side, metres.

    The places are [1, n + 1, n + 1, 3], of corners, from the plane's centre, and lie around the middle of the flight
    volume; one tile is wider than that volume.
    """
    lower, upper = np.asarray(scene.volume, float)
    side = float(np.linalg.norm(upper - lower))
    x, y, _ = ((lower + upper) / 2 - geom.position) @ geom.rotation
    # Texture coordinates run along x and against y, and are 1/2 at the plane's centre.
    rolled = round(-y / side * TILE_TEXELS), round(x / side * TILE_TEXELS)
    texels = np.arange(TILE_TEXELS + 1) - TILE_TEXELS // 2
    down, right = ((texels + by) * side / TILE_TEXELS for by in rolled)
    across, along = np.meshgrid(right, -down)
    return np.stack([across, along, 0 * across], axis=-1)[None] @ geom.rotation.T, rolled, side
