"""Cast shadows: held against a second ray of MuJoCo's, and against lengths worked out by hand."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera, raycast, shadows
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import Scene
from tests.oracles import camera_plain, mujoco_shadows
from tests.oracles.mujoco_depth import RayCaster
from tests.support.drawn_scenes import GROUND, box, closed_room, every_kind, free_points, pillar, rotation_of, scene_of
from tests.support.marks import in_whole
from tests.support.meshes import CUBE, bracket, hull, mesh_world

SILHOUETTES = 0.02
"""Most lit pixels that may differ: those with an edge in them, where the middle is not all that a pixel shows."""

Mount = Literal["level", "body"]
AMBIENT = 0.3
CONFIG = CameraConfig(texture_contrast=0.0, ambient=AMBIENT, sun_elevation_deg=35.0, sun_azimuth_deg=140.0)


@partial(jax.jit, static_argnums=0)
def pictures(config: CameraConfig, scene: Scene, position: jax.Array, rotation: jax.Array) -> jax.Array:
    return jax.vmap(partial(camera.render_luma, config, scene))(position, rotation)


def share_of_sun(config: CameraConfig, scene: Scene, position: NDArray, rotation: NDArray) -> tuple[NDArray, NDArray]:
    """What share of the sun's light is left in pictures [M, H, W] with shadows, and where there is any without."""
    given = scene, jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32)
    sunny = np.asarray(pictures(config, *given))
    shaded = np.asarray(pictures(dataclasses.replace(config, shadows=True), *given))
    # Without a sun, the sky as bright as before.
    dim = pictures(dataclasses.replace(config, ambient=1.0, sky_rgb=tuple(s / AMBIENT for s in config.sky_rgb)), *given)
    dim = AMBIENT * np.asarray(dim)
    lit = sunny > dim + 0.02
    return (shaded - dim) / np.where(lit, sunny - dim, 1.0), lit


def disagreement(config: CameraConfig, scene: Scene, place: NDArray, turn: NDArray) -> tuple[float, float, int]:
    """Share of lit pixels that are dark here or in MuJoCo alone; share that is dark in MuJoCo; number of lit ones."""
    sun, world = np.array(raycast.sun_direction(config)), RayCaster(scene)
    kept, lit = share_of_sun(config, scene, place, turn)
    rays = [camera_plain.directions(config, one, 1) for one in turn]
    dark = np.stack([mujoco_shadows.in_shadow(world, at, ray, sun) for at, ray in zip(place, rays, strict=True)])
    return float(np.mean((kept < 0.5)[lit] != dark[lit])), float(np.mean(dark[lit])), int(lit.sum())


@pytest.mark.whole
@pytest.mark.parametrize("mount", ["level", *in_whole("body")])
def test_what_is_dark_is_what_a_ray_of_mujoco_towards_the_sun_says(mount: Mount) -> None:
    config, rng, found = dataclasses.replace(CONFIG, mount=mount), np.random.default_rng(5), []
    for _ in range(4):
        scene = every_kind(rng)
        place, lean = free_points(scene, rng, 4, clearance=1.0), 0.3 if mount == "body" else 0.0
        turn = np.array([rotation_of(*rng.uniform(-1, 1, 3) * [lean, lean, np.pi]) for _ in place])
        found.append(disagreement(config, scene, place, turn))
    wrong, dark, count = np.mean(found, axis=0)
    assert wrong < SILHOUETTES and dark > 0.05 and count > 500, found


@pytest.mark.whole
def test_meshes_cast_shadows_also_on_themselves(tmp_path: Path) -> None:
    geoms = (
        '<geom type="mesh" mesh="bracket" pos="10 5 2" euler="0 0 30"/><geom type="mesh" mesh="block" pos="14 5 2"/>'
        '<geom type="box" size=".5 .5 3" pos="10 8 3"/>'
    )
    meshes = {"bracket": bracket(), "block": hull(CUBE * [0.43, 2.02, 1.51])}
    scene = load_scene(mesh_world(tmp_path, geoms, **meshes))
    # From where the sun is, and to either side, so that the bracket's lit sides are seen.
    way = np.radians([100.0, 140.0, 180.0])
    place = np.array([10.0, 5.0, 3.0]) + 4.0 * np.stack([np.cos(way), np.sin(way), 0 * way], axis=1)
    turn = np.array([rotation_of(0.0, 0.1, one + np.pi) for one in way])
    wrong, dark, count = disagreement(dataclasses.replace(CONFIG, mount="body"), scene, place, turn)
    assert wrong < 2 * SILHOUETTES and dark > 0.05 and count > 500, (wrong, dark, count)


def test_a_pillar_throws_a_shadow_as_long_as_the_sun_is_low() -> None:
    config = dataclasses.replace(
        CONFIG, mount="body", width=81, height=61, sun_elevation_deg=45.0, sun_azimuth_deg=180.0
    )
    # Looking straight down, +x upwards in the picture: columns are ahead, left and up.
    down = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    # The sun is towards -x at 45 degrees, so the shadow of 6 m ends 6 m beyond the pillar, towards +x.
    kept, lit = share_of_sun(
        config, scene_of(GROUND, pillar(30, 30, 3, 0.5, 3)), np.array([[30.0, 30.0, 20.0]]), down[None]
    )
    way = np.linspace(1.2, 15.0, 400)
    pitch = raycast.pitch_of(config)
    row = np.round(30 - way / 20.0 / pitch).astype(int)
    found = kept[0, row, 40]
    assert lit[0, row, 40].all() and np.all((found < 0.5) == (way < 6.5), where=abs(way - 6.5) > 20 * pitch)
    assert np.allclose(kept[0, 30:, 40][lit[0, 30:, 40]][8:], 1.0)  # nothing on the sun's side


def test_no_sun_shines_in_at_the_foot_of_a_wall_or_where_walls_and_roof_meet() -> None:
    scene = closed_room()
    place = np.array([[28.0, 29.0, 2.5], [32.0, 31.0, 4.0], [30.0, 27.0, 1.0], [29.0, 33.0, 5.0]])
    turn = np.array([rotation_of(0.0, 0.0, yaw) for yaw in (0.3, 1.4, 2.9, 4.1)])
    kept, lit = share_of_sun(CONFIG, scene, place, turn)
    # At a grazing angle a pixel of the ground may show in its middle what lies beyond the wall.
    assert lit.sum() > 500 and np.mean(np.abs(kept[lit]) > 0.01) < 2e-3


def test_a_shape_shades_what_lies_within_it_but_not_what_stands_on_its_lit_face() -> None:
    config = dataclasses.replace(CONFIG, width=1, height=1, sun_azimuth_deg=180.0)  # towards -x, where the eye is
    scene = scene_of(box(30, 28, 2, 1, 1, 2), box(30, 30, 2, 1, 1, 2))  # side by side, their faces at x = 29
    light = raycast.daylight_of(config, scene.daylight)
    rays = raycast.camera_rays(config, jnp.eye(3))
    first = raycast.first_numbers(raycast.albedo_values(scene, jnp.ones(3)))
    # Metres to points on the second box's face and 5 cm behind it, as shown of the first box (0) and of its own (1).
    depth, shape = (jnp.array(x, jnp.float32).reshape(-1, 1, 1) for x in ([9, 9.05, 9, 9.05], [0, 0, 1, 1]))
    dark = shadows.in_shadow(scene, light, jnp.array([20.0, 30.5, 2.0]), rays, depth, shape, first)
    assert dark.ravel().tolist() == [False, True, False, False]
