"""Greedy rollouts: every mission once, all in parallel, in one compiled loop."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

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
from edqn_jax.kept_programs import Place, named, place_of, without_seed
from edqn_jax.keys import run_streams
from edqn_jax.learn.actor import Actor, AgentActor, blank_observation
from edqn_jax.native.own_programs import own_program, without_collection
from edqn_jax.native.threefry import draw_own_in_c
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task import group
from edqn_jax.sim.task.action_sets import describe_space
from edqn_jax.sim.task.env import EnvParams, EnvState, Step, scene_of
from edqn_jax.sim.task.flights import Flights, Record, at_start, update_tallies
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import shaped_task, task_of


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
    """Carry of the loop over decisions; M missions on D devices, between the loop's pieces with D in front of []."""

    state: EnvState
    observation: Observation
    memory: Any  # [M, ...] of the actor
    flights: Flights  # record not in it
    record: Record | None  # decision first: [D, M, ...]
    decoder_errors: Array | None  # [M, 2, BINS]
    decision: Array  # [] int32, -1 is the reset
    key: Array


class Programs(NamedTuple):
    """Compiled functions of which flying consists."""

    begin: Any
    """Program, world, parameters and key to `_Flying`."""
    fly_on: Any
    """The same without the key, `_Flying` (donated) and a decision, to `_Flying` and how many flights of each device
    have ended: flies until that decision, or to the end of the last flight."""
    end: Any
    """Number of missions and `_Flying` to flights."""


NO_END = np.int32(np.iinfo(np.int32).max)
"""A decision that no flight takes."""

DRONES_A_PIECE = 4096
"""Decisions of each device in one piece of the loop where it is told how many flights have ended: a fraction of a
second on a core."""


def fly_missions(
    config: Config,
    env_params: EnvParams,
    params: Any,
    key: Array,
    *,
    actor: Actor | None = None,
    extras: Extras = Extras(),
    mesh: Mesh | None = None,
    tell: Callable[[int, int], None] | None = None,
    programs: Programs | None = None,
) -> Flights:
    """Flies each of the world's M missions once, greedily.

    Environment i flies mission i; the loop ends with the last flight. Environments whose flight has ended
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
        tell: called with how many flights have ended, and M: once it is compiled, and as they end. The host then
            starts the loop piece by piece, which changes no flight; of several processes none is told.
        programs: of `trace_missions` for such arguments; None compiles them where this process has not yet.

    Returns:
        Flights of the M missions, on the devices.

    Raises:
        ConfigError: if the actor's actions are not those of `env.actions`.
        ValueError: if codes are to be shuffled and a device has only one mission.
    """
    program, missions = _Program(config, actor or AgentActor(config), extras), _count(env_params)
    begin, fly_on, end = programs or _programs(mesh, None)
    flying = begin(program, env_params, params, key)
    if tell is None or jax.process_count() > 1:
        return end(missions, fly_on(program, env_params, params, flying, NO_END)[0])
    piece = max(1, DRONES_A_PIECE * (1 if mesh is None else mesh.size) // missions)
    until, ended, counts = piece - 1, 0, []
    while ended < missions:
        flying, count = fly_on(program, env_params, params, flying, np.int32(until))
        counts.append(count)
        # A piece is started before the one ahead of it is waited for, so that devices do not wait for the host; after
        # the last flight a piece does nothing.
        ended = int(np.sum(counts.pop(0))) if len(counts) > 1 else 0
        tell(ended, missions)
        until += piece
    return end(missions, flying)


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
    phase: ShowPhase | None = None,
) -> Flights:
    """Runs `fly_missions` on all devices and returns the flights on the host.

    `phase` is called as a phase begins, and as flights end.
    """
    if phase is None:
        tell = None
    else:
        phase("compiling")
        tell = partial(phase, "flying" if _count(env_params) == 1 else "flying the missions")
    mesh = Mesh(np.asarray(jax.devices()), ("mission",))
    env_params, params = jax.device_put((env_params, params), NamedSharding(mesh, PartitionSpec()))
    key = run_streams(seed).flights
    options: Any = {"extras": Extras(record, shuffle_codes, decoder_errors), "mesh": mesh}
    is_agent = actor is None or actor == AgentActor(config)
    is_kept = is_agent and _place_of(config, env_params, key, **options).name is not None
    programs = trace_missions(config, env_params, lambda: params, key, **options)() if is_kept else None
    flights = fly_missions(config, env_params, params, key, actor=actor, tell=tell, programs=programs, **options)
    return jax.tree.map(np.asarray, flights)


