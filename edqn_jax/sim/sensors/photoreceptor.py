"""The photoreceptor of an event pixel: it follows log brightness no faster than its photocurrent lets it.

The cutoff frequency of a photoreceptor is proportional to the light that falls on it, so a dark pixel lags behind a
bright one and smears what moves (Hu, Liu and Delbruck 2021, "v2e: From Video Frames to Realistic DVS Events", CVPR
Workshops). As there the filter is of first order; here it is stepped exactly for brightness whose logarithm changes
linearly between two frames, so that its result does not depend on how often frames are rendered.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

DARKEST = 20.0
"""8-bit value that v2e adds to brightness, so that a black pixel still has a photocurrent."""


SHOT_NOISE_OF_WHITE = 0.25
"""Shot noise of a white pixel per that of a black one, in v2e."""


def photocurrent(luma: Array, light: Array | float = 1.0) -> Array:
    """Returns the photocurrent of pixels as a share of a white one's: luma [...] in [0, 1] to [...], v2e's formula.

    >>> print(photocurrent(jnp.array([0.0, 1.0])))
    [0.07272727 1.        ]

    Args:
        light: [] illuminance as a share of the one in which the white pixel is.
    """
    return light * (255.0 * luma + DARKEST) / (255.0 + DARKEST)


def shot_noise(current: Array) -> Array:
    """Returns the rate of shot noise as a share of that in darkness, of photocurrents [...].

    v2e's line from 1 in darkness to a quarter in a white pixel. Beyond, in more light, the rate is inversely
    proportional to it: a continuation of ours. The relative density of a current's shot noise falls so, and with it
    what passes a limited bandwidth (Graca and Delbruck 2021, arXiv:2109.08640); a real pixel's rate falls faster.
    """
    line = 1.0 - (1.0 - SHOT_NOISE_OF_WHITE) * current
    return jnp.where(current < 1.0, line, SHOT_NOISE_OF_WHITE / jnp.maximum(current, 1.0))


def between_frames(photocurrents: Array) -> Array:
    """Returns the photocurrents [F, H, W] between frames that have these [T, H, W]: the mean of both."""
    return 0.5 * (photocurrents[:-1] + photocurrents[1:])


def filter_log_brightness(
    cutoff_hz: float, level: Array, times: NDArray, current: Array, lag: Array
) -> tuple[Array, Array]:
    """Low-pass filters log brightness [T, H, W]; returns it and the lag after the last frame [H, W].

    y' = 2 pi f (x - y) with f = `cutoff_hz` x photocurrent. For x that changes by d within the time t between two
    frames the lag y - x becomes lag e^-r - d (1 - e^-r) / r, with r = 2 pi f t.

    Args:
        cutoff_hz: of a pixel with a photocurrent of 1.
        level: log brightness x at the frames.
        times: [T] seconds.
        current: [F, H, W] photocurrents between frames.
        lag: [H, W] y - x at the first frame; 0 for pixels that have settled.
    """
    turns = jnp.asarray(2.0 * np.pi * cutoff_hz * np.diff(times), jnp.float32)[:, None, None] * current

    def pair(lag: Array, xs: tuple[Array, Array]) -> tuple[Array, Array]:
        change, r = xs
        fade = -jnp.expm1(-r)
        # Of a jump, in no time, nothing is followed.
        lag = lag * (1.0 - fade) - change * jnp.where(r > 0.0, fade / jnp.maximum(r, 1e-12), 1.0)
        return lag, lag

    # As in `event_laws`: a window of two or three frames needs no loop.
    last, lags = jax.lax.scan(pair, lag, (jnp.diff(level, axis=0), turns), unroll=min(len(times) - 1, 2))
    return level + jnp.concatenate([lag[None], lags]), last
