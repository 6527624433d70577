"""One method on one world, kept alive: a child of `runtime.py`.

Started as `python -P rival.py NAME CONFIG.yaml SECONDS MISSIONS`, the last two a planner's budget and how many
missions it is given. It says what it is, or `reason`, why it is not there; then, for each seed that it is asked for,
how that went.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, TextIO

import jax

from edqn_jax.config import Config
from edqn_jax.config.loading import apply, load_layer
from edqn_jax.errors import ConfigError
from edqn_jax.parallel.devices import use_cpu_devices
from edqn_jax.planners.packages import MissingPackageError
from edqn_jax.planners.planner import PLANNERS
from edqn_jax.runs.directory import plain
from measurement.child import answers
from measurement.peak_memory import peak_of
from rivals.learners import Learner
from rivals.planning import Planning
from rivals.stack import STACK, STEADY, Stack


def peak_bytes(workers: int) -> dict[str, int | None]:
    """The most memory held so far, by this process and the `workers` bytes of others, and on an accelerator, if any."""
    stats = jax.devices()[0].memory_stats() or {}
    return {"peak_bytes": (peak_of() or 0) + workers, "device_peak_bytes": stats.get("peak_bytes_in_use")}


def method(name: str, config: Config, seconds: float, missions: int) -> Any:
    """What the name stands for: something with `about` and `turn`.

    Raises:
        ConfigError: if the configuration cannot be run.
        MissingPackageError: if a package that it needs is not installed.
    """
    if name in PLANNERS:
        return Planning(name, config, seconds, missions)
    return {STACK: Stack, **STEADY}.get(name, Learner)(config)


def main(stream: TextIO) -> None:
    """Answers until the input ends."""
    name, file, seconds, missions = sys.argv[1:]
    config = apply(Config(), load_layer(Path(file)), file)
    use_cpu_devices()

    def say(what: dict[str, Any]) -> None:
        print(json.dumps(plain(what), allow_nan=False), file=stream)

    try:
        rival = method(name, config, float(seconds), int(missions))
    except (ConfigError, MissingPackageError) as error:
        say({"reason": str(error)})
        return
    say(rival.about)
    for line in sys.stdin:
        turn = rival.turn(int(line))
        workers = turn.pop("workers_peak_bytes", 0)
        say({**turn, **peak_bytes(workers)})


if __name__ == "__main__":
    main(answers())
