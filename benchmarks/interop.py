"""What does Gymnasium cost? Steps its environments beside the pure functions that they call.

Rows take turns; each is the median of its turns, in decisions a second: the compiled step of many drones called in a
loop on the host, the same through `DroneVectorEnv`, and one drone through `DroneEnv`. Moves are random.

    python benchmarks/interop.py --num-envs 256 --json interop.json

Arguments after -- are options of train.py. Needs `pip install 'edqn-jax[gym]'`.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.task.task import task_of
from measurement import json_report
from measurement.flags import parse_config, split

DRONES = 256
STEPS = 200
REPEATS = 5


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration that is flown.

    Raises:
        ConfigError: if the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("interop", __doc__)
    parser.add_argument("--num-envs", type=at_least_one, default=DRONES, help=f"drones of a vector (default {DRONES})")
    parser.add_argument("--steps", type=at_least_one, default=STEPS, help=f"steps of a turn (default {STEPS})")
    parser.add_argument("--repeats", type=at_least_one, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    args = parser.parse(words)
    return args, parse_config(flags)


def pure(environment: Environment, drones: int) -> Callable[[np.ndarray], None]:
    """Returns a step of many drones by the pure functions; what it makes stays on the device."""
    task, world = task_of(environment.config), environment.world
    step = jax.jit(jax.vmap(lambda state, move: task.step(world, state, move)), donate_argnums=0)
    keys = jax.random.split(jax.random.key(0), drones)
    states, _ = jax.jit(jax.vmap(lambda key: task.reset(world, key, None)))(keys)

    def advance(moves: np.ndarray) -> None:
        nonlocal states
        states, done = step(states, jnp.asarray(moves))
        jax.block_until_ready(done)

    return advance


def alone(one: Any, moves: np.ndarray) -> None:
    """Steps one drone, and resets it where its episode ends."""
    *_, terminated, truncated, _ = one.step(int(moves[0]))
    if terminated or truncated:
        one.reset()


def measure(config: Config, drones: int, steps: int, repeats: int) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes.

    Raises:
        ConfigError: if the world cannot be flown.
        MissingPackageError: if Gymnasium is not installed.
    """
    interop = require_extra("edqn_jax.interop.gymnasium", extra="gym")
    vector, one = interop.DroneVectorEnv(drones, config=config), interop.DroneEnv(config=config)
    vector.reset(seed=0)
    one.reset(seed=0)
    rows: dict[str, tuple[int, Callable[[np.ndarray], Any]]] = {
        "pure functions": (drones, pure(vector.task.environment, drones)),
        "DroneVectorEnv": (drones, vector.step),
        "DroneEnv": (1, partial(alone, one)),
    }
    moves = np.random.default_rng(0).integers(0, len(ACTIONS), (steps, drones))
    turns: dict[str, list[float]] = {name: [] for name in rows}
    for _, step in rows.values():
        step(moves[0])  # compiles
    for _ in range(repeats):
        for name, (count, step) in rows.items():
            began = time.perf_counter()
            for each in moves:
                step(each)
            turns[name].append(steps * count / (time.perf_counter() - began))
    return {
        "workload": describe_workload(config, vector.task.environment.scene()),
        **json_report.machine(jax.devices()),
        "drones": drones,
        "repeats": repeats,
        "rows": [
            {"name": name, "decisions_per_second": statistics.median(found), "turns": found}
            for name, found in turns.items()
        ],
        "share_of_pure_functions": statistics.median(
            a / b for a, b in zip(turns["DroneVectorEnv"], turns["pure functions"], strict=True)
        ),
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input or a missing package."""
    args, config = parse(argv)
    report = measure(config, args.num_envs, args.steps, args.repeats)
    for row in report["rows"]:
        print(f"{row['name']:<16}{row['decisions_per_second']:>12,.0f} decisions/s")
    print(f"The vector makes {report['share_of_pure_functions']:.0%} of the pure functions' decisions.")
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
