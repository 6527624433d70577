"""Compares the compiled programs of the package with XLA's path through YNNPACK on and off, and with double precision.

    python scripts/check_compiler.py             # chunks of 64 to 4,096 environments, flights of 1 to 4,096 missions
    python scripts/check_compiler.py --quick     # the smallest of each

Every program is compiled with four sets of options and run on the same inputs: `off` is what the package compiles with,
`products` the same with matrix products in YNNPACK, `defaults` XLA's own options, and `plain` without LLVM's optimiser,
as a measure of what rounding alone does. A difference from `off` is that of the worst array: of floating-point numbers
the largest, as a share of the array's largest magnitude, of whole numbers the share of elements that differ, since a
rounded difference can tip an event. Flights whose moves differ, as of two equally good ones, are left out and counted.
Where there is an oracle in double precision, all four are compared with it.

Exit code 1 if `off` is wrong beside an oracle, if a difference from `off` is more than `BEYOND` times that of `plain`
and more than `NEGLIGIBLE`, or if more than `TIPPED` of the flights have other moves.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax

# XLA reads its flags at the first use: before the package is imported, so that its own defaults are compared as well.
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
if jax.__version_info__[:2] == (0, 11):
    jax.config.update("jax_use_shardy_partitioner", False)  # as in `use_cpu_devices`
jax.block_until_ready(jax.numpy.zeros(()))

import jax.numpy as jnp
import numpy as np
from jaxlib.version import __version__ as JAXLIB

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.devices.devices import compiler_options
from edqn_jax.devices.sums import squared_norms
from edqn_jax.evaluation import rollouts
from edqn_jax.evaluation.missions import load_missions, run_missions
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.interop import functional
from edqn_jax.interop.deployment import onnx_export
from edqn_jax.keys import run_streams
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.trainer import Trainer
from edqn_jax.runs.policies import load_policy
from edqn_jax.xla_flags import YNN_OPTION

OURS = dict(compiler_options("cpu"))
OPTIONS: dict[str, dict[str, Any]] = {
    "off": OURS,
    "products": OURS | {YNN_OPTION: "LIBRARY_FUSION_TYPE_DOT"},
    "defaults": {},
    "plain": OURS | {"xla_backend_optimization_level": "0"},
}
"""Compiler options by name."""

BEYOND, NEGLIGIBLE = 30.0, 1e-4
"""Times the difference that rounding makes, and a share of an array's largest number."""

WRONG = 1e-5
"""Largest difference from double precision, as a share of the array's largest number; float32 has 6e-8."""

TIPPED = 1e-3
"""Share of the flights."""

ENVIRONMENTS, MISSIONS = (64, 256, 1024, 4096), (1, 64, 1024, 4096)
ROWS = (16_385, 32_769, 65_537, 131_073)

Tree = Any


@dataclasses.dataclass(frozen=True)
class Program:
    """A program, and its result in double precision where there is one."""

    name: str
    run: Callable[[dict[str, Any]], Tree]
    """Compiles with these options and returns the results on the host."""
    exact: Callable[[], Tree] | None = None
    moves: Callable[[Tree], np.ndarray] | None = None
    """Returns the moves [M, D] of flights, whose every array has a leading [M]."""


def programs(quick: bool) -> list[Program]:
    """Returns the programs to compare; the smallest of each kind with `quick`."""
    few = slice(0, 1) if quick else slice(None)
    policy = load_policy("pretrained")
    chunks = [Program(f"chunk, {count:,} environments", Chunk(count).run) for count in ENVIRONMENTS[few]]
    moves = lambda flights: flights.record.action  # noqa: E731
    flights = [
        Program(f"flights, {count:,} missions", partial(_fly, policy, count), moves=moves) for count in MISSIONS[few]
    ]
    steps = [Program(f"functional, {count:,} drones", partial(_step, count)) for count in ENVIRONMENTS[few]]
    sums = [
        Program(f"sum of squares, {rows:,} rows", partial(_sum, rows), partial(_exact_sum, rows)) for rows in ROWS[few]
    ]
    inputs = _policy_inputs(policy.config, 256 if quick else 4096)
    decide = Program(
        f"exported decision, {len(inputs[0]):,} inputs",
        partial(_decide, policy, inputs),
        partial(_exactly, policy, inputs),
    )
    return [*sums, decide, *steps, *flights, *chunks]


