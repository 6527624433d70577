r"""Averages the parameters of two policies of which one was trained further from the other, and keeps the best mean.

    python scripts/average.py edqn_jax/policies/pretrained-looks runs/autopilot --worlds rooms medium forest \
        --out runs/averaged

Policies of which one began with the other often lie in one valley of the loss (Wortsman et al. 2022, "Model soups"):
their mean can fly both as the one was trained and as the other was. Each weight flies the validation worlds under the
conditions of both, and the weight with the highest success of all is kept; test worlds have no say in it. What is
written has the configuration of the second policy.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy, save_policy
from edqn_jax.sim.task.outcomes import Outcome

WEIGHTS = (0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 1.0)
"""Of the second policy, that are tried."""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when the mean is written, 2 for invalid input."""
    parser = argparse.ArgumentParser(
        prog="python scripts/average.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first", type=Path, help="policy that the second began with")
    parser.add_argument("second", type=Path, help="policy that was trained further, and its configuration")
    parser.add_argument("--out", type=Path, required=True, help="new folder for the mean")
    parser.add_argument("--worlds", nargs="+", default=["rooms"], help="whose validation worlds are flown (rooms)")
    parser.add_argument("--missions", type=int, default=1024, help="in each world, under both conditions (1024)")
    parser.add_argument("--weights", type=float, nargs="+", default=WEIGHTS, help="of the second, that are tried")
    args = parser.parse_args(argv)
    if args.missions < 1:
        parser.error(f"--missions must be at least 1, not {args.missions}")
    if args.out.exists():
        parser.error(f"'{args.out}' is there already; give a new folder")
    use_cpu_devices()
    try:
        first, second = load_policy(args.first), load_policy(args.second)
        best, most = None, -1.0
        for weight in args.weights:
            policy = mean_of(first, second, weight)
            flown = {
                f"{name} {world}": success(policy, conditions, world, args.missions)
                for name, conditions in (("first", first.config), ("second", second.config))
                for world in args.worlds
            }
            mean = float(np.mean(list(flown.values())))
            print(json.dumps({"weight": weight, "mean": round(mean, 4), **flown}), flush=True)
            if mean > most:
                best, most = policy, mean
        assert best is not None
        save_policy(best, args.out)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def mean_of(first: Policy, second: Policy, weight: float) -> Policy:
    """Returns the policy with parameters `(1 - weight) first + weight second`, and the second one's configuration.

    Raises:
        ConfigError: if their parameters have other shapes.
    """
    shapes = [jax.tree.map(np.shape, each.params) for each in (first, second)]
    if shapes[0] != shapes[1]:
        raise ConfigError("the two policies have networks of other shapes; one must have begun with the other")
    params = jax.tree.map(lambda a, b: (1.0 - weight) * a + weight * b, first.params, second.params)
    return dataclasses.replace(second, params=params)


def success(policy: Policy, conditions: Config, world: str, missions: int) -> float:
    """Returns the share of validation worlds in which a policy arrives under the conditions of a configuration."""
    there = dataclasses.replace(
        conditions,
        world=dataclasses.replace(conditions.world, name=world, flown=""),
        train=dataclasses.replace(conditions.train, validation_missions=missions),
    )
    flights = fly_on_all_devices(there, run_missions(there).validation.env_params, policy.params)
    return float(np.mean(flights.outcome == Outcome.GOAL))


if __name__ == "__main__":
    sys.exit(main())
