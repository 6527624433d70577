"""Greedy rollouts: every mission once, all in parallel, in one compiled program."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.config import Config
from edqn_jax.devices.devices import compiler_options
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation import decoder
from edqn_jax.keys import run_streams
from edqn_jax.learn.actor import Actor, AgentActor, blank_observation
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task import group
from edqn_jax.sim.task.action_sets import describe_space
from edqn_jax.sim.task.env import EnvParams, EnvState, Step, scene_of
from edqn_jax.sim.task.flights import Flights, Record, at_start, update_tallies
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of


class ShowPhase(Protocol):
    """What is called as a phase of work begins, and again as parts of it are done."""

    def __call__(self, name: str, done: int = 0, total: int = 0, /) -> None:
        """Takes the name of the phase and, where it has parts, how many are done, of how many."""


def show_nothing(name: str, done: int = 0, total: int = 0, /) -> None:
    """Shows no phase."""


@dataclasses.dataclass(frozen=True)
class Extras:
    """What flights do beside flying."""

    record: bool = False
    """Keep every pose."""
    shuffle_codes: bool = False
    """Give each environment the sensor's output of another one, permuted anew at each decision, but its own state:
    measures how much the policy depends on its sensor."""
    decoder_errors: bool = False
    """Compare the distances that the decoder predicts with the true ones, see `decoder`; of an agent whose decoder
    predicts distance."""


@dataclasses.dataclass(frozen=True)
class _Program:
    """Static arguments of a compiled program, except for devices."""

    config: Config
    actor: Actor
    extras: Extras


@struct.dataclass
class _Flying:
    """Carry of the loop over decisions."""

    state: EnvState
    observation: Observation
    memory: Any  # [M, ...] of the actor
    flights: Flights  # record not in it
    record: Record | None  # decision first: [D, M, ...]
    decoder_errors: Array | None  # [M, 2, BINS]
    decision: Array  # [] int32, -1 is the reset
    key: Array


def fly_missions(
    config: Config,
    env_params: EnvParams,
    params: Any,
    key: Array,
    *,
    actor: Actor | None = None,
    extras: Extras = Extras(),
    mesh: Mesh | None = None,
) -> Flights:
    """Flies each of the world's M missions once, greedily.

    Environment i flies mission i; the program ends with the last flight. Environments whose flight has ended
    fly it again, which is not counted, those of a group when all have ended. M is a multiple of `env.drones`.

    Compiles once for each configuration, choice of flags, mesh, and shapes and layout of the arrays.

    Args:
        config: configuration of the policy and its world.
        env_params: the missions.
        params: parameters of the policy.
        key: consumed; sensor noise, the shuffling and an actor that is not greedy depend on it.
        actor: what flies; None is the agent of `config`.
        extras: recording and measuring.
        mesh: devices, along one axis, to spread the missions over; flights do not depend on it, except for
            which codes are exchanged.

    Returns:
        Flights of the M missions, on the devices.

    Raises:
        ConfigError: if the actor's actions are not those of `env.actions`.
        ValueError: if codes are to be shuffled and a device has only one mission.
    """
    program = _Program(config, actor or AgentActor(config), extras)
    return _compiled_for(mesh)(program, mesh, env_params, params, key)


def fly_on_all_devices(
    config: Config,
    env_params: EnvParams,
    params: Any,
    seed: int = 0,
    *,
    actor: Actor | None = None,
    record: bool = False,
    shuffle_codes: bool = False,
    decoder_errors: bool = False,
    phase: Callable[[str], None] = lambda _: None,
) -> Flights:
    """Runs `fly_missions` on all devices and returns the flights on the host; `phase` is called as a phase begins."""
    phase("compiling")
    mesh = Mesh(np.asarray(jax.devices()), ("mission",))
    env_params, params = jax.device_put((env_params, params), NamedSharding(mesh, PartitionSpec()))
    key = run_streams(seed).flights
    extras = Extras(record, shuffle_codes, decoder_errors)
    flights = fly_missions(config, env_params, params, key, actor=actor, extras=extras, mesh=mesh)
    phase("flying")  # compiled, and not waited for
    return jax.tree.map(np.asarray, flights)


def trace_missions(
    config: Config, env_params: EnvParams, params: Any, key: Array, *, record: bool, mesh: Mesh
) -> jax.stages.Lowered:
    """Returns the program that `fly_missions` runs for the agent, to be compiled ahead of its first call."""
    program = _Program(config, AgentActor(config), Extras(record=record))
    return _compiled_for(mesh).lower(program, mesh, env_params, params, key)


def flight_keys(key: Array, missions: int) -> tuple[Array, Array]:
    """Returns the keys [M] of the missions' environments, and that of the loop; `key` is consumed."""
    reset_key, loop_key = jax.random.split(key)
    return jax.vmap(partial(jax.random.fold_in, reset_key))(jnp.arange(missions)), loop_key


