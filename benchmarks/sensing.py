"""What does a look cost? The bytes that each sensor gives for a decision, and the time from photons to move.

The time is that of one drone on one core, from its poses on the host to the move there: the camera's pictures, the
events, code and Q-network, with dispatch. Bytes are those of the sensor's output: 4 for an event (as in Prophesee's
format EVT 2.0), 1 for a pixel of a picture. Events are counted in greedy flights of the policy through test worlds.

    python benchmarks/sensing.py --json sensing.json
    python benchmarks/sensing.py --policy runs/DIR --worlds rooms --missions 16
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.latency import decision_seconds, look_seconds
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.learn import policy as acting
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.runs.files import check_can_write
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim import env
from edqn_jax.sim.events import EventField
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.sim.sensor import frames_per_decision
from measurement import json_report

SENSORS = ("events", "frames", "frame-pair")
BYTES_OF_AN_EVENT, BYTES_OF_A_PIXEL = 4, 1
CALLS = 2000


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = argparse.ArgumentParser(
        prog="python benchmarks/sensing.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", default="pretrained", help="run or policy that flies (default pretrained)")
    parser.add_argument("--worlds", nargs="+", default=["medium", "rooms"], choices=FAMILIES, help="of the flights")
    parser.add_argument("--missions", type=int, default=64, help="test worlds of each (default 64)")
    parser.add_argument("--calls", type=int, default=CALLS, help=f"decisions that are timed (default {CALLS})")
    parser.add_argument("--json", type=Path, help="write the report to this file")
    args = parser.parse_args(argv)
    for name in ("missions", "calls"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, not {getattr(args, name)}")
    return args


def events_per_decision(policy: Policy, course: MissionSet) -> float:
    """Returns the mean number of events that a drone gets for a decision, in greedy flights of the missions."""
    count, decisions = _flown(policy.config, course.world, policy.params)
    return float(count) / float(decisions)


@partial(jax.jit, static_argnums=0)
def _flown(config: Config, world: env.World, params: acting.PolicyParams) -> tuple[jax.Array, jax.Array]:
    """Returns the events of all flights, and their decisions."""
    missions = world.missions.scene.shape[0]
    number, keys = jnp.arange(missions), jax.random.split(jax.random.key(0), missions)
    act = jax.vmap(partial(acting.act, config, params, key=jax.random.key(1)))  # greedy: the key has no effect
    state = jax.vmap(partial(env.ended, config, world))(keys, number)
    state, first = jax.vmap(partial(env.step, config, world))(state, jnp.zeros(missions, jnp.int32), number)
    memory = jnp.broadcast_to(acting.empty_memory(config), (missions, *acting.empty_memory(config).shape))

    def decide(carry: Any, _: None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        state, seen, memory, flying = carry
        move, memory = act(memory, seen)
        state, step = jax.vmap(partial(env.step, config, world))(state, move, number)
        field = step.observation.sensed
        assert isinstance(field, EventField)
        events = jnp.sum(field.count, axis=(-3, -2, -1))
        now = jnp.sum(jnp.where(flying, events, 0)), jnp.sum(flying)
        return (state, step.observation, memory, flying & (step.outcome == Outcome.RUNNING)), now

    carry = state, first.observation, memory, jnp.ones(missions, bool)
    _, (events, decisions) = jax.lax.scan(decide, carry, None, length=config.env.max_decisions)
    return jnp.sum(events), jnp.sum(decisions)


def row_of(policy: Policy, course: MissionSet, sensor: str, calls: int) -> dict[str, Any]:
    """Returns what a sensor costs in these worlds; networks are as large as the policy's, and untrained."""
    config = policy.config
    events = events_per_decision(policy, course) if sensor == "events" else None
    seen = dataclasses.replace(config, env=dataclasses.replace(config.env, sensor=sensor))
    pixels = frames_per_decision(seen) * config.camera.width * config.camera.height
    params = fresh_policy(seen)
    look = 1e3 * look_seconds(seen, params, course.scene(), calls)
    act = 1e3 * decision_seconds(seen, params, calls)
    return {
        "world": course.name,
        "sensor": sensor,
        "events_per_decision": events,
        "bytes_per_decision": BYTES_OF_A_PIXEL * pixels if events is None else BYTES_OF_AN_EVENT * events,
        "photons_to_move_ms": float(np.median(look)),
        "photons_to_move_p99_ms": float(np.percentile(look, 99)),
        "data_to_move_ms": float(np.median(act)),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table."""
    lines = [
        "| world | sensor | events a decision | bytes a decision | photons to move, ms (99 %) | data to move, ms |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for row in rows:
        events = "–" if row["events_per_decision"] is None else f"{row['events_per_decision']:,.0f}"
        lines.append(
            f"| {row['world']} | {row['sensor']} | {events} | {row['bytes_per_decision']:,.0f} "
            f"| {row['photons_to_move_ms']:.2f} ({row['photons_to_move_p99_ms']:.2f}) | {row['data_to_move_ms']:.2f} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    args = parse(argv)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX starts its threads
    try:
        if args.json is not None:
            check_can_write(args.json)
        policy = load_policy(args.policy)
        if policy.config.env.sensor != "events":
            raise ConfigError(f"'{args.policy}' sees {policy.config.env.sensor}; --policy must be one that sees events")
        courses = [load_missions(policy.config, world, args.missions) for world in args.worlds]
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    rows = [row_of(policy, course, sensor, args.calls) for course in courses for sensor in SENSORS]
    print(table(rows))
    if args.json is not None:
        json_report.write(
            args.json,
            {
                **json_report.machine(jax.devices()),
                "cores": 1,
                "missions": args.missions,
                "calls": args.calls,
                "rows": rows,
            },
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
