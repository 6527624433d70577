"""Pictures of worlds with fields in C beside JAX, which draws them where there is no compiler."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera, native
from edqn_jax.sim.scene.distance import shape_distances
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import Scene
from tests.support.drawn_scenes import looking, rotation_of
from tests.support.marks import in_whole
from tests.support.meshes import CUBE, bracket, hull, mesh_world

RING = trimesh.creation.torus(1.2, 0.3, major_sections=24, minor_sections=12)
MESHES = {
    "ring": (np.asarray(RING.vertices), np.asarray(RING.faces)),
    "bracket": bracket(),
    "block": hull(CUBE * [0.43, 2.02, 1.51]),
}
GEOMS = (
    '<geom type="mesh" mesh="ring" pos="8 5 3" euler="0 70 20" rgba=".8 .3 .2 1"/>'
    '<geom type="mesh" mesh="block" pos="13 6 2" euler="0 0 30"/>'
    '<geom type="mesh" mesh="bracket" pos="6 7 2" euler="10 20 30" rgba=".2 .6 .9 1"/>'
    '<geom type="box" size=".5 .5 3" pos="10 3 3"/><geom type="sphere" size=".7" pos="9 5.2 3"/>'
    '<geom type="cylinder" size=".4 2" pos="5 3 2"/>'
)
COUNT = 24
ROUNDING, TIES = 1e-4, 0.01
"""Brightness, and the share of pixels in which a ray meets the other of two cells at an edge, or passes by it."""
BESIDE_M = 0.01
"""An eye a millimetre before a box, where no drone's is, sees it or not by rounding."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(mesh_world(tmp_path_factory.mktemp("fields"), GEOMS, **MESHES))


def poses(scene: Scene, seed: int) -> tuple[jax.Array, jax.Array]:
    """Places in the volume, inside of shapes as well but not at their surfaces, and turns of drones that lean."""
    rng = np.random.default_rng(seed)
    place = rng.uniform([2, 2, 0.5], [15, 8, 5], (2 * COUNT, 3)).astype(np.float32)
    each = jax.vmap(partial(shape_distances, scene))(jnp.asarray(place)).values()
    nearest = np.min([np.abs(distances).min(1) for distances in each], axis=0)
    place = place[nearest > BESIDE_M][:COUNT]
    leans = rng.uniform(-0.4, 0.4, (COUNT, 2))
    turn = [rotation_of(a, b, yaw) for (a, b), yaw in zip(leans, rng.uniform(-np.pi, np.pi, COUNT), strict=True)]
    return jnp.asarray(place, jnp.float32), jnp.asarray(np.stack(turn), jnp.float32)


@partial(jax.jit, static_argnums=(0, 1))
def images(config: CameraConfig, natively: bool, scene: Scene, place: Any, turn: Any) -> Any:
    """Brightness and depth; `natively` tells programs apart."""
    draw = [partial(render, config, scene) for render in (camera.render_luma, camera.render_depth)]
    return [jax.vmap(one)(place, turn) for one in draw]


def drawn(config: CameraConfig, in_c: bool, scene: Scene, seed: int) -> list[np.ndarray]:
    with pytest.MonkeyPatch.context() as patch:  # while the program is traced
        if not in_c:
            patch.setattr(native, "can_render", lambda *_: False)
        return [np.asarray(image) for image in images(config, in_c, scene, *poses(scene, seed))]


def agree(config: CameraConfig, scene: Scene, seed: int) -> None:
    (picture, depth), (plain, plain_depth) = (drawn(config, in_c, scene, seed) for in_c in (True, False))
    assert np.isfinite(picture).all() and np.mean(np.abs(picture - plain) > ROUNDING) < TIES
    same = np.isclose(1 / depth, 1 / plain_depth, rtol=1e-4, atol=1e-7)
    assert same.mean() > 1 - TIES / 2 and picture.std() > 0.05


@pytest.mark.whole
@pytest.mark.parametrize("mount", ["level", *in_whole("body")])
@settings(max_examples=6, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(seed=st.integers(0, 2**16))
def test_c_draws_fields_among_other_shapes_as_jax_does(world: Scene, mount: Any, seed: int) -> None:
    assert native.can_render(world, "cpu") is native.is_available("cpu") and not native.can_render(world, "cuda")
    assert not native.can_render(world, "cpu", shadows=True)
    agree(CameraConfig(mount=mount), world, seed)


@pytest.mark.whole
@pytest.mark.parametrize("mount", ["level", "body"])
def test_c_draws_other_sizes_and_numbers_of_rays_and_patterns(world: Scene, mount: Any) -> None:
    config = CameraConfig(width=13, height=7, samples_across=2, samples_down=3, mount=mount)
    agree(config, looking(world, 3), 1)


@pytest.mark.parametrize("mount", ["level", "body"])
@pytest.mark.parametrize("in_c", [True, False], ids=["c", "jax"])
def test_a_pose_that_is_not_finite_gives_a_picture_of_nan(
    world: Scene, mount: Any, in_c: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, turn = poses(world, 4)
    place = place.at[jnp.arange(3), jnp.arange(3)].set(jnp.array([jnp.nan, jnp.inf, jnp.nan]))
    turn = turn.at[3, 0, 0].set(jnp.nan).at[4, 1, 0].set(jnp.inf)
    if not in_c:
        monkeypatch.setattr(native, "can_render", lambda *_: False)
    picture, _ = images(CameraConfig(mount=mount), in_c, world, place, turn)
    assert np.isnan(picture[:5]).all() and np.isfinite(picture[5:]).all()


def test_worlds_whose_fields_stand_elsewhere_are_drawn_each_as_its_own(world: Scene) -> None:
    if not native.is_available("cpu"):
        return
    place, turn = poses(world, 2)
    fields = world.others["fields"]
    shifts = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (COUNT, 1, 3)), jnp.float32)

    def one(shift: Any, place: Any, turn: Any) -> Any:
        moved = dataclasses.replace(world, others={"fields": fields.replace(position=fields.position + shift)})
        return camera.render_luma(CameraConfig(), moved, place, turn)

    together = np.asarray(jax.jit(jax.vmap(one))(shifts, place, turn))
    alone = jax.jit(one)
    for n in range(0, COUNT, 5):
        np.testing.assert_array_equal(together[n], alone(shifts[n], place[n], turn[n]))
    assert np.ptp([np.abs(together[n] - alone(shifts[0], place[n], turn[n])).max() for n in range(8)]) > 0.1
