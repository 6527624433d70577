"""The rows of `scaling.py --cores`: training on more and more cores, with as many environments on each.

Every row is a process of its own that may run on so many cores alone, so that JAX, XLA's threads and C MuJoCo's see no
others. The process with the fewest cores stays, and takes turns with each of the others.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import statistics
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from curves.sizes import replace_options
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from measurement.child import Child, ChildEndedError
from measurement.conditions import middle
from measurement.whole import steady

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).with_name("core_row.py")
TOPOLOGY = Path("/sys/devices/system/cpu")

HEAD = (
    "| cores | environments a core | decisions/s | over the first row | C MuJoCo steps/s | over the first row "
    "| physics steps in training over C MuJoCo's | cores busy | with others | stolen | compiling, s |\n|"
) + " ---: |" * 11


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is measured."""

    cores: tuple[int, ...]
    environments: tuple[int, ...]
    """A core."""
    repeats: int
    limit_s: float
    """Of a row; one that takes longer is ended, and said to have been."""
    flags: tuple[str, ...] = ()
    """Of train.py."""


def with_cores(base: Config, cores: int, environments: int) -> Config:
    """Returns the steady workload for so many cores, with so many environments on each.

    Batches and the replay grow with the environments, updates a step do not; there are as many shards as needed.

    Raises:
        ConfigError: if it is invalid.
    """
    many, agent = cores * environments, base.agent
    shards = math.lcm(base.train.shards, cores)
    batch, replay = (
        max(shards, round(size * many / base.train.num_envs / shards) * shards)
        for size in (agent.batch_size, agent.replay_size)
    )
    train = {"num_envs": many, "shards": shards, "devices": cores}
    encoder = {"batch_size": many, "warmup_updates_per_step": 1}
    changed = replace_options(base, train=train, agent={"batch_size": batch, "replay_size": replay}, encoder=encoder)
    return steady(changed, base.train.chunk_steps)


def choose_cpus(count: int, allowed: Sequence[int], topology: Path = TOPOLOGY) -> list[int]:
    """Returns the numbers of `count` of the allowed CPUs: of one package, and one of each core, as long as there are.

    Raises:
        ConfigError: if there are fewer.
    """
    if count > len(allowed):
        raise ConfigError(f"--cores must be at most {len(allowed)}, the cores of this process, not {count}")
    places = {cpu: _place(cpu, topology) for cpu in allowed}
    seen: dict[tuple[int, int], int] = {}
    order = []
    for cpu in sorted(allowed):
        thread = seen[places[cpu]] = seen.get(places[cpu], -1) + 1
        order.append((thread, *places[cpu], cpu))
    return [cpu for *_, cpu in sorted(order)[:count]]


def physical_cores(cpus: Sequence[int], topology: Path = TOPOLOGY) -> int:
    """Returns how many cores have these CPUs, of which a core with two threads is two."""
    return len({_place(cpu, topology) for cpu in cpus})


def _place(cpu: int, topology: Path) -> tuple[int, int]:
    """Returns package and core of a CPU; a core of its own where the system does not tell."""
    folder = topology / f"cpu{cpu}" / "topology"
    try:
        package, core = (int((folder / name).read_text()) for name in ("physical_package_id", "core_id"))
    except (OSError, ValueError):
        return 0, cpu
    return package, core


def measure_rows(plan: Plan, folder: Path) -> Iterator[dict[str, Any]]:
    """Yields a row for each number of environments and of cores, as they end; one that failed has `error`.

    Args:
        plan: what is measured.
        folder: for what the processes print.

    Raises:
        ConfigError: if there are fewer cores.
    """
    allowed = sorted(os.sched_getaffinity(0))
    chosen = {count: choose_cpus(count, allowed) for count in sorted(set(plan.cores))}
    for environments in plan.environments:
        first: Child | None = None
        with contextlib.ExitStack() as kept:
            for count, cpus in chosen.items():
                with contextlib.ExitStack() as scope:
                    spec = json.dumps({"cpus": cpus, "environments": environments})
                    log = folder / f"{count}-{environments}.log"
                    own = scope.enter_context(Child(ROOT, SCRIPT, [spec, *plan.flags], log))
                    measured = _within_limit(own, first, plan)
                    about = {"name": f"{count} cores of {environments} environments", "cores": count, "cpus": cpus}
                    about |= {"physical_cores": physical_cores(cpus), "environments_per_core": environments}
                    if first is None and "error" not in measured:
                        first = own
                        kept.push(scope.pop_all())
                yield about | measured


