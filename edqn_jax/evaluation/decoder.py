"""Error of the distances that the decoder predicts from the code, over the pixels of things that are near."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import Actor, AgentActor
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.perception.code import Params
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, distance_of

NEAR_M = 10.0
"""Pixels whose true distance is less than this count, metres."""
BINS = 1000
"""Bins of a histogram of errors e, equally wide in e / (1 + e); the last ends at infinity."""


def check_predicts_distance(config: Config, actor: Actor) -> None:
    """Raises unless an actor has a decoder that predicts distance.

    Raises:
        ConfigError: says why it has none.
    """
    if not isinstance(actor, AgentActor):
        raise ConfigError("a function has no decoder; the decoder's error needs a policy that was trained here")
    if not embedding.has_code(config):
        raise ConfigError(
            f"a policy with the sensor '{config.env.sensor}' has no decoder; only events and pictures are encoded"
        )
    if not embedding.needs_nearness(config):
        raise ConfigError(
            f"this policy's decoder predicts no distance: it was trained with encoder.target {config.encoder.target}, "
            "not nearness or both"
        )


def metres_of(label: Array) -> Array:
    """Returns the distances [...] in metres of labels or predictions [...] as the sensor `depth` shows them."""
    return distance_of(label / DEPTH_SCALE)


def predicted_distance(config: Config, encoder: Params, code: Array) -> Array:
    """Returns the distances [..., H, W] in metres that the decoder predicts from codes [..., C]; infinity is far."""
    return metres_of(vae.decode(config.encoder, config.camera, encoder, code)[..., -1, :, :])


def error_histograms(predicted: Array, true: Array) -> Array:
    """Returns how many near pixels have which error: [2, BINS] int32, relative to the true distance and in metres.

    Args:
        predicted: [H, W] metres, of which infinity is an infinite error.
        true: [H, W] metres.
    """
    near = (true < NEAR_M) & (true > 0)
    metres = jnp.abs(predicted - jnp.where(near, true, 1.0))
    errors = jnp.stack([metres / jnp.where(near, true, 1.0), metres]).reshape(2, -1)
    # 1 - 1 / (1 + e) and not e / (1 + e), which is NaN for infinity.
    number = jnp.minimum(BINS * (1.0 - 1.0 / (1.0 + errors)), BINS - 1).astype(jnp.int32)
    weight = jnp.broadcast_to(near.reshape(-1).astype(jnp.int32), number.shape)
    return jnp.zeros((2, BINS), jnp.int32).at[jnp.arange(2)[:, None], number].add(weight)


def median_error(predicted: ArrayLike, true: ArrayLike) -> float | None:
    """Returns the median relative error over the near pixels of distances [..., H, W]; None where nothing is near."""
    predicted, true = np.asarray(predicted, np.float64), np.asarray(true, np.float64)
    near = (true < NEAR_M) & (true > 0)
    return float(np.median(np.abs(predicted[near] - true[near]) / true[near])) if near.any() else None


def summarise_errors(histograms: np.ndarray, frames: int) -> dict[str, Any]:
    """Returns the figures of the decoder's error.

    Args:
        histograms: [M, 2, BINS] of `error_histograms`, summed over the frames of each flight.
        frames: of all flights.

    Returns:
        `near_m`, `frames`, `pixels`, and median and 90th percentile of the error, `relative_*` as a share of the true
        distance and `metres_*`; these are None where nothing was near, and where the prediction is beyond all bins.
    """
    relative, metres = np.asarray(histograms, np.int64).sum(axis=0)
    figures: dict[str, Any] = {"near_m": NEAR_M, "frames": frames, "pixels": int(relative.sum())}
    for name, counts in (("relative", relative), ("metres", metres)):
        figures |= {f"{name}_median": _quantile(counts, 0.5), f"{name}_p90": _quantile(counts, 0.9)}
    return figures


def _quantile(counts: np.ndarray, share: float) -> float | None:
    """Returns the error below which `share` of the pixels are; None without pixels, and in the last bin."""
    total = int(counts.sum())
    below = np.cumsum(counts)
    number = int(np.searchsorted(below, share * total)) if total else BINS - 1
    if number >= BINS - 1:
        return None
    within = (share * total - (below[number] - counts[number])) / counts[number]
    place = (number + within) / BINS
    return float(place / (1.0 - place))
