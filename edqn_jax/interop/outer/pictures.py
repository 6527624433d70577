"""Pictures of a world by MuJoCo's OpenGL renderer, or by the package's own ray-cast camera.

MuJoCo's renderer knows light, materials and shadows, and nothing of this project: it draws the MJCF that the package
writes. Brightness is the luma of its 8-bit picture, 1 for white.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig, Config
from edqn_jax.interop.outer.opengl import no_opengl
from edqn_jax.sim.camera.painting.materials import painted_spec
from edqn_jax.sim.environment import Environment

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in Eq. 1."""

FINER = 8
"""Pixels of the renderer along each side of a pixel that is shown; their mean is its brightness."""

LOOKS = ("plain", "textured", "shadows", "own")
"""`plain`: one colour a shape. `textured`: noise and checks, light drawn. `shadows`: plain, with cast shadows.
`own`: the patterns and the light that our camera sees."""

TEXELS = 32
"""Of a texture along each side."""

See = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""From a camera's position [3], metres, and rotation [3, 3], x ahead, to brightness [H, W] in [0, 1]."""


def spec_of(environment: Environment, mission: int, look: str, seed: int) -> mujoco.MjSpec:
    """Returns the world of a mission with a look.

    Args:
        environment: whose world it is.
        mission: number of the mission.
        look: one of `LOOKS`.
        seed: of what the look draws: textures, tints and light.
    """
    if look == "own":
        spec = painted_spec(environment.config.camera, environment.scene(mission))
    else:
        spec = mujoco.MjSpec.from_string(environment.mjcf(mission))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1024, 1024
    spec.visual.quality.shadowsize = 8192 if look == "shadows" else 0
    for light in spec.lights:
        light.castshadow = look == "shadows"
    if look == "textured":
        _texture(spec, np.random.default_rng(seed))
    return spec


def _texture(spec: mujoco.MjSpec, random: np.random.Generator) -> None:
    """Gives every geom noise or checks of its own, and draws the light."""
    for number, geom in enumerate(spec.geoms):
        name, flat = f"look {number}", geom.type == mujoco.mjtGeom.mjGEOM_PLANE
        checks = mujoco.mjtBuiltin.mjBUILTIN_CHECKER if random.random() < 0.5 else mujoco.mjtBuiltin.mjBUILTIN_FLAT
        dark, bright = np.sort(random.uniform(0.1, 0.9, 2))
        tint = random.uniform(0.8, 1.2, 3)
        spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D if flat else mujoco.mjtTexture.mjTEXTURE_CUBE,
            builtin=checks,
            mark=mujoco.mjtMark.mjMARK_RANDOM,
            random=float(random.uniform(0.05, 0.4)),
            markrgb=random.uniform(0, 1, 3),
            rgb1=np.clip(dark * tint, 0, 1),
            rgb2=np.clip(bright * tint, 0, 1),
            width=TEXELS,
            height=TEXELS * (1 if flat else 6),
        )
        # Repeats are in metres on a plane alone; a solid's face has its texture once.
        material = spec.add_material(name=name, texrepeat=random.uniform(0.3, 2.0, 2), texuniform=flat)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        geom.material, geom.rgba = name, [1.0, 1.0, 1.0, 1.0]
    elevation, azimuth = random.uniform(0.4, 1.3), random.uniform(-np.pi, np.pi)
    for light in spec.lights:
        light.dir = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)]
        light.diffuse = np.full(3, random.uniform(0.4, 0.9))
    spec.visual.headlight.ambient = np.full(3, random.uniform(0.2, 0.5))


@dataclasses.dataclass(frozen=True)
class MujocoPictures:
    """A world in MuJoCo's renderer. Close it after use, since a renderer holds a context of OpenGL."""

    see: See
    close: Callable[[], None]


def mujoco_pictures(spec: mujoco.MjSpec, camera: CameraConfig) -> MujocoPictures:
    """Returns what draws a world with the camera's resolution and field of view.

    Raises:
        ConfigError: if there is no OpenGL to draw with.
    """
    spec = spec.copy()
    down = np.degrees(2 * np.arctan(np.tan(np.radians(camera.horizontal_fov_deg) / 2) * camera.height / camera.width))
    spec.worldbody.add_camera(name="outer", fovy=down)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    finer = max(1, min(FINER, 1024 // max(camera.width, camera.height)))
    try:
        renderer = mujoco.Renderer(model, camera.height * finer, camera.width * finer)
    except Exception as error:
        raise no_opengl(error) from None
    number = model.camera("outer").id

    def see(position: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
        data.cam_xpos[number] = position
        # MuJoCo's cameras look along -z with x to the right.
        data.cam_xmat[number] = np.stack([-rotation[:, 1], rotation[:, 2], -rotation[:, 0]], axis=1).reshape(-1)
        renderer.update_scene(data, number)
        fine = renderer.render().reshape(camera.height, finer, camera.width, finer, 3)
        # Whole sums: a third of the time that means of brightness take. 8 x 8 pixels of 255 fit into 16 bits.
        total = sum(fine[:, row, :, column].astype(np.uint16) for row in range(finer) for column in range(finer))
        return total @ (LUMA / (255.0 * finer**2))

    return MujocoPictures(see, renderer.close)


def own_pictures(config: Config, environment: Environment, mission: int) -> See:
    """Returns what draws a mission's world with the package's own camera, at `config.camera`'s resolution."""
    import jax

    from edqn_jax.sim.camera import camera

    scene = environment.scene(mission)
    draw = jax.jit(lambda position, rotation: camera.render_luma(config.camera, scene, position, rotation))

    def see(position: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(draw(position.astype(np.float32), rotation.astype(np.float32)), np.float64)

    return see