def trace_missions(
    config: Config, env_params: EnvParams, params: Callable[[], Any], key: Array, *, extras: Extras, mesh: Mesh
) -> Callable[[], Programs]:
    """Returns a function that compiles what `fly_missions` runs for the agent, or loads it where it is kept.

    Tracing is done here, so that the function has little left to do in Python.

    Args:
        config: as of `fly_missions`, and so on.
        env_params: the missions.
        params: returns parameters of the shapes and layout of those that will fly; asked for what is to be traced.
        key: of the flights.
        extras: recording and measuring.
        mesh: devices.
    """
    program = _Program(config, AgentActor(config), extras)
    place = _place_of(config, env_params, key, extras=extras, mesh=mesh)
    traced = None if place.holds_programs() else _lower(place, program, mesh, env_params, params(), key)

    def compile_all() -> Programs:
        trace = lambda: traced or _lower(place, program, mesh, env_params, params(), key)  # noqa: E731
        compiled = place.load_or_compile(trace, [*mesh.devices.flat])
        # JAX finds what it has compiled again when its functions are called.
        return _programs(mesh, None) if place.name is None else Programs(*map(_without_static, compiled))

    return compile_all


def _place_of(config: Config, env_params: EnvParams, key: Array, *, extras: Extras, mesh: Mesh) -> Place:
    """Returns where the programs are kept that fly the agent."""
    told_apart = without_seed(config), extras, [device.id for device in mesh.devices.flat]
    return place_of("flights", told_apart, (env_params, key))


def _lower(
    place: Place, program: _Program, mesh: Mesh, env_params: EnvParams, params: Any, key: Array
) -> list[jax.stages.Lowered]:
    begin, fly_on, end = _programs(mesh, place.name)
    draw_own_in_c()
    with own_program(), without_collection():
        first = begin.trace(program, env_params, params, key)
        flying = jax.tree.map(
            lambda leaf, layout: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=layout),
            first.out_info,
            _layout(mesh, first.out_info),
        )
        return [
            first.lower(),
            fly_on.lower(program, env_params, params, flying, NO_END),
            end.lower(_count(env_params), flying),
        ]


def _without_static(compiled: jax.stages.Compiled) -> Callable[..., Any]:
    """Returns a compiled program as it is called before it is compiled: with its static argument, the first."""
    return lambda static, *arguments: compiled(*arguments)


def flight_keys(key: Array, missions: int) -> tuple[Array, Array]:
    """Returns the keys [M] of the missions' environments, and that of the loop; `key` is consumed."""
    reset_key, loop_key = jax.random.split(key)
    return jax.vmap(partial(jax.random.fold_in, reset_key))(jnp.arange(missions)), loop_key


@functools.cache
def _programs(
    mesh: Mesh | None, name: str | None, options: tuple[tuple[str, str | bool], ...] | None = None
) -> Programs:
    """Returns what flies on the devices of a mesh, compiled with the platform's options, or with others.

    `name` is that of the place where they are kept, None where they are not.
    """
    platform = (jax.devices()[0] if mesh is None else mesh.devices.flat[0]).platform
    compiled = partial(jax.jit, compiler_options=compiler_options(platform) if options is None else dict(options))
    # Static by position: an argument passed by name would compile another program.
    return Programs(
        begin=compiled(named(partial(_begin_all, mesh), name), static_argnums=0),
        fly_on=compiled(named(partial(_fly_on_all, mesh), name), static_argnums=0, donate_argnums=3),
        end=compiled(named(partial(_end_all, mesh), name), static_argnums=0),
    )


def _count(env_params: EnvParams) -> int:
    return env_params.missions.scene.shape[0]


