"""The one scanned training step: act, fly, see, encode, store, learn; for every environment at once.

Sums are added over the mesh axis that shards are spread over. Numbers that steer `lax.cond` come in through the scan's
inputs, so that they stay unbatched when `vmap` maps training over seeds.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.checks import is_finite
from edqn_jax.config import Config
from edqn_jax.learn import replay, samples
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.learn.checked import one_by_one
from edqn_jax.learn.imitation.advice import Advice, advise
from edqn_jax.learn.learner import Exploration, Metrics, Rings, learner_of
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.samples import Samples
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import NO_START, Actors, Episodes, Health, Losses, TrainState
from edqn_jax.learn.updates import Networks, merge_shards, update_vae
from edqn_jax.native.all_sum import all_sum
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task import group
from edqn_jax.sim.task.env import EnvParams, EnvState, Step
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of


class ShardKeys(NamedTuple):
    """Keys split from those of the shards [S] in each step; each is consumed."""

    act: Array
    held_move: Array
    vae: Array
    dqn: Array
    next: Array

    @classmethod
    def split(cls, keys: Array) -> ShardKeys:
        """Splits the keys [S] of the shards, the same way whatever device they are on."""
        parts = jax.vmap(lambda key: jax.random.split(key, len(cls._fields)))(keys)
        return cls(*(parts[:, number] for number in range(len(cls._fields))))


def train_step(
    config: Config, env_params: EnvParams, axis: str | None, state: TrainState, step: Array
) -> tuple[TrainState, tuple[Episodes, Losses]]:
    """Takes one decision in every environment, and learns (Algorithm 1).

    Args:
        axis: name of the mesh axis over which the shards of `state.actors` are spread; None on one device.
        step: [] int32, the number of this step from 0; steers the phases.
    """
    schedule, actors, networks = Schedule.from_config(config), state.actors, state.learner
    keys = ShardKeys.split(actors.key)
    in_warmup = step < schedule.warmup
    time = schedule.replay_time(step)

    action, held_move, acted = _act(config, networks, actors, keys, jnp.maximum(step - schedule.warmup, 0), in_warmup)
    ring = _store(actors, action, time)
    env_state, timestep = _fly(config, env_params, actors, action)
    near = None if actors.advice is None else _nearness(config, env_params, env_state)
    rings = _store_samples(config, env_params, actors, env_state, timestep, step, near)
    # The acting encoder is made from the VAE. Each network alone: the VAE's update joins its parameters in any case,
    # which XLA does once for both.
    params_nonfinite = ~(is_finite(networks.vae) & is_finite(learner_of(config).network(networks.agent)))
    of_vae, networks = update_vae(config, axis, networks, rings, keys.vae, step)
    last = of_vae.metrics["reconstruction_loss"]
    of_agent, agent = learner_of(config).update(config, axis, networks.agent, Rings(ring, time, keys.dqn), last)
    networks = _refresh_acting_encoder(config, dataclasses.replace(networks, agent=agent), step)
    memory = _encode_observations(config, networks, actors, timestep, step)
    shaped = partial(_by_shard, actors.reward.shape)
    outcome, reward = shaped(timestep.outcome), shaped(timestep.reward)
    actors = Actors(
        env=shaped(env_state),
        memory=shaped(memory),
        reward=reward,
        outcome=outcome if timestep.waits is None else jnp.where(shaped(timestep.waits), NO_START, outcome),
        is_reset=shaped(timestep.is_reset),
        manoeuvre=held_move,
        episodes=actors.episodes + ((outcome != Outcome.RUNNING) & ~in_warmup),
        replay=ring,
        samples=rings,
        key=keys.next,
        advice=shaped(_advise(config, networks, actors, timestep, near)),
    )
    episodes = Episodes(
        outcome=outcome, length=shaped(timestep.episode_length), episode_return=shaped(timestep.episode_return)
    )
    part = outcome.shape[0] / config.train.shards  # of all shards, on this device
    means, broken = all_sum(
        (
            {name: jnp.where(in_warmup, jnp.nan, value * part) for name, value in acted.items()},
            {name: jnp.sum(getattr(timestep.broken, name), dtype=jnp.int32) for name in _STEP_COUNTERS},
        ),
        axis,
        after=next(iter(of_agent.metrics.values()), last),
    )
    losses = Losses(
        metrics={**of_agent.metrics, **of_vae.metrics, **means},
        health=Health(
            **broken,
            parameters=params_nonfinite.astype(jnp.int32),
            loss=of_agent.ill_losses + of_vae.ill_losses,
            gradient=of_agent.ill_gradients + of_vae.ill_gradients,
        ),
    )
    return TrainState(actors=actors, learner=networks, step=step + 1), (episodes, losses)


_STEP_COUNTERS = ("physics_state", "observation", "reward")


def _act(
    config: Config, networks: Networks, actors: Actors, keys: ShardKeys, time: Array, in_warmup: Array
) -> tuple[Array, Array, Metrics]:
    """Chooses moves [S, E]: random held moves in the warm-up, then the learner's (Algorithm 1, step 5).

    Returns:
        action and held move, each [S, E], and the learner's metrics.
    """
    schedule, envs = Schedule.from_config(config), config.train.num_envs
    progress = Exploration(time * envs, (schedule.scheduled - schedule.warmup) * envs, actors.episodes)
    if actors.advice is not None:
        progress = progress._replace(advice=actors.advice.move)
    chosen, metrics = learner_of(config).act(config, networks.agent, actors.memory, keys.act, progress)
    held_move = jax.vmap(partial(_held_moves, config))(actors.manoeuvre, keys.held_move)
    return jnp.where(in_warmup, held_move, chosen), held_move, metrics


def _store(actors: Actors, action: Array, time: Array) -> replay.Rows:
    """Returns the replay with every environment's observation and action."""
    rows = replay.Rows(
        observation=actors.memory[..., -1, :],
        reward=actors.reward,
        outcome=actors.outcome,
        is_reset=actors.is_reset,
        action=action,
        advice=None if actors.advice is None else actors.advice.move,
    )
    return jax.vmap(replay.store_decision, in_axes=(0, 0, None))(actors.replay, rows, time)


