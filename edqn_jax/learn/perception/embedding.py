"""Embeds what the sensor shows for the Q-network: a learned code, the values themselves, or nothing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.code import EMBEDDED, Params
from edqn_jax.sim.sensors.sensor import Form, sensor_of
from edqn_jax.sim.task.observation import Observation


def has_code(config: Config) -> bool:
    """Returns whether a VAE embeds what the sensor shows; it then learns in a warm-up."""
    return sensor_of(config).form in EMBEDDED


def needs_nearness(config: Config) -> bool:
    """Returns whether the VAE learns to draw how near things are, a label that the simulator renders for training."""
    return has_code(config) and vae.needs_nearness(config.encoder)


def size(config: Config) -> int:
    """Returns the number of values that the Q-network sees of what the sensor shows."""
    return config.encoder.code_size if has_code(config) else sensor_of(config).values(config)


def init(config: Config, key: Array) -> Params:
    """Returns fresh parameters of the VAE; {} where there is none."""
    if not has_code(config):
        return {}
    form, layers = _shape(config)
    return vae.init_vae(config.encoder, config.camera, key, form=form, layers=layers)


def acting(config: Config, params: Params) -> Params:
    """Returns the parameters in the form that `embed` evaluates fastest, no longer trainable; {} of {}."""
    if not params:
        return {}
    form, layers = _shape(config)
    return vae.frozen(config.encoder, config.camera, params, form=form, layers=layers)


def embed(config: Config, params: Params, observation: Observation, previous: Array) -> Array | None:
    """Returns [..., size] of order 1: the scaled code, or values as they are; None where the sensor shows nothing.

    Args:
        previous: `[..., size]` what this returned for the decision before; 0 at the start of an episode.
    """
    if observation.sensed is None:
        return None
    if not has_code(config):
        return jnp.asarray(observation.sensed)
    scale = config.agent.code_scale
    code = vae.embed(config.encoder, params, observation.sensed, observation.motion, previous / scale)  # type: ignore[arg-type]
    return scale * code


def _shape(config: Config) -> tuple[Form, int]:
    """Returns the form of what the sensor shows, and its frame pairs or pictures."""
    sensor = sensor_of(config)
    return sensor.form, len(config.events.frame_times_s) - 1 if sensor.form is Form.EVENTS else sensor.pictures(config)
