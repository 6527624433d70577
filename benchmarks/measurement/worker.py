"""The process that times one commit for `compare.py`.

Started as `python -P worker.py ROWS [--quick] [-- flags of train.py]`, with the commit's package and benchmarks first
on PYTHONPATH; ROWS is a JSON list of names, empty for all rows. It prints lines of JSON: once everything is compiled,
a description of what it times; then, for each line of its input that names a row, a new measurement of that row in
microseconds of one device per decision.

`compare.py` starts the worker of the commit that is timed. Arguments, description and answers are therefore an
interface between commits; later commits must keep it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

import edqn_jax
import throughput
from edqn_jax.devices.devices import choose_devices, use_cpu_devices
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn.trainer import AXIS
from edqn_jax.runs.provenance import describe_workload
from measurement import json_report
from measurement.child import answers
from measurement.parts import PARTS, parts_of
from measurement.timing import Timed
from measurement.whole import WHOLE, WholeStep


def prepare(wanted: Sequence[str], words: Sequence[str]) -> tuple[dict[str, Any], dict[str, Callable[[], float]]]:
    """Compiles the wanted rows.

    Args:
        wanted: names of rows; those that do not exist are left out. Empty for all.
        words: arguments of `throughput.py`.

    Returns:
        the description; a function for each row that measures it, in microseconds of one device per decision.
    """
    _, config = throughput.parse(words)
    missions = run_missions(config)
    devices = choose_devices(config.train.devices, config.train.shards)
    whole = WholeStep(config, missions.training.env_params, devices)
    turns: dict[str, Callable[[], float]] = {WHOLE: lambda: 1e6 * len(devices) / whole.turn()}
    names = [name for name in PARTS if not wanted or name in wanted]
    if names:
        # A copy, because the next chunk is given the state itself.
        state = jax.tree.map(lambda x: jax.device_put(x, devices[0]).copy(), whole.state)
        mesh = Mesh(np.asarray(devices), (AXIS,))
        for part in parts_of(config, missions.training.env_params, state, names):
            turns[part.name] = Timed(part, mesh, config.train.num_envs).turn
    about = {
        "package": edqn_jax.__file__,
        "rows": [name for name in turns if not wanted or name in wanted],
        "workload": {**describe_workload(config, missions.scene), "world": config.world.name},
        **json_report.machine(devices),
    }
    return about, turns


def main() -> None:
    """Answers until the input ends."""
    stream = answers()
    use_cpu_devices()
    about, turns = prepare(json.loads(sys.argv[1]), sys.argv[2:])
    print(json.dumps(about), file=stream)
    for line in sys.stdin:
        print(json.dumps(turns[line.strip()]()), file=stream)


if __name__ == "__main__":
    main()
