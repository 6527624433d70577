"""The camera in C beside the camera in JAX, from which it is translated."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.native import build
from edqn_jax.sim.camera import camera, columns, coverage, native, shadows, surfaces
from edqn_jax.sim.camera.camera import LUMA_WEIGHTS
from edqn_jax.sim.scene import surface
from edqn_jax.sim.scene.scene import PARKED, Scene, stack_scenes, take_scene, with_drones, with_equal_capacities
from edqn_jax.sim.scene.shapes import kind, plane
from edqn_jax.sim.worlds import families
from tests.support.camera_in_c import CONFIG, ROUNDING, TIES, crowd, frames, in_c
from tests.support.drawn_scenes import (
    GROUND,
    ball,
    box,
    closed_room,
    every_kind,
    looking,
    pillar,
    rotation_of,
    scene_of,
)
from tests.support.marks import in_whole


@partial(jax.jit, static_argnums=0)
def in_jax(config: CameraConfig, scene: Scene, origin: jax.Array, rotation: jax.Array, weights):
    draw = columns.render_columns if config.mount == "level" else camera._tilted_pictures
    pictures = draw(config, camera.blend_layers, scene, origin, rotation, weights)
    return pictures, camera._depths(config, scene, origin, rotation)


AT_ONCE = 64
"""Frames that JAX draws at once."""


def roomy() -> Scene:
    """A pool with as many places for shapes as any world here needs."""
    return stack_scenes([scene_of(GROUND, GROUND, boxes=96, cylinders=320, spheres=16)])


def drawn(config: CameraConfig, scene: Scene, origin: jax.Array, rotation: jax.Array) -> list[np.ndarray]:
    """Brightness and depth [M, H, W], first in C and then in JAX.

    Pictures of the usual size are drawn by one program of JAX, whatever the world.
    """
    weights = jnp.broadcast_to(jnp.asarray(LUMA_WEIGHTS), origin.shape)
    shared = config == CONFIG and scene.boxes.surface is None
    padded = with_equal_capacities([scene], [roomy()])[0] if shared else scene
    given = jax.tree.map(np.asarray, (padded, origin, rotation, weights))
    parts = [jax.tree.map(lambda leaf, i=i: leaf[i : i + AT_ONCE], given) for i in range(0, len(origin), AT_ONCE)]
    plain = [np.concatenate(images) for images in zip(*(in_jax(config, *part) for part in parts), strict=True)]
    return [np.asarray(image) for image in in_c(native._call, config, scene, origin, rotation, weights)] + plain


def agree(config: CameraConfig, scene: Scene, origin: jax.Array, rotation: jax.Array, ties: float = 0.0) -> None:
    picture, depth, plain_picture, plain_depth = drawn(config, scene, origin, rotation)
    differ = np.abs(picture - plain_picture) > ROUNDING
    assert np.isfinite(picture).all() and np.mean(differ) <= ties, np.abs(picture - plain_picture).max()
    np.testing.assert_array_equal(np.isfinite(depth), np.isfinite(plain_depth))
    # Near the horizon rounding grows with the distance to the ground.
    np.testing.assert_allclose(1 / depth, 1 / plain_depth, rtol=1e-4, atol=1e-7)
    assert picture.std() > 0.05 and np.isfinite(depth).mean() > 0.3  # there is something to see


def test_the_library_is_at_hand_wherever_there_is_a_compiler() -> None:
    assert native.is_available("cpu") is (shutil.which("cc") is not None)


def test_constants_are_the_same_in_c_and_in_python() -> None:
    texts = dict(re.findall(r"^#define (\w+) ([-\w.]+)", native.HEADERS[1].read_text(), re.MULTILINE))
    places = {
        **dict.fromkeys(("NEAR_M", "FAR_U", "LEVEL_FACE", "DEPTH_OF_LAYERS"), coverage),
        **dict.fromkeys(("EDGE", "OVERTONE"), surfaces),
        "CLEAR_M": shadows,
        **dict.fromkeys(("SURFACE_NUMBERS", "KIND", "CONTRAST", "SHARES", "PHASES"), surface),
        **{"TINY": kind, "HORIZON_M": plane, "MOST_PLANES": native},
    }
    assert texts.keys() == places.keys()
    assert {name: float(text.rstrip("f")) for name, text in texts.items()} == {
        name: getattr(place, name) for name, place in places.items()
    }
    whole = {name for name, text in texts.items() if not text.endswith("f")}
    assert whole == {name for name, place in places.items() if isinstance(getattr(place, name), int)}


@pytest.mark.whole
def test_both_draw_the_other_drones_and_neither_those_that_are_absent() -> None:
    if not native.is_available("cpu"):
        return
    scene, origin, rotation = frames([crowd(np.random.default_rng(3))], 64, seed=4)
    ahead = np.asarray(rotation)[:, :, 0] * 3.0 + np.random.default_rng(5).normal(0, 0.5, (64, 3))
    place = np.stack([np.asarray(origin) + ahead, np.full((64, 3), PARKED)], axis=1).astype(np.float32)
    radius = jnp.broadcast_to(jnp.array([0.36, 0.0]), (64, 2))
    among = jax.jit(jax.vmap(with_drones))(scene, jnp.asarray(place), radius)
    agree(CONFIG, among, origin, rotation)
    apart = np.abs(drawn(CONFIG, among, origin, rotation)[0] - drawn(CONFIG, scene, origin, rotation)[0])
    assert (apart.max(axis=(1, 2)) > 0.05).mean() > 0.4  # the others' drones are behind something


SIZES = [(32, 24), *in_whole((13, 7))]
"""The usual one, and one that is no multiple of a vector."""


@pytest.mark.parametrize("size", SIZES)
def test_c_draws_what_jax_draws(size: tuple[int, int]) -> None:
    config = dataclasses.replace(CONFIG, width=size[0], height=size[1])
    rng = np.random.default_rng(3)
    if native.is_available("cpu"):
        agree(config, *frames([crowd(rng) for _ in range(8)], 64, seed=4))
    else:  # then there is one camera, and the pictures of the package are its
        scene, origin, rotation = frames([crowd(rng)], 2, seed=4)
        assert np.isfinite(jax.vmap(partial(camera.render_luma, config))(scene, origin, rotation)).all()


@pytest.mark.whole
def test_c_draws_every_pattern_as_jax_does() -> None:
    rng = np.random.default_rng(6)
    if native.is_available("cpu"):
        # As many as JAX draws with one of its branches, which is quick to compile.
        agree(CONFIG, *frames([looking(crowd(rng), seed) for seed in range(4)], 8, seed=7), ties=TIES)


@pytest.mark.whole
@pytest.mark.parametrize("mount", ["level", *in_whole("body")])
def test_c_draws_shadows_as_jax_does(mount: Literal["level", "body"]) -> None:
    rng = np.random.default_rng(9)
    config = dataclasses.replace(CONFIG, shadows=True, mount=mount, sun_elevation_deg=30.0)
    if not native.is_available("cpu"):
        return
    scene, origin, rotation = frames([crowd(rng) for _ in range(4)], 24, seed=10)
    if mount == "body":
        rotation = tilted_poses(rng, 24)
    # Edges of shadows are whole pixels, which rounding may move by one.
    agree(config, scene, origin, rotation, ties=TIES)
    room = frames([closed_room()], 24, seed=11)[0]
    within = jnp.asarray(rng.uniform([24, 24, 0.5], [36, 36, 5.5], (24, 3)), jnp.float32)
    # Walls and roof touch; a bright shade, so that pictures of it are not empty.
    agree(dataclasses.replace(config, ambient=0.8), room, within, rotation, ties=TIES)
    sunny = drawn(dataclasses.replace(config, shadows=False), scene, origin, rotation)[0]
    assert np.mean(sunny - drawn(config, scene, origin, rotation)[0] > 0.1) > 0.02  # some of it is in the dark


FAMILIES = ("rooms", "forest", "canyon", "dense")


@pytest.fixture(scope="module")
def worlds() -> dict[str, list[Scene]]:
    """Four worlds of each family with as many places for shapes in all, so that one program draws them."""
    pools = [families.random_pool(family, families.world_keys("training", 4)) for family in FAMILIES]
    padded = stack_scenes([take_scene(pool, number) for pool in pools for number in range(4)])
    each = [take_scene(padded, number) for number in range(16)]
    return {family: each[4 * k : 4 * k + 4] for k, family in enumerate(FAMILIES)}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.whole
@pytest.mark.slow
def test_c_draws_the_worlds_of_a_family_as_jax_does(worlds: dict[str, list[Scene]], family: str) -> None:
    if native.is_available("cpu"):
        agree(CONFIG, *frames(worlds[family], 128, seed=8), ties=TIES)


def tilted_poses(rng: np.random.Generator, count: int) -> jax.Array:
    """Rotations [count, 3, 3] of drones that lean."""
    tilts = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(-np.pi, np.pi, (count, 1))], axis=1)
    return jnp.asarray(np.stack([rotation_of(*tilt) for tilt in tilts]), jnp.float32)


@pytest.mark.whole
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("patterned", [False, *in_whole(True)])
def test_c_draws_what_jax_does_of_a_camera_on_the_body(size: tuple[int, int], patterned: bool) -> None:
    if not native.is_available("cpu"):
        return
    config = dataclasses.replace(CONFIG, width=size[0], height=size[1], mount="body")
    rng = np.random.default_rng(12)
    worlds = [looking(crowd(rng), seed) if patterned else crowd(rng) for seed in range(4)]
    scene, origin, _ = frames(worlds, 96, seed=13)
    agree(config, scene, origin, tilted_poses(rng, 96), ties=TIES)


@pytest.mark.whole
def test_c_draws_what_jax_does_of_a_camera_on_the_body_within_shapes_and_on_their_axes() -> None:
    """Also from the ground's other side, and looking up and down."""
    if not native.is_available("cpu"):
        return
    config = dataclasses.replace(CONFIG, mount="body")
    scene = scene_of(GROUND, box(20, 20, 3, 4, 2, 3, 0.7), pillar(30, 20, 3, 1.5, 3), ball(25, 26, 4, 1.5))
    places = np.array([[20, 20, 3], [30, 20, 3], [20, 20, 6.4], [30, 20, 6.3], [25, 26, 4], [25, 20, -2]])
    turns = [(0.4, 0.2, 0.3), (-1.2, 0.1, 2.0), (0.0, 1.5, -1.0), (3.0, -0.3, 0.5), (0.2, -1.4, -2.6)]
    origin = jnp.asarray(np.repeat(places, len(turns), axis=0), jnp.float32)
    rotation = jnp.asarray(np.tile([rotation_of(*turn) for turn in turns], (len(places), 1, 1)), jnp.float32)
    scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(origin), *leaf.shape)), scene)
    agree(config, scenes, origin, rotation, ties=TIES)


