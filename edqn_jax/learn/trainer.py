"""Training steps as one compiled, donated program over devices.

A chunk is a fixed number of training steps. `shard_map` spreads the logical shards over a mesh axis, parameters are
replicated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.config import Config
from edqn_jax.devices import processes
from edqn_jax.devices.devices import compiler_options
from edqn_jax.kept_programs import Place, named, place_of, without_seed
from edqn_jax.keys import run_streams
from edqn_jax.learn.checked import CheckedChunk
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.policy import Policy
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import Episodes, Losses, TrainState, init_state
from edqn_jax.learn.step import run_steps
from edqn_jax.learn.updates import begin_networks
from edqn_jax.native.own_programs import own_program, without_collection
from edqn_jax.native.threefry import draw_own_in_c
from edqn_jax.sim.task.env import EnvParams

AXIS = "env"
"""Name of the mesh axis that shards are spread over."""


def _with_sharding(shapes: Any, sharding: NamedSharding) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)


def _cut(whole: Array, laid_out: jax.ShapeDtypeStruct) -> Array:
    """Returns an array that one device of this process has, laid out over the devices of all; `whole` is used up."""
    assert laid_out.sharding is not None
    if laid_out.sharding.num_devices == 1:
        return jax.device_put(whole, laid_out.sharding)
    if jnp.issubdtype(whole.dtype, jax.dtypes.prng_key):
        return jax.jit(jax.random.wrap_key_data, out_shardings=laid_out.sharding)(
            np.asarray(jax.random.key_data(whole))
        )
    # Through the host: JAX cannot move what one device has to another process, and would compile a cut for each shape.
    values = np.asarray(whole)
    cut = jax.make_array_from_callback(whole.shape, laid_out.sharding, lambda index: values[index])
    whole.delete()
    return cut


class Trainer:
    """A compiled, donated chunk over a mesh of devices. The state goes in and comes out; nothing is kept here.

    Where the devices are of several processes, each of them makes its own trainer of the same mesh, from the same
    world and seed, and calls it alike; each holds the shards of its own devices.
    """

    def __init__(
        self,
        config: Config,
        env_params: EnvParams | Sequence[EnvParams],
        devices: Sequence[jax.Device],  # pyright: ignore[reportInvalidTypeForm]
    ):
        """Prepares one agent, or as many as there are worlds: they learn side by side in one program.

        Args:
            config: of all agents.
            env_params: of the one agent, or one for each of K agents, which may differ in their missions alone. States,
                episodes and losses of several agents have a leading [K].
            devices: over which the environments of every agent are spread.
        """
        self.config = config
        self.schedule = Schedule.from_config(config)
        self.agents = None if isinstance(env_params, EnvParams) else len(env_params)
        self.mesh = Mesh(np.asarray(devices), (AXIS,))
        self.replicated = NamedSharding(self.mesh, PartitionSpec())
        self.env_params = processes.replicate(
            env_params if isinstance(env_params, EnvParams) else _stack_missions(env_params), self.mesh
        )
        self._place: Place | None = None
        self._traced: jax.stages.Lowered | None = None
        self._shapes: TrainState | None = None
        self._make_first: tuple[Policy | None, Callable[[Array], TrainState]] | None = None
        self._chunk = None
        draw_own_in_c()

    def trace_first(self, start: Policy | None = None) -> Callable[[], None]:
        """Traces what makes the first state, unless it is kept, and returns what compiles it, for the next `init`.

        Args:
            start: as of `init`.

        Raises:
            ConfigError: likewise.
        """

        def begin(env_params: EnvParams, key: Array) -> TrainState:
            state = init_state(self.config, env_params, key)
            if start is None:
                return state
            networks = begin_networks(self.config, state.learner, start.config, start.params)
            return dataclasses.replace(state, learner=networks)

        device = self._own_device()
        world = jax.tree.map(lambda leaf: leaf.addressable_data(0), self.env_params)
        arguments = world, self._keys(range(self.agents or 1))
        place = Place(None) if start is not None else self._place_of("first_state", arguments, [device])

        def lower() -> list[jax.stages.Lowered]:
            with own_program(), without_collection():
                traced = jax.jit(named(self._each(begin, 0), place.name)).trace(*arguments)
                self._shapes = self._shapes or self._laid_out(traced.out_info)
                return [traced.lower()]

        lowered = None if place.holds_programs() else lower()

        def compile_first() -> None:
            [make] = place.load_or_compile(lambda: lowered or lower(), [device])
            self._make_first = start, partial(make, world)

        return compile_first

    def init(self, seed: int | Sequence[int], start: Policy | None = None) -> TrainState:
        """Returns the state before the first step, laid out over the devices.

        Args:
            seed: of several agents, one for each.
            start: policy whose networks all agents begin with.

        Raises:
            ConfigError: if its networks have other shapes, or the learner cannot begin with any.
        """
        if self._make_first is None or self._make_first[0] is not start:
            self.trace_first(start)()
        assert self._make_first is not None
        (_, make), self._make_first = self._make_first, None  # it may hold parameters
        keys = self._keys([seed] if isinstance(seed, int) else seed)
        # Made whole, by each process on one device, and then cut: made in parts it would be rounded otherwise.
        return jax.tree.map(_cut, make(keys), self.shapes())

    def _own_device(self) -> jax.Device:  # pyright: ignore[reportInvalidTypeForm]
        """Returns the first of this process's devices."""
        return next(each for each in self.mesh.devices.flat if each.process_index == jax.process_index())

    def _keys(self, seeds: Sequence[int]) -> Array:
        """Returns the agents' keys [K] of their seeds, [] of one agent."""
        keys = [run_streams(seed).learning for seed in seeds]
        return keys[0] if self.agents is None else jnp.stack(keys)

    def _each(self, function: Callable[..., Any], *axes: int | None) -> Callable[..., Any]:
        """Returns `function(world, *arguments)` for all agents; `axes` are those of the other arguments."""
        if self.agents is None:  # K = 1 computes the same bits, and compiles an eighth to a fifth longer
            return function
        missions = dataclasses.replace(self.env_params, airframe=None, pool=None, missions=0, distances=None)
        return jax.vmap(function, in_axes=(missions, *axes))

    def _spread(self, *before: None) -> PartitionSpec:
        """Returns how arrays [K, *before, S, ...] are laid out."""
        return PartitionSpec(*([] if self.agents is None else [None]), *before, AXIS)

    def _layout(self) -> Any:
        spread, same = NamedSharding(self.mesh, self._spread()), self.replicated
        return TrainState(actors=spread, learner=same, step=same)  # pyright: ignore[reportArgumentType]

    def shapes(self) -> TrainState:
        """Returns shape, type and layout of every array of a state, which takes some seconds where no chunk is kept."""
        if self._shapes is None:
            self._shapes = self._shaped()
        return self._shapes

    def _shaped(self) -> TrainState:
        self._load()
        if isinstance(self._chunk, jax.stages.Compiled):
            shapes = self._chunk.args_info[0][1]
        else:
            keys = self._keys(range(self.agents or 1))
            shapes = jax.eval_shape(self._each(partial(init_state, self.config), 0), self.env_params, keys)
        return self._laid_out(shapes)

    def _laid_out(self, shapes: Any) -> TrainState:
        """Returns a state's shapes and types with the layout that its arrays have."""
        layout = self._layout()
        return TrainState(
            actors=_with_sharding(shapes.actors, layout.actors),
            learner=_with_sharding(shapes.learner, layout.learner),
            step=_with_sharding(shapes.step, layout.step),
        )

    def compile(self) -> None:
        """Compiles the chunk, once; needs no state, so that it can go on while one is made.

        With `train.debug` the chunk is of one agent on one device.

        Raises:
            CheckError: with `train.debug`, if a random key is used twice.
        """
        if self.config.train.debug:
            run = partial(run_steps, self.config)
            self._chunk = CheckedChunk(self.config, run, self.env_params, self.shapes(), self._steps(0))
            return
        self.trace()
        if self._chunk is not None:
            return
        assert self._place is not None and self._traced is not None
        devices = [*self.mesh.devices.flat]
        [self._chunk] = self._place.compile([self._traced], devices, compiler_options(devices[0].platform))
        self._traced = None

    def trace(self) -> None:
        """Traces the chunk, so that `compile` has little left to do in Python, unless it is kept.

        Does nothing with `train.debug`.
        """
        if self.config.train.debug:
            return
        self._load()
        if self._chunk is None and self._traced is None:
            self._traced = self._lower()

    def _load(self) -> None:
        """Loads the chunk if it is kept. The shapes of states follow from the configuration, and need not be known."""
        if self._place is None and not self.config.train.debug:
            self._place = self._place_of("training", (self.env_params, self._steps(0)), [*self.mesh.devices.flat])
            [self._chunk] = self._place.load() or [None]

    def _place_of(self, name: str, arguments: Any, on: Sequence[Any]) -> Place:
        """Returns where a program for these devices is kept; nowhere if it may hold what is in a teacher's files."""
        if learner_of(self.config).teacher is not None:
            return Place(None)
        return place_of(name, (without_seed(self.config), self.agents, [device.id for device in on]), arguments)

    def _lower(self) -> jax.stages.Lowered:
        # One spec for each subtree: only environments and replay are spread, and what they return.
        spread, same = self._spread(), PartitionSpec()
        specs: Any = TrainState(actors=spread, learner=same, step=same)  # pyright: ignore[reportArgumentType]
        run = jax.shard_map(
            self._each(
                lambda env_params, state, steps: run_steps(self.config, env_params, state, steps, AXIS), 0, None
            ),
            mesh=self.mesh,
            in_specs=(same, specs, same),
            out_specs=(specs, (self._spread(None), same)),
            check_vma=False,
        )
        assert self._place is not None
        program = jax.jit(named(run, self._place.name), donate_argnums=1)
        with own_program(), without_collection():
            return program.lower(self.env_params, self.shapes(), self._steps(0))

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
        return self._chunk(self.env_params, state, self._steps(first))

    def each(self, tree: Any) -> list[Any]:
        """Returns the arrays of each agent, of arrays that have a leading [K] if there are several."""
        return [self.of_agent(tree, number) for number in range(self.agents or 1)]

    def of_agent(self, tree: Any, number: int) -> Any:
        """Returns the arrays of one agent, of arrays that have a leading [K] if there are several."""
        return tree if self.agents is None else jax.tree.map(lambda leaf: leaf[number], tree)


def _stack_missions(worlds: Sequence[EnvParams]) -> EnvParams:
    """Returns the first world with the missions of all, [K, M]."""
    missions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(world.missions for world in worlds))
    return dataclasses.replace(worlds[0], missions=missions)
