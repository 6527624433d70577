"""How long does one decision take where an exported policy flies, from a packet of events to the command?

The runner's own time, with NumPy and onnxruntime on one core: counting the events, the own state, the network and the
command. Packets are those of a simulated flight, at the resolution of a camera. Needs the extra `export`.

    python benchmarks/deployed.py --json deployed.json
    python benchmarks/deployed.py pretrained --camera 346 260
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import flight_trajectory
from edqn_jax.extras import require_extra
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.interop.deployment.runner import Runner
from edqn_jax.interop.recordings.flight_events import flight_recording
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy
from edqn_jax.runs.provenance import describe_workload
from measurement import json_report
from measurement.cores import keep_to, own_cores

REPEATS, CALLS = 5, 2000

WORLD = "medium"
"""Where the flight is whose packets are timed: the first test world."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments.

    Raises:
        ConfigError: if the file cannot be written, or the camera has no pixels.
    """
    parser = Parser("deployed", __doc__)
    parser.add_argument("run", nargs="?", type=Path, default=Path("pretrained"), help="folder of a run, or pretrained")
    parser.add_argument("--camera", nargs=2, type=int, metavar=("W", "H"), help="pixels (default: the policy's)")
    parser.add_argument("--quick", action="store_true", help=f"{CALLS // 10} decisions instead of {REPEATS} x {CALLS}")
    args = parser.parse(argv)
    if args.camera is not None and min(args.camera) < 1:
        raise ConfigError(f"--camera must be two numbers of at least 1, not {args.camera[0]} {args.camera[1]}")
    return args


def measure(policy: Policy, camera: tuple[int, int] | None, repeats: int, calls: int) -> dict[str, Any]:
    """Returns the report that `--json` writes: medians over `repeats` of the percentiles of `calls` decisions."""
    missions = load_missions(policy.config, WORLD, 1, 0, None, None)
    flights = fly_on_all_devices(policy.config, missions.env_params, policy.params, 0, record=True)
    recording = flight_recording(policy.config, missions.env_params, flight_trajectory(policy.config, flights), camera)
    with tempfile.TemporaryDirectory() as folder:
        file = export_policy(policy, Path(folder) / "policy.onnx").file
        size = file.stat().st_size
        runner = Runner(file, camera=recording.size())
    given = _decisions(runner, recording, missions.env_params)
    turns = []
    for _ in range(repeats):
        runner.reset()
        milliseconds = 1e3 * _seconds(runner, given, calls)
        turns.append(dict(zip(("median", "p99"), np.percentile(milliseconds, [50, 99]), strict=True)))
    return {
        "workload": describe_workload(policy.config, missions.scene()),
        **json_report.machine(jax.devices()),
        "onnxruntime": require_extra("onnxruntime", extra="export").__version__,
        "cores": 1,
        "decisions": repeats * calls,
        "camera": list(recording.size()),
        "events_per_packet": float(np.mean([len(packet) for packet, _, _ in given])),
        "bytes_of_the_policy": size,
        "rows": [
            {
                "name": "packet_to_command",
                **{f"{key}_ms": statistics.median(float(turn[key]) for turn in turns) for key in turns[0]},
            }
        ],
    }


def _decisions(runner: Runner, recording: Any, world: Any) -> list[tuple[np.ndarray, int, dict[str, Any]]]:
    """Returns packet, end of the window and state of each decision of the flight."""
    flight, stream = recording.flight, recording.events
    goal, volume = np.asarray(world.missions.goal[0]), np.asarray(world.pool.volume[0])
    steps = round(runner.period_s * 1e6) // int(flight["t"][1] - flight["t"][0])
    decisions = []
    for row in range(steps, len(flight["t"]), steps):
        until = int(flight["t"][row])
        first, last = np.searchsorted(stream["t"], [until - runner.window_us, until])
        state = {name: flight[name][row] for name in ("position", "quaternion", "velocity")}
        decisions.append((stream[first:last], until, {**state, "yaw_rate": 0.0, "goal": goal, "volume": volume}))
    return decisions


def _seconds(runner: Runner, given: list[tuple[np.ndarray, int, dict[str, Any]]], calls: int) -> np.ndarray:
    """Returns the seconds [calls] of each decision, without some first ones."""
    seconds, warm = [], 20
    for number in range(calls + warm):
        packet, until, state = given[number % len(given)]
        began = time.perf_counter()
        runner.decide(packet, until, **state)
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[warm:])


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    args = parse(argv)
    keep_to(own_cores()[:1])  # before JAX and onnxruntime start their threads
    camera = None if args.camera is None else (args.camera[0], args.camera[1])
    report = measure(load_policy(args.run), camera, *((1, CALLS // 10) if args.quick else (REPEATS, CALLS)))
    row = report["rows"][0]
    width, height = report["camera"]
    print(
        f"From {report['events_per_packet']:,.0f} events of {width} x {height} pixels to the command, on one core: "
        f"median {row['median_ms']:.2f} ms, 99th percentile {row['p99_ms']:.2f} ms ({report['decisions']:,} decisions, "
        f"{report['device']})"
    )
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