@pytest.fixture(scope="module")
def kernels() -> bool:
    """Whether the kernels of GPUs are registered for the CPU, where there is a compiler."""
    on_cpu = Path(__file__).parents[2] / "oracles" / "cuda_on_cpu.h"
    names = [f"-D{target}=emulated_{target}" for target in native.TARGETS]
    compiler = dataclasses.replace(build.C, flags=(*build.C.flags, "-xc", "-include", str(on_cpu), *names))
    targets = tuple(f"emulated_{target}" for target in native.TARGETS)
    headers = (*native.HEADERS, on_cpu)
    return build.ensure_registered(native.SOURCES["cu"], targets, by=compiler, headers=headers)


def crowded_forest(rng: np.random.Generator) -> Scene:
    """More shapes in a frame than a block of threads gathers in a pass, and than it keeps at once."""
    places = rng.uniform([0, 0, 0], [60, 60, 6], (300, 3))
    return scene_of(
        GROUND, *(pillar(x, y, z, 0.3, 3) for x, y, z in places), box(30, 30, 2, 2, 3, 4, 1), ball(9, 9, 3, 2)
    )


def wide_boxes(rng: np.random.Generator) -> Scene:
    """Shapes that cover so many columns that a block has no room for all of them at once."""
    low, high = [0, 0, 0, 4, 4, 0.2, 0], [60, 60, 8, 9, 9, 0.6, 3]
    return scene_of(GROUND, *(box(*map(float, rng.uniform(low, high))) for _ in range(100)))


