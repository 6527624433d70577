"""One side of `compare.py`: times rows of the commit whose package and benchmarks stand first on PYTHONPATH.

Started as `python -P worker.py ROWS [throughput.py's words] [-- train.py's flags]`, ROWS in JSON, [] for all. What
is timed, and how, is the commit's own `throughput.py`: of it the worker needs `parse`, `WholeStep`, `parts_of` and
`Timed`. Speaks lines of JSON: first what it is, when everything is compiled; then, for each line that names a row,
the microseconds of one device that a decision takes, measured anew; until its input ends.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

import edqn_jax
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.trainer import AXIS
from edqn_jax.parallel.devices import choose_devices, processor, use_cpu_devices
from edqn_jax.runs.provenance import versions, workload

WHOLE = "whole_training_step"


def prepare(wanted: Sequence[str], words: Sequence[str]) -> tuple[dict[str, Any], dict[str, Callable[[], float]]]:
    """What the worker is, and the turn of every wanted row that the commit has."""
    import throughput  # the commit's own, so it must not be looked up before this is a worker

    _, config = throughput.parse(words)
    missions = run_missions(config)
    devices = choose_devices(config.train.devices, config.train.shards)
    whole = throughput.WholeStep(config, missions.training.world, devices)
    turns: dict[str, Callable[[], float]] = {WHOLE: lambda: 1e6 * len(devices) / whole.turn()}
    if set(wanted) != {WHOLE}:
        # A copy: the next chunk is given the state itself.
        state = jax.tree.map(lambda x: jax.device_put(x, devices[0]).copy(), whole.state)
        mesh = Mesh(np.asarray(devices), (AXIS,))
        for part in throughput.parts_of(config, missions.training.world, state):
            if not wanted or part.name in wanted:
                turns[part.name] = throughput.Timed(part, mesh, config.train.num_envs).turn
    about = {
        "package": edqn_jax.__file__,
        "rows": [name for name in turns if not wanted or name in wanted],
        "workload": {**workload(config, missions.scene), "world": config.world.name},
        "device": processor() if devices[0].platform == "cpu" else devices[0].device_kind,
        "devices": [str(device) for device in devices],
        "versions": versions(),
    }
    return about, turns


def main() -> None:
    """Answers until the input ends."""
    # Whatever else prints must not be taken for an answer.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    use_cpu_devices()
    about, turns = prepare(json.loads(sys.argv[1]), sys.argv[2:])
    print(json.dumps(about), file=answers)
    for line in sys.stdin:
        print(json.dumps(turns[line.strip()]()), file=answers)


if __name__ == "__main__":
    main()
