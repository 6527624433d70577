"""Embeds what the sensor shows for the Q-network: a learned code, the values themselves, or nothing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn import encoder
from edqn_jax.learn.encoder import Params
from edqn_jax.sim.sensor import Sensed, sensor_of


def has_code(config: Config) -> bool:
    """Returns whether a VAE embeds what the sensor shows; it then learns in a warm-up."""
    return sensor_of(config).form in encoder.CHANNELS


def size(config: Config) -> int:
    """Returns the number of values that the Q-network sees of what the sensor shows."""
    return config.encoder.code_size if has_code(config) else sensor_of(config).values(config)


def init(config: Config, key: Array) -> Params:
    """Returns fresh parameters of the VAE; {} where there is none."""
    if not has_code(config):
        return {}
    return encoder.init_encoder(config.encoder, config.camera, key, form=sensor_of(config).form)


def acting(config: Config, params: Params) -> Params:
    """Returns the parameters in the form that `embed` evaluates fastest, no longer trainable; {} of {}."""
    return encoder.tabulated(config.encoder, config.camera, params) if params else {}


def embed(config: Config, params: Params, sensed: Sensed) -> Array | None:
    """Returns [..., size] of order 1: the scaled code, or values as they are; None of None."""
    if sensed is None:
        return None
    if not has_code(config):
        return jnp.asarray(sensed)
    return config.agent.code_scale * encoder.embed(config.encoder, params, sensed)
