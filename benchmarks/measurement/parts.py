"""The parts of a training step, each timed through the function that training calls."""

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
from edqn_jax.learn import qnetwork, replay, updates
from edqn_jax.learn.exploration import epsilon_greedy
from edqn_jax.learn.learner import Rings, learner_of
from edqn_jax.learn.perception import vae
from edqn_jax.learn.samples import Samples
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import Actors, TrainState
from edqn_jax.learn.trainer import AXIS
from edqn_jax.learn.updates import Networks
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.camera import camera, columns, native
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.controller import rotor_thrusts
from edqn_jax.sim.physics.drone import DroneState
from edqn_jax.sim.physics.flight import fly_decision, physics_step
from edqn_jax.sim.scene.scene import take_scene
from edqn_jax.sim.sensors import event_laws, sensor
from edqn_jax.sim.task.action_sets import heading_setpoint, velocity_command
from edqn_jax.sim.task.env import EnvParams, EnvState, Step
from edqn_jax.sim.task.outcomes import judge_decision
from edqn_jax.sim.task.task import task_of
from measurement.timing import Part, depending_on, force_computation, operations_of, size_of

_ROWS, _SAME = PartitionSpec(AXIS), PartitionSpec()
_LEARNER_AND_KEYS = (_ROWS, (_SAME, _ROWS))


@dataclasses.dataclass(frozen=True)
class Moment:
    """The state of a training, from which the parts take their inputs."""

    config: Config
    world: EnvParams
    state: TrainState

    @property
    def actors(self) -> Actors:
        return self.state.actors

    @property
    def learner(self) -> Networks:
        return self.state.learner

    @cached_property
    def environments(self) -> EnvState:
        return _flat(self.actors.env)

    @property
    def moves(self) -> Array:
        return jnp.arange(self.config.train.num_envs) % len(ACTIONS)

    @property
    def scenes(self) -> Array:
        return self.world.missions.scene[self.environments.mission]

    @property
    def goals(self) -> Array:
        return self.world.missions.goal[self.environments.mission]

    @cached_property
    def next_step(self) -> Step:
        """Returns the result of the next decision."""
        step = jax.jit(jax.vmap(lambda s, a: task_of(self.config).step(self.world, s, a)))
        return step(self.environments, self.moves)[1]

    @property
    def newest(self) -> Array:
        """Returns the number of the newest row of the replay."""
        return jnp.int32(self.state.step - Schedule.from_config(self.config).warmup)

    @property
    def sampled(self) -> int:
        """Returns the minimum bytes that sampling reads: a row for each step of a sample's history and return."""
        agent = self.config.agent
        each = (agent.history + agent.n_step) * self.row // self.config.train.num_envs
        return agent.updates_per_step * agent.batch_size * each

    @property
    def row(self) -> int:
        """Returns the bytes in the replay of one decision of all environments."""
        return size_of(jax.tree.map(lambda leaf: leaf[:, 0], self.actors.replay))

    def keys(self, count: int) -> Array:
        return jax.random.split(jax.random.key(2), count)

    @property
    def shard_keys(self) -> Array:
        return self.keys(self.config.train.shards)


def physics(now: Moment) -> Part:
    """Returns the part of a decision's physics steps with the controller, without camera and outcome."""
    config = now.config

    def one(world: EnvParams, body: DroneState, move: Array, goal: Array):
        command = velocity_command(config.env, move, drone.yaw_of(body.quaternion))
        heading = heading_setpoint(config.env, body, goal, command)
        after, flight = fly_decision(config.drone, world.airframe, body, command, heading)
        return after, flight.position

    def body(world: EnvParams, carry):
        state, move, goal = carry
        after, path = jax.vmap(partial(one, world))(state, move, goal)
        return after, depending_on(move, path), goal

    def single(world: EnvParams, carry):
        """Takes one physics step without the scan, of which XLA counts one iteration and what is around it."""
        state, move, goal = carry

        def step(state: DroneState, goal: Array) -> DroneState:
            thrust = rotor_thrusts(config.drone, world.airframe, state, goal)  # the goal stands for the velocity
            return physics_step(config.drone, world.airframe, state, thrust)

        return jax.vmap(step)(state, goal), move, goal

    carry = (now.environments.drone, now.moves, now.goals)
    return Part("physics", body, now.world, carry, scans=config.drone.physics_steps, counted=single)


def outcome(now: Moment) -> Part:
    """Returns the part that determines the outcome of a decision."""

    def body(world: EnvParams, carry):
        before, flight, scene, goal = carry
        judged = jax.vmap(
            lambda b, f, s, g: judge_decision(now.config, take_scene(world.pool, s), g, b, f, jnp.int32(1))
        )(before, flight, scene, goal)
        return depending_on(before, judged), flight, scene, goal

    return Part(
        "outcome", body, now.world, (now.environments.drone.position, now.next_step.flight, now.scenes, now.goals)
    )


