"""The process of `runtime.py` that runs one method on one world.

Started as `python -P rival.py NAME CONFIG.yaml SECONDS MISSIONS`; the last two are the budget and the number of
missions of a planner. It prints a description of the method, or `reason`, why it cannot run; then, for each seed in
its input, the result.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, TextIO

import jax

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, load_layer
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.extras import MissingPackageError
from edqn_jax.runs.directory import to_plain_json
from measurement.child import answers
from measurement.peak_memory import peak_of
from rivals.learners import Learner
from rivals.planners.planner import PLANNERS
from rivals.planning import Planning
from rivals.stack import STACK, STEADY, Stack


def peak_bytes(workers: int) -> dict[str, int | None]:
    """Returns the peak memory so far of this process plus `workers` bytes of others, and of the accelerator if any."""
    stats = jax.devices()[0].memory_stats() or {}
    return {"peak_bytes": (peak_of() or 0) + workers, "device_peak_bytes": stats.get("peak_bytes_in_use")}


def method(name: str, config: Config, seconds: float, missions: int) -> Any:
    """Returns the method of that name, which has `about` and `turn`.

    Raises:
        ConfigError: if the configuration is invalid.
        MissingPackageError: if a required package is not installed.
    """
    if name in PLANNERS:
        return Planning(name, config, seconds, missions)
    return {STACK: Stack, **STEADY}.get(name, Learner)(config)


def main(stream: TextIO) -> None:
    """Answers until the input ends."""
    name, file, seconds, missions = sys.argv[1:]
    config = apply_layer(Config(), load_layer(Path(file)), file)
    use_cpu_devices()

    def send(what: dict[str, Any]) -> None:
        print(json.dumps(to_plain_json(what), allow_nan=False), file=stream)

    try:
        rival = method(name, config, float(seconds), int(missions))
    except (ConfigError, MissingPackageError) as error:
        send({"reason": str(error)})
        return
    send(rival.about)
    for line in sys.stdin:
        turn = rival.turn(int(line))
        workers = turn.pop("workers_peak_bytes", 0)
        send({**turn, **peak_bytes(workers)})


if __name__ == "__main__":
    main(answers())
