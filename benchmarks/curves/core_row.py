"""The process that measures one row of `scaling.py --cores`, on the cores that it is given.

Started as `python -P core_row.py SPEC [flags of train.py]`, with the benchmarks on PYTHONPATH; SPEC is JSON: `cpus`,
numbers of cores, and `environments` a core. It prints lines of JSON: once everything is compiled, a description; then,
for each line of its input, `step`, `rollout` or `rates`, a measurement.
"""

from __future__ import annotations

import json
import os
import sys

SPEC = json.loads(sys.argv[1])
# Before JAX and MuJoCo count the cores, and NumPy starts its threads.
os.sched_setaffinity(0, SPEC["cpus"])
os.environ["JAX_PLATFORMS"] = "cpu"

import math  # noqa: E402
from typing import Any  # noqa: E402

from curves.cores import with_cores  # noqa: E402
from edqn_jax.devices.devices import choose_devices, use_cpu_devices  # noqa: E402
from edqn_jax.evaluation.missions import run_missions  # noqa: E402
from edqn_jax.runs.provenance import describe_workload  # noqa: E402
from measurement import json_report  # noqa: E402
from measurement.ceilings import Rollout  # noqa: E402
from measurement.child import answers  # noqa: E402
from measurement.conditions import Watch, rates  # noqa: E402
from measurement.flags import parse_config  # noqa: E402
from measurement.whole import WholeStep  # noqa: E402

TURN_SECONDS = 1.0
"""Minimum duration of a turn."""


class Measured:
    """The compiled training step, and C MuJoCo's rollout, on these cores."""

    def __init__(self, cores: int, environments: int, flags: list[str]) -> None:
        config = with_cores(parse_config(flags), cores, environments)
        missions = run_missions(config)
        devices = choose_devices(cores, config.train.shards)
        self.whole = WholeStep(config, missions.training.env_params, devices)
        self.chunks = math.ceil(TURN_SECONDS * self.whole.turn() / self.whole.decisions)
        self.rollout = Rollout(config)
        self.rollout.turn()
        self.about = {
            "workload": {**describe_workload(config, missions.scene), "world": config.world.name},
            **json_report.machine(devices),
            "compile_seconds": self.whole.compile_seconds,
        }

    def answer(self, asked: str) -> Any:
        """Returns decisions/s of a turn with its conditions, physics steps/s of the rollout, or rates of a thread."""
        if asked == "rollout":
            return self.rollout.turn()
        if asked == "rates":
            return rates()
        watch = Watch()
        for _ in range(self.chunks):
            self.whole.turn()
        seen = watch.so_far()
        return self.chunks * self.whole.decisions / (seen["seconds"] or math.inf), seen


def main() -> None:
    """Answers until the input ends."""
    stream = answers()
    use_cpu_devices()
    measured = Measured(len(SPEC["cpus"]), SPEC["environments"], sys.argv[2:])
    print(json.dumps(measured.about), file=stream)
    for line in sys.stdin:
        print(json.dumps(measured.answer(line.strip())), file=stream)


if __name__ == "__main__":
    main()
