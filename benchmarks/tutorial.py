"""How fast is training as tutorials write it?

One Gymnasium environment for each drone, with C MuJoCo, MuJoCo's own renderer (without shadows), an event simulator in
NumPy and controllers in plain Python, each in a process of its own; stable-baselines3's DQN reads the event images,
without an auto-encoder. Nothing is vectorised by hand: `conventional.py` measures what these packages can do when it
is. The rows take turns with the training step of edqn_jax, which has its auto-encoder learning throughout; each is the
median of its turns. The reference workload: the same moves, physics steps, frames, pixels and replayed samples a
decision.

    python benchmarks/tutorial.py --json tutorial.json

Needs `pip install 'edqn-jax[bench]'` and OpenGL without a display (MUJOCO_GL=egl or osmesa).
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from functools import partial
from importlib import metadata
from typing import Any

import jax

from conventional_stack.settings import PACKAGES
from edqn_jax.config import FAMILIES, Config
from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.extras import require_extra
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world
from measurement import json_report
from measurement.flags import parse_config, split
from measurement.whole import WholeStep, steady

DRONES = 8
DECISIONS = 800
REPEATS = 3
REPLAYED = 4
"""Samples that the DQN learns from for each decision, as in the reference workload."""


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """Returns the parsed arguments, and the configuration of edqn_jax.

    Raises:
        ConfigError: if the options after -- are invalid, or the file cannot be written.
    """
    words, flags = split(argv)
    parser = Parser("tutorial", __doc__)
    parser.add_argument(
        "--drones", type=at_least_one, default=DRONES, help=f"environments of the tutorials (default {DRONES})"
    )
    parser.add_argument(
        "--decisions", type=at_least_one, default=DECISIONS, help=f"their decisions in each turn (default {DECISIONS})"
    )
    parser.add_argument("--repeats", type=at_least_one, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    args = parser.parse(words)
    return args, steady(parse_config(flags), 64)


class Tutorial:
    """stable-baselines3's DQN over environments in processes of their own. A context manager, which ends them."""

    def __init__(self, config: Config, drones: int, together: Any = None, **options: Any) -> None:
        """Starts the environments; `together` is the class of stable-baselines3's vector of them."""
        from tutorial_stack.env import TutorialDrone

        world, vectors = resolve_world(config.world.name), require_extra("stable_baselines3.common.vec_env")
        self.environments = (together or vectors.SubprocVecEnv)(
            [partial(TutorialDrone, world, config, **options)] * drones
        )
        self.dqn = require_extra("stable_baselines3").DQN(
            "MlpPolicy",
            self.environments,
            policy_kwargs={"net_arch": list(config.agent.hidden)},
            batch_size=REPLAYED * drones,
            buffer_size=50_000,
            learning_starts=drones,
            train_freq=1,
            gradient_steps=1,
            gamma=config.agent.discount,
            device="cpu",
            seed=0,
        )

    def __enter__(self) -> Tutorial:
        return self

    def __exit__(self, *_: object) -> None:
        self.environments.close()

    def turn(self, decisions: int) -> float:
        """Trains for that many more decisions and returns how many there were a second."""
        before, began = self.dqn.num_timesteps, time.perf_counter()
        self.dqn.learn(decisions, reset_num_timesteps=False)
        return (self.dqn.num_timesteps - before) / (time.perf_counter() - began)


def check(config: Config) -> None:
    """Raises ConfigError if the environments of the tutorials do not have what the configuration asks for."""
    require_extra("conventional_stack.fleet").check(config)
    if config.world.name in FAMILIES:
        raise ConfigError(f"the tutorials' world must be 'paper' or an MJCF file, not '{config.world.name}'")
    if config.env.reward != "progress" or config.env.sensor != "events":
        raise ConfigError(
            "the tutorials' drone has events and a reward of straight metres; set env.reward to 'progress'"
        )


def measure(config: Config, drones: int, decisions: int, repeats: int) -> dict[str, Any]:
    """Measures and returns the report that `--json` writes.

    Raises:
        ConfigError: if this stack does not support the configuration.
        MissingPackageError: if a package of the extra `bench` is not installed.
    """
    check(config)
    ours = WholeStep(config, run_missions(config).training.env_params, choose_devices(0, config.train.shards))
    turns: list[tuple[float, float]] = []
    with Tutorial(config, drones) as tutorial:
        tutorial.turn(2 * drones)  # the first decisions are random and nothing is learnt
        for _ in range(repeats):
            turns.append((tutorial.turn(decisions), ours.turn()))
    machine = json_report.machine(jax.devices())
    machine["versions"] |= {name: metadata.version(name) for name in PACKAGES}
    rates = [statistics.median(rate) for rate in zip(*turns, strict=True)]
    return {
        "workload": describe_workload(config, load_scene(resolve_world(config.world.name))),
        **machine,
        "drones": drones,
        "decisions_per_turn": decisions,
        "repeats": repeats,
        "rows": [
            {"name": name, "decisions_per_second": rate, "turns": [turn[column] for turn in turns]}
            for column, (name, rate) in enumerate(zip(("tutorial", "edqn_jax"), rates, strict=True))
        ],
        "ratio": statistics.median(fast / slow for slow, fast in turns),
    }


def table(report: dict[str, Any]) -> str:
    """Returns the report as Markdown."""
    tutorial, ours = (row["decisions_per_second"] for row in report["rows"])
    return "\n".join(
        [
            f"{report['device']}; medians of {report['repeats']}",
            "",
            "| training | decisions/s |",
            "| --- | ---: |",
            f"| as tutorials write it, {report['drones']} environments, a process each; no VAE | {tutorial:,.0f} |",
            f"| edqn_jax, {report['workload']['num_envs']} environments, the VAE learning throughout | {ours:,.0f} |",
            f"| ratio | {report['ratio']:,.0f} |",
        ]
    )


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    use_cpu_devices()
    args, config = parse(argv)
    report = measure(config, args.drones, args.decisions, args.repeats)
    print(table(report))
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
