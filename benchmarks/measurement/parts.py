"""The parts that a training step is made of, each cut out of it by the function that training itself calls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import PartitionSpec

from edqn_jax.config import Config
from edqn_jax.learn import dqn, encoder, qnetwork, replay, trainer
from edqn_jax.learn.trainer import AXIS, Actors, Learner, TrainState
from edqn_jax.sim import camera, columns, drone, env, events, sensor
from edqn_jax.sim.drone import DroneState
from edqn_jax.sim.env import EnvState, World
from edqn_jax.sim.scene import take_scene
from measurement.timing import Part, held, nudged, operations_of, size_of

_ROWS, _SAME = PartitionSpec(AXIS), PartitionSpec()
_LEARNER_AND_KEYS = (_ROWS, (_SAME, _ROWS))


@dataclasses.dataclass(frozen=True)
class Moment:
    """The state that training has come to, from which the parts take what they are given."""

    config: Config
    world: World
    state: TrainState

    @property
    def actors(self) -> Actors:
        return self.state.actors

    @property
    def learner(self) -> Learner:
        return self.state.learner

    @cached_property
    def environments(self) -> EnvState:
        return _flat(self.actors.env)

    @property
    def moves(self) -> Array:
        return jnp.arange(self.config.train.num_envs) % len(env.ACTIONS)

    @property
    def scenes(self) -> Array:
        return self.world.missions.scene[self.environments.mission]

    @property
    def goals(self) -> Array:
        return self.world.missions.goal[self.environments.mission]

    @cached_property
    def seen(self) -> env.Step:
        """What the next decision leads to."""
        step = jax.jit(jax.vmap(lambda s, a: env.step(self.config, self.world, s, a)))
        return step(self.environments, self.moves)[1]

    @property
    def newest(self) -> Array:
        """The replay's newest row."""
        return jnp.int32(self.state.step - trainer.Plan.of(self.config).warmup)

    @property
    def sampled(self) -> int:
        """Bytes that sampling reads at the least: a row for each step of a sample's history and of its return."""
        agent = self.config.agent
        each = (agent.history + agent.n_step) * self.row // self.config.train.num_envs
        return agent.updates_per_step * agent.batch_size * each

    @property
    def row(self) -> int:
        """Bytes of the replay's rows of one decision of all environments."""
        return size_of(jax.tree.map(lambda leaf: leaf[:, 0], self.actors.replay))

    def keys(self, count: int) -> Array:
        return jax.random.split(jax.random.key(2), count)

    @property
    def shard_keys(self) -> Array:
        return self.keys(self.config.train.shards)


def physics(now: Moment) -> Part:
    """A decision's physics steps with their controller; nothing is looked at."""
    config = now.config

    def one(world: World, body: DroneState, move: Array, goal: Array):
        command = env.velocity_command(config.env, move, drone.yaw_of(body.quaternion))
        bearing = env.bearing(config.env, body, goal)
        flown, flight = drone.fly(config.drone, world.airframe, body, command, bearing)
        return flown, flight.position

    def body(world: World, carry):
        state, move, goal = carry
        flown, path = jax.vmap(partial(one, world))(state, move, goal)
        return flown, nudged(move, path), goal

    def single(world: World, carry):
        """One physics step alone: a scan of any length is counted as one step and what stands around it."""
        state, move, goal = carry

        def step(state: DroneState, goal: Array) -> DroneState:
            thrust = drone.thrusts(config.drone, world.airframe, state, goal)  # any three numbers are a velocity
            return drone.physics_step(config.drone, world.airframe, state, thrust)

        return jax.vmap(step)(state, goal), move, goal

    carry = (now.environments.drone, now.moves, now.goals)
    return Part("physics", body, now.world, carry, scans=config.drone.physics_steps, counted=single)


def outcome(now: Moment) -> Part:
    """What the flown path touched or reached."""

    def body(world: World, carry):
        before, flight, scene, goal = carry
        judged = jax.vmap(lambda b, f, s, g: env.judge(now.config, take_scene(world.pool, s), g, b, f, jnp.int32(1)))(
            before, flight, scene, goal
        )
        return nudged(before, judged), flight, scene, goal

    return Part("outcome", body, now.world, (now.environments.drone.position, now.seen.flight, now.scenes, now.goals))


