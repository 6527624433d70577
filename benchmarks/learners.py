"""Learners in `runtime.py`: one program, compiled once, trains seed after seed and flies what was learnt."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

import json_report
from edqn_jax.config import DENSITIES, Config
from edqn_jax.devices import choose_devices
from edqn_jax.endings import DivergedError
from edqn_jax.evaluate import decision_seconds, fly_on_all_devices
from edqn_jax.flights import Flights
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.trainer import Trainer, policy_of
from edqn_jax.provenance import workload
from edqn_jax.resolve import apply
from edqn_jax.run import (
    Candidate,
    check_finite,
    choose,
    first_success,
    is_due,
    lay_courses,
    validated_by,
)
from edqn_jax.sim.env import Outcome, World
from edqn_jax.validate import validate

LEARNERS = {
    "E-DQN": "events",
    "DQN frames": "frames",
    "DQN blind": "blind",
    "DQN depth": "depth",
    "DQN ranges": "ranges",
}
"""What each sees, `env.sensor`; in all else they are alike."""


def flown_rows(flights: Flights, count: int) -> dict[str, list[Any]]:
    """The first `count` flights, a list for each figure."""
    return {
        "outcome": [Outcome(int(kind)).name.lower() for kind in flights.outcome[:count]],
        "decisions": [int(n) for n in flights.decisions[:count]],
        "flight_seconds": [float(x) for x in flights.flight_seconds[:count]],
        "path_length_m": [float(x) for x in flights.path_length_m[:count]],
        "clearance_m": [float(x) for x in flights.closest.distance[:count]],
    }


class Learner:
    """Trains from scratch for each seed, as `train.py` does, and flies the missions that are judged."""

    def __init__(self, config: Config) -> None:
        """Compiles all that training and flying need.

        Raises:
            ConfigError: if the configuration cannot be trained.
        """
        self.config = config
        self.courses = lay_courses(config)
        # In a world from a file only the first mission is judged: the others are validation's.
        self.judged = self.courses.final.missions.scene.shape[0] if config.world.name in DENSITIES else 1
        devices = choose_devices(config.train.devices, config.train.shards)
        self.trainer = Trainer(config, self.courses.training, devices)
        began = time.perf_counter()
        self.trainer.compile()
        self._fly(self.courses.final, jax.tree.map(np.asarray, policy_of(self.trainer.init(0))))
        self.about = {
            **json_report.machine(devices),
            "workload": workload(config, self.courses.scene),
            "compile_seconds": time.perf_counter() - began,
        }

    def _fly(self, world: World, params: PolicyParams) -> Flights:
        return fly_on_all_devices(self.config, world, params, self.config.train.seed)

    def turn(self, seed: int) -> dict[str, Any]:
        """One seed, trained and flown.

        Returns:
            `train_seconds` and `decisions` of training (the chunks alone); `curve`, a point for each validation, with
            `test`, which of the judged missions the parameters kept by then fly, a digit each; the
            `first_success_*` of `run.first_success`, of these seconds; the judged `flights`, with the seconds of
            computation (`planning_seconds`) of each one's decisions.
        """
        config, plan, envs = self.config, self.trainer.plan, self.config.train.num_envs
        state = self.trainer.init(seed)
        kept = Candidate(jax.tree.map(np.asarray, policy_of(state)))
        flown = self._fly(self.courses.final, kept.params)
        curve: list[dict[str, Any]] = []
        seconds, done, failure = 0.0, 0, None
        while done < plan.total:
            began = time.perf_counter()
            state, (_, losses) = self.trainer.chunk(state, done)
            losses = jax.tree.map(np.asarray, losses)
            seconds += time.perf_counter() - began
            done += config.train.chunk_steps
            try:
                check_finite(plan, done, losses)
            except DivergedError as error:
                failure = str(error)
                break
            if done >= plan.total or is_due(config, plan, curve[-1]["decisions"] if curve else 0, done):
                params = jax.tree.map(np.asarray, policy_of(state))
                checked = self._fly(self.courses.validation, params)
                latest, mission = validated_by(config, self.courses, checked, params, done * envs)
                kept, before = choose(config.train.keep, kept, latest), kept
                if kept is not before:
                    flown = self._fly(self.courses.final, kept.params)
                arrived = np.asarray(flown.outcome)[: self.judged] == Outcome.GOAL
                curve.append(
                    {
                        "decisions": done * envs,
                        "seconds": seconds,
                        "validation_success": latest.success,
                        "validation_mission": mission,
                        "validation_spl": latest.spl,
                        "test": "".join("01"[int(one)] for one in arrived),
                    }
                )
        since = first_success([(p["decisions"], p["seconds"], p["validation_mission"]) for p in curve])
        rows = flown_rows(flown, self.judged)
        if failure is not None:
            rows["outcome"] = ["diverged"] * self.judged
        thinking = np.cumsum(decision_seconds(config, kept.params, max(rows["decisions"])))
        return {
            "seed": seed,
            "failure": failure,
            "decisions": done * envs,
            "train_seconds": seconds,
            "first_success_decisions": since[0],
            "first_success_seconds": since[1],
            "curve": curve,
            "flights": {**rows, "planning_seconds": [float(thinking[n - 1]) for n in rows["decisions"]]},
        }


def sensing(config: Config, name: str) -> Config:
    """`config` as the learner of that name has it.

    Raises:
        ConfigError: if there is no such sensor.
    """
    if getattr(config.env, "sensor", "events") == LEARNERS[name]:
        return config
    config = apply(config, {"env": {"sensor": LEARNERS[name]}}, name)
    validate(config)
    return config
