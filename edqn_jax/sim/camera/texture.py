"""Procedural surface texture, box-filtered analytically over each ray's footprint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera.raycast import Rays


@dataclass(frozen=True)
class Wave:
    """One plane wave of the solid texture."""

    direction: tuple[float, float, float]  # unit, world axes
    weight: float  # share of the contrast
    octave: float  # period in units of the configured one


# Two oblique waves an octave make a plaid on faces of every orientation; no direction is parallel to
# an axis, so no axis-aligned face is left blank.
WAVES = (
    Wave((0.62, 0.60, 0.51), 0.3, 1.0),
    Wave((-0.66, 0.52, 0.54), 0.3, 1.0),
    Wave((0.71, -0.33, 0.62), 0.2, 4.0),
    Wave((0.35, 0.78, -0.52), 0.2, 4.0),
)


def smooth_wave(phase: Array) -> Array:
    """Returns a smooth wave of period 1 in [-1, 1]: parabolas that approximate sin(2 pi phase)."""
    f = phase - jnp.round(phase)
    return f * (8.0 - 16.0 * jnp.abs(f))


def box_filter(cycles: Array) -> Array:
    """Returns the amplitude [...] of a wave after an average over `cycles` [...]: sinc to 1.03 % below one, then 0."""
    x = jnp.minimum(cycles * cycles, 1.0)
    return (1.0 - x) * (1.0 - 0.55 * x)


@partial(jax.jit, static_argnums=0)  # traced once for all layers
def texture_factor(
    config: CameraConfig, origin: Array, rays: Rays, depth: Array, slope_right: Array, slope_up: Array
) -> Array:
    """Returns the texture's factor on each pixel's brightness: [H, W], 1 on average.

    The texture is a sum of plane waves in world space, fixed to static surfaces. Along a ray
    the point is o + t d; over a pixel its phase changes by k . (t d' + t' d), and the box average of a wave
    over that many cycles is a sinc.

    Args:
        depth: [H, W] finite.
        slope_right, slope_up: [H, W] change of depth per pixel on the surface.
    """
    total = jnp.zeros_like(depth)
    for each in WAVES:
        per_metre = 1.0 / (config.texture_period_m * each.octave)
        kx, ky, kz = (component * per_metre for component in each.direction)
        along = (kx * rays.dx + ky * rays.dy) + kz * rays.dz
        at_origin = kx * origin[0] + ky * origin[1] + kz * origin[2]
        right = (kx * rays.right[0] + ky * rays.right[1] + kz * rays.right[2]) * rays.pitch
        up = (kx * rays.up[0] + ky * rays.up[1] + kz * rays.up[2]) * rays.pitch
        left = box_filter(depth * right + slope_right * along) * box_filter(depth * up + slope_up * along)
        total = total + each.weight * left * smooth_wave(at_origin + depth * along)
    return 1.0 + config.texture_contrast * total
