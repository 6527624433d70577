"""The conventional stack in `runtime.py`: trained and flown as the learners are, and both timed in steady training.

The settings of its processes and threads are all timed, and the fastest counts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from importlib import metadata
from typing import Any

import numpy as np

from conventional_stack.settings import PACKAGES, SETTINGS
from edqn_jax.config import Config
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.parallel.devices import choose_devices, processor
from edqn_jax.runs.provenance import workload
from edqn_jax.sim.env import OWN_SIZE, World
from edqn_jax.sim.flights import Flights
from measurement import json_report
from measurement.peak_memory import peak_of_workers
from measurement.whole import WholeStep, steady
from rivals.learners import Watched

STACK = "Conventional stack"
DECISIONS = 8192
"""Of a timed turn, about."""
CHOOSING_TURNS = 3
"""Of which the median chooses the setting: a turn is short, and a moment's pause may double it."""


class Stack:
    """Trains from scratch for each seed and flies the missions that are judged."""

    def __init__(self, config: Config) -> None:
        """Times every setting in a short training, to choose one.

        Raises:
            MissingPackageError: if a package that it needs is not installed.
            ConfigError: if the configuration asks for what this stack does not have.
        """
        from conventional_stack import fleet, train

        self.config, self.missions = config, run_missions(config)
        self.stack, self.course = train, fleet.Course.of
        self.setting = self._fastest()
        machine = json_report.machine(choose_devices(1, config.train.shards))
        machine |= {"device": processor()}  # whatever JAX prefers
        machine["versions"] |= {name: metadata.version(name) for name in PACKAGES}
        self.about = {
            **machine,
            "workload": {**workload(config, self.missions.scene), "physics": "c_mujoco"},
            "processes": self.setting[0],
            "torch_threads": self.setting[1],
        }

    def _fastest(self) -> tuple[int, int]:
        timed = SteadyStack(steady(self.config, 4), 2 * self.config.train.num_envs)
        with timed:
            turns = [list(timed.turn(number)["decisions_per_second"].values()) for number in range(CHOOSING_TURNS)]
        return SETTINGS[int(np.argmax(np.median(turns, axis=0)))]

    def _fly(self, world: World, trained: Any) -> Flights:
        return self.stack.fly(trained, self.course(world))

    def turn(self, seed: int) -> dict[str, Any]:
        """One seed, trained and flown: see `Watched.turn`; and `workers_peak_bytes`, of its other processes."""
        config = dataclasses.replace(self.config, train=dataclasses.replace(self.config.train, seed=seed))
        watched = Watched(config, self.missions, self._fly)
        workers = 0

        def watch(trained: Any) -> None:
            nonlocal workers
            workers = peak_of_workers()  # while they run: after the training they are gone
            watched.validate(trained, trained.decisions, trained.seconds)

        trained = self.stack.train(config, self.course(self.missions.training.world), *self.setting, watch)
        turn = watched.turn(seed, trained.decisions, trained.seconds, self._decision_seconds)
        return {**turn, "workers_peak_bytes": workers}

    def _decision_seconds(self, trained: Any, calls: int) -> np.ndarray:
        """Seconds [calls] of each decision of one drone, from arrays on the host to a move."""
        random, shape = np.random.default_rng(0), (1, self.config.camera.height, self.config.camera.width)
        seen = random.integers(-2, 3, shape, dtype=np.int8), np.zeros((1, OWN_SIZE), np.float32)
        seconds = []
        for _ in range(calls + 1):
            began = time.perf_counter()
            int(trained.act(*seen)[0])
            seconds.append(time.perf_counter() - began)
        return np.array(seconds[1:])  # the first call is slower by what it sets up


class SteadyStack(contextlib.ExitStack):
    """The conventional stack in steady training, in every setting. A context."""

    def __init__(self, config: Config, decisions: int = DECISIONS) -> None:
        """`config` has the VAE learn throughout.

        Raises:
            MissingPackageError: if a package that it needs is not installed.
            ConfigError: if the configuration asks for what this stack does not have.
        """
        from conventional_stack.fleet import Course
        from conventional_stack.train import Steady

        super().__init__()
        course = Course.of(run_missions(config).training.world)
        self.decisions = decisions
        self.runs = {setting: self.enter_context(Steady(config, course, *setting)) for setting in SETTINGS}
        self.about: dict[str, Any] = {}

    def turn(self, number: int) -> dict[str, Any]:
        """Decisions per second of each setting."""
        del number
        return {
            "decisions_per_second": {
                f"processes: {processes}, threads of PyTorch: {threads}": run.turn(self.decisions)
                for (processes, threads), run in self.runs.items()
            }
        }


class SteadyStep:
    """E-DQN's whole training step, likewise."""

    def __init__(self, config: Config) -> None:
        """`config` has the VAE learn throughout."""
        devices, missions = choose_devices(config.train.devices, config.train.shards), run_missions(config)
        self.whole = WholeStep(config, missions.training.world, devices)
        self.about = {**json_report.machine(devices), "workload": workload(config, missions.scene)}

    def turn(self, number: int) -> dict[str, Any]:
        """Decisions per second of one chunk."""
        del number
        return {"decisions_per_second": {"one program": self.whole.turn()}}


STEADY = {"E-DQN, steady": SteadyStep, f"{STACK}, steady": SteadyStack}
"""What is timed for the ratio of training rates."""
