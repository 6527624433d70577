"""Preparing a run: devices, missions, programs, the first state."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.config import Config
from edqn_jax.config.rules import check_learns, validate
from edqn_jax.devices import processes
from edqn_jax.devices.devices import choose_devices
from edqn_jax.devices.forks import check_not_forked
from edqn_jax.devices.jax_settings import keep_tested_settings
from edqn_jax.devices.memory import check_fits
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation import rollouts
from edqn_jax.evaluation.missions import MissionSet, missions_of_runs
from edqn_jax.keys import run_streams
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.perception import patches
from edqn_jax.learn.policy import Policy, PolicyParams, fresh_policy
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.trainer import Trainer
from edqn_jax.learn.updates import check_begins
from edqn_jax.native import adam, all_sum, products, threefry
from edqn_jax.planning.astar import Path as ShortestPath
from edqn_jax.planning.astar import kept_shortest_path
from edqn_jax.sim.camera import native as drawing
from edqn_jax.sim.task.env import check_sensor
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.reward import Reward, check_reward
from edqn_jax.sim.worlds import geodesic
from edqn_jax.training.learner_check import check_learner
from edqn_jax.user_code import describe_object

Made = TypeVar("Made")
Tree = TypeVar("Tree")


class Display(Protocol):
    """Interface of a progress display."""

    def phase(self, name: str, *, total: int = 0, done: int = 0) -> None:
        """Shows that the phase `name` begins; if it is training, with the decisions in all and those taken before."""

    def count(self, done: int, total: int) -> None:
        """Shows how many parts of the phase are done, of how many."""

    def update(self, metrics: dict[str, Any]) -> None:
        """Shows the metrics of a chunk."""


class Silent:
    """Shows nothing."""

    def phase(self, name: str, *, total: int = 0, done: int = 0) -> None:
        pass

    def count(self, done: int, total: int) -> None:
        pass

    def update(self, metrics: dict[str, Any]) -> None:
        pass


class TrainingSetup:
    """Devices, missions, programs and the first state of a run; made by `set_up_training`."""

    def __init__(
        self,
        config: Config,
        reward: Reward | None,
        display: Display,
        pool: Executor,
        agents: int | None,
        start: Policy | None,
        begins: bool,
    ) -> None:
        """Compiles in the background while the shortest path is searched.

        Programs are traced one after the other: several threads of Python would only wait for one another. Where what
        is kept cannot be loaded, they are traced beside one another.

        Raises:
            ConfigError: if the configuration is invalid, the world cannot be flown, or memory is too small.
        """
        check_reward(reward)
        if start is not None and not isinstance(start, Policy):
            raise ConfigError(
                f"training can begin with a policy that has parameters, not with {describe_object(start)}"
            )
        config = config_for_reward(config, reward)
        self.configs = _agent_configs(config, agents)
        for each in self.configs:
            validate(each)
            check_learns(each)
        check_learner(config)
        if (teacher := learner_of(config).teacher) is not None:
            teacher(config)  # raises ConfigError, before anything is compiled
        if start is not None:
            check_begins(config, start)
        self.config, self.display, self.pool, self.began = config, display, pool, time.perf_counter()
        self.start = start
        display.phase("preparing worlds")
        self.devices = choose_devices(1 if config.train.debug else config.train.devices, config.train.shards)
        # Where they are not kept, compilers need no Python, worlds one small library. Who calls one finds its errors.
        pool.submit(_load_libraries, config, len(self.devices))
        # A world's file may be missing on one host.
        self.missions = processes.run_synchronised(lambda: missions_of_runs(self.configs, reward))
        worlds = [missions.training.env_params for missions in self.missions]
        check_sensor(config, worlds[0])
        if config.env.reward == "geodesic":  # agents that train together share their worlds
            distances = geodesic.distance_fields(worlds[0].pool, config.drone.body_radius_m)
            worlds = [dataclasses.replace(world, distances=distances) for world in worlds]
        self.trainer = Trainer(config, worlds[0] if agents is None else worlds, self.devices)
        compile_first = self.trainer.trace_first(start) if begins else None
        check_fits(self.trainer.shapes(), [each for each in self.devices if each in jax.local_devices()][:1])
        self.mesh = Mesh(np.asarray(self.devices), ("mission",))
        display.phase("compiling")
        # Python traces one program after another, XLA compiles beside it: the longest one comes last, and has the
        # processor for itself.
        self._first_compiled = None if compile_first is None else _in_background(pool, compile_first)
        world, key = self._placed(self.missions[0].validation.env_params), run_streams(config.train.seed).flights
        compile_flights = rollouts.trace_missions(
            *(config, world, self._shaped_policy, key),
            extras=rollouts.Extras(record=True),
            mesh=self.mesh,
        )
        self._flights_compiled = _in_background(pool, compile_flights)
        began = time.perf_counter()
        self.trainer.trace()
        self._compiled = _in_background(pool, lambda: _timed(self.trainer.compile, began))
        self._first: TrainState | None = None
        self.shortest = processes.run_synchronised(self._shortest)

    def ready(self, begins: bool) -> float:
        """Waits until training can go on, and returns the seconds that its program took.

        Meanwhile makes the first state, unless the run is continued.
        """
        if begins and self._first is None:
            if self._first_compiled is not None:
                self._first_compiled.result()
            seeds = [config.train.seed for config in self.configs]
            self._first = self.trainer.init(seeds[0] if self.trainer.agents is None else seeds, self.start)
        return self._compiled.result()

    def take_first(self) -> TrainState:
        """Returns the state before the first step, which is not kept: it will be donated."""
        self.ready(True)
        state, self._first = self._first, None
        assert state is not None
        return state

    def fly(self, missions: MissionSet, params: PolicyParams, agent: int = 0) -> Flights:
        """Returns the missions, flown greedily and recorded; sensor noise is the same each time."""
        programs = self._flights_compiled.result()
        world, params = self._placed((missions.env_params, params))
        key = run_streams(self.configs[agent].train.seed).flights
        recorded = rollouts.Extras(record=True)

        def tell(ended: int, count: int) -> None:  # the agents fly one after the other
            self.display.count(agent * count + ended, len(self.configs) * count)

        return processes.fetch_global(
            rollouts.fly_missions(
                self.config, world, params, key, extras=recorded, mesh=self.mesh, tell=tell, programs=programs
            )
        )

    def _shortest(self) -> ShortestPath:
        return kept_shortest_path(self.missions[0].scene, self.config.drone.body_radius_m)

    def _shaped_policy(self) -> PolicyParams:
        """Returns the shapes and layout of what will fly."""
        everywhere = NamedSharding(self.mesh, PartitionSpec())
        shaped = jax.eval_shape(lambda: fresh_policy(self.config))
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), shaped)

    def _placed(self, tree: Tree) -> Tree:
        """Returns arrays as `fly_missions` takes them."""
        return processes.replicate(tree, self.mesh)


def config_for_reward(config: Config, reward: Reward | None) -> Config:
    """Returns the configuration that a run with a reward of one's own has: the reward may prefer a direction."""
    if reward is None or not config.agent.turn:
        return config
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, turn=False))


