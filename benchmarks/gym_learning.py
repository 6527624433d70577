"""Does stable-baselines3's DQN learn the task through Gymnasium? Flies unseen worlds before and after its training.

One DQN for each seed trains in the random worlds of `EDQN/Random-v0`, many drones in one compiled program. Before and
after that it flies the same missions greedily, each in a world of its own that it is not trained in.

    python benchmarks/gym_learning.py --json gym_learning.json
    python benchmarks/gym_learning.py --observation kinematics --world sparse --seeds 1

With `code` it sees the codes that the encoder of the policy `pretrained` makes of events; with `kinematics` it is
blind. Intervals are a bootstrap over seeds and missions, Wilson's for one seed. Needs `pip install 'edqn-jax[bench]'`.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from edqn_jax.config import FAMILIES
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.intervals import bootstrap_rates, rate_interval
from edqn_jax.extras import require_extra
from edqn_jax.runs.policies import load_policy
from edqn_jax.runs.provenance import describe_workload
from measurement import json_report

NAME = "EDQN/Random-v0"
OBSERVATIONS = ("code", "kinematics")
SEEDS, DECISIONS, DRONES, MISSIONS = 2, 200_000, 64, 128
WORLDS = 1024
"""Worlds that are trained in."""

DISCOUNT = 0.97
REWARD_SCALE = 0.01
"""Factor on rewards before learning, which stable-baselines3 does not offer; returns are reported without it."""

SETTINGS: dict[str, Any] = {
    "gamma": DISCOUNT,
    "learning_rate": 1e-3,
    "batch_size": 256,
    "buffer_size": 100_000,
    "learning_starts": 5_000,
    "train_freq": 1,  # after each decision of all drones
    "gradient_steps": 8,
    "target_update_interval": 1,  # as often
    "tau": 0.1,
    "n_steps": 3,
    "exploration_fraction": 0.15,
    "exploration_final_eps": 0.02,
    "policy_kwargs": {"net_arch": [128, 128]},
}
"""Arguments of stable-baselines3's DQN, otherwise its defaults."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments.

    Raises:
        ConfigError: if there are no random worlds of that name, or the file cannot be written.
    """
    parser = Parser("gym_learning", __doc__)
    parser.add_argument("--world", default="medium", help="name of random worlds (default medium)")
    parser.add_argument("--observation", choices=OBSERVATIONS, default=OBSERVATIONS[0], help="default code")
    for name, default, help in (
        ("--seeds", SEEDS, "training seeds"),
        ("--decisions", DECISIONS, "decisions of a training"),
        ("--num-envs", DRONES, "drones that train"),
        ("--missions", MISSIONS, "test missions"),
    ):
        parser.add_argument(name, type=at_least_one, default=default, help=f"{help} (default {default:,})")
    args = parser.parse(argv)
    if args.world not in FAMILIES:
        raise ConfigError(f"--world must be one of {', '.join(FAMILIES)}, not '{args.world}'")
    return args


def fly(model: Any, drones: Any) -> tuple[np.ndarray, np.ndarray]:
    """Flies one mission with each drone, greedily.

    Returns:
        returns [missions], undiscounted, and whether the goal was reached [missions] bool.
    """
    missions = drones.num_envs
    drones.seed(0)
    drones.set_options([{"mission": number} for number in range(missions)])
    observed = drones.reset()
    total, success, running = np.zeros(missions), np.zeros(missions, bool), np.ones(missions, bool)
    while running.any():
        moves, _ = model.predict(observed, deterministic=True)
        observed, rewards, dones, infos = drones.step(moves)
        total += np.where(running, rewards, 0.0)
        for number in np.flatnonzero(running & dones):
            success[number] = infos[number]["is_success"]
        running &= ~dones
    return total, success


def row(name: str, returns: list[np.ndarray], success: list[np.ndarray]) -> dict[str, Any]:
    """Returns the figures of flights [seeds][missions] before or after training."""
    flown, reached = np.stack(returns), np.stack(success)
    return {
        "name": name,
        "mean_return": float(flown.mean()),
        "return_interval": interval(bootstrap_rates([flown])[0]),
        "success_rate": float(reached.mean()),
        "success_interval": rate_interval(reached),
        "returns_of_seeds": flown.mean(axis=1).tolist(),
        "success_of_seeds": reached.mean(axis=1).tolist(),
    }


def interval(drawn: np.ndarray) -> list[float]:
    """Returns the middle 95 % of bootstrap draws."""
    return [float(bound) for bound in np.percentile(drawn, [2.5, 97.5])]


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Trains, flies and returns the report that `--json` writes.

    Raises:
        MissingPackageError: if Gymnasium or stable-baselines3 is not installed.
    """
    began = time.perf_counter()
    interop = require_extra("edqn_jax.interop.stable_baselines3")
    learner = require_extra("stable_baselines3")
    policy = load_policy("pretrained") if args.observation == "code" else None
    options = {"world": args.world, "observation": args.observation, "policy": policy}
    test = interop.DroneVecEnv(NAME, args.missions, worlds=args.missions, world_seed=WORLDS, **options)
    train = interop.DroneVecEnv(
        NAME, args.num_envs, worlds=WORLDS, reward=lambda decision: REWARD_SCALE * decision.configured, **options
    )
    flights: dict[str, tuple[list[np.ndarray], list[np.ndarray]]] = {"untrained": ([], []), "trained": ([], [])}
    training_seconds = []
    for seed in range(args.seeds):
        model = learner.DQN("MlpPolicy", train, seed=seed, device="cpu", **SETTINGS)
        for name in flights:
            if name == "trained":
                started = time.perf_counter()
                model.learn(args.decisions)
                training_seconds.append(time.perf_counter() - started)
            for kept, found in zip(flights[name], fly(model, test), strict=True):
                kept.append(found)
            print(f"seed {seed}, {name}: mean return {flights[name][0][-1].mean():.1f}", flush=True)
    before, after = (bootstrap_rates([np.stack(returns)])[0] for returns, _ in flights.values())
    return {
        "workload": describe_workload(test.envs.task.config, test.envs.task.environment.scene()),
        **json_report.machine(jax.devices()),
        "environment": NAME,
        "world": args.world,
        "observation": args.observation,
        "decisions": args.decisions,
        "drones": args.num_envs,
        "seeds": args.seeds,
        "missions": args.missions,
        "training_worlds": WORLDS,
        "settings": {**SETTINGS, "reward_scale": REWARD_SCALE},
        "training_seconds": training_seconds,
        "total_seconds": time.perf_counter() - began,
        "rows": [row(name, *found) for name, found in flights.items()],
        "return_gained_interval": interval(after - before),
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input or a missing package."""
    args = parse(argv)
    report = measure(args)
    for each in report["rows"]:
        (low, high), (least, most) = each["return_interval"], each["success_interval"]
        print(
            f"{each['name']:<10} mean return {each['mean_return']:7.1f} ({low:.1f} to {high:.1f})   "
            f"success {each['success_rate']:.1%} ({least:.1%} to {most:.1%})"
        )
    low, high = report["return_gained_interval"]
    print(f"Training gains {low:.1f} to {high:.1f} of return; all took {report['total_seconds']:.0f} s.")
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
