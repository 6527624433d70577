"""The one scanned training step: act, fly, see, encode, store, learn; for every environment at once.

`TrainState` holds everything that the future depends on. A chunk is a fixed number of training steps,
compiled once and donated. Environments and replay stand in S logical shards, [S, E, ...], whatever the
number of devices; `shard_map` spreads the shards over a mesh axis, parameters are replicated, sums are
added over the axis. Numbers that steer `lax.cond` come in through the scan's inputs, so that they stay
unbatched when `vmap` maps training over seeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.checks import is_finite
from edqn_jax.config import Config
from edqn_jax.devices import processes
from edqn_jax.devices.devices import compiler_options
from edqn_jax.errors import ConfigError
from edqn_jax.keys import run_streams
from edqn_jax.learn import replay, samples
from edqn_jax.learn.actor import AgentActor, PolicyParams, observation_size
from edqn_jax.learn.checked import CheckedChunk, one_by_one
from edqn_jax.learn.learner import Exploration, Metrics, Rings, learner_of
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.samples import Samples
from edqn_jax.learn.updates import (
    Networks,
    flat,
    init_networks,
    update_vae,
)
from edqn_jax.native.all_sum import all_sum
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task import group
from edqn_jax.sim.task.env import EnvState, Step, World
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of

AXIS = "env"
"""Name of the mesh axis that shards are spread over."""


@struct.dataclass
class Actors:
    """Environments and replay of S shards with E environments each."""

    env: EnvState  # [S, E, ...]
    memory: Array  # [S, E, H, D] stacked observations, the newest included
    reward: Array  # [S, E] for arriving where the environment is
    outcome: Array  # [S, E]
    is_reset: Array  # [S, E]
    manoeuvre: Array  # [S, E] the held move of the warm-up
    episodes: Array  # [S, E] episodes finished since the DQN started
    replay: replay.Rows  # [S, L, E, ...]
    samples: Samples | None  # [S, L, E, ...] what the VAE learns from; None where there is none
    key: Array  # [S] typed keys of the shards


@struct.dataclass
class TrainState:
    """Everything that the future of a run depends on."""

    actors: Actors
    learner: Networks
    step: Array  # [] int32 training steps done


@struct.dataclass
class Episodes:
    """What ended in each training step: [S, E]; an environment that goes on has outcome RUNNING."""

    outcome: Array
    length: Array
    episode_return: Array


@struct.dataclass
class Health:
    """How often a quantity was not finite in one training step, in the order in which one spoils the next; [] int32."""

    physics_state: Array
    """Environments, which were reset."""
    observation: Array
    reward: Array
    parameters: Array
    """1 if a number of any network was not finite before the updates."""
    loss: Array
    """Updates."""
    gradient: Array
    """Updates, which were skipped."""


@struct.dataclass
class Losses:
    """One training step: metrics of perception and learner by name, and health."""

    metrics: Metrics
    """Means over the step's updates that had a finite loss, and what the learner tells of acting; NaN for what did not
    learn in it."""
    health: Health


class InitialKeys(NamedTuple):
    """What the key of a run's learning is split into."""

    learner: Array
    environments: Array  # [N] by the environment's global number
    shards: Array  # [S] by the shard's global number, never a device's

    @classmethod
    def split(cls, key: Array, envs: int, shards: int) -> InitialKeys:
        """Splits `key`, which is consumed."""
        learner, environments, of_shards = jax.random.split(key, 3)
        return cls(
            learner,
            jax.vmap(partial(jax.random.fold_in, environments))(jnp.arange(envs)),
            jax.vmap(partial(jax.random.fold_in, of_shards))(jnp.arange(shards)),
        )