class Chunk:
    """One training step after the warm-up, in which encoder and Q-network learn."""

    def __init__(self, envs: int) -> None:
        """Chooses the workload; nothing is made before the first run."""
        config = make_config("medium")
        self.config = dataclasses.replace(
            config,
            agent=dataclasses.replace(config.agent, learning_starts=4 * envs, replay_size=64 * envs, batch_size=envs),
            encoder=dataclasses.replace(
                config.encoder,
                keep_learning=True,
                warmup_decisions=4 * envs,
                retrain_at=(),
                batch_size=envs,
                replay_size=8 * envs,
            ),
            train=dataclasses.replace(config.train, num_envs=envs, chunk_steps=1, total_steps=1000 * envs),
        )
        self.trainer: Trainer | None = None
        self.state: Tree = None
        self.done = 0

    def run(self, options: dict[str, Any]) -> Tree:
        """Compiles the chunk and returns the state after it, from the same state every time."""
        if self.trainer is None:
            self.trainer = Trainer(self.config, run_missions(self.config).training.env_params, jax.devices())
            state = self.trainer.init(0)
            while self.done <= self.trainer.schedule.learn_from:
                state, _ = self.trainer.chunk(state, self.done)
                self.done += 1
            self.state = jax.tree.map(_held, state)
            self.layout = jax.tree.map(lambda leaf: leaf.sharding, state)
        self.trainer.trace()
        assert self.trainer._traced is not None
        chunk = self.trainer._traced.compile(options)
        state = jax.tree.map(_placed, self.state, self.layout)
        return jax.tree.map(_numbers, chunk(self.trainer.env_params, state, self.trainer._steps(self.done)))


def _fly(policy: Any, missions: int, options: dict[str, Any]) -> Tree:
    """Returns the first two decisions of greedy flights, before a tipped move makes two flights of one."""
    short = dataclasses.replace(policy.config, env=dataclasses.replace(policy.config.env, max_decisions=2))
    world = load_missions(short, "rooms", missions).env_params
    program = rollouts._Program(short, AgentActor(short), rollouts.Extras(record=True))
    begin, fly_on, end = rollouts._programs(None, None, tuple(options.items()))
    flying = begin(program, world, policy.params, run_streams(0).flights)
    flying, _ = fly_on(program, world, policy.params, flying, rollouts.NO_END)
    return jax.tree.map(_numbers, end(missions, flying))


def _step(drones: int, options: dict[str, Any]) -> Tree:
    """Returns a reset and a step of the functional environment, which Gymnasium's vectors compile as well."""
    env, params = functional.make("medium", worlds=16)

    def two(keys: jax.Array) -> Tree:
        observation, state = env.reset(keys[0], params)
        return observation, env.step(keys[1], state, jnp.asarray(22), params)

    keys = jax.vmap(lambda key: jax.random.split(key, 2))(jax.random.split(jax.random.key(0), drones))
    return jax.tree.map(_numbers, jax.jit(jax.vmap(two), compiler_options=options)(keys))


def _decide(policy: Any, inputs: list[np.ndarray], options: dict[str, Any]) -> Tree:
    decide = jax.jit(onnx_export.decision_function(policy.config, policy.params), compiler_options=options)
    return jax.tree.map(_numbers, decide(*inputs))


def _exactly(policy: Any, inputs: list[np.ndarray]) -> Tree:
    return onnx_export._by_jax(policy, np.float64)([inputs])


def _policy_inputs(config: Config, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        np.concatenate(each)
        for each in zip(*(onnx_export._random_inputs(config, rng) for _ in range(count)), strict=True)
    ]


def _rows(rows: int) -> np.ndarray:
    numbers = np.zeros((rows, 3), np.float32)
    numbers[:, 0] = np.arange(rows)
    return numbers


