"""Samples that the VAE learns from: observations with the decoder's targets, in a ring per logical shard.

Consecutive observations of one flight are alike, and so are those of all flights in one place. So the VAE does not
learn from the newest ones alone, but from batches drawn from the last `encoder.replay_size`, half of them mirrored left
to right: the physics of drone and light know no left or right, but for the place of the sun.

L is the ring's length in decisions, E the environments of the shard. Events are stored as signed counts wherever
nothing else of them is read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.checks import check_index
from edqn_jax.config import EncoderConfig
from edqn_jax.keys import uniform_integers
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.vae import Target
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import flip_left_right
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.task import Task

MAX_EVENTS = 2**15 - 1
"""More events of a pixel than this are stored as this many."""


@struct.dataclass
class Counts:
    """An event field of which the times are not read."""

    signed: Array  # [..., F, H, W] int16 count x polarity
    window_s: float = struct.field(pytree_node=False)
    divides_window: bool = struct.field(pytree_node=False)
    with_noise: bool = struct.field(pytree_node=False)
    unit: Array | None = None  # [...] as of the field


@struct.dataclass
class Samples:
    """Inputs of a VAE update, or a ring of them with leading [L, E]."""

    sensed: Counts | EventField | Array  # a picture is an array
    motion: Array  # [..., motion_size]
    wanted: Target


def samples_of(config: EncoderConfig, observation: Observation, wanted: Target) -> Samples:
    """Returns observations, as `embedding.as_encoder_input` has them, and their targets in the form that is stored."""
    sensed = observation.sensed
    assert isinstance(sensed, EventField | Array)
    return Samples(_stored(config, sensed), observation.motion, wanted)


def empty_ring(config: EncoderConfig, one: Samples, envs: int, total_envs: int) -> Samples:
    """Returns a ring for one shard's `envs` of `total_envs` environments, like `one` sample, which may be a shape.

    Its last row is not part of the ring: what must not be kept is written there.
    """
    length = ring_length(config, total_envs) + 1
    return jax.tree.map(lambda leaf: jnp.zeros((length, envs, *leaf.shape), leaf.dtype), one)


def ring_length(config: EncoderConfig, total_envs: int) -> int:
    """Returns the decisions that the ring holds."""
    return max(config.replay_size // total_envs, 1)


def store_samples(ring: Samples, rows: Samples, time: Array, keep: Array) -> Samples:
    """Returns the ring with the samples [E, ...] of one decision.

    Args:
        time: [] int32, how many decisions have been kept before.
        keep: [] bool, whether these are kept.
    """
    length = ring.motion.shape[0] - 1
    at = jnp.where(keep, time % length, length)
    return jax.tree.map(lambda old, new: old.at[at].set(new), ring, rows)


def sample_batch(
    config: EncoderConfig,
    ring: Samples,
    time: Array,
    count: int,
    key: Array,
    task: Task | None = None,
    mirror: Callable[[Array], Array] = flip_left_right,
) -> Samples:
    """Returns `count` samples of one shard, each of which is uniform.

    Args:
        time: [] int32, how many decisions have been kept, at least 1.
        key: consumed.
        task: that was flown; None will do where `config.mirror` is off.
        mirror: of the sensor, see `Sensor.mirror`.
    """
    rows, envs = ring.motion.shape[:2]
    row_key, env_key, *coin_key = jax.random.split(key, 2 + count % 2)
    oldest = jnp.maximum(time - (rows - 1), 0)
    row = (oldest + uniform_integers(row_key, (count,), time - oldest)) % (rows - 1)
    env = uniform_integers(env_key, (count,), envs)
    check_index(env, envs, "the samples' environments")
    check_index(row, jnp.minimum(time, rows - 1), "the samples that have been kept")
    batch = jax.tree.map(lambda leaf: leaf[row, env], ring)
    if not config.mirror:
        return batch
    assert task is not None and task.mirror is not None
    # Half of them; of an odd number the one in the middle is mirrored or not.
    half = count // 2
    reflected = mirror_samples(batch, task.mirror, mirror)
    turned = jax.tree.map(lambda leaf: leaf[: half + 1 if coin_key else half], reflected)
    if coin_key:
        middle = jax.random.bernoulli(*coin_key)
        turned = jax.tree.map(lambda new, old: new.at[half].set(jnp.where(middle, new[half], old[half])), turned, batch)
    return jax.tree.map(lambda new, old: jnp.concatenate([new, old[len(new) :]]), turned, batch)


def mirror_samples(
    samples: Samples, factors: Sequence[float], mirror: Callable[[Array], Array] = flip_left_right
) -> Samples:
    """Returns samples [...] as they would be with left and right exchanged.

    Args:
        factors: [motion_size] of the own motion.
        mirror: of the sensor, see `Sensor.mirror`.
    """
    # The standing waves across the image that change their sign are the odd ones.
    amplitudes = samples.wanted.amplitudes
    signs = jnp.asarray(1.0 - 2.0 * (np.arange(amplitudes.shape[-1]) % 2), jnp.float32)
    mirrored = jax.tree.map(mirror, samples.sensed)
    if isinstance(samples.sensed, Counts | EventField):
        mirrored = dataclasses.replace(mirrored, unit=samples.sensed.unit)
    return Samples(
        sensed=mirrored,
        motion=samples.motion * jnp.asarray(factors),
        wanted=Target(amplitudes * signs, samples.wanted.beyond),
    )


def to_encoder_input(samples: Samples) -> EventField | Array:
    """Returns the sensor's output in samples, as the encoder's input."""
    stored = samples.sensed
    if not isinstance(stored, Counts):
        return stored
    count, polarity = jnp.abs(stored.signed).astype(jnp.int32), jnp.sign(stored.signed).astype(jnp.int8)
    unread = jnp.zeros(count.shape)
    kind = stored.window_s, stored.divides_window, stored.with_noise
    return EventField(count, polarity, unread, unread, *kind, stored.unit)


def _stored(config: EncoderConfig, sensed: EventField | Array) -> Counts | EventField | Array:
    if not isinstance(sensed, EventField) or not _counts_alone(config, sensed):
        return sensed
    signed = (jnp.minimum(sensed.count, MAX_EVENTS) * sensed.polarity).astype(jnp.int16)
    return Counts(signed, sensed.window_s, sensed.divides_window, sensed.with_noise, sensed.unit)


def _counts_alone(config: EncoderConfig, field: EventField) -> bool:
    """Returns whether the encoder reads signed counts and no times of such fields."""
    return config.architecture == "patches" or (config.architecture == "pooled" and field.divides_window)


def target_of(config: EncoderConfig, observation: Observation, nearness: Array | None) -> Target:
    """Returns the decoder's target for observations, without a unit, see `vae.target_in_waves`."""
    assert isinstance(observation.sensed, EventField | Array)
    return vae.target_in_waves(config, observation.sensed, nearness)
