"""The conventional camera by columns against ours, whose method it has: pictures, labels and what it declines."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conventional_stack import world
from conventional_stack.cameras.columns import ColumnCamera
from conventional_stack.cameras.rays import RayCamera
from conventional_stack.stopwatch import Stopwatch
from edqn_jax.config import CameraConfig, Config
from edqn_jax.errors import ConfigError
from edqn_jax.sim.camera import camera as our_camera
from edqn_jax.sim.sensors import sensor as our_sensor
from tests.support.benchmarks.conventional_course import paper
from tests.support.camera_in_c import ROUNDING, TIES, crowd
from tests.support.drawn_scenes import GROUND, every_kind, free_points, pillar, rotation_of, scene_of


def poses(scene, count, seed):
    """[count, 7] level ones, anywhere free: above and below shapes, and beside their walls."""
    rng = np.random.default_rng(seed)
    place, yaw = free_points(scene, rng, count), rng.uniform(-np.pi, np.pi, count)
    zero = np.zeros(count)
    return np.column_stack([place, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)]).astype(np.float32).astype(float), yaw


def drawn(kind, config, scene, pose):
    """Luma [M, H, W] of the poses and their labels, by a camera of this stack."""
    seen = world.compiled(world.text_of(scene))
    shape = len(pose), config.height * config.width
    luma, label = np.full((2, *shape), np.nan), np.full(shape, np.nan, np.float32)
    kind(config, seen, len(pose)).draw(Stopwatch(), np.stack([pose[::-1], pose]), luma, label)
    np.testing.assert_array_equal(luma[0, ::-1], luma[1])  # either of the two frames
    return luma[1].reshape(-1, config.height, config.width), label.reshape(-1, config.height, config.width)


@partial(jax.jit, static_argnums=0)
def ours(config, scene, pose, rotation):
    def one(pose, rotation):
        label = our_sensor.nearness_image(config, scene, pose[:3], pose[3:])
        return our_camera.render_luma(config.camera, scene, pose[:3], rotation), label

    return jax.vmap(one)(pose, rotation)


def beside_ours(config, scene, count, seed):
    """Luma and labels of this stack, and ours."""
    pose, yaw = poses(scene, count, seed)
    rotation = jnp.asarray(np.stack([rotation_of(0, 0, angle) for angle in yaw]), jnp.float32)
    picture, near = ours(Config(camera=config), scene, jnp.asarray(pose, jnp.float32), rotation)
    return *drawn(ColumnCamera, config, scene, pose), np.asarray(picture), np.asarray(near)


SIZES = [(32, 24), (13, 7)]
"""The usual one; one with a middle row, on the horizon."""


@pytest.mark.parametrize("size", SIZES, ids=["usual", "odd"])
def test_pictures_and_labels_are_ours(size):
    config = dataclasses.replace(CameraConfig(), width=size[0], height=size[1])
    crowds = [crowd(np.random.default_rng(seed)) for seed in (1, 2)]
    for seed, scene in enumerate([paper(), *crowds]):
        luma, label, picture, near = beside_ours(config, scene, 48, seed)
        # Ours is in single precision, which tells apart what coincides by rounding; in the paper's world nothing does.
        rounding, ties = (1e-5, 0.0) if seed == 0 else (ROUNDING, TIES)
        assert np.mean(np.abs(luma - picture) > rounding) <= ties, np.abs(luma - picture).max()
        assert np.mean(np.abs(label - near) > rounding) <= ties, np.abs(label - near).max()
        assert picture.std() > 0.05 and np.ptp(label) > 1.0 and np.any(label == 0.0)


def test_a_plane_that_is_not_level_is_drawn_as_ours():
    tilted = dataclasses.replace(GROUND, position=np.array([0, 0, -4.0]), normal=np.array([0.28, 0.0, 0.96]))
    luma, label, picture, near = beside_ours(CameraConfig(), scene_of(tilted, GROUND, pillar(20, 30, 4, 2, 4)), 24, 0)
    assert np.mean(np.abs(luma - picture) > ROUNDING) <= TIES
    assert np.mean(np.abs(label - near) > ROUNDING) <= TIES


def test_off_the_silhouettes_both_cameras_of_this_stack_show_the_same():
    config, scene = CameraConfig(texture_contrast=0.0), paper()
    pose, _ = poses(scene, 32, seed=3)
    (columns, near), (rays, cast) = (drawn(kind, config, scene, pose) for kind in (ColumnCamera, RayCamera))
    apart = np.abs(columns - rays)
    # A ray sees one side of a silhouette, an area both; that is so in one pixel of ten.
    assert 0.005 < np.mean(apart > 1e-3) < 0.2 and np.median(apart) < 1e-6
    # Labels are of the middle ray in both.
    assert np.mean(np.abs(near - cast) > 1e-5) < 0.003


def test_a_world_of_other_shapes_is_declined_and_the_other_camera_is_named():
    seen = world.compiled(world.text_of(every_kind(np.random.default_rng(0))))
    with pytest.raises(ConfigError, match="supports only upright boxes and cylinders, spheres and planes; its camera"):
        ColumnCamera(CameraConfig(), seen, 1)
