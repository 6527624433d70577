"""From what the sensor shows to what the Q-network sees of it: a learned code, the values themselves, or nothing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn import encoder
from edqn_jax.learn.encoder import Params
from edqn_jax.sim.moves import DIRECTIONS
from edqn_jax.sim.sensor import Sensed


def has_code(config: Config) -> bool:
    """Whether the sensor's image goes through a VAE, which then has a warm-up to learn in."""
    return config.env.sensor in ("events", "frames", "depth")


def size(config: Config) -> int:
    """Values that the Q-network sees of what the sensor shows."""
    if has_code(config):
        return config.encoder.code_size
    return len(DIRECTIONS) if config.env.sensor == "ranges" else 0


def init(config: Config, key: Array) -> Params:
    """Fresh parameters of the VAE; {} where there is none."""
    if not has_code(config):
        return {}
    return encoder.init_encoder(config.encoder, config.camera, key, pictures=config.env.sensor != "events")


def acting(config: Config, params: Params) -> Params:
    """Parameters that learn no more, as `embed` has least to do with them; {} where there are none."""
    return encoder.tabulated(config.encoder, config.camera, params) if params else {}


def embed(config: Config, params: Params, sensed: Sensed) -> Array | None:
    """[..., size] of what the sensor shows, of order 1: the scaled code, or ranges as they are; None of nothing."""
    if sensed is None:
        return None
    if config.env.sensor == "ranges":
        return jnp.asarray(sensed)
    return config.agent.code_scale * encoder.embed(config.encoder, params, sensed)