def _compiled_for(mesh: Mesh | None):
    return _compiled((jax.devices()[0] if mesh is None else mesh.devices.flat[0]).platform)


@functools.cache
def _compiled(platform: str):
    # Static by position: a flag passed by name would compile another program.
    return jax.jit(_fly_all, static_argnums=(0, 1), compiler_options=compiler_options(platform))


def _fly_all(program: _Program, mesh: Mesh | None, env_params: EnvParams, params: Any, key: Array) -> Flights:
    missions = env_params.missions.scene.shape[0]
    devices = 1 if mesh is None else mesh.size
    reset_keys, loop_key = flight_keys(key, missions)
    # Every device flies equally many missions, whole groups; the first ones are repeated to fill up.
    unit = devices * program.config.env.drones
    number = jnp.arange(-(-missions // unit) * unit) % missions
    if program.extras.shuffle_codes and number.shape[0] // devices < 2:
        raise ValueError("shuffling codes needs at least two missions on each device")
    keys = reset_keys[number]
    fly = partial(_fly, program)
    if mesh is not None:
        (axis,) = mesh.axis_names
        specs = PartitionSpec(), PartitionSpec(), PartitionSpec(axis), PartitionSpec(axis), PartitionSpec()
        fly = jax.shard_map(fly, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(axis), check_vma=False)
    flights = fly(env_params, params, number, keys, loop_key)
    return jax.tree.map(lambda leaf: leaf[:missions], flights)


def _fly(program: _Program, env_params: EnvParams, params: Any, number: Array, keys: Array, key: Array) -> Flights:
    """Runs `fly_missions` on one device: missions `number` [M] with the environments' keys [M]."""
    config, actor, missions = program.config, program.actor, number.shape[0]
    first, task = actor.init(), task_of(config)
    action = _action_of(config, actor, params)
    step_all = task.map(partial(task.step, env_params))

    def decide(flying: _Flying) -> _Flying:
        key, act_key, shift_key = jax.random.split(flying.key, 3)
        seen = flying.observation
        if program.extras.shuffle_codes:
            shift = jax.random.randint(shift_key, (), 1, missions)
            # Only the sensor's output tells of obstacles, so the own motion is not shuffled.
            sensed = jax.tree.map(lambda x: jnp.roll(x, shift, axis=0), seen.sensed)
            seen = dataclasses.replace(seen, sensed=sensed)
        own_keys = jax.vmap(partial(jax.random.fold_in, act_key))(number)
        action, memory = jax.vmap(partial(actor.act, params))(flying.memory, seen, own_keys)
        state, step = step_all(flying.state, action, number)
        flights, clearance = jax.vmap(partial(_tally, config, env_params))(flying.flights, flying.state, step)
        return _Flying(
            state=state,
            observation=step.observation,
            memory=jax.tree.map(lambda new, begun: _select_missions(step.is_reset, begun, new), memory, first),
            flights=flights,
            record=_write(flying, action, step, clearance),
            decoder_errors=_add_errors(program, env_params, params, flying, memory, step),
            decision=flying.decision + 1,
            key=key,
        )

    # The first iteration resets every environment: the observation and the action before it are not used.
    state = jax.vmap(partial(task.begin, env_params))(keys, number)
    actions = jnp.zeros((missions, *action.shape), action.dtype)
    seen = jax.eval_shape(step_all, state, actions)[1].observation
    flying = _Flying(
        state=state,
        observation=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), seen),
        memory=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (missions, *leaf.shape)), first),
        flights=jax.vmap(partial(_at_start, config, env_params))(state),
        record=_blank(config, missions, action) if program.extras.record else None,
        decoder_errors=jnp.zeros((missions, 2, decoder.BINS), jnp.int32) if program.extras.decoder_errors else None,
        decision=jnp.full((), -1),
        key=key,
    )
    flying = jax.lax.while_loop(lambda f: jnp.any(f.flights.outcome == Outcome.RUNNING), decide, flying)
    whole = None if flying.record is None else _by_mission(flying.record)
    return dataclasses.replace(flying.flights, record=whole, decoder_errors=flying.decoder_errors)


def _at_start(config: Config, env_params: EnvParams, state: EnvState) -> Flights:
    """Returns the tallies of one flight before its first step."""
    flights = at_start(config, scene_of(env_params, state.mission), state.drone)
    return dataclasses.replace(flights, hit_drone=jnp.zeros((), bool)) if group.is_multi_drone(config) else flights


def _tally(
    config: Config, env_params: EnvParams, flights: Flights, before: EnvState, step: Step
) -> tuple[Flights, Array]:
    """Returns the tallies of one flight after a step, and the clearance [n] after each of its physics steps."""
    running = (flights.outcome == Outcome.RUNNING) & ~step.is_reset
    scene = scene_of(env_params, before.mission, before.aim)
    verdict = step.outcome, step.end_step, step.contact
    after, clearance = update_tallies(config, scene, flights, before.drone.position, step.flight, *verdict)
    after = dataclasses.replace(after, episode_return=step.episode_return, hit_drone=step.hit_drone)
    return jax.tree.map(lambda new, old: jnp.where(running, new, old), after, flights), clearance