def empty_field(rng: np.random.Generator) -> Scene:
    """Ground and a ball: no upright shape."""
    return scene_of(GROUND, ball(30, 30, 3, rng.uniform(8, 12)))


@pytest.mark.parametrize(
    "size, world",
    [
        pytest.param((32, 24), crowd, id="usual"),
        pytest.param((13, 7), crowd, id="no multiple of a block", marks=pytest.mark.whole),
        pytest.param((70, 20), crowd, id="several blocks", marks=pytest.mark.whole),
        pytest.param((32, 24), crowded_forest, id="several passes", marks=pytest.mark.whole),
        pytest.param((32, 24), wide_boxes, id="no room for all", marks=pytest.mark.whole),
        pytest.param((32, 24), empty_field, id="no upright shapes"),
    ],
)
def test_the_kernels_of_gpus_draw_what_jax_draws(
    kernels: bool, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], world: Callable[..., Scene]
) -> None:
    """On the CPU, thread by thread."""
    call = native._call
    monkeypatch.setattr(native, "_call", lambda target, *given: call(f"emulated_{target}", *given))
    config = dataclasses.replace(CONFIG, width=size[0], height=size[1])
    if kernels:
        agree(config, *frames([world(np.random.default_rng(3))], 64, seed=4))
    else:
        assert shutil.which("cc") is None