def init(config: Config, world: World, key: Array) -> TrainState:
    """Returns the state before the first step; a pure function of the key, so `vmap` maps it over seeds.

    Raises:
        ConfigError: if the environments or the batch do not divide into the shards.
    """
    shards, envs = config.train.shards, config.train.num_envs
    if envs % shards or config.agent.batch_size % shards or config.encoder.batch_size % shards:
        raise ConfigError(
            f"train.num_envs ({envs}), agent.batch_size ({config.agent.batch_size}) and encoder.batch_size "
            f"({config.encoder.batch_size}) must be multiples of train.shards ({shards})"
        )
    keys = InitialKeys.split(key, envs, shards)
    # Nothing has been seen yet: the first step is every environment's reset.
    task = task_of(config)
    state = task.map(lambda k: task.begin(world, k, None))(keys.environments)
    networks, memory = init_networks(config, keys.learner), AgentActor(config).init()
    ring = replay.empty(learner_of(config).ring_length(config), envs // shards, observation_size(config))
    flat = Actors(
        env=state,
        memory=jnp.broadcast_to(memory, (envs, *memory.shape)),
        reward=jnp.zeros(envs),
        outcome=jnp.full(envs, _NO_START),
        is_reset=jnp.ones(envs, bool),
        manoeuvre=jnp.zeros(envs, jnp.int32),
        episodes=jnp.zeros(envs, jnp.int32),
        replay=jnp.zeros(envs),  # type: ignore[arg-type]
        samples=None,
        key=jnp.zeros(envs),
    )
    actors = jax.tree.map(lambda x: x.reshape(shards, envs // shards, *x.shape[1:]), flat).replace(
        replay=jax.tree.map(lambda x: jnp.broadcast_to(x, (shards, *x.shape)), ring),
        samples=_empty_samples(config, world, state),
        key=keys.shards,
    )
    return TrainState(actors=actors, learner=networks, step=jnp.zeros((), jnp.int32))


def _empty_samples(config: Config, world: World, state: EnvState) -> Samples | None:
    """Returns the rings [S, L, E, ...] of what the VAE learns from; None where there is no VAE."""
    if not embedding.has_code(config):
        return None
    task, shards, envs = task_of(config), config.train.shards, config.train.num_envs

    def one(state: EnvState) -> Samples:
        step = task.step(world, state, task.still)[1]
        observation = embedding.as_encoder_input(config, step.observation)
        near = None if task.label is None else task.label(world, state)
        wanted = samples.target_of(config.encoder, observation, near)
        return samples.samples_of(config.encoder, observation, wanted)

    if group.several(config):
        whole = jax.eval_shape(task.map(one), state)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), whole)
    else:
        shapes = jax.eval_shape(one, jax.tree.map(lambda x: x[0], state))
    ring = samples.empty(config.encoder, shapes, envs // shards, envs)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (shards, *x.shape)), ring)


class ShardKeys(NamedTuple):
    """What the keys [S] of the shards are split into in each step; every one is consumed."""

    act: Array
    manoeuvre: Array
    vae: Array
    dqn: Array
    next: Array

    @classmethod
    def split(cls, keys: Array) -> ShardKeys:
        """Splits the keys [S] of the shards, the same way whatever device they are on."""
        parts = jax.vmap(lambda key: jax.random.split(key, len(cls._fields)))(keys)
        return cls(*(parts[:, number] for number in range(len(cls._fields))))


def train_step(
    config: Config, world: World, axis: str | None, state: TrainState, step: Array
) -> tuple[TrainState, tuple[Episodes, Losses]]:
    """Takes one decision in every environment, and learns (Algorithm 1).

    Args:
        axis: name of the mesh axis over which the shards of `state.actors` are spread; None on one device.
        step: [] int32, the number of this step from 0; steers the phases.
    """
    plan, actors, networks = Plan.of(config), state.actors, state.learner
    keys = ShardKeys.split(actors.key)
    warming = step < plan.warmup
    time = plan.replay_time(step)

    action, manoeuvre, acted = _act(config, networks, actors, keys, jnp.maximum(step - plan.warmup, 0), warming)
    ring = _store(actors, action, time)
    flown, seen = _fly(config, world, actors, action)
    rings = _keep(config, world, actors, flown, seen, step)
    spoilt = ~is_finite((networks.vae, networks.encoder, learner_of(config).network(networks.agent)))
    of_vae, networks = update_vae(config, axis, networks, rings, keys.vae, step)
    last = of_vae.metrics["reconstruction_loss"]
    of_agent, agent = learner_of(config).update(config, axis, networks.agent, Rings(ring, time, keys.dqn), last)
    networks = _publish(config, dataclasses.replace(networks, agent=agent), step)
    memory = _remember(config, networks, actors, seen, step)

    shaped = partial(_shaped, actors.reward.shape)
    outcome, reward = shaped(seen.outcome), shaped(seen.reward)
    actors = Actors(
        env=shaped(flown),
        memory=shaped(memory),
        reward=reward,
        outcome=outcome if seen.waits is None else jnp.where(shaped(seen.waits), _NO_START, outcome),
        is_reset=shaped(seen.is_reset),
        manoeuvre=manoeuvre,
        episodes=actors.episodes + ((outcome != Outcome.RUNNING) & ~warming),
        replay=ring,
        samples=rings,
        key=keys.next,
    )
    episodes = Episodes(outcome=outcome, length=shaped(seen.episode_length), episode_return=shaped(seen.episode_return))
    part = outcome.shape[0] / config.train.shards  # of all shards, on this device
    means, broken = all_sum(
        (
            {name: jnp.where(warming, jnp.nan, value * part) for name, value in acted.items()},
            {name: jnp.sum(getattr(seen.broken, name), dtype=jnp.int32) for name in _OF_A_DECISION},
        ),
        axis,
        after=next(iter(of_agent.metrics.values()), last),
    )
    losses = Losses(
        metrics={**of_agent.metrics, **of_vae.metrics, **means},
        health=Health(
            **broken,
            parameters=spoilt.astype(jnp.int32),
            loss=of_agent.ill_losses + of_vae.ill_losses,
            gradient=of_agent.ill_gradients + of_vae.ill_gradients,
        ),
    )
    return TrainState(actors=actors, learner=networks, step=step + 1), (episodes, losses)


_OF_A_DECISION = ("physics_state", "observation", "reward")

_NO_START = int(Outcome.TIME_OUT)
"""Outcome in the replay of a row at which no transition starts, as where an episode has ended."""


def _act(
    config: Config, networks: Networks, actors: Actors, keys: ShardKeys, time: Array, warming: Array
) -> tuple[Array, Array, Metrics]:
    """Chooses moves [S, E]: held random manoeuvres in the warm-up, then the learner's (Algorithm 1, step 5).

    Returns:
        action, the held manoeuvres, each [S, E], and the learner's metrics.
    """
    plan, envs = Plan.of(config), config.train.num_envs
    progress = Exploration(time * envs, (plan.scheduled - plan.warmup) * envs, actors.episodes)
    chosen, metrics = learner_of(config).act(config, networks.agent, actors.memory, keys.act, progress)
    manoeuvre = jax.vmap(partial(_manoeuvre, config))(actors.manoeuvre, keys.manoeuvre)
    return jnp.where(warming, manoeuvre, chosen), manoeuvre, metrics


def _store(actors: Actors, action: Array, time: Array) -> replay.Rows:
    """Returns the replay with where every environment is and what it does there."""
    rows = replay.Rows(
        observation=actors.memory[..., -1, :],
        reward=actors.reward,
        outcome=actors.outcome,
        is_reset=actors.is_reset,
        action=action,
    )
    return jax.vmap(replay.write, in_axes=(0, 0, None))(actors.replay, rows, time)


def _fly(config: Config, world: World, actors: Actors, action: Array) -> tuple[EnvState, Step]:
    """Steps all environments, [S * E, ...]."""
    task = task_of(config)
    each = one_by_one if config.train.debug else task.map
    return each(lambda s, a: task.step(world, s, a))(jax.tree.map(flat, actors.env), flat(action))


def _remember(config: Config, networks: Networks, actors: Actors, seen: Step, step: Array) -> Array:
    """Returns memories [S * E, H, D] with the new observations, encoded once; new episodes or encoders begin empty."""
    forget = seen.is_reset | Plan.of(config).replaces_encoder(step)
    memory = jnp.where(forget[:, None, None], 0.0, flat(actors.memory))
    return AgentActor(config).encode(_acting(config, networks), memory, seen.observation)


def _shaped(shape: tuple[int, ...], tree: Any) -> Any:
    """Returns [S, E, ...] of [S * E, ...]."""
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), tree)


