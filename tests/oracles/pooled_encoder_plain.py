"""The pooled encoder over a list of events, one after the other: what its sums over a dense field must equal."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import CameraConfig, EncoderConfig
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.pooled_encoder import POOL_SCALE, PooledEncoder


def temporal_encoding(frequencies: int, tau: Array) -> Array:
    """Returns `phi(t) = [1, cos(2 pi k tau), sin(2 pi k tau), ...]` for k = 1 .. frequencies: `[...]` to `[..., C]`.

    `tau` is the time normalised to the window: 0 at its start, 1 at its end.
    """
    channels = [jnp.ones_like(tau)]
    for k in range(1, frequencies + 1):
        channels += [jnp.cos(2.0 * jnp.pi * k * tau), jnp.sin(2.0 * jnp.pi * k * tau)]
    return jnp.stack(channels, axis=-1)


def encode_events(
    config: EncoderConfig, params: Any, camera: CameraConfig, x: Array, y: Array, tau: Array, p: Array
) -> tuple[Array, Array]:
    """Returns the same as `vae.encode` with the pooled encoder, from a list of events: `[..., N]` each.

    Args:
        x: column.
        y: row.
        tau: time in the window, 0 at its start and 1 at its end.
        p: polarity; 0 marks an empty entry.
    """

    def sparse(encoder: PooledEncoder) -> tuple[Array, Array]:
        of_pixels = encoder.pixels.everywhere()[(p < 0).astype(jnp.int32), y * camera.width + x]
        phi = temporal_encoding(config.time_frequencies, tau)
        pooled = jnp.einsum("...nf,...nc->...cf", of_pixels * (p != 0)[..., None], phi)
        return encoder._head(pooled.reshape(*pooled.shape[:-2], -1), POOL_SCALE)

    encoder = PooledEncoder(vae._with_features_of(config, params), camera.height, camera.width)
    return encoder.apply({"params": params["encoder"]}, method=sparse)  # type: ignore
