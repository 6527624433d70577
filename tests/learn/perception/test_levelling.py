"""Events of a camera on the body, moved to the pixels of a level one."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax import ConfigError, make_config
from edqn_jax.config import CameraConfig
from edqn_jax.fly.frames import quaternion_of_angles
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.perception.levelling import level_events, level_places
from edqn_jax.sim.camera.raycast import camera_rays, pitch_of
from edqn_jax.sim.physics import drone
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import label_image, mount_rotation, nearness_image
from edqn_jax.sim.task.observation import Observation, lean_of, motion_size, own_size
from tests.support.drawn_scenes import every_kind, rotation_of

LEVEL, BODY = CameraConfig(), CameraConfig(mount="body")
LEANS = [(0.0, 0.0), (0.3, 0.0), (0.0, -0.4), (-0.25, 0.5), (1.2, 0.9)]


@pytest.mark.parametrize(("roll", "pitch"), LEANS)
def test_a_place_in_the_bodys_picture_looks_where_the_level_pixel_looks(roll: float, pitch: float) -> None:
    """The rays of both cameras, which know nothing of places, point the same way."""
    rotation = mount_rotation(
        make_config(camera={"mount": "body"}), jnp.asarray(quaternion_of_angles(roll, pitch, 0.7))
    )
    level, body = camera_rays(LEVEL, rotation), camera_rays(BODY, rotation)
    row, column, seen = (np.asarray(x) for x in level_places(LEVEL, jnp.array([roll, pitch])))
    size = pitch_of(LEVEL)
    u, v = (column - 15.5) * size, (11.5 - row) * size
    ahead, right, up = np.asarray(rotation[:, 0]), np.asarray(body.right), np.asarray(body.up)
    found = ahead + u[..., None] * right + v[..., None] * up
    wanted = np.stack(np.broadcast_arrays(level.dx, level.dy, level.dz), axis=-1)
    unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)  # noqa: E731
    # Half of a pixel is cut off at the picture's edge, whose middle is the last place.
    inside = seen & (row > 0) & (row < 23) & (column > 0) & (column < 31)
    np.testing.assert_allclose(unit(found)[inside], unit(wanted)[inside], atol=2e-6)
    ahead_of_body = unit(wanted) @ ahead
    assert (ahead_of_body[seen] > 0.5).all() or not seen.any()
    assert seen.all() == ((roll, pitch) == (0.0, 0.0))


def test_roll_and_pitch_are_those_of_the_attitude() -> None:
    """What the own motion tells is what turned the test's rays."""
    for roll, pitch in LEANS:
        found = drone.roll_and_pitch_of(jnp.asarray(quaternion_of_angles(roll, pitch, -1.1)))
        np.testing.assert_allclose(found, [roll, pitch], atol=1e-5)
    np.testing.assert_allclose(
        rotation_of(0.3, -0.2, 0.5),
        mount_rotation(make_config(camera={"mount": "body"}), jnp.asarray(quaternion_of_angles(0.3, -0.2, 0.5))),
        atol=1e-6,
    )


def field_of(signed: np.ndarray, *, with_noise: bool = False) -> EventField:
    events = jnp.asarray(signed, jnp.int32)
    times = jnp.broadcast_to(0.01 * jnp.arange(events.shape[-3], dtype=jnp.float32)[:, None, None], events.shape)
    return EventField(jnp.abs(events), jnp.sign(events).astype(jnp.int8), times, times, 0.08, with_noise=with_noise)


@pytest.mark.parametrize("whole", [True, False])
def test_a_level_body_moves_no_event(whole: bool) -> None:
    signed = np.random.default_rng(0).integers(-9, 9, (2, 24, 32))
    field = field_of(signed)
    moved = level_events(LEVEL, field, jnp.zeros((3, 2)), whole=whole)
    for name in ("count", "polarity", "t_first", "t_step"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(field, name), err_msg=name)