def _agent_configs(config: Config, agents: int | None) -> list[Config]:
    """Returns the configuration of each agent: the seeds of several are those from the configured one on."""
    if agents is None:
        return [config]
    if agents < 1:
        raise ConfigError(f"the number of agents must be at least 1, not {agents}")
    if config.train.debug:
        raise ConfigError("--debug trains one agent; leave --seeds out")
    seeds = range(config.train.seed, config.train.seed + agents)
    return [dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed)) for seed in seeds]


@contextlib.contextmanager
def set_up_training(
    config: Config,
    reward: Reward | None = None,
    display: Display | None = None,
    agents: int | None = None,
    start: Policy | None = None,
    begins: bool = True,
) -> Iterator[TrainingSetup]:
    """Prepares a run; pending compilations are cancelled if the block ends with an error.

    Args:
        config: of the run; its seed is that of the first agent.
        reward: as in `train`.
        display: of the progress.
        agents: how many are trained in one program; None is one, compiled as such.
        start: policy whose networks they begin with.
        begins: whether a first state will be needed, as far as it is known: what makes it is then compiled ahead.

    Raises:
        ConfigError: if the configuration is invalid or the world cannot be flown, or the process was forked after JAX
            had been used.
    """
    check_not_forked()
    pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="compiling", initializer=keep_tested_settings)
    try:
        yield TrainingSetup(config, reward, display or Silent(), pool, agents, start, begins)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _load_libraries(config: Config, devices: int) -> None:
    """Has what the program of a training calls in C or CUDA compiled, unless it is kept."""
    on_cpu = jax.default_backend() == "cpu"
    if on_cpu:  # what worlds are drawn with comes first, what compiles for seconds last
        threefry.is_available()
        patches.is_available()
        adam.is_available()
    if on_cpu and devices > 1 and jax.process_count() == 1:
        all_sum.is_available()
    products.precision_of(config.train.products)
    drawing.is_available("cpu" if on_cpu else "cuda")


def _in_background(pool: Executor, work: Callable[[], Made]) -> Future[Made]:
    """Runs `work` in a thread. Of several processes none works ahead: all must meet in one order."""
    future = pool.submit(work)
    if jax.process_count() > 1:
        future.result()
    return future


def _timed(work: Callable[[], object], began: float) -> float:
    """Does `work` and returns the seconds since the time `began`."""
    work()
    return time.perf_counter() - began