def rendering(now: Moment) -> Part:
    """A decision's frames."""
    steps = sensor.frame_steps(now.config)

    def body(world: World, carry):
        position, quaternion, scene = carry

        def one(position: Array, quaternion: Array, scene: Array) -> list[Array]:
            here = take_scene(world.pool, scene)
            return [sensor.view(now.config, here, position[t], quaternion[t]) for t in range(len(steps))]

        frames = jax.vmap(one)(position, quaternion, scene)
        return nudged(position, frames), quaternion, scene

    poses = [
        jnp.stack([path[:, t - 1] for t in steps], 1) for path in (now.seen.flight.position, now.seen.flight.quaternion)
    ]
    return Part("rendering", body, now.world, (*poses, now.scenes), by_hand=_drawing(now, *poses))


def _drawing(now: Moment, position: Array, quaternion: Array) -> float | None:
    """Operations that frames at poses [E, T, ...] take at the least, for each column those of the way that it needs.

    XLA counts a loop's body once, and one block of columns needs another way than the next; so every way is counted
    for one column, and the columns by the way that they need. None where nothing is counted: on a GPU, and for
    cameras that do not draw by columns.
    """
    config = now.config.camera
    if config.mount != "level":
        return None
    times = position.shape[1]
    scene = jax.tree.map(
        lambda leaf: jnp.repeat(leaf, times, axis=0), jax.vmap(partial(take_scene, now.world.pool))(now.scenes)
    )
    place = position.reshape(-1, 3)
    turn = jax.vmap(partial(sensor.mount_rotation, now.config))(quaternion.reshape(-1, 4))
    weights = jnp.broadcast_to(jnp.asarray(camera.LUMA), (len(place), 3))
    given = (scene, place, turn, weights)
    ways, way = columns.ways_to_draw(config, *given)
    laid = operations_of(lambda *given: columns.ways_to_draw(config, *given)[1], *given)
    each = [operations_of(partial(draw, config, camera.blend), jnp.zeros(1, jnp.int32)) for draw in ways]
    if laid is None:
        return None
    needed = np.bincount(np.asarray(way), minlength=len(ways))
    return laid + sum(count * cost for count, cost in zip(needed, each, strict=True) if cost is not None)


def sensing(now: Moment) -> Part:
    """From frames to events."""
    config = now.config

    def body(_: None, carry):
        frames, memory, keys = carry
        field, memory = jax.vmap(lambda f, m, k: events.events(config.events, m, f, config.events.frame_times_s, k))(
            frames, memory, keys
        )
        return nudged(frames, field), memory, keys

    shape = (len(config.events.frame_times_s), config.camera.height, config.camera.width)
    frames = jax.random.uniform(jax.random.key(1), (config.train.num_envs, *shape))
    return Part("events", body, None, (frames, now.environments.memory, now.keys(config.train.num_envs)))


def environment(now: Moment) -> Part:
    """All of the environment's step, always from where training has come to."""

    def body(world: World, carry):
        state, move = carry
        flown, step = jax.vmap(lambda s, a: env.step(now.config, world, s, a))(state, move)
        return held(state, flown, move), nudged(move, step.observation, step.reward)

    return Part("environment", body, now.world, (now.environments, now.moves), floor=False)


def environment_without_resets(now: Moment) -> Part:
    """The same for environments that never end: the compiler leaves out all that a reset needs."""

    def body(world: World, carry):
        state, move = carry

        def go_on(state: EnvState, move: Array):
            return env.step(now.config, world, dataclasses.replace(state, ended=jnp.zeros((), bool)), move)

        flown, step = jax.vmap(go_on)(state, move)
        return held(state, flown, move), nudged(move, step.observation, step.reward)

    carry = (now.environments, now.moves)
    return Part("environment_without_resets", body, now.world, carry, floor=False)


def encoding(now: Moment) -> Part:
    """From events to codes."""

    def body(params: Any, field: events.EventField) -> events.EventField:
        code = encoder.embed(now.config.encoder, params, field)
        return dataclasses.replace(field, count=nudged(field.count, code))

    return Part("encoder", body, now.learner.encoder, now.seen.observation.sensed, products=True)