@pytest.mark.parametrize("whole", [True, False])
def test_many_fields_are_levelled_as_one_by_one_pixel_by_pixel(whole: bool) -> None:
    """Against plain loops over pixels; ON rows and OFF rows of a noisy field lean alike."""
    rng = np.random.default_rng(1)
    signed = rng.integers(0, 90, (3, 4, 24, 32)) * np.array([1, 1, -1, -1])[:, None, None]
    lean = rng.normal(0, 0.25, (3, 3, 2))
    moved = level_events(LEVEL, field_of(signed, with_noise=True), jnp.asarray(lean), whole=whole)
    found = np.asarray(moved.count * moved.polarity)
    for one in range(3):
        for pair in range(2):
            places = level_places(LEVEL, jnp.asarray((lean[one, pair] + lean[one, pair + 1]) / 2))
            rows, columns, seen = (np.asarray(x) for x in places)
            for half in (pair, pair + 2):
                expected = np.zeros((24, 32))
                for r, c in zip(*np.nonzero(seen), strict=True):
                    expected[r, c] = _sample(signed[one, half], float(rows[r, c]), float(columns[r, c]), whole)
                np.testing.assert_allclose(found[one, half], expected, atol=0.51)  # rounded to whole events
                assert seen.mean() > 0.3


def _sample(picture: np.ndarray, row: float, column: float, whole: bool) -> float:
    if whole:
        return picture[round(row), round(column)]
    top, left = int(row), int(column)
    below, beside = min(top + 1, 23), min(left + 1, 31)
    down, right = row - top, column - left
    upper = (1 - right) * picture[top, left] + right * picture[top, beside]
    lower = (1 - right) * picture[below, left] + right * picture[below, beside]
    return (1 - down) * upper + down * lower


def test_the_encoder_reads_levelled_events() -> None:
    """Moving the events and turning the camera are the same to the encoder's input."""
    config = make_config(
        "medium",
        camera={"mount": "body"},
        encoder={"levelled": True},
        events={"least_contrast": 0.1, "most_contrast": 0.2},
    )
    signed = np.random.default_rng(2).integers(-9, 9, (1, 24, 32))
    motion = jnp.concatenate([jnp.zeros(7), jnp.array([0.2, 0.1, 0.3, 0.2]), jnp.ones(1)])
    assert motion.shape == (motion_size(config),)
    np.testing.assert_allclose(lean_of(config, motion), [[0.2, 0.1], [0.3, 0.2]], atol=1e-6)
    read = embedding.as_encoder_input(config, Observation(field_of(signed), jnp.zeros(own_size(config)), motion))
    expected = level_events(LEVEL, field_of(signed), lean_of(config, motion), whole=True)
    jax.tree.map(np.testing.assert_array_equal, read.sensed, expected)


def test_only_events_of_a_camera_on_the_body_are_levelled() -> None:
    for camera, sensor in (("level", "events"), ("body", "frames")):
        with pytest.raises(ConfigError, match=r"encoder.levelled.*camera.mount is body and env.sensor is events"):
            make_config(camera={"mount": camera}, env={"sensor": sensor}, encoder={"levelled": True})
    assert dataclasses.replace(LEVEL, mount="body") == BODY


@pytest.mark.whole
def test_the_label_of_levelled_events_is_that_of_a_level_camera() -> None:
    """At the heading to which roll and pitch are relative; without levelling it is the body's own view."""
    scene = every_kind(np.random.default_rng(4))
    position, attitude = jnp.array([5.0, 5.0, 3.0]), jnp.asarray(quaternion_of_angles(0.3, -0.25, 0.6), jnp.float32)
    level, body = make_config("medium"), make_config("medium", camera={"mount": "body"})
    levelled = make_config("medium", camera={"mount": "body"}, encoder={"levelled": True})
    flat = jnp.asarray(quaternion_of_angles(0.0, 0.0, 0.6), jnp.float32)
    label = label_image(levelled, scene, position, attitude)
    np.testing.assert_allclose(label, nearness_image(level, scene, position, flat), atol=1e-4)
    np.testing.assert_allclose(
        label_image(body, scene, position, attitude), nearness_image(body, scene, position, attitude)
    )
    assert np.abs(label - label_image(body, scene, position, attitude)).max() > 0.1