def rendering(now: Moment) -> Part:
    """Returns the part that renders the frames of a decision."""
    steps = sensor.frame_steps(now.config)

    def body(world: EnvParams, carry):
        position, quaternion, scene = carry

        def one(position: Array, quaternion: Array, scene: Array) -> list[Array]:
            here = take_scene(world.pool, scene)
            return [sensor.render_view(now.config, here, position[t], quaternion[t]) for t in range(len(steps))]

        frames = jax.vmap(one)(position, quaternion, scene)
        return depending_on(position, frames), quaternion, scene

    poses = [
        jnp.stack([path[:, t - 1] for t in steps], 1)
        for path in (now.next_step.flight.position, now.next_step.flight.quaternion)
    ]
    by_hand = _drawing(now, *poses)
    return Part("rendering", body, now.world, (*poses, now.scenes), by_hand=by_hand, countable=by_hand is not None)


def _drawing(now: Moment, position: Array, quaternion: Array) -> float | None:
    """Returns the minimum operations to render frames at poses [E, T, ...]; None if they cannot be counted.

    XLA counts the body of a loop once, and blocks of columns differ in the branch that draws them. So the operations of
    every branch are counted for one column, and the columns by the branch that they need. They cannot be counted on a
    GPU, for cameras that do not draw by columns, and where the columns are drawn in C.
    """
    config = now.config.camera
    if config.mount != "level" or jax.default_backend() != "cpu" or native.can_render(now.world.pool, "cpu"):
        return None
    times = position.shape[1]
    scene = jax.tree.map(
        lambda leaf: jnp.repeat(leaf, times, axis=0), jax.vmap(partial(take_scene, now.world.pool))(now.scenes)
    )
    place = position.reshape(-1, 3)
    turn = jax.vmap(partial(sensor.mount_rotation, now.config))(quaternion.reshape(-1, 4))
    weights = jnp.broadcast_to(jnp.asarray(camera.LUMA_WEIGHTS), (len(place), 3))
    given = (scene, place, turn, weights)
    branches, branch = columns.render_branches(config, *given)
    laid = operations_of(lambda *given: columns.render_branches(config, *given)[1], *given)
    each = [operations_of(partial(draw, config, camera.blend_layers), jnp.zeros(1, jnp.int32)) for draw in branches]
    if laid is None:
        return None
    needed = np.bincount(np.asarray(branch), minlength=len(branches))
    return laid + sum(count * cost for count, cost in zip(needed, each, strict=True) if cost is not None)


def sensing(now: Moment) -> Part:
    """Returns the part that computes events from frames."""
    config = now.config

    def body(_: None, carry):
        frames, memory, keys = carry
        field, memory = jax.vmap(
            lambda f, m, k: event_laws.generate_events(config.events, m, f, config.events.frame_times_s, k)
        )(frames, memory, keys)
        return depending_on(frames, field), memory, keys

    shape = (len(config.events.frame_times_s), config.camera.height, config.camera.width)
    frames = jax.random.uniform(jax.random.key(1), (config.train.num_envs, *shape))
    return Part("events", body, None, (frames, now.environments.memory, now.keys(config.train.num_envs)))


def environment(now: Moment) -> Part:
    """Returns the part of the environment's whole step, always from the same state."""

    def body(world: EnvParams, carry):
        state, move = carry
        after, step = jax.vmap(lambda s, a: task_of(now.config).step(world, s, a))(state, move)
        return force_computation(state, after, move), depending_on(move, step.observation, step.reward)

    return Part("environment", body, now.world, (now.environments, now.moves), countable=False)


def environment_without_resets(now: Moment) -> Part:
    """Returns the same for environments that never end, from which the compiler removes the resets."""

    def body(world: EnvParams, carry):
        state, move = carry

        def go_on(state: EnvState, move: Array):
            return task_of(now.config).step(world, dataclasses.replace(state, ended=jnp.zeros((), bool)), move)

        after, step = jax.vmap(go_on)(state, move)
        return force_computation(state, after, move), depending_on(move, step.observation, step.reward)

    carry = (now.environments, now.moves)
    return Part("environment_without_resets", body, now.world, carry, countable=False)


def encoding(now: Moment) -> Part:
    """Returns the part that encodes events."""

    def body(params: Any, carry):
        field, motion = carry
        code = vae.embed(now.config.encoder, params, field, motion)
        return dataclasses.replace(field, count=depending_on(field.count, code)), motion

    seen = now.next_step.observation
    return Part("encoder", body, now.learner.encoder, (seen.sensed, seen.motion), products=True)


