"""Recorded flights of a run's policy."""

from __future__ import annotations

import argparse

from edqn_jax.config import Config
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.runs.policies import load_run
from edqn_jax.sim.task import group
from edqn_jax.sim.task.flights import Flights


def fly_recorded(args: argparse.Namespace) -> tuple[Config, MissionSet, Flights]:
    """Flies what the options of `Parser.add_flights` say, on all cores, with every pose recorded.

    Raises:
        ConfigError: if there is no such run or world, or its drones fly in groups.
    """
    use_cpu_devices()
    config, params = load_run(args.run)
    group.check_alone(config, "this benchmark")
    missions = load_missions(config, args.world or config.world.name, args.missions, args.seed)
    return config, missions, fly_on_all_devices(config, missions.env_params, params, args.seed, record=True)