def _within_limit(own: Child, first: Child | None, plan: Plan) -> dict[str, Any]:
    """Returns the measured part of a row, or why there is none."""
    began = time.perf_counter()
    ending = threading.Timer(plan.limit_s, own.process.kill)
    ending.start()
    try:
        return _measure(own, first, plan)
    except ChildEndedError as error:
        late = time.perf_counter() - began >= plan.limit_s
        return {"error": f"took more than {plan.limit_s:g} s" if late else str(error)}
    finally:
        ending.cancel()


def _measure(own: Child, first: Child | None, plan: Plan) -> dict[str, Any]:
    """Takes turns of the training step and the rollout, on these cores and on those of the first row."""
    about = own.answer()
    turns: dict[str, list[float]] = {name: [] for name in ("step", "rollout", "first_step", "first_rollout")}
    seen = []
    for _ in range(plan.repeats):
        rate, conditions = own.ask("step")
        turns["step"].append(rate)
        seen.append(conditions)
        turns["rollout"].append(own.ask("rollout"))
        if first is not None:
            turns["first_step"].append(first.ask("step")[0])
            turns["first_rollout"].append(first.ask("rollout"))
    figures = summary(turns, about["workload"]["physics_steps_per_decision"])
    return {**figures, "conditions": middle(seen) | own.ask("rates"), **about, "turns": turns}


def summary(turns: dict[str, list[float]], physics_steps: int) -> dict[str, float]:
    """Returns the figures of a row: medians, and medians of the ratios of turns.

    Args:
        turns: `step` in decisions/s and `rollout` in physics steps/s; `first_step` and `first_rollout` of the first
            row, empty in that row itself.
        physics_steps: a decision.
    """
    pairs = {"over_first": ("step", "first_step"), "c_mujoco_over_first": ("rollout", "first_rollout")}
    ratios = {name: _ratio(turns[a], turns[b] or turns[a]) for name, (a, b) in pairs.items()}
    return {
        "decisions_per_second": statistics.median(turns["step"]),
        "decisions_low": min(turns["step"]),
        "decisions_high": max(turns["step"]),
        **ratios,
        "c_mujoco_steps_per_second": statistics.median(turns["rollout"]),
        "over_c_mujoco_rollout": physics_steps * _ratio(turns["step"], turns["rollout"]),
    }


def _ratio(above: Sequence[float], below: Sequence[float]) -> float:
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def line(row: dict[str, Any]) -> str:
    """Returns a row of the table whose head is `HEAD`."""
    begin = f"| {row['cores']} | {row['environments_per_core']} |"
    if "error" in row:
        return f"{begin} {row['error']} |" + " |" * 8
    seen = row["conditions"]
    cells = (
        f"{row['decisions_per_second']:,.0f}",
        f"{row['over_first']:.2f}",
        f"{row['c_mujoco_steps_per_second']:,.0f}",
        f"{row['c_mujoco_over_first']:.2f}",
        f"{row['over_c_mujoco_rollout']:.3f}",
        f"{seen['cores_busy']:.2f}",
        "" if seen["cores_busy_with_others"] is None else f"{seen['cores_busy_with_others']:.2f}",
        "" if seen["steal"] is None else f"{seen['steal']:.1%}",
        f"{row['compile_seconds']:.1f}",
    )
    return f"{begin} " + " | ".join(cells) + " |"