@pytest.mark.whole
@pytest.mark.parametrize(
    "size, world, rays, patterned",
    [
        ((32, 24), crowd, 3, False),
        ((13, 7), crowd, 3, True),
        ((70, 20), crowd, 5, True),
        ((32, 24), crowded_forest, 3, False),
        ((32, 24), wide_boxes, 3, False),
        ((32, 24), wide_boxes, 16, False),
        ((32, 24), empty_field, 16, False),
    ],
    ids=[
        *("usual", "no multiple of a block", "several blocks", "several passes", "no room for all"),
        *("room for few", "no upright shapes"),
    ],
)
def test_the_kernels_of_gpus_draw_what_c_draws_of_a_camera_on_the_body(
    kernels: bool,
    monkeypatch: pytest.MonkeyPatch,
    size: tuple[int, int],
    world: Callable[..., Scene],
    rays: int,
    patterned: bool,
) -> None:
    """On the CPU, thread by thread; C is held against JAX above."""
    if not (kernels and native.is_available("cpu")):
        return
    config = dataclasses.replace(CONFIG, width=size[0], height=size[1], mount="body", samples_across=rays)
    rng = np.random.default_rng(5)
    scene, origin, _ = frames([looking(world(rng), 3) if patterned else world(rng)], 32, seed=6)
    rotation = tilted_poses(rng, 32)
    weights = jnp.broadcast_to(jnp.asarray(LUMA_WEIGHTS), origin.shape)
    in_one = [np.asarray(image) for image in in_c(native._call, config, scene, origin, rotation, weights)]
    call = native._call
    monkeypatch.setattr(native, "_call", lambda target, *given: call(f"emulated_{target}", *given))
    in_other = [np.asarray(image) for image in in_c(native._call, config, scene, origin, rotation, weights)]
    for first, second in zip(in_one, in_other, strict=True):
        assert np.isfinite(first).any()
        # A ray that grazes an edge is counted by one of them.
        assert np.mean(~np.isclose(first, second, rtol=1e-4, atol=1e-4)) < TIES


@pytest.mark.whole
@pytest.mark.parametrize("world", [crowd, crowded_forest], ids=["usual", "several passes"])
def test_the_kernels_of_gpus_draw_every_pattern(
    kernels: bool, monkeypatch: pytest.MonkeyPatch, world: Callable[..., Scene]
) -> None:
    call = native._call
    monkeypatch.setattr(native, "_call", lambda target, *given: call(f"emulated_{target}", *given))
    if kernels:
        rng = np.random.default_rng(8)
        agree(CONFIG, *frames([looking(world(rng), seed) for seed in range(4)], 8, seed=7), ties=TIES)