def _places(program: _Program, mesh: Mesh | None, missions: int) -> np.ndarray:
    """Returns numbers [N] of missions: every device flies equally many, whole groups."""
    unit = (1 if mesh is None else mesh.size) * program.config.env.drones
    return np.arange(-(-missions // unit) * unit)


def _spread(mesh: Mesh | None, function: Callable[..., Any], ins: tuple[Any, ...], outs: Any) -> Callable[..., Any]:
    """Returns a function of one device's missions as one of all devices'; without a mesh there is one device."""
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=ins, out_specs=outs, check_vma=False)


def _axis(mesh: Mesh | None) -> PartitionSpec:
    return PartitionSpec() if mesh is None else PartitionSpec(*mesh.axis_names)


def _specs(mesh: Mesh | None) -> _Flying:
    """Returns how the leaves of `_Flying` are spread: along their missions."""
    own: Any = _axis(mesh)
    by_decision: Any = PartitionSpec(None, *own)
    return _Flying(own, own, own, own, by_decision, own, own, own)


def _layout(mesh: Mesh, flying: _Flying) -> _Flying:
    """Returns the sharding of each leaf of `flying`, which may be shapes."""
    specs = jax.tree.broadcast(_specs(mesh), flying, is_leaf=lambda leaf: isinstance(leaf, PartitionSpec))
    return jax.tree.map(partial(NamedSharding, mesh), specs)


def _begin_all(mesh: Mesh | None, program: _Program, env_params: EnvParams, params: Any, key: Array) -> _Flying:
    """Returns what stands before the reset; the first missions are flown by more than one to fill up the devices."""
    missions = _count(env_params)
    places = _places(program, mesh, missions)
    if program.extras.shuffle_codes and len(places) // (1 if mesh is None else mesh.size) < 2:
        raise ValueError("shuffling codes needs at least two missions on each device")
    reset_keys, loop_key = flight_keys(key, missions)
    own, every = _axis(mesh), PartitionSpec()
    begin = _spread(mesh, partial(_begin, program), (every, every, own, own, every), _specs(mesh))
    number = jnp.asarray(places % missions)
    return begin(env_params, params, number, reset_keys[number], loop_key)


def _fly_on_all(
    mesh: Mesh | None, program: _Program, env_params: EnvParams, params: Any, flying: _Flying, until: Array
) -> tuple[_Flying, Array]:
    """Flies all devices' missions, each until its own have ended or the decision `until` [] is taken."""
    missions = _count(env_params)
    places = _places(program, mesh, missions)
    own, every, specs = _axis(mesh), PartitionSpec(), _specs(mesh)
    fly_on = _spread(mesh, partial(_fly_on, program), (every, every, own, own, every, specs), (specs, own))
    return fly_on(env_params, params, jnp.asarray(places % missions), jnp.asarray(places < missions), until, flying)


def _end_all(mesh: Mesh | None, missions: int, flying: _Flying) -> Flights:
    """Returns the flights of the missions, without those that filled up the devices."""
    flights = _spread(mesh, _end, (_specs(mesh),), _axis(mesh))(flying)
    return jax.tree.map(lambda leaf: leaf[:missions], flights)


def _begin(program: _Program, env_params: EnvParams, params: Any, number: Array, keys: Array, key: Array) -> _Flying:
    """Returns what stands before the reset of one device's missions `number` [M] with the environments' keys [M]."""
    config, missions, task = program.config, number.shape[0], task_of(program.config)
    action = _action_of(config, program.actor, params)
    # The first decision resets every environment: the observation and the action before it are not used.
    state = jax.vmap(partial(task.begin, env_params))(keys, number)
    actions = jnp.zeros((missions, *action.shape), action.dtype)
    shaped = shaped_task(config)
    seen = jax.eval_shape(shaped.map(partial(shaped.step, env_params)), state, actions)[1].observation
    return _Flying(
        state=state,
        observation=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), seen),
        memory=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (missions, *leaf.shape)), program.actor.init()),
        flights=jax.vmap(partial(_at_start, config, env_params))(state),
        record=_blank(config, missions, action) if program.extras.record else None,
        decoder_errors=jnp.zeros((missions, 2, decoder.BINS), jnp.int32) if program.extras.decoder_errors else None,
        decision=jnp.full((1,), -1),
        key=key[None],
    )


def _fly_on(
    program: _Program,
    env_params: EnvParams,
    params: Any,
    number: Array,
    is_counted: Array,
    until: Array,
    flying: _Flying,
) -> tuple[_Flying, Array]:
    """Flies missions `number` [M] of one device on, and counts [1] those that have ended among `is_counted` [M]."""
    config, actor, missions = program.config, program.actor, number.shape[0]
    first, task = actor.init(), task_of(config)
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

    def goes_on(flying: _Flying) -> Array:
        return (flying.decision < until) & jnp.any(flying.flights.outcome == Outcome.RUNNING)

    flying = dataclasses.replace(flying, decision=flying.decision[0], key=flying.key[0])
    flying = jax.lax.while_loop(goes_on, decide, flying)
    has_ended = flying.flights.outcome != Outcome.RUNNING
    flying = dataclasses.replace(flying, decision=flying.decision[None], key=flying.key[None])
    return flying, jnp.sum(has_ended & is_counted)[None]


def _end(flying: _Flying) -> Flights:
    """Returns the flights of one device."""
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
