"""Learners in `runtime.py`: a program that is compiled once trains one seed after another and flies each policy."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer
from edqn_jax.config.rules import validate
from edqn_jax.devices.devices import choose_devices
from edqn_jax.errors import DivergedError
from edqn_jax.evaluation.latency import decision_seconds
from edqn_jax.evaluation.missions import RunMissions, run_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.state import TrainState
from edqn_jax.learn.step import policy_of
from edqn_jax.learn.trainer import Trainer
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.history import DivergenceMonitor
from edqn_jax.training.selection import Candidate, choose_candidate, first_success, is_due, make_candidate
from measurement import json_report

LEARNERS = {
    "E-DQN": "events",
    "DQN frames": "frames",
    "DQN frame pair": "frame-pair",
    "DQN blind": "blind",
    "DQN depth": "depth",
    "DQN ranges": "ranges",
}
"""`env.sensor` by learner; everything else is the same."""


def flight_columns(flights: Flights, count: int) -> dict[str, list[Any]]:
    """Returns the first `count` flights as a list for each figure."""
    return {
        "outcome": [Outcome(int(kind)).name.lower() for kind in flights.outcome[:count]],
        "decisions": [int(n) for n in flights.decisions[:count]],
        "flight_seconds": [float(x) for x in flights.flight_seconds[:count]],
        "path_length_m": [float(x) for x in flights.path_length_m[:count]],
        "clearance_m": [float(x) for x in flights.closest.distance[:count]],
    }


class Validation:
    """The validations of one training: its learning curve and the parameters that would be kept so far."""

    def __init__(self, config: Config, missions: RunMissions, fly: Callable[[EnvParams, Any], Flights]) -> None:
        """Starts without validations; `fly(world, params)` flies every mission of a world once, greedily.

        In random worlds `world.flown` must be empty, so that all final missions are tests.
        """
        self.config, self.missions, self.fly = config, missions, fly
        self.judged = missions.tests or 1
        self.kept: Candidate | None = None
        self.curve: list[dict[str, Any]] = []

    @property
    def checked(self) -> int:
        """Returns the number of decisions at the last validation."""
        return self.curve[-1]["decisions"] if self.curve else 0

    def validate(self, params: Any, decisions: int, seconds: float) -> None:
        """Flies the validation missions and, if these parameters are kept, the test missions."""
        flights = self.fly(self.missions.validation.env_params, params)
        latest = make_candidate(self.config, self.missions, flights, params, decisions)
        before, self.kept = self.kept, choose_candidate(self.config.train.keep, self.kept or latest, latest)
        if self.kept is not before:
            self.flights = flight_columns(self.fly(self.missions.final.env_params, params), self.judged)
        self.curve.append(
            {
                "decisions": decisions,
                "seconds": seconds,
                "validation_success": latest.success,
                "validation_mission": latest.success_near_start,
                "validation_spl": latest.spl,
                "test": "".join("01"[outcome == "goal"] for outcome in self.flights["outcome"]),
            }
        )

    def result(
        self, seed: int, decisions: int, seconds: float, decision_seconds: Callable[[Any, int], np.ndarray]
    ) -> dict[str, Any]:
        """Returns the result of a training.

        Args:
            seed: of the training.
            decisions, seconds: of the whole training.
            decision_seconds: returns the seconds [n] of n decisions with given parameters.

        Returns:
            `train_seconds` and `decisions`; `curve`, a point for each validation, whose `test` is a digit for each test
            mission, 1 if the parameters kept so far reach the goal; `first_success_*` of
            `training.selection.first_success`; `flights` of the test missions, with the seconds of computation of each
            (`planning_seconds`).
        """
        since = first_success([(p["decisions"], p["seconds"], p["validation_mission"]) for p in self.curve])
        assert self.kept is not None
        elapsed = np.cumsum(decision_seconds(self.kept.params, max(self.flights["decisions"])))
        return {
            "seed": seed,
            "failure": None,
            "decisions": decisions,
            "train_seconds": seconds,
            "first_success_decisions": since[0],
            "first_success_seconds": since[1],
            "curve": self.curve,
            "flights": {**self.flights, "planning_seconds": [float(elapsed[n - 1]) for n in self.flights["decisions"]]},
        }


class Learner:
    """Trains from scratch for each seed, as `train.py` does, and flies the test missions."""

    def __init__(self, config: Config) -> None:
        """Compiles training and flights.

        Raises:
            ConfigError: if the configuration cannot be trained.
        """
        self.config, self.missions = config, run_missions(config)
        devices = choose_devices(config.train.devices, config.train.shards)
        self.trainer = Trainer(config, self.missions.training.env_params, devices)
        began = time.perf_counter()
        self.trainer.compile()
        self._fly(self.missions.final.env_params, self._policy(self.trainer.init(0)))
        self.about = {
            **json_report.machine(devices),
            "workload": describe_workload(config, self.missions.scene),
            "compile_seconds": time.perf_counter() - began,
        }

    def _fly(self, world: EnvParams, params: PolicyParams) -> Flights:
        return fly_on_all_devices(self.config, world, params, self.config.train.seed)

    def _policy(self, state: TrainState) -> PolicyParams:
        return jax.tree.map(np.asarray, policy_of(self.config, state))

    def turn(self, seed: int) -> dict[str, Any]:
        """Trains and flies one seed and returns `Validation.result`. Seconds are of the chunks alone."""
        config, plan, envs = self.config, self.trainer.schedule, self.config.train.num_envs
        validation = Validation(config, self.missions, self._fly)
        state = self.trainer.init(seed)
        seconds, done, watch = 0.0, 0, DivergenceMonitor()
        seeded = dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed))
        while done < plan.total:
            began = time.perf_counter()
            state, (_, losses) = self.trainer.chunk(state, done)
            losses = jax.tree.map(np.asarray, losses)
            seconds += time.perf_counter() - began
            done += config.train.chunk_steps
            try:
                watch.check(plan, seeded, done, losses)
            except DivergedError as error:
                return diverged(seed, str(error), done * envs, seconds, validation)
            if done >= plan.total or is_due(config, plan, validation.checked, done):
                validation.validate(self._policy(state), done * envs, seconds)
        return validation.result(seed, done * envs, seconds, lambda params, n: decision_seconds(config, params, n))


def diverged(seed: int, failure: str, decisions: int, seconds: float, validation: Validation) -> dict[str, Any]:
    """Returns the result of a seed whose training diverged: no mission is flown."""
    nothing = {
        "decisions": 0,
        "flight_seconds": 0.0,
        "path_length_m": 0.0,
        "clearance_m": None,
        "planning_seconds": 0.0,
    }
    return {
        "seed": seed,
        "failure": failure,
        "decisions": decisions,
        "train_seconds": seconds,
        "first_success_decisions": None,
        "first_success_seconds": None,
        "curve": validation.curve,
        "flights": {key: [value] * validation.judged for key, value in {"outcome": "diverged", **nothing}.items()},
    }


def sensing(config: Config, name: str) -> Config:
    """Returns `config` with the sensor of that learner.

    Raises:
        ConfigError: if other options cannot be combined with that sensor.
    """
    config = apply_layer(config, {"env": {"sensor": LEARNERS[name]}}, name)
    validate(config)
    return config