def _action_of(config: Config, actor: Actor, params: Any) -> jax.ShapeDtypeStruct:
    """Returns shape and type of an actor's actions.

    Raises:
        ConfigError: if they are not those that the task flies.
    """
    act = partial(actor.act, key=jax.random.key(0))
    action = jax.eval_shape(act, params, actor.init(), blank_observation(config))[0]
    space = task_of(config).actions
    kind = jnp.integer if isinstance(space, Discrete) else jnp.floating
    if action.shape != space.shape or not jnp.issubdtype(action.dtype, kind):
        wanted = "a move is a number from 0 to 26, [] int, a vector of three from -1, 0 and 1, or a name"
        if config.env.actions != "moves":
            wanted = f"an action of '{config.env.actions}' is {describe_space(space)}"
        raise ConfigError(f"this policy's actions are {action.dtype}{list(action.shape)}; {wanted}")
    return action


def _blank(config: Config, missions: int, action: jax.ShapeDtypeStruct) -> Record:
    decisions, steps = config.env.max_decisions, config.drone.physics_steps

    def unwritten(*size: int) -> Array:
        return jnp.full((decisions, missions, *size), jnp.nan)

    return Record(
        position=unwritten(steps, 3),
        quaternion=unwritten(steps, 4),
        velocity=unwritten(steps, 3),
        clearance=unwritten(steps),
        action=jnp.full((decisions, missions, *action.shape), _no_action(action.dtype), action.dtype),
        reward=unwritten(),
    )


def _no_action(kind: Any) -> float | int:
    """Returns the filler for actions in a record after a flight's end."""
    return -1 if jnp.issubdtype(kind, jnp.integer) else jnp.nan


def _select_missions(chosen: Array, new: Array, old: Array) -> Array:
    """Returns new rows [...] or [M, ...] where `chosen` [M], and old ones [M, ...] elsewhere."""
    return jnp.where(chosen.reshape(-1, *(1 for _ in old.shape[1:])), new, old)


def _write(flying: _Flying, action: Array, step: Step, clearance: Array) -> Record | None:
    """Returns the record with one more decision of the running flights."""
    if flying.record is None:
        return None
    running = (flying.flights.outcome == Outcome.RUNNING) & ~step.is_reset
    steps = jnp.arange(clearance.shape[1])[None]
    is_flown = running[:, None] & (steps < step.end_step[:, None])
    row = Record(
        position=jnp.where(is_flown[..., None], step.flight.position, jnp.nan),
        quaternion=jnp.where(is_flown[..., None], step.flight.quaternion, jnp.nan),
        velocity=jnp.where(is_flown[..., None], step.flight.velocity, jnp.nan),
        clearance=jnp.where(is_flown, clearance, jnp.nan),
        action=_select_missions(running, action, jnp.full_like(action, _no_action(action.dtype))),
        reward=jnp.where(running, step.reward, jnp.nan),
    )
    return jax.tree.map(lambda whole, new: whole.at[flying.decision].set(new), flying.record, row)


def _add_errors(
    program: _Program, env_params: EnvParams, params: Any, flying: _Flying, memory: Any, step: Step
) -> Array | None:
    """Returns the histograms [M, 2, BINS] with the decoder's errors on what running flights acted on.

    Args:
        memory: of the agent after it acted, whose newest code is that of the observation.
        step: what its action led to.
    """
    if flying.decoder_errors is None:
        return None
    actor, task = program.actor, task_of(program.config)
    assert isinstance(actor, AgentActor) and task.label is not None
    true = decoder.metres_of(task.map(partial(task.label, env_params))(flying.state))
    predicted = decoder.predicted_distance(program.config, params.encoder, actor.code(memory))
    running = (flying.flights.outcome == Outcome.RUNNING) & ~step.is_reset
    new = jax.vmap(decoder.error_histograms)(predicted, true)
    return flying.decoder_errors + jnp.where(running[:, None, None], new, 0)


def _by_mission(record: Record) -> Record:
    """Reshapes every field from [D, M, n, ...] to [M, D n, ...]."""

    def joined(leaf: Array) -> Array:
        leaf = jnp.moveaxis(leaf, 1, 0)
        return leaf.reshape(leaf.shape[0], leaf.shape[1] * leaf.shape[2], *leaf.shape[3:])

    return Record(
        position=joined(record.position),
        quaternion=joined(record.quaternion),
        velocity=joined(record.velocity),
        clearance=joined(record.clearance),
        action=jnp.swapaxes(record.action, 0, 1),
        reward=record.reward.T,
    )
