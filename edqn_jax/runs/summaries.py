"""The content of `summary.json`, of a run and of several seeds."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.devices.hardware import describe_processor
from edqn_jax.evaluation.intervals import interquartile_mean, rate_interval
from edqn_jax.evaluation.metrics import flight_summary, summarise_flights
from edqn_jax.runs.provenance import describe_workload, package_versions, reward_record
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.reward import Reward
from edqn_jax.training.loop import TrainingResult
from edqn_jax.training.selection import first_success
from edqn_jax.training.setup import TrainingSetup


def summarize_run(
    preparation: TrainingSetup, result: TrainingResult, flights: Flights, digest: str, reward: Reward | None
) -> dict[str, Any]:
    """Returns the content of `summary.json`."""
    config = result.policy.config
    since = first_success(result.history.validations)
    summary = {
        **flight_summary(flights),
        "shortest_path_m": preparation.shortest.length_m,
        "world": config.world.name,
        "flown": config.world.flown or config.world.name,
        "seed": config.train.seed,
        "train_decisions": result.decisions,
        "train_seconds": result.train_seconds,
        "compile_seconds": result.compile_seconds,
        "total_seconds": time.perf_counter() - preparation.began,
        "decisions_per_second": result.decisions / result.train_seconds,
        "episodes": result.history.episode_count,
        "first_success_decisions": since[0],
        "first_success_seconds": since[1],
        "validation_success": result.kept.success,
        "validation_spl": result.kept.spl,
        **({} if result.kept.timed_out is None else {"validation_timed_out": result.kept.timed_out}),
        "parameters_from_decisions": result.kept.decisions,
        "reward": reward_record(config, reward),
        "workload": describe_workload(config, preparation.missions[0].training.scene()),
        "devices": [_name(device) for device in preparation.devices],
        "processor": describe_processor(),
        "versions": package_versions(),
        "state_digest": digest,
        "figures": "drawn",  # by the time that anybody reads it
    }
    tests = preparation.missions[0].tests
    if tests:
        summary["test"] = summarize_tests(tests, flights)
    return summary


def _name(device: jax.Device) -> str:  # pyright: ignore[reportInvalidTypeForm]
    """Returns the number of a device and, of a card, its model, such as `cuda:0 (NVIDIA H200)`."""
    return str(device) if device.platform == "cpu" else f"{device} ({device.device_kind})"


def summarize_tests(tests: int, flights: Flights) -> dict[str, Any]:
    """Returns the metrics of the last `tests` flights, those through unseen random worlds."""
    return summarise_flights(jax.tree.map(lambda x: x[-tests:], dataclasses.replace(flights, record=None)))


def summarize_seeds(
    config: Config, tests: int, flights: list[Flights], summaries: list[dict[str, Any]]
) -> dict[str, Any]:
    """Returns the summary over seeds: of all test missions in random worlds, elsewhere of the one mission."""
    arrived = np.array([np.asarray(agent_flights.outcome) == Outcome.GOAL for agent_flights in flights])
    arrived = arrived[:, -tests:] if tests else arrived[:, :1]
    rates = arrived.mean(axis=1)
    return {
        "world": config.world.name,
        "flown": summaries[0]["flown"],
        "flown_successes": sum(summary["success"] for summary in summaries),
        "seeds": [summary["seed"] for summary in summaries],
        "missions": arrived.shape[1],
        "success_rates": rates.tolist(),
        "success_iqm": interquartile_mean(rates),
        "success_mean": float(rates.mean()),
        "success_interval": list(rate_interval(arrived)),
        "train_decisions": summaries[0]["train_decisions"],
        "train_seconds": summaries[0]["train_seconds"],
    }
