"""Columns drawn in blocks: whatever the block, whatever the batch, the picture is the same but for rounding."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera, columns
from edqn_jax.sim.scene.scene import stack_scenes, take_scene
from tests.oracles import camera_plain
from tests.support.drawn_scenes import GROUND, ball, box, free_points, pillar, rotation_of, scene_of

CONFIG = CameraConfig(width=16, height=12)
ROUNDING = 2e-6
"""Ten times float32's own: compilers contract multiplications and additions differently in different programs."""


@pytest.fixture(autouse=True)
def in_jax(monkeypatch):
    """Columns as they are drawn without a compiler; `test_native.py` holds the others against them."""
    monkeypatch.setattr(camera, "_pictures_natively", lambda *_: None)


def stairs(count):
    """Steps one behind the other, each a little higher: all of them in the same columns."""
    return [box(8 + 1.5 * n, 20, 0.5 + 0.2 * n, 0.3, 6, 0.5 + 0.2 * n) for n in range(count)]


def crowd(rng, boxes, cylinders, spheres):
    def places(count):
        return rng.uniform([10, 5, 2], [60, 55, 8], (count, 3))

    return scene_of(
        GROUND,
        *(box(x, y, z, 2.0, 1.0, z, yaw) for yaw, (x, y, z) in enumerate(places(boxes))),
        *(pillar(x, y, z, 0.8, z) for x, y, z in places(cylinders)),
        *(ball(x, y, z, 1.5) for x, y, z in places(spheres)),
    )


@pytest.mark.whole
@pytest.mark.parametrize("count", [10, 40], ids=["more than any capacity", "more than a word holds"])
@pytest.mark.slow
def test_columns_with_more_shapes_than_any_capacity_are_drawn_completely(count):
    scene, position, rotation = scene_of(GROUND, *stairs(count)), (4.0, 20.0, 9.0), rotation_of(0, 0, 0.05)
    seen = jax.jit(partial(camera.render_luma, CONFIG))(
        scene, jnp.asarray(position), jnp.asarray(rotation, jnp.float32)
    )
    plain = camera_plain.luma(CONFIG, scene, np.array(position), rotation, samples=8)
    # Reached: rms 0.016 and 0.19 in one pixel; many edges stand in it, three of which are kept.
    assert np.sqrt(np.mean((seen - plain) ** 2)) < 0.02 and np.abs(seen - plain).max() < 0.25


@pytest.mark.whole
@pytest.mark.slow
def test_a_picture_does_not_depend_on_blocks_and_on_how_it_is_mapped(monkeypatch):
    """Two crowded worlds, 64 poses: sorted into blocks, and one shape after another in every column."""
    rng = np.random.default_rng(5)
    pool = stack_scenes([crowd(rng, 20, 6, 2), crowd(rng, 34, 8, 3)])
    index = np.arange(64) % 2
    points = [free_points(take_scene(pool, world), rng, 32) for world in range(2)]
    positions = np.stack([points[world][n // 2] for n, world in enumerate(index)]).astype(np.float32)
    rotations = np.stack([rotation_of(0, 0, yaw) for yaw in rng.uniform(-np.pi, np.pi, 64)]).astype(np.float32)

    def one(i, p, r):
        return camera.render_luma(CONFIG, take_scene(pool, i), p, r)

    poses = (index, positions, rotations)
    blocks = jax.jit(jax.vmap(one))(*poses)
    monkeypatch.setattr(columns, "SLOTS", (0,))
    folded = jax.jit(jax.vmap(jax.vmap(one)))(*(x.reshape(8, 8, *x.shape[1:]) for x in poses))
    np.testing.assert_allclose(folded.reshape(blocks.shape), blocks, atol=ROUNDING)