def acting(now: Moment) -> Part:
    """Q-values of what is remembered, and a move for each environment."""

    def body(params: Any, carry):
        memory, keys = carry
        q = qnetwork.q_values(now.config.agent, params, len(env.ACTIONS), memory)
        keys = _next(keys)
        action = jax.vmap(lambda q, k: dqn.epsilon_greedy(q, jnp.float32(0.02), k))(q, keys)
        return nudged(memory, action), keys

    carry = (now.actors.memory, now.shard_keys)
    return Part("acting", body, now.learner.q, carry, products=True)


def _draw(now: Moment, ring: replay.Rows, keys: Array) -> tuple[Array, Any]:
    """A training step's batches from the replay: the keys after it, and what depends on all that was drawn."""
    agent, newest = now.config.agent, now.newest
    share = agent.batch_size // now.config.train.shards

    def batch(keys: Array, _: None):
        keys = _next(keys)
        drawn = jax.vmap(lambda r, k: replay.sample(agent, r, newest, share, k))(ring, keys)
        return keys, jax.tree.map(jnp.sum, drawn)

    return jax.lax.scan(batch, keys, length=agent.updates_per_step)


def sampling(now: Moment) -> Part:
    """Reading a training step's batches from the replay."""

    def body(ring: replay.Rows, carry):
        keys, result = carry
        keys, sums = _draw(now, ring, keys)
        return keys, nudged(result, sums)

    carry = (now.shard_keys, jnp.zeros(now.config.train.shards))
    updates = now.config.agent.updates_per_step
    return Part("sampling", body, now.actors.replay, carry, (_ROWS, _ROWS), updates, moved=now.sampled)


def replaying(now: Moment) -> Part:
    """Writing a row into the replay, and reading batches from it."""

    def body(_: None, carry):
        ring, keys = carry
        row = jax.tree.map(lambda leaf: leaf[:, 0], ring)
        ring = jax.vmap(replay.write, in_axes=(0, 0, None))(ring, row, now.newest)
        keys, sums = _draw(now, ring, keys)
        return dataclasses.replace(ring, reward=nudged(ring.reward, sums)), keys

    carry = (now.actors.replay, now.shard_keys)
    updates = now.config.agent.updates_per_step
    return Part("replay", body, None, carry, scans=updates, moved=now.sampled + now.row)


def seeing(now: Moment) -> Part:
    """A VAE update on the events that have just been seen."""

    def body(field: events.EventField, carry):
        learner, keys = carry
        keys = _next(keys)
        _, learner = trainer.learn_to_see(now.config, AXIS, learner, field, keys, now.state.step)
        return learner, keys

    field, carry = now.seen.observation.sensed, (now.learner, now.shard_keys)
    return Part("vae_update", body, field, carry, _LEARNER_AND_KEYS, products=True, moved=size_of(field))


def learning(now: Moment) -> Part:
    """A training step's DQN updates and what they sample."""

    def body(ring: replay.Rows, carry):
        learner, keys = carry
        keys = _next(keys)
        _, learner = trainer.learn_to_act(now.config, AXIS, learner, ring, now.newest, keys, now.state.step)
        return learner, keys

    return Part(
        "dqn_update_and_sampling",
        body,
        now.actors.replay,
        (now.learner, now.shard_keys),
        _LEARNER_AND_KEYS,
        scans=now.config.agent.updates_per_step,
        products=True,
        moved=now.sampled,
    )


def _next(keys: Array) -> Array:
    return jax.vmap(lambda key: jax.random.split(key)[0])(keys)


def _flat(tree: Any) -> Any:
    """[S, E, ...] -> [S * E, ...]"""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)


PARTS: dict[str, Callable[[Moment], Part]] = {
    "physics": physics,
    "outcome": outcome,
    "rendering": rendering,
    "events": sensing,
    "environment": environment,
    "environment_without_resets": environment_without_resets,
    "encoder": encoding,
    "acting": acting,
    "replay": replaying,
    "sampling": sampling,
    "vae_update": seeing,
    "dqn_update_and_sampling": learning,
}
"""Every part by the name of its row."""


def parts_of(config: Config, world: World, state: TrainState, names: Sequence[str] = tuple(PARTS)) -> list[Part]:
    """The named parts, on the state that training has come to."""
    now = Moment(config, world, state)
    return [PARTS[name](now) for name in names]