def _fly(config: Config, env_params: EnvParams, actors: Actors, action: Array) -> tuple[EnvState, Step]:
    """Steps all environments, [S * E, ...]."""
    task = task_of(config)
    each = one_by_one if config.train.debug else task.map
    return each(lambda s, a: task.step(env_params, s, a))(jax.tree.map(merge_shards, actors.env), merge_shards(action))


def _encode_observations(config: Config, networks: Networks, actors: Actors, timestep: Step, step: Array) -> Array:
    """Returns memories [S * E, H, D] with the new observations, encoded once; new episodes or encoders begin empty."""
    forget = timestep.is_reset | Schedule.from_config(config).replaces_encoder(step)
    memory = jnp.where(forget[:, None, None], 0.0, merge_shards(actors.memory))
    return AgentActor(config).encode(_acting(config, networks), memory, timestep.observation)


def _nearness(config: Config, env_params: EnvParams, env_state: EnvState) -> Array:
    """Returns how near things are from every environment [S * E, H, W], a label for training."""
    task = task_of(config)
    assert task.label is not None
    return task.map(partial(task.label, env_params))(env_state)


def _advise(config: Config, networks: Networks, actors: Actors, timestep: Step, near: Array | None) -> Advice | None:
    """Returns the advice [S * E, ...] of the learner's teacher for new observations; None without one."""
    teacher = learner_of(config).teacher
    if teacher is None:
        return None
    assert near is not None and networks.teacher is not None
    before = jax.tree.map(merge_shards, actors.advice)
    return advise(
        config, teacher(config).config, networks.teacher, before, timestep.observation, timestep.is_reset, near
    )


def _by_shard(shape: tuple[int, ...], tree: Any) -> Any:
    """Returns [S, E, ...] of [S * E, ...]."""
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), tree)


def _held_moves(config: Config, held: Array, key: Array) -> Array:
    """Returns random moves [E] that are held for `encoder.hold_decisions` decisions on average."""
    moves = task_of(config).actions
    assert isinstance(moves, Discrete)
    coin, choice = jax.random.uniform(key, (2, *held.shape))
    return jnp.where(coin < 1.0 / config.encoder.hold_decisions, (choice * moves.n).astype(held.dtype), held)


def _refresh_acting_encoder(config: Config, networks: Networks, step: Array) -> Networks:
    """Copies the VAE to the encoder that acts, in the step after which the replay begins anew."""
    encoder = lax.cond(
        Schedule.from_config(config).replaces_encoder(step),
        lambda: embedding.inference_params(config, networks.vae),
        lambda: networks.encoder,
    )
    return dataclasses.replace(networks, encoder=encoder)


def _store_samples(
    config: Config,
    env_params: EnvParams,
    actors: Actors,
    env_state: EnvState,
    timestep: Step,
    step: Array,
    near: Array | None = None,
) -> Samples | None:
    """Returns the VAE's rings [S, L, E, ...], with this step's observations [S * E, ...] if the VAE learns in it.

    Only then are labels rendered, unless they are there already: `near` [S * E, H, W]. None where there is no VAE.
    """
    if actors.samples is None:
        return None
    schedule = Schedule.from_config(config)
    keep = schedule.trains_vae(step) | config.encoder.keep_learning
    observation = embedding.as_encoder_input(config, timestep.observation)

    def target() -> vae.Target:
        label = None
        if embedding.needs_nearness(config):
            label = _nearness(config, env_params, env_state) if near is None else near
        return samples.target_of(config.encoder, observation, label)

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(target))
    wanted = lax.cond(keep, target, lambda: nothing)
    rows = samples.samples_of(config.encoder, observation, wanted)
    if group.is_multi_drone(config):
        assert timestep.waits is not None
        mate = group.active_partner_index(config, timestep.waits)
        rows = jax.tree.map(lambda x: x[mate], rows)
    write = jax.vmap(samples.store_samples, in_axes=(0, 0, None, None))
    return write(actors.samples, _by_shard(actors.reward.shape, rows), schedule.samples_kept(config, step), keep)


def run_steps(
    config: Config, env_params: EnvParams, state: TrainState, steps: Array, axis: str | None = None
) -> tuple[TrainState, tuple[Episodes, Losses]]:
    """Takes a chunk: the training steps numbered `steps` [K], scanned. Pure; `vmap` it over states for many seeds.

    Returns:
        state, (episodes [K, S, E], losses [K]).
    """
    return lax.scan(partial(train_step, config, env_params, axis), state, steps)


def policy_of(config: Config, state: TrainState) -> PolicyParams:
    """Returns the parameters for evaluation: acting encoder and averaged Q-network."""
    return _acting(config, state.learner)


def _acting(config: Config, networks: Networks) -> PolicyParams:
    return PolicyParams(encoder=networks.encoder, q=learner_of(config).policy(networks.agent))
