"""The updates of a training step: what learns, and how it changes (Algorithm 1, steps 7-9).

Both updates add their gradients up over the devices, so that the networks stay the same on every one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from edqn_jax.config import Config
from edqn_jax.keys import split_each
from edqn_jax.learn import dqn, qnetwork, replay, samples
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.policy import observation_size
from edqn_jax.learn.qnetwork import Params
from edqn_jax.learn.samples import Samples
from edqn_jax.native.all_sum import all_sum
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.env import is_finite


@struct.dataclass
class Learner:
    """Parameters and optimisers; the same on every device."""

    vae: Params  # what learns; {} for a sensor whose image is not encoded
    vae_optimiser: Any
    encoder: Params  # frozen encoder used for acting
    q: Params
    target: Params
    average: Params  # Polyak average that evaluation flies
    q_optimiser: Any


class Learnt(NamedTuple):
    """What the updates of one network in one training step come to."""

    means: tuple[Array, Array]
    """Loss and what goes with it, over the updates with a finite loss; NaN if there was none."""
    broken: tuple[Array, Array]
    """Updates whose loss, and whose gradient, was not finite; int32."""

    @classmethod
    def none(cls) -> Learnt:
        nothing, never = jnp.float32(jnp.nan), jnp.int32(0)
        return cls((nothing, nothing), (never, never))

    @classmethod
    def of(cls, loss: Array, other: Array, gradient_is_finite: Array) -> Learnt:
        """Returns what updates [U] with these losses and gradients come to."""
        finite = jnp.isfinite(loss)
        count = jnp.sum(finite)
        means = (jnp.sum(jnp.where(finite, x, 0.0)) / jnp.maximum(count, 1) for x in (loss, other))
        loss, other = (jnp.where(count > 0, mean, jnp.nan) for mean in means)
        return cls((loss, other), (_count(~finite), _count(~gradient_is_finite)))


def _count(flags: Array) -> Array:
    return jnp.sum(flags, dtype=jnp.int32)


def init_learner(config: Config, key: Array) -> Learner:
    """Returns networks that have learnt nothing, with their optimisers; `key` is consumed."""
    vae_key, q_key = jax.random.split(key)
    vae = embedding.init(config, vae_key)
    q = qnetwork.init_q(config.agent, observation_size(config), len(ACTIONS), q_key)
    return Learner(
        vae=vae,
        vae_optimiser=_vae_optimiser(config).init(vae) if vae else None,
        encoder=embedding.acting(config, vae),
        q=q,
        target=q,
        average=q,
        q_optimiser=_q_optimiser(config).init(q),
    )


def _vae_optimiser(config: Config) -> optax.GradientTransformation:
    return _unless_broken(optax.flatten(optax.adam(config.encoder.learning_rate)))


def _unless_broken(optimiser: optax.GradientTransformation) -> optax.GradientTransformation:
    """Returns an optimiser that changes nothing where a gradient is not finite, however often."""
    return optax.apply_if_finite(optimiser, max_consecutive_errors=2**31 - 1)


def _q_optimiser(config: Config) -> optax.GradientTransformation:
    plan = Plan.of(config)
    return _unless_broken(
        dqn.optimiser(config.agent, (plan.scheduled - plan.learn_from) * config.agent.updates_per_step)
    )


def learn_to_see(
    config: Config, axis: str | None, learner: Learner, rings: Samples | None, keys: Array, step: Array
) -> tuple[Learnt, Learner]:
    """Updates the VAE on samples of the rings [S, L, E, ...]; returns reconstruction and KL, and the learner.

    Args:
        axis: name of the mesh axis over which the shards are spread; None on one device.
        rings: None where there is no VAE.
        keys: [S] of the shards on this device, consumed.
        step: [] int32, of training.
    """
    plan = Plan.of(config)
    if rings is None:
        return Learnt.none(), learner
    share = config.encoder.batch_size // config.train.shards
    kept = plan.samples_kept(config, step) + 1
    part = keys.shape[0] / config.train.shards  # of all shards, on this device

    def loss(params: Params, batch: Samples, noise: Array):
        sensed = samples.read(batch)
        total, parts = vae.vae_loss(config.encoder, params, sensed, batch.motion, batch.wanted, noise, batch.begins)
        return total * part, parts

    def update(learner: Learner, keys: Array):
        draw_keys, noise_keys = split_each(keys, 2)
        batch = jax.vmap(lambda ring, key: samples.draw(config.encoder, ring, kept, share, key))(rings, draw_keys)
        # Each shard draws its own noise, so that the layout on devices does not change it.
        shape = *batch.motion.shape[1:-1], config.encoder.code_size
        noise = jax.vmap(lambda key: jax.random.normal(key, shape))(noise_keys)
        batch, noise = jax.tree.map(_side_by_side, (batch, noise))
        gradient, parts = jax.grad(loss, has_aux=True)(learner.vae, batch, noise)
        found = gradient, jax.tree.map(lambda x: jnp.mean(x) * part, parts)
        gradient, parts = all_sum(found, axis, after=0.0)
        change, optimiser = _vae_optimiser(config).update(gradient, learner.vae_optimiser, learner.vae)
        learner = dataclasses.replace(learner, vae=optax.apply_updates(learner.vae, change), vae_optimiser=optimiser)
        return learner, (parts.reconstruction, parts.kl, is_finite(gradient))

    def learn(learner: Learner, updates: int):
        learner, found = lax.scan(update, learner, split_each(keys, updates))
        return Learnt.of(*found), learner

    def rest(learner: Learner):
        if config.encoder.keep_learning:
            return learn(learner, 1)
        return Learnt.none(), learner

    return lax.cond(plan.trains_vae(step), lambda x: learn(x, config.encoder.warmup_updates_per_step), rest, learner)


def learn_to_act(
    config: Config,
    axis: str | None,
    learner: Learner,
    ring: replay.Rows,
    time: Array,
    keys: Array,
    step: Array,
    after: Array | float = 0.0,
) -> tuple[Learnt, Learner]:
    """Updates the DQN from the replay [S, L, E, ...] (steps 7-9); returns loss and mean Q, and the learner.

    Args:
        time: [] int32, of the newest row of the replay.
        after: [] a result of the sum over the devices before these, see `all_sum`.
        axis, keys, step: as in `learn_to_see`.
    """
    plan, agent = Plan.of(config), config.agent
    share = agent.batch_size // config.train.shards

    # All of a network as one vector: what is done to each number of it is one operation, and not one for each layer.
    _, tree = ravel_pytree(learner.q)

    def vector(params: Params) -> Array:
        return ravel_pytree(params)[0]

    def loss(q: Array, target: Array, batch: replay.Batch):
        return dqn.batch_loss(agent, tree(q), tree(target), len(ACTIONS), batch)

    def update(learner: Learner, keys: Array):
        batch = jax.vmap(lambda r, k: replay.sample(agent, r, time, share, k))(ring, keys)
        batch = jax.tree.map(flat, batch)
        (total, (count, sum_q)), gradient = jax.value_and_grad(loss, has_aux=True)(learner.q, learner.target, batch)
        gradient, total, count, sum_q = all_sum((gradient, total, count, sum_q), axis, after)
        gradient = gradient / jnp.maximum(count, 1.0)
        change, optimiser = _q_optimiser(config).update(gradient, learner.q_optimiser, learner.q)
        q, finite = optax.apply_updates(learner.q, change), is_finite(gradient)

        def followed(old: Array, rate: float) -> Array:
            """Follows `q`, unless it may be `q` that is not finite."""
            return jnp.where(finite, dqn.polyak(q, old, rate), old)

        learner = dataclasses.replace(
            learner,
            q=q,
            q_optimiser=optimiser,
            target=followed(learner.target, agent.target_rate),
            average=followed(learner.average, agent.average_rate),
        )
        count = jnp.maximum(count, 1.0)
        return learner, (total / count, sum_q / count, finite)

    def learn(learner: Learner):
        many = split_each(keys, agent.updates_per_step)
        learner, losses = lax.scan(update, _each_network(vector, learner), many)
        return Learnt.of(*losses), _each_network(tree, learner)

    def rest(learner: Learner):
        return Learnt.none(), learner

    return lax.cond(plan.trains_q(step), learn, rest, learner)


def _each_network(change: Callable[[Any], Any], learner: Learner) -> Learner:
    """Returns `learner` with its three Q-networks changed."""
    return dataclasses.replace(
        learner, q=change(learner.q), target=change(learner.target), average=change(learner.average)
    )


def flat(x: Array) -> Array:
    """Returns [S * E, ...] of [S, E, ...]."""
    return x.reshape(-1, *x.shape[2:])


def _side_by_side(x: Array) -> Array:
    """Returns [T, S * B, ...] of [S, T, B, ...]."""
    return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])
