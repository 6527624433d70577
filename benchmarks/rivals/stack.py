"""The conventional stack in `runtime.py`, trained and flown as the learners are, and the steady training of both.

All settings of processes and threads are timed; the results are of the fastest.
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
from edqn_jax.devices.devices import choose_devices
from edqn_jax.devices.hardware import describe_processor
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE
from measurement import json_report
from measurement.peak_memory import peak_of_workers
from measurement.whole import WholeStep, steady
from rivals.learners import Validation

STACK = "Conventional stack"
DECISIONS = 8192
"""Approximate number of decisions in a timed turn."""
CHOOSING_TURNS = 3
"""Turns whose median chooses the setting: a turn is short, and a pause of the machine may double it."""


class Stack:
    """Trains from scratch for each seed and flies the test missions."""

    def __init__(self, config: Config) -> None:
        """Times every setting in a short training and chooses the fastest.

        Raises:
            MissingPackageError: if a required package is not installed.
            ConfigError: if this stack does not support the configuration.
        """
        from conventional_stack import fleet, train

        self.config, self.missions = config, run_missions(config)
        self.stack, self.course = train, fleet.Course.of
        self.setting = self._fastest()
        machine = json_report.machine(choose_devices(1, config.train.shards))
        machine |= {"device": describe_processor()}  # whatever JAX's default device
        machine["versions"] |= {name: metadata.version(name) for name in PACKAGES}
        self.about = {
            **machine,
            "workload": {**describe_workload(config, self.missions.scene), "physics": "c_mujoco"},
            "processes": self.setting[0],
            "torch_threads": self.setting[1],
        }

    def _fastest(self) -> tuple[int, int]:
        timed = SteadyStack(steady(self.config, 4), 2 * self.config.train.num_envs)
        with timed:
            turns = [list(timed.turn(number)["decisions_per_second"].values()) for number in range(CHOOSING_TURNS)]
        return SETTINGS[int(np.argmax(np.median(turns, axis=0)))]

    def _fly(self, world: EnvParams, trained: Any) -> Flights:
        return self.stack.fly(trained, self.course(world))

    def turn(self, seed: int) -> dict[str, Any]:
        """Trains and flies one seed; returns `Validation.result` and `workers_peak_bytes` of its other processes."""
        config = dataclasses.replace(self.config, train=dataclasses.replace(self.config.train, seed=seed))
        validation = Validation(config, self.missions, self._fly)
        workers = 0

        def validate(trained: Any) -> None:
            nonlocal workers
            workers = peak_of_workers()  # during training, because they end with it
            validation.validate(trained, trained.decisions, trained.seconds)

        trained = self.stack.train(config, self.course(self.missions.training.env_params), *self.setting, validate)
        turn = validation.result(seed, trained.decisions, trained.seconds, self._decision_seconds)
        return {**turn, "workers_peak_bytes": workers}

    def _decision_seconds(self, trained: Any, calls: int) -> np.ndarray:
        """Returns the seconds [calls] of each decision of one drone, from arrays on the host to the action."""
        random, shape = np.random.default_rng(0), (1, self.config.camera.height, self.config.camera.width)
        own, motion = (np.zeros((1, size), np.float32) for size in (OWN_SIZE, MOTION_SIZE))
        observation = random.integers(-2, 3, shape, dtype=np.int8), own, motion
        seconds = []
        for _ in range(calls + 1):
            began = time.perf_counter()
            int(trained.act(*observation)[0])
            seconds.append(time.perf_counter() - began)
        return np.array(seconds[1:])  # the first call includes initialisation


class SteadyStack(contextlib.ExitStack):
    """The conventional stack in steady training, in every setting. A context manager."""

    def __init__(self, config: Config, decisions: int = DECISIONS) -> None:
        """Starts every setting; `config` must let the VAE learn throughout.

        Raises:
            MissingPackageError: if a required package is not installed.
            ConfigError: if this stack does not support the configuration.
        """
        from conventional_stack.fleet import Course
        from conventional_stack.train import Steady

        super().__init__()
        course = Course.of(run_missions(config).training.env_params)
        self.decisions = decisions
        self.runs = {setting: self.enter_context(Steady(config, course, *setting)) for setting in SETTINGS}
        self.about: dict[str, Any] = {}

    def turn(self, number: int) -> dict[str, Any]:
        """Returns the decisions per second of each setting."""
        del number
        return {
            "decisions_per_second": {
                f"processes: {processes}, threads of PyTorch: {threads}": run.turn(self.decisions)
                for (processes, threads), run in self.runs.items()
            }
        }


class SteadyStep:
    """E-DQN's whole training step in steady training."""

    def __init__(self, config: Config) -> None:
        """Compiles; `config` must let the VAE learn throughout."""
        devices, missions = choose_devices(config.train.devices, config.train.shards), run_missions(config)
        self.whole = WholeStep(config, missions.training.env_params, devices)
        self.about = {**json_report.machine(devices), "workload": describe_workload(config, missions.scene)}

    def turn(self, number: int) -> dict[str, Any]:
        """Returns the decisions per second of one chunk."""
        del number
        return {"decisions_per_second": {"one program": self.whole.turn()}}


STEADY = {"E-DQN, steady": SteadyStep, f"{STACK}, steady": SteadyStack}
"""The methods that are timed for the ratio of training rates."""