def _sum(rows: int, options: dict[str, Any]) -> Tree:
    return np.asarray(jax.jit(squared_norms, compiler_options=options)(_rows(rows)))


def _exact_sum(rows: int) -> Tree:
    return np.sum(_rows(rows).astype(np.float64) ** 2, axis=1)


def _held(leaf: Any) -> Any:
    """Returns an array on the host; of a key its type and numbers."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return _Key(jax.random.key_impl(leaf), np.asarray(jax.random.key_data(leaf)))
    return np.asarray(leaf)


@dataclasses.dataclass(frozen=True)
class _Key:
    kind: Any
    data: np.ndarray


def _placed(held: Any, layout: Any) -> Any:
    array = jax.random.wrap_key_data(jnp.asarray(held.data), impl=held.kind) if isinstance(held, _Key) else held
    return jax.device_put(array, layout)


def _numbers(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def difference(found: Tree, wanted: Tree) -> float:
    """Returns the difference of the worst array of two trees, as the module's docstring has it."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    return max((_of_array(np.asarray(a), np.asarray(b)) for a, b in pairs), default=0.0)


def _of_array(a: np.ndarray, b: np.ndarray) -> float:
    if not a.size:
        return 0.0
    if not np.issubdtype(b.dtype, np.floating):
        return float(np.mean(a != b))
    a, b = a.astype(np.float64), b.astype(np.float64)
    finite = np.isfinite(a) & np.isfinite(b)
    if np.any((a != b) & ~finite & ~(np.isnan(a) & np.isnan(b))):
        return np.inf
    scale = np.abs(b[finite]).max(initial=0.0)
    return float(np.abs(a - b)[finite].max(initial=0.0) / scale) if scale else 0.0


def compare(program: Program) -> dict[str, Any]:
    """Returns the row of a program: its differences by options, and what is wrong with it."""
    results = {name: program.run(options) for name, options in OPTIONS.items()}
    row: dict[str, Any] = {"name": program.name}
    if program.exact is not None:
        exact = program.exact()
        row |= {f"{name}_from_double": difference(result, exact) for name, result in results.items()}
        row["wrong"] = row["off_from_double"] > WRONG
        return row
    ours, most_tipped = results.pop("off"), 0.0
    for name, result in results.items():
        kept = slice(None)
        if program.moves is not None:
            kept = np.all(program.moves(result) == program.moves(ours), axis=1)
            row[f"{name}_tipped"] = int(np.sum(~kept))
            most_tipped = max(most_tipped, float(np.mean(~kept)))
        row[name] = difference(*(jax.tree.map(lambda leaf: leaf[kept], tree) for tree in (result, ours)))  # noqa: B023
    most = max(NEGLIGIBLE, BEYOND * row["plain"])
    row["wrong"] = max(row["products"], row["defaults"]) > most or most_tipped > TIPPED
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Returns 0 if all programs agree but for rounding, else 1."""
    parser = argparse.ArgumentParser(
        prog="python scripts/check_compiler.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="the smallest program of each kind, two minutes")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args(argv)
    if args.json is not None:
        check_can_write(args.json)
    # XLA's own defaults are what is compared here.
    warnings.filterwarnings("ignore", ".*computes wrong sums on this CPU with its own defaults", RuntimeWarning)
    print(f"jaxlib {JAXLIB}, Python {sys.version.split()[0]}", flush=True)
    rows = []
    for program in programs(args.quick):
        row = compare(program)
        rows.append(row)
        told = ", ".join(
            f"{name.replace('_', ' ')} {value:.1e}" for name, value in row.items() if isinstance(value, float)
        )
        print(f"{row['name']}: {told}{'  WRONG' if row['wrong'] else ''}", flush=True)
        jax.clear_caches()
    if args.json is not None:
        report = {"jaxlib": JAXLIB, "python": sys.version.split()[0], "rows": rows}
        write_atomically(args.json, json.dumps(report, indent=2) + "\n")
    return 1 if any(row["wrong"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