def _manoeuvre(config: Config, held: Array, key: Array) -> Array:
    """Returns random moves [E] that are held for `encoder.hold_decisions` decisions on average."""
    moves = task_of(config).actions
    assert isinstance(moves, Discrete)
    coin, draw = jax.random.uniform(key, (2, *held.shape))
    return jnp.where(coin < 1.0 / config.encoder.hold_decisions, (draw * moves.n).astype(held.dtype), held)


def _publish(config: Config, networks: Networks, step: Array) -> Networks:
    """Copies the VAE to the encoder that acts, in the step after which the replay begins anew."""
    encoder = lax.cond(
        Plan.of(config).replaces_encoder(step),
        lambda: embedding.acting(config, networks.vae),
        lambda: networks.encoder,
    )
    return dataclasses.replace(networks, encoder=encoder)


def _keep(config: Config, world: World, actors: Actors, flown: EnvState, seen: Step, step: Array) -> Samples | None:
    """Returns the VAE's rings [S, L, E, ...], with this step's observations [S * E, ...] if the VAE learns in it.

    Only then are labels rendered. None where there is no VAE.
    """
    if actors.samples is None:
        return None
    plan = Plan.of(config)
    keep = plan.trains_vae(step) | config.encoder.keep_learning
    observation = embedding.as_encoder_input(config, seen.observation)

    def target() -> vae.Target:
        near = None
        if embedding.needs_nearness(config):
            task = task_of(config)
            assert task.label is not None
            near = task.map(partial(task.label, world))(flown)
        return samples.target_of(config.encoder, observation, near)

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(target))
    wanted = lax.cond(keep, target, lambda: nothing)
    rows = samples.samples_of(config.encoder, observation, wanted)
    if group.several(config):
        assert seen.waits is not None
        mate = group.mates(config, seen.waits)
        rows = jax.tree.map(lambda x: x[mate], rows)
    write = jax.vmap(samples.write, in_axes=(0, 0, None, None))
    return write(actors.samples, _shaped(actors.reward.shape, rows), plan.samples_kept(config, step), keep)


