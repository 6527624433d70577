"""Rays, shade, texture and label of the conventional camera by rays against brute force and ours; its events too."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conventional_stack import events, task, world
from conventional_stack.cameras import rays as camera
from conventional_stack.cameras.optics import optics_of
from edqn_jax.config import CameraConfig, Config, EncoderConfig, EventsConfig
from edqn_jax.sim.camera import camera as our_camera
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.sensors import event_laws, event_memory
from edqn_jax.sim.sensors import sensor as our_sensor
from tests.oracles import camera_plain, event_fields, events_plain
from tests.support.benchmarks.conventional_course import paper
from tests.support.drawn_scenes import every_kind, free_points

PLAIN = CameraConfig(texture_contrast=0.0)


def poses(scene, count, seed):
    """[count, 7], tilted by up to half a radian: the camera must not be."""
    rng = np.random.default_rng(seed)
    position = free_points(scene, rng, count)
    yaw = rng.uniform(-np.pi, np.pi, count)
    lean = np.concatenate([np.ones((count, 1)), rng.uniform(-0.25, 0.25, (count, 2)), np.zeros((count, 1))], axis=1)
    w, x, y, _ = (lean / np.linalg.norm(lean, axis=1, keepdims=True)).T
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    turned = np.stack([cos * w, cos * x - sin * y, cos * y + sin * x, sin * w], axis=1)
    return np.concatenate([position, turned], axis=1), yaw


def pictures(config, scene, pose):
    """Luma [M, H, W] and what was met."""
    seen, optics = world.compiled(world.text_of(scene)), optics_of(config)
    hits = camera.Hits.empty(len(pose), config.height * config.width)
    luma = np.empty((len(pose), config.height * config.width))
    camera.cast(seen.model._address, seen.data._address, optics, pose, hits)
    camera.shade(seen.geoms, optics, pose, hits, luma)
    return luma.reshape(-1, config.height, config.width), hits


def turn(yaw):
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


@pytest.mark.parametrize("seed", range(3))
def test_without_texture_every_pixel_is_its_middle_ray(seed):
    scene = every_kind(np.random.default_rng(seed))
    pose, yaw = poses(scene, 6, seed)
    got, _ = pictures(PLAIN, scene, pose)
    for picture, p, angle in zip(got, pose, yaw, strict=True):
        expected = camera_plain.luma(PLAIN, scene, p[:3], turn(angle), samples=1)
        # A ray may pass a silhouette on the other side: the shapes' own float32 numbers go through MJCF.
        assert np.mean(np.abs(picture - expected) > 1e-5) < 0.003


def inside(hits, shape):
    """[M, H, W] whether a pixel and its four neighbours lie on one face."""
    geom, normal = hits.geom.reshape(shape), hits.normal.reshape(*shape, 3)
    same = geom >= 0
    for axis in (1, 2):
        for way in (1, -1):
            same &= np.roll(geom, way, axis) == geom
            same &= np.abs(np.roll(normal, way, axis) - normal).max(-1) < 1e-3
    same[:, [0, -1]], same[:, :, [0, -1]] = False, False
    return same


def test_off_the_silhouettes_a_picture_is_ours():
    config, scene = CameraConfig(), paper()
    pose, yaw = poses(scene, 16, seed=7)
    got, hits = pictures(config, scene, pose)
    rotations = jnp.asarray(np.stack([turn(angle) for angle in yaw]), jnp.float32)
    ours = jax.jit(jax.vmap(partial(our_camera.render_luma, config, scene)))(
        jnp.asarray(pose[:, :3], jnp.float32), rotations
    )
    error = np.abs(got - np.asarray(ours))
    face = inside(hits, got.shape)
    assert face.sum() > 3000
    # Float32 against float64; the few others lie beside a face that a middle ray does not meet.
    assert np.quantile(error[face], 0.99) < 1e-5


def our_labels(config, scene, pose):
    place = jnp.asarray(pose, jnp.float32)
    label = partial(our_sensor.nearness_image, config, scene)
    return np.asarray(jax.jit(jax.vmap(label))(place[:, :3], place[:, 3:]))


@pytest.mark.parametrize("seed", range(3))
def test_the_label_is_our_nearness_image(seed):
    config, scene = Config(), every_kind(np.random.default_rng(seed))
    pose, _ = poses(scene, 6, seed)
    _, hits = pictures(config.camera, scene, pose)
    label = np.empty(hits.depth.shape, np.float32)
    camera.nearness(hits, label)
    error = np.abs(label.reshape(-1, config.camera.height, config.camera.width) - our_labels(config, scene, pose))
    # A ray may pass a silhouette on the other side, as above.
    assert np.mean(error > 1e-5) < 0.003
    assert np.ptp(label) > 1.0 and np.any(label == 0.0)


def test_texture_is_averaged_over_the_pixel():
    config, scene = CameraConfig(), paper()
    pose, yaw = poses(scene, 8, seed=5)
    got, hits = pictures(config, scene, pose)
    face = inside(hits, got.shape)
    expected, point = (
        np.stack([camera_plain.luma(config, scene, p[:3], turn(y), samples=n) for p, y in zip(pose, yaw, strict=True)])
        for n in (8, 1)
    )
    error, unfiltered = np.abs(got - expected)[face].mean(), np.abs(point - expected)[face].mean()
    assert error < unfiltered / 8


def test_frames_seen_in_blocks_are_those_seen_alone():
    scene = paper()
    pose, _ = poses(scene, 5, seed=9)
    together, _ = pictures(CameraConfig(), scene, pose)
    for picture, one in zip(together, pose, strict=True):
        np.testing.assert_array_equal(pictures(CameraConfig(), scene, one[None])[0][0], picture)


def test_the_signed_distance_is_ours_for_every_kind_of_shape():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene = every_kind(rng)
        points = rng.uniform((-5, -5, -2), (65, 65, 27), (500, 3))
        geoms = world.compiled(world.text_of(scene)).geoms
        got = [task.signed_distance(geoms, x, y, z) for x, y, z in points]
        ours = jax.vmap(partial(signed_distance, scene))(jnp.asarray(points, jnp.float32))
        np.testing.assert_allclose(got, ours, atol=1e-4)  # float32 at 60 m
        assert np.mean(np.asarray(got) < 0) > 0.05


def test_an_empty_world_is_free_everywhere():
    from tests.support.drawn_scenes import scene_of

    geoms = world.compiled(world.text_of(scene_of())).geoms
    assert task.signed_distance(geoms, 1.0, 2.0, 3.0) == np.inf


@pytest.mark.parametrize("change", [{}, {"tolerance": 0.02, "threshold": 0.1}, {"refractory_ns": 1e7}])
def test_events_are_the_papers_law(change):
    config = dataclasses.replace(EventsConfig(), **change)
    rng = np.random.default_rng(0)
    before = rng.uniform(0, 1, (4, 30))
    after = np.clip(before * np.exp(rng.normal(0, 0.3, before.shape)), 0, 1)
    after[0, :5], before[1, :5] = 0.0, 0.0
    counts = np.zeros(before.shape, np.int8)
    events.signed_counts(events.law_of(config), before, after, counts)
    times = np.array(config.frame_times_s)
    level = np.log(np.stack([before, after]) + config.log_epsilon)
    plain = np.zeros(before.shape, int)
    for _, x, y, p in events_plain.paper(level, times, config.threshold, config.tolerance, config.refractory_ns):
        plain[y, x] += p
    np.testing.assert_array_equal(counts, np.clip(plain, -127, 127))
    # And ours; its float32 logarithm may count one more or less where a change is a whole number of tolerances.
    memory = event_memory.reset_memory(config, before.shape[0], before.shape[1], jax.random.key(0))
    frames = jnp.asarray(np.stack([before, after]), jnp.float32)
    field, _ = event_laws.generate_events(config, memory, frames, config.frame_times_s, jax.random.key(0))
    assert np.mean(np.asarray(event_fields.signed_count(field)) != counts) < 0.02


def test_the_fleet_sees_what_the_two_frames_show():
    from tests.support.benchmarks.conventional_course import fleet_of

    config = Config()
    start, goal = np.array([[40.0, 22.0, 6.0], [20.0, 40.0, 5.0]]), np.array([[90.0, 90.0, 10.0]] * 2)
    fleet = fleet_of(config, start, goal)
    for action in (22, 22, 25):
        fleet.record.action[:] = action
        fleet.step(restart=False)
    first, last = our_sensor.frame_steps(config)
    frames = [pictures(config.camera, paper(), fleet.path[:, at].copy())[0] for at in (first, last)]
    expected = np.zeros((2, config.camera.height * config.camera.width), np.int8)
    events.signed_counts(events.law_of(config.events), *(f.reshape(2, -1) for f in frames), expected)
    np.testing.assert_array_equal(fleet.record.events.reshape(2, -1), expected)
    assert np.count_nonzero(expected) > 50
    label = our_labels(config, paper(), fleet.path[:, last])
    assert np.mean(np.abs(fleet.record.nearness - label) > 1e-5) < 0.003


def test_a_label_that_is_not_drawn_is_not_rendered():
    from tests.support.benchmarks.conventional_course import fleet_of

    config = dataclasses.replace(Config(), encoder=EncoderConfig(target="sensed"))
    fleet = fleet_of(config, np.array([[40.0, 22.0, 6.0]]), np.array([[90.0, 90.0, 10.0]]))
    fleet.step(restart=False)
    assert fleet.record.nearness.shape == (1, 0, 0)
