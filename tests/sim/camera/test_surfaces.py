"""Averages of patterns over pixels, beside many samples."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera
from edqn_jax.sim.camera.surfaces import Phase, relative_albedo
from edqn_jax.sim.scene.surface import PATTERNS, PHASES
from tests.oracles import camera_plain, surfaces_plain
from tests.sim.drawn_scenes import GROUND, box, every_kind, free_points, looking, pillar, rotation_of, scene_of

SHARES = {
    "blank": (0, 0, 0, 0),
    "waves": (0.4, 0.3, 0.2, 0.1),
    "noise": (0.3, 0.3, 0.2, 0.2),
    "checks": (0.2, 0.6, 0.2, 0.4),
    "bricks": (-1, 0.15, 0.1, 0),
    "posters": (-0.2, 0.2, 0.4, 0.6),
    "wood": (0.8, 0.3, 0.3, 0.2),
}

LARGEST = {"blank": 0, "waves": 0.13, "noise": 0.11, "checks": 0.13, "bricks": 0.12, "posters": 0.14, "wood": 0.11}
TYPICAL = {"blank": 0, "waves": 0.02, "noise": 0.02, "checks": 0.022, "bricks": 0.026, "posters": 0.026, "wood": 0.022}
"""Error of a pixel's pattern, whose amplitude is 1: at most, and root mean square. Waves err most beyond a period a
pixel, where `texture.box_filter` has no side lobes; edges that are oblique in the pixel, which is taken for as wide as
its diagonal; and products of averages where a corner is in the middle of the pixel."""


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pixel_is_the_average_of_what_is_in_it(name: str) -> None:
    rng = np.random.default_rng(0)
    count = 400
    at = rng.uniform(-3, 3, (4, count))
    size, turn = 2.0 ** rng.uniform(-5, 1, count), rng.uniform(-np.pi, np.pi, (2, 4, count))
    if name in ("checks", "bricks", "posters"):
        turn[:, 1] = turn[:, 0] + np.pi / 2  # the first two phases are perpendicular, and the pixel is a square
    turn[1] = turn[0] + np.pi / 2
    right, up = size * np.cos(turn)
    if name == "wood":
        right[1:3] *= 0.2  # rings bend over several of their periods
        up[1:3] *= 0.2
    numbers = [jnp.full(count, x, jnp.float32) for x in (PATTERNS.index(name), 1.0, *SHARES[name])]
    assert len(numbers) == PHASES
    phases = [Phase(*(jnp.asarray(x[i], jnp.float32) for x in (at, right, up))) for i in range(4)]
    drawn = np.asarray(jax.jit(lambda n, p: relative_albedo((name,), n, p))(numbers, phases)) - 1
    error = drawn - surfaces_plain.pixel(name, SHARES[name], at, right, up)
    assert np.abs(error).max() <= LARGEST[name], (np.abs(error).max(), np.sqrt(np.mean(error**2)))
    assert np.sqrt(np.mean(error**2)) <= TYPICAL[name]
    assert name == "blank" or np.std(drawn) > 0.05


@pytest.mark.parametrize("mount, most", [("level", 0.02), ("body", 0.034)])
def test_pictures_of_every_pattern_agree_with_supersampling(mount: Literal["level", "body"], most: float) -> None:
    """Where rays are counted, as for the body's camera, a face's slant is not known to the filter: it errs more."""
    rng = np.random.default_rng(4)
    upright = scene_of(GROUND, box(20, 30, 4, 3, 2, 5, 1), box(40, 30, 8, 6, 1, 6), pillar(30, 20, 6, 1.5, 6))
    scene = looking(upright if mount == "level" else every_kind(rng, each=6))
    config = CameraConfig(mount=mount)
    position = free_points(scene, rng, 3, clearance=2.0)
    tilt = 0.3 if mount == "body" else 0.0
    rotation = np.stack([rotation_of(tilt, -tilt, yaw) for yaw in (0.3, 2.0, 4.4)]).astype(np.float32)
    drawn = jax.jit(jax.vmap(partial(camera.luma, config, scene)))(jnp.asarray(position), jnp.asarray(rotation))
    fine = np.stack(
        [camera_plain.luma(config, scene, *pose, samples=6) for pose in zip(position, rotation, strict=True)]
    )
    error = np.asarray(drawn) - fine
    assert np.sqrt(np.mean(error**2)) < most and fine.std() > 0.1
