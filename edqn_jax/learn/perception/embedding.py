"""Embeds what the sensor shows for the Q-network: a learned code, values as they are, both, or nothing."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.code import Form, Params
from edqn_jax.learn.perception.levelling import level_events
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import sensor_of
from edqn_jax.sim.task.observation import Observation, knows_contrast, lean_motion_size, lean_of, motion_size


def has_code(config: Config) -> bool:
    """Returns whether a VAE embeds what the sensor shows; it then learns in a warm-up."""
    sensor = sensor_of(config)
    return sensor.shows_events(config) or sensor.count_pictures(config) > 0


def needs_nearness(config: Config) -> bool:
    """Returns whether the VAE learns to draw how near things are, a label that the simulator renders for training."""
    return has_code(config) and vae.needs_nearness(config.encoder)


def embedding_size(config: Config) -> int:
    """Returns the size of the embedding of the sensor's output."""
    return code_size(config) + sensor_of(config).count_values(config)


def code_size(config: Config) -> int:
    """Returns the length of the VAE's code, with which the embedding begins; 0 without a VAE."""
    return config.encoder.code_size if has_code(config) else 0


def as_encoder_input(config: Config, observation: Observation) -> Observation:
    """Returns observations [...] whose `sensed` is the VAE's input, an event field or pictures."""
    read = sensor_of(config).encoder_input(config, observation.sensed)
    if config.encoder.levelled:
        assert isinstance(read, EventField)
        lean = lean_of(config, observation.motion)
        read = level_events(config.camera, read, lean, whole=config.events.sensor_pixels == 1)
    return dataclasses.replace(observation, sensed=read)


def init_params(config: Config, key: Array) -> Params:
    """Returns fresh parameters of the VAE; {} where there is none."""
    if not has_code(config):
        return {}
    form, layers = _shape(config)
    motion = motion_size(config)
    return vae.init_vae(config.encoder, config.camera, key, form=form, layers=layers, motion=motion)


def grow_motion(config: Config, known: Config, params: Params) -> Params:
    """Returns a VAE's parameters for an own motion of more values, which begin with weights of 0.

    Args:
        config: of the new own motion.
        known: with which the parameters were trained; they are returned as they are where it has as many values.
        params: of an encoder of patches; {} without a VAE.
    """
    more_lean = lean_motion_size(config) - lean_motion_size(known)
    told, more_told = motion_size(known) - lean_motion_size(known), knows_contrast(config) - knows_contrast(known)
    if not params or max(more_lean, more_told) <= 0 or min(more_lean, more_told) < 0:
        return params

    def grow(path: tuple[Any, ...], array: Array) -> Array:
        """Adds rows to the layers that read the own motion, which is the last of what they read."""
        layer, name = (key.key for key in path[-2:])
        if layer not in ("motion", "joint_0") or name != "kernel":
            return array
        before, contrast = array[: len(array) - told], array[len(array) - told :]
        blank = [jnp.zeros((more, array.shape[1])) for more in (more_lean, more_told)]
        return jnp.concatenate([before, blank[0], contrast, blank[1]])

    return {**params, "encoder": jax.tree_util.tree_map_with_path(grow, params["encoder"])}


def inference_params(config: Config, params: Params) -> Params:
    """Returns the parameters in the form that `embed` evaluates fastest, not trainable; {} for {}."""
    if not params:
        return {}
    form, layers = _shape(config)
    return vae.freeze_params(config.encoder, config.camera, params, form=form, layers=layers)


def embed(config: Config, params: Params, observation: Observation) -> Array | None:
    """Returns [..., size] of order 1: the scaled code, then values as they are; None where the sensor shows nothing."""
    if observation.sensed is None:
        return None
    values = sensor_of(config).values(config, observation.sensed)
    if not has_code(config):
        return values
    read = as_encoder_input(config, observation)
    code = config.agent.code_scale * vae.embed(config.encoder, params, read.sensed, read.motion)
    return code if values is None else jnp.concatenate([code, values], axis=-1)


def _shape(config: Config) -> tuple[Form, int]:
    """Returns the form of what the VAE reads, and its frame pairs or pictures."""
    sensor = sensor_of(config)
    if sensor.shows_events(config):
        return Form.EVENTS, len(config.events.frame_times_s) - 1
    return Form.PICTURE, sensor.count_pictures(config)
