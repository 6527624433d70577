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
from tests.support.drawn_scenes import GROUND, box, looking, pillar, rotation_of, scene_of

SHARES = {
    "blank": (0, 0, 0, 0),
    "waves": (0.4, 0.3, 0.2, 0.1),
    "noise": (0.3, 0.3, 0.2, 0.2),
    "checks": (0.2, 0.6, 0.2, 0.4),
    "bricks": (-1, 0.15, 0.1, 0),
    "posters": (-0.2, 0.2, 0.4, 0.6),
    "wood": (0.8, 0.3, 0.3, 0.2),
    "spots": (-0.4, 0.2, 0.4, 0.1),
}

ERRORS = {
    "blank": (0, 0),
    "waves": (0.13, 0.02),
    "noise": (0.11, 0.02),
    "checks": (0.13, 0.022),
    "bricks": (0.12, 0.026),
    "posters": (0.14, 0.026),
    "wood": (0.11, 0.022),
    "spots": (0.14, 0.026),
}
"""Error of a pixel's pattern, whose amplitude is 1: at most, and root mean square. Waves err most beyond a period a
pixel, where `texture.box_filter` has no side lobes; edges that are oblique in the pixel, which is taken for as wide as
its diagonal; and products of averages where a corner is in the middle of the pixel."""


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pixel_is_the_average_of_what_is_in_it(name: str) -> None:
    rng = np.random.default_rng(0)
    count = 400
    at = rng.uniform(-3, 3, (4, count))
    size, turn = 2.0 ** rng.uniform(-5, 1, count), rng.uniform(-np.pi, np.pi, (2, 4, count))
    if name in ("checks", "bricks", "posters", "spots"):
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
    largest, typical = ERRORS[name]
    assert np.abs(error).max() <= largest, (np.abs(error).max(), np.sqrt(np.mean(error**2)))
    assert np.sqrt(np.mean(error**2)) <= typical
    assert name == "blank" or np.std(drawn) > 0.05


@pytest.mark.whole
@pytest.mark.parametrize("mount, most", [("level", 0.014), ("body", 0.015)])
def test_pictures_of_every_pattern_agree_with_supersampling(mount: Literal["level", "body"], most: float) -> None:
    """With a light of its own, from near enough to see what the patterns are."""
    posts = [pillar(4 * x, 9.0, 3, 1.2, 3) for x in range(4)]
    scene = looking(scene_of(GROUND, *(box(4 * x, 0.0, 2, 1.5, 1, 2, 0.3 * x) for x in range(6)), *posts))
    tilt = 0.3 if mount == "body" else 0.0
    places = [(4.0 * x - 1, 4.5, 2.0) for x in range(6)]
    rotation = np.stack([rotation_of(tilt, -tilt, (-1) ** x * 1.5) for x in range(6)]).astype(np.float32)
    config = CameraConfig(mount=mount)
    drawn = jax.jit(jax.vmap(partial(camera.render_luma, config, scene)))(jnp.array(places), jnp.asarray(rotation))
    poses = zip(np.array(places), rotation, strict=True)
    fine = np.stack([camera_plain.luma(config, scene, *pose, samples=8) for pose in poses])
    error = np.asarray(drawn) - fine
    assert np.sqrt(np.mean(error**2)) < most and fine.std() > 0.05