def acting(now: Moment) -> Part:
    """Returns the part that computes the Q-values of the policy's memory and an action for each environment."""

    def body(params: Any, carry):
        memory, keys = carry
        q = qnetwork.q_values(now.config.agent, params, len(ACTIONS), memory)
        keys = _next(keys)
        action = jax.vmap(lambda q, k: epsilon_greedy(q, jnp.float32(0.02), k))(q, keys)
        return depending_on(memory, action), keys

    carry = (now.actors.memory, now.shard_keys)
    return Part("acting", body, now.learner.agent.q, carry, products=True)


def _draw(now: Moment, ring: replay.Rows, keys: Array) -> tuple[Array, Any]:
    """Draws a training step's batches from the replay; returns the next keys, and sums over all that was drawn."""
    agent, task, newest = now.config.agent, task_of(now.config), now.newest
    share = agent.batch_size // now.config.train.shards

    def batch(keys: Array, _: None):
        keys = _next(keys)
        drawn = jax.vmap(lambda r, k: replay.sample_transitions(agent, r, newest, share, k, task))(ring, keys)
        return keys, jax.tree.map(jnp.sum, drawn)

    return jax.lax.scan(batch, keys, length=agent.updates_per_step)


def sampling(now: Moment) -> Part:
    """Returns the part that reads a training step's batches from the replay."""

    def body(ring: replay.Rows, carry):
        keys, result = carry
        keys, sums = _draw(now, ring, keys)
        return keys, depending_on(result, sums)

    carry = (now.shard_keys, jnp.zeros(now.config.train.shards))
    updates = now.config.agent.updates_per_step
    return Part("sampling", body, now.actors.replay, carry, (_ROWS, _ROWS), updates, moved=now.sampled)


def replaying(now: Moment) -> Part:
    """Returns the part that writes a row into the replay and reads a training step's batches."""

    def body(_: None, carry):
        ring, keys = carry
        row = jax.tree.map(lambda leaf: leaf[:, 0], ring)
        ring = jax.vmap(replay.store_decision, in_axes=(0, 0, None))(ring, row, now.newest)
        keys, sums = _draw(now, ring, keys)
        return dataclasses.replace(ring, reward=depending_on(ring.reward, sums)), keys

    carry = (now.actors.replay, now.shard_keys)
    updates = now.config.agent.updates_per_step
    return Part("replay", body, None, carry, scans=updates, moved=now.sampled + now.row)


def vae_updating(now: Moment) -> Part:
    """Returns the part of a VAE update with drawing its batch."""

    def body(config: Config, rings: Samples, carry):
        learner, keys = carry
        keys = _next(keys)
        _, learner = updates.update_vae(config, AXIS, learner, rings, keys, now.state.step)
        return learner, keys

    rings, carry = now.actors.samples, (now.learner, now.shard_keys)
    each = size_of(jax.tree.map(lambda leaf: leaf[0, 0, 0], rings))
    moved = now.config.encoder.batch_size * each
    timed, counted = partial(body, now.config), partial(body, _in_float32(now.config))
    return Part("vae_update", timed, rings, carry, _LEARNER_AND_KEYS, counted=counted, products=True, moved=moved)


def learning(now: Moment) -> Part:
    """Returns the part of a training step's DQN updates with their sampling."""

    def body(config: Config, ring: replay.Rows, carry):
        agent, keys = carry
        keys = _next(keys)
        _, agent = learner_of(config).update(config, AXIS, agent, Rings(ring, now.newest, keys), 0.0)
        return agent, keys

    return Part(
        "dqn_update_and_sampling",
        partial(body, now.config),
        now.actors.replay,
        (now.learner.agent, now.shard_keys),
        _LEARNER_AND_KEYS,
        scans=now.config.agent.updates_per_step,
        counted=partial(body, _in_float32(now.config)),
        products=True,
        moved=now.sampled,
    )


def _in_float32(config: Config) -> Config:
    """Returns the configuration with products whose operations XLA can count."""
    return dataclasses.replace(config, train=dataclasses.replace(config.train, products="float32"))


def _next(keys: Array) -> Array:
    return jax.vmap(lambda key: jax.random.split(key)[0])(keys)


def _flat(tree: Any) -> Any:
    """Joins shards and environments: [S, E, ...] to [S * E, ...]."""
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
    "vae_update": vae_updating,
    "dqn_update_and_sampling": learning,
}
"""Parts by the name of their row."""


def parts_of(config: Config, world: EnvParams, state: TrainState, names: Sequence[str] = tuple(PARTS)) -> list[Part]:
    """Returns the named parts on a state of the training."""
    now = Moment(config, world, state)
    return [PARTS[name](now) for name in names]
