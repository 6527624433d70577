"""Updates of a training step: the VAE's are here, the Q-network's in its learner.

Both add their gradients up over the devices, so that the networks stay the same on every one.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.keys import split_each
from edqn_jax.learn import samples
from edqn_jax.learn.actor import PolicyParams, grow_moves
from edqn_jax.learn.learner import VAE_METRICS, Metrics, State, UpdateStats, learner_of
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.policy import Policy
from edqn_jax.learn.qnetwork import Params
from edqn_jax.learn.samples import Samples
from edqn_jax.learn.schedule import Schedule
from edqn_jax.native.adam import Adam
from edqn_jax.native.all_sum import all_sum
from edqn_jax.native.products import in_precision
from edqn_jax.sim.sensors.sensor import sensor_of
from edqn_jax.sim.task.task import task_of


@struct.dataclass
class Networks:
    """Parameters and optimisers of perception and learner; the same on every device."""

    vae: Params  # what learns; {} for a sensor whose image is not encoded
    vae_optimiser: Any
    encoder: Params  # frozen encoder used for acting
    agent: State  # of the learner
    teacher: PolicyParams | None = None  # of the learner's teacher, which never change; None without one


def init_networks(config: Config, key: Array) -> Networks:
    """Returns networks that have learnt nothing, with their optimisers; `key` is consumed."""
    vae_key, agent_key = jax.random.split(key)
    vae, learner = embedding.init_params(config, vae_key), learner_of(config)
    return Networks(
        vae=vae,
        vae_optimiser=Adam(config.encoder.learning_rate).init(ravel_pytree(vae)[0]) if vae else None,
        encoder=embedding.inference_params(config, vae),
        agent=learner.init(config, agent_key),
        teacher=None if learner.teacher is None else jax.tree.map(jnp.asarray, learner.teacher(config).params),
    )


def begin_networks(config: Config, fresh: Networks, known: Config, policy: PolicyParams) -> Networks:
    """Returns networks that begin with those of a policy; their optimisers have seen nothing.

    Where the own motion has values that the policy did not know, as with a camera on the body, or the Q-network sees
    the last move and did not, their weights begin at 0.

    Args:
        config: of the run.
        fresh: networks that have learnt nothing.
        known: configuration of the policy.
        policy: its parameters.

    Raises:
        ConfigError: if the learner cannot, or the networks of the run have other shapes.
    """
    learner = learner_of(config)
    if learner.begin_from is None:
        raise ConfigError(f"the learner '{config.agent.learner}' cannot begin with a policy: it has no `begin_from`")
    vae, q = embedding.grow_motion(config, known, policy.encoder), grow_moves(config, known, policy.q)
    wanted, found = (jax.tree.map(jnp.shape, each) for each in ((fresh.vae, learner.policy(fresh.agent)), (vae, q)))
    if wanted != found:
        raise ConfigError(
            "the networks of this run have other shapes than those of the policy that it is to begin with; give the "
            "policy's own options of camera, sensor, encoder and agent"
        )
    return dataclasses.replace(
        fresh,
        vae=vae,
        encoder=embedding.inference_params(config, vae),
        agent=learner.begin_from(config, fresh.agent, q),
    )


def check_begins(config: Config, policy: Policy) -> None:
    """Raises unless training can begin with a policy; computes nothing.

    Raises:
        ConfigError: as `begin_networks`.
    """

    def begin(key: Array) -> Networks:
        return begin_networks(config, init_networks(config, key), policy.config, policy.params)

    jax.eval_shape(begin, jax.random.key(0))


def update_vae(
    config: Config, axis: str | None, networks: Networks, rings: Samples | None, keys: Array, step: Array
) -> tuple[UpdateStats, Networks]:
    """Updates the VAE on samples of the rings [S, L, E, ...]; returns statistics and the networks.

    Args:
        axis: name of the mesh axis over which the shards are spread; None on one device.
        rings: None where there is no VAE.
        keys: [S] of the shards on this device, consumed.
        step: [] int32, of training.
    """
    schedule, task = Schedule.from_config(config), task_of(config)
    if rings is None:
        return UpdateStats.without_updates(*VAE_METRICS), networks
    share = config.encoder.batch_size // config.train.shards
    kept = schedule.samples_kept(config, step) + 1
    rate = schedule.vae_rate(config, step)
    part = keys.shape[0] / config.train.shards  # of all shards, on this device
    mirror = sensor_of(config).mirror

    # As one vector: what is done to each number of it is one operation, and not one for each layer.
    vector, tree = ravel_pytree(networks.vae)

    def loss(params: Array, batch: Samples, noise: Array):
        sensed = samples.to_encoder_input(batch)
        with in_precision(config.train.products):
            total, parts = vae.vae_loss(config.encoder, tree(params), sensed, batch.motion, batch.wanted, noise)
        return total * part, parts

    def update(state: tuple[Any, Any], keys: Array):
        params, optimiser = state
        draw_keys, noise_keys = split_each(keys, 2)
        sample = lambda ring, key: samples.sample_batch(config.encoder, ring, kept, share, key, task, mirror)  # noqa: E731
        batch = jax.vmap(sample)(rings, draw_keys)
        # Each shard draws its own noise, so that the layout on devices does not change it.
        noise = jax.vmap(lambda key: jax.random.normal(key, (share, config.encoder.code_size)))(noise_keys)
        batch, noise = jax.tree.map(merge_shards, (batch, noise))
        gradient, parts = jax.grad(loss, has_aux=True)(params, batch, noise)
        found = gradient, jax.tree.map(lambda x: jnp.mean(x) * part, parts)
        gradient, parts = all_sum(found, axis, after=0.0)
        new = Adam(rate).step(gradient, optimiser, params)
        return (new.params, new.state), (parts.reconstruction, parts.kl, new.finite)

    in_training, otherwise = config.encoder.warmup_updates_per_step, int(config.encoder.keep_learning)
    count = jnp.where(schedule.trains_vae(step), in_training, otherwise)
    most = max(in_training, otherwise)
    # As data: JAX's check for keys that are used twice cannot see that each turn of the loop takes its own.
    many = jax.random.key_data(split_each(keys, most))

    def each(number: Array, reached: tuple[Any, tuple[Array, ...]]) -> tuple[Any, tuple[Array, ...]]:
        state, before = reached
        state, found = update(state, jax.random.wrap_key_data(many[number], impl=jax.random.key_impl(keys)))
        return state, tuple(x.at[number].set(one) for x, one in zip(before, found, strict=True))

    # One loop of as many updates as there are: in branches, they would be traced and compiled twice.
    nothing = tuple(jnp.zeros(most, dtype) for dtype in (jnp.float32, jnp.float32, bool))
    start = (vector, networks.vae_optimiser), nothing
    (vector, optimiser), (reconstruction, kl, finite) = lax.fori_loop(0, count, each, start)
    metrics: Metrics = dict(zip(VAE_METRICS, (reconstruction, kl), strict=True))
    networks = dataclasses.replace(networks, vae=tree(vector), vae_optimiser=optimiser)
    return UpdateStats.from_updates(reconstruction, metrics, finite, count), networks


def merge_shards(x: Array) -> Array:
    """Returns [S * E, ...] of [S, E, ...]."""
    return x.reshape(-1, *x.shape[2:])