@pytest.mark.parametrize("mount", ["level", *in_whole("body")])
def test_the_kernels_of_gpus_draw_shadows_as_c_does(
    kernels: bool, monkeypatch: pytest.MonkeyPatch, mount: Literal["level", "body"]
) -> None:
    if not (kernels and native.is_available("cpu")):
        return
    config = dataclasses.replace(CONFIG, shadows=True, mount=mount, sun_elevation_deg=30.0)
    rng = np.random.default_rng(11)
    scene, origin, rotation = frames([crowd(rng), empty_field(rng)], 32, seed=12)
    if mount == "body":
        rotation = tilted_poses(rng, 32)
    weights = jnp.broadcast_to(jnp.asarray(LUMA_WEIGHTS), origin.shape)
    in_one, _ = in_c(native._call, config, scene, origin, rotation, weights)
    call = native._call
    monkeypatch.setattr(native, "_call", lambda target, *given: call(f"emulated_{target}", *given))
    in_other, _ = in_c(native._call, config, scene, origin, rotation, weights)
    assert np.isfinite(in_one).any()
    assert np.mean(~np.isclose(in_one, in_other, rtol=1e-4, atol=1e-4)) < TIES


def test_a_ceiling_keeps_the_sun_out_in_c_too() -> None:
    low, down = jnp.array([0.0, 0.0, 9.0]), jnp.array([0.0, 0.0, -1.0])
    hall = scene_of(GROUND, dataclasses.replace(GROUND, position=low, normal=down), box(30, 30, 2, 2, 3, 2, 1))
    config = dataclasses.replace(CONFIG, texture_contrast=0.0)
    place, turn = jnp.array([22.0, 28.0, 3.0]), jnp.asarray(rotation_of(0.0, 0.0, 0.3), jnp.float32)
    draw = jax.jit(camera.render_luma, static_argnums=0)
    # All that is seen has the ambient light alone; sky there is none.
    inside = draw(dataclasses.replace(config, shadows=True), hall, place, turn)
    np.testing.assert_allclose(
        inside, config.ambient * draw(dataclasses.replace(config, ambient=1.0), hall, place, turn), atol=1e-6
    )


def test_a_world_with_other_shapes_is_drawn_by_jax() -> None:
    rng = np.random.default_rng(0)
    assert not native.can_render(every_kind(rng), "cpu")
    walls = [GROUND] * native.MOST_PLANES
    assert native.can_render(scene_of(*walls), "cpu") is native.is_available("cpu")
    assert not native.can_render(scene_of(*walls, GROUND), "cpu")
    assert native.can_render(crowd(rng), "cpu") is native.is_available("cpu")


def test_a_frame_is_the_same_to_the_bit_however_it_is_mapped() -> None:
    """Worlds of their own, a world for every four frames, and one world for all."""
    scene, origin, rotation = frames([crowd(np.random.default_rng(1))], 12, seed=2)
    world = take_scene(scene, 0)
    one = partial(camera.render_luma, CONFIG)
    own = jax.jit(jax.vmap(one))(scene, origin, rotation)
    folded = [np.reshape(leaf, (3, 4, *leaf.shape[1:])) for leaf in (origin, rotation)]
    three = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (3, *leaf.shape)), world)
    shared = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0, 0))))(three, *folded)
    single = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))(world, origin, rotation)
    inverted = jax.jit(jax.vmap(jax.vmap(one, in_axes=(0, None, None)), in_axes=(None, 0, 0)))(three, origin, rotation)
    alone = np.stack(
        [jax.jit(one)(world, *pose) for pose in zip(np.asarray(origin), np.asarray(rotation), strict=True)]
    )
    for other in (np.reshape(shared, own.shape), single, np.asarray(inverted)[:, 2], alone):
        np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("render", [camera.render_luma, camera.render_depth], ids=["pictures", "depths"])
@pytest.mark.parametrize("mount", ["level", "body"])
def test_poses_that_are_not_finite_spoil_their_own_frame_alone(
    mount: Literal["level", "body"], render: Callable[..., jax.Array]
) -> None:
    scene, origin, rotation = frames([crowd(np.random.default_rng(1))], 6, seed=2)
    draw = jax.jit(jax.vmap(partial(render, dataclasses.replace(CONFIG, mount=mount))))
    good = np.asarray(draw(scene, origin, rotation))
    bad = np.asarray(draw(scene, origin.at[1].set(jnp.nan).at[4].set(jnp.inf), rotation.at[2].set(jnp.nan)))
    np.testing.assert_array_equal(bad[[0, 3, 5]], good[[0, 3, 5]])
    assert render is camera.render_depth or np.isnan(bad[[1, 2, 4]]).all()