def run_steps(
    config: Config, world: World, state: TrainState, steps: Array, axis: str | None = None
) -> tuple[TrainState, tuple[Episodes, Losses]]:
    """Takes a chunk: the training steps numbered `steps` [K], scanned. Pure; `vmap` it over states for many seeds.

    Returns:
        state, (episodes [K, S, E], losses [K]).
    """
    return lax.scan(partial(train_step, config, world, axis), state, steps)


def policy_of(config: Config, state: TrainState) -> PolicyParams:
    """Returns what evaluation flies: the acting encoder and the averaged Q-network."""
    return _acting(config, state.learner)


def _acting(config: Config, networks: Networks) -> PolicyParams:
    return PolicyParams(encoder=networks.encoder, q=learner_of(config).policy(networks.agent))


def _laid(shapes: Any, sharding: NamedSharding) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)


class Trainer:
    """A compiled, donated chunk over a mesh of devices. The state goes in and comes out; nothing is kept here.

    Where the devices are of several processes, each of them makes its own trainer of the same mesh, from the same
    world and seed, and calls it alike; each holds the shards of its own devices.
    """

    def __init__(
        self,
        config: Config,
        world: World | Sequence[World],
        devices: Sequence[jax.Device],  # pyright: ignore[reportInvalidTypeForm]
    ):
        """Prepares one agent, or as many as there are worlds: they learn side by side in one program.

        Args:
            config: of all agents.
            world: of the one agent, or one for each of K agents, which may differ in their missions alone. States,
                episodes and losses of several agents have a leading [K].
            devices: over which the environments of every agent are spread.
        """
        self.config = config
        self.plan = Plan.of(config)
        self.agents = None if isinstance(world, World) else len(world)
        self.mesh = Mesh(np.asarray(devices), (AXIS,))
        self.replicated = NamedSharding(self.mesh, PartitionSpec())
        self.world = processes.replicate(world if isinstance(world, World) else _joined(world), self.mesh)
        self._traced: jax.stages.Lowered | None = None
        self._shapes: TrainState | None = None
        self._chunk = None

    def init(self, seed: int | Sequence[int]) -> TrainState:
        """Returns the state before the first step, laid out over the devices; of several agents, one seed for each."""
        make = jax.jit(self._each(lambda world, key: init(self.config, world, key), 0))
        keys = [run_streams(number).learning for number in ([seed] if isinstance(seed, int) else seed)]
        # Made whole and then cut: made in parts it would be rounded otherwise. `device_put` reaches no other process.
        whole = make(self.world, keys[0] if self.agents is None else jnp.stack(keys))
        return jax.jit(lambda state: state, out_shardings=self._layout())(whole)

    def _each(self, function: Callable[..., Any], *axes: int | None) -> Callable[..., Any]:
        """Returns `function(world, *arguments)` for all agents; `axes` are those of the other arguments."""
        if self.agents is None:
            return function
        missions = dataclasses.replace(self.world, airframe=None, pool=None, missions=0, distances=None)
        return jax.vmap(function, in_axes=(missions, *axes))

    def _spread(self, *before: None) -> PartitionSpec:
        """Returns how arrays [K, *before, S, ...] are laid out."""
        return PartitionSpec(*([] if self.agents is None else [None]), *before, AXIS)

    def _layout(self) -> Any:
        spread, same = NamedSharding(self.mesh, self._spread()), self.replicated
        return TrainState(actors=spread, learner=same, step=same)  # pyright: ignore[reportArgumentType]

    def shapes(self) -> TrainState:
        """Returns shape, type and layout of every array of a state, which takes half a second once."""
        if self._shapes is None:
            self._shapes = self._shaped()
        return self._shapes

    def _shaped(self) -> TrainState:
        key = jax.random.key(0)
        keys = key if self.agents is None else jax.random.split(key, self.agents)
        shapes = jax.eval_shape(self._each(partial(init, self.config), 0), self.world, keys)
        layout = self._layout()
        return TrainState(
            actors=_laid(shapes.actors, layout.actors),
            learner=_laid(shapes.learner, layout.learner),
            step=_laid(shapes.step, layout.step),
        )

    def compile(self) -> None:
        """Compiles the chunk, once; needs no state, so that it can go on while one is made.

        With `train.debug` the chunk is of one agent on one device.

        Raises:
            CheckError: with `train.debug`, if a random key is used twice.
        """
        if self.config.train.debug:
            run = partial(run_steps, self.config)
            self._chunk = CheckedChunk(self.config, run, self.world, self.shapes(), self._steps(0))
            return
        self.trace()
        assert self._traced is not None
        self._chunk = self._traced.compile(compiler_options(self.mesh.devices.flat[0].platform))
        self._traced = None

    def trace(self) -> None:
        """Traces the chunk, so that `compile` has little left to do in Python; nothing with `train.debug`."""
        if self.config.train.debug or self._traced is not None:
            return
        state = self.shapes()
        # One spec for each subtree: only environments and replay are spread, and what they return.
        spread, same = self._spread(), PartitionSpec()
        specs: Any = TrainState(actors=spread, learner=same, step=same)  # pyright: ignore[reportArgumentType]
        run = jax.shard_map(
            self._each(lambda world, state, steps: run_steps(self.config, world, state, steps, AXIS), 0, None),
            mesh=self.mesh,
            in_specs=(same, specs, same),
            out_specs=(specs, (self._spread(None), same)),
            check_vma=False,
        )
        self._traced = jax.jit(run, donate_argnums=1).lower(self.world, state, self._steps(0))

    def _steps(self, first: int) -> Array:
        numbers = np.arange(first, first + self.config.train.chunk_steps, dtype=np.int32)
        return processes.replicate(numbers, self.mesh)

    def chunk(self, state: TrainState, first: int) -> tuple[TrainState, tuple[Episodes, Losses]]:
        """Takes the training steps `first .. first + chunk_steps - 1`; `state` is donated.

        Returns:
            state, (episodes [T, S, E], losses [T]) of the chunk's T steps; of several agents with a leading [K]. The
            episodes are spread over the devices as the shards are.

        Raises:
            CheckError: with `train.debug`, at the first fault; `state` is not donated then.
        """
        if self._chunk is None:
            self.compile()
        assert self._chunk is not None
        return self._chunk(self.world, state, self._steps(first))

    def each(self, tree: Any) -> list[Any]:
        """Returns the arrays of each agent, of arrays that have a leading [K] if there are several."""
        return [self.of_agent(tree, number) for number in range(self.agents or 1)]

    def of_agent(self, tree: Any, number: int) -> Any:
        """Returns the arrays of one agent, of arrays that have a leading [K] if there are several."""
        return tree if self.agents is None else jax.tree.map(lambda leaf: leaf[number], tree)


def _joined(worlds: Sequence[World]) -> World:
    """Returns the first world with the missions of all, [K, M]."""
    missions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(world.missions for world in worlds))
    return dataclasses.replace(worlds[0], missions=missions)
