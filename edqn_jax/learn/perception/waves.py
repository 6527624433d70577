"""Standing waves of an image, and initialisers with which the VAE learns from its first update on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.nn.initializers import lecun_normal

WAVES = 48
"""Number of standing waves of the image that the first and last layer are initialised with."""

OUTPUT_SCALE = 2.0
"""Constant factor on the decoder's amplitudes; with it the VAE learns as fast as one that decodes single pixels."""


def cosine_basis(size: int, count: int) -> np.ndarray:
    """Returns the `count` lowest standing waves of `size` pixels as orthonormal rows: `[count, size]` (the DCT-II)."""
    place = (np.arange(size) + 0.5) / size
    rows = np.cos(np.pi * np.arange(count)[:, None] * place) * np.sqrt(2.0 / size)
    rows[0] /= np.sqrt(2.0)
    return rows.astype(np.float32)


def lowest_waves(height: int, width: int, rows: int, columns: int) -> np.ndarray:
    """Returns which of the first `rows` x `columns` standing waves are among the `WAVES` lowest: `[rows, columns]`."""
    frequency = np.hypot(np.arange(rows)[:, None] / height, np.arange(columns) / width)
    return np.argsort(np.argsort(frequency, axis=None, kind="stable")).reshape(rows, columns) < WAVES


def standing_waves(height: int, width: int) -> Array:
    """Returns the `WAVES` lowest standing waves of the image (products of cosines), rms 1: `[WAVES, H, W]`."""
    down, across = np.nonzero(lowest_waves(height, width, height, width))
    image = cosine_basis(height, height)[down][:, :, None] * cosine_basis(width, width)[across][:, None, :]
    return jnp.asarray(image * np.sqrt(height * width), jnp.float32)


def paired_relu_init(*, inputs: bool, outputs: bool) -> Callable[..., Array]:
    """Returns an initialiser of ReLU layers that makes the untrained network linear.

    Units come in pairs of opposite sign and are read in pairs of opposite sign: relu(a) - relu(-a) = a. The positions
    of events then affect the code, and the code affects the image, from the first update on.
    """

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        rows = -(-shape[0] // 2) if inputs else shape[0]
        columns = -(-shape[1] // 2) if outputs else shape[1]
        kernel = lecun_normal()(key, (rows, columns), dtype)
        if outputs:
            kernel = jnp.concatenate([kernel, -kernel], axis=1)
        if inputs:
            kernel = jnp.concatenate([kernel, -kernel], axis=0)
        return kernel[: shape[0], : shape[1]]

    return init


def wave_images(height: int, width: int) -> Callable[..., Array]:
    """Returns the initialiser of the decoder's last layer, `[hidden, channels, P, Q]`: small lowest waves, mirrored.

    Event images are smooth on average, white noise is not: initialised with white noise the decoder outputs a blank
    image for thousands of updates, with waves it does not. Part of each wave is common to the first two channels, ON
    and OFF, part of opposite sign; a third channel has the common part.
    """

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        size, channels, rows, columns = shape
        lowest = lowest_waves(height, width, rows, columns)
        key_even, key_odd = jax.random.split(key)
        even, odd = (
            0.0075
            * np.sqrt(height * width)
            / OUTPUT_SCALE
            * lecun_normal()(k, (-(-size // 2), lowest.size), dtype).reshape(-1, rows, columns)
            * jnp.asarray(lowest * np.sqrt(lowest.size / lowest.sum()), dtype)
            for k in (key_even, key_odd)
        )
        kernel = jnp.stack([even + odd, even - odd, even][:channels], axis=1)
        return jnp.concatenate([kernel, -kernel])[:size]

    return init


def wave_table(height: int, width: int) -> Callable[..., Array]:
    """Returns the initialiser of `PixelTable`: mixtures of waves, half of each odd in the polarity, half even."""

    def init(key: Array, shape: tuple[int, ...]) -> Array:
        key_odd, key_even = jax.random.split(key)
        basis = standing_waves(height, width).reshape(-1, height * width).T
        mix = lecun_normal()
        odd = basis @ mix(key_odd, (basis.shape[1], shape[-1]))
        even = basis @ mix(key_even, (basis.shape[1], shape[-1]))
        return jnp.stack([even + polarity * odd for polarity in channel_polarities(shape[0])])

    return init


def channel_polarities(channels: int) -> np.ndarray:
    """Returns the polarity of each channel, `[channels]`: 1 and -1 of ON and OFF, evenly between them of more."""
    return np.linspace(1.0, 1.0 if channels == 1 else -1.0, channels)
