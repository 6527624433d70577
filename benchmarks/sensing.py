"""What does a look cost? The bytes that each sensor gives for a decision, and the time from photons to move.

The time is that of one drone on one core, from its poses on the host to the move there: the camera's pictures, the
events, code and Q-network, with dispatch. The sensors are timed in turns, 50 decisions of each again and again, so
that their ratios are those of one machine in one mood. Bytes are those of the sensor's output: 4 for an event (as in
Prophesee's format EVT 2.0), 1 for a pixel of a picture. Events are counted in greedy flights of the policy through test
worlds.

    python benchmarks/sensing.py --json sensing.json
    python benchmarks/sensing.py --policy runs/DIR --worlds rooms --missions 16
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import FAMILIES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.latency import decision_call, time_interleaved
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.sensor import SensorMemory, at_rest, frame_steps, frames_per_decision, sense
from edqn_jax.sim.task import group
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.observation import Observation, motion_size, own_size
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of
from measurement import json_report
from measurement.cores import keep_to, own_cores
from measurement.intervals import median_interval

SENSORS = ("events", "frames", "frame-pair")
BYTES_OF_AN_EVENT, BYTES_OF_A_PIXEL = 4, 1
BESIDE = "frames"
"""The sensor whose time is 1 in the ratios."""
CALLS, BLOCK = 2000, 50


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = Parser("sensing", __doc__)
    parser.add_argument("--policy", default="pretrained", help="run or policy that flies (default pretrained)")
    parser.add_argument("--worlds", nargs="+", default=["medium", "rooms"], choices=FAMILIES, help="of the flights")
    parser.add_argument("--missions", type=at_least_one, default=64, help="test worlds of each (default 64)")
    parser.add_argument("--calls", type=at_least_one, default=CALLS, help=f"decisions that are timed (default {CALLS})")
    args = parser.parse(argv)
    return args


def events_per_decision(policy: Policy, course: MissionSet) -> float:
    """Returns the mean number of events that a drone gets for a decision, in greedy flights of the missions."""
    count, decisions = _flown(policy.config, course.env_params, policy.params)
    return float(count) / float(decisions)


@partial(jax.jit, static_argnums=0)
def _flown(config: Config, world: EnvParams, params: PolicyParams) -> tuple[jax.Array, jax.Array]:
    """Returns the events of all flights, and their decisions."""
    missions = world.missions.scene.shape[0]
    number, keys = jnp.arange(missions), jax.random.split(jax.random.key(0), missions)
    actor, task = AgentActor(config), task_of(config)
    step_all = jax.vmap(partial(task.step, world))
    act = jax.vmap(partial(actor.act, params, key=jax.random.key(1)))  # greedy: the key has no effect
    state = jax.vmap(partial(task.begin, world))(keys, number)
    state, first = step_all(state, jnp.zeros(missions, jnp.int32), number)
    memory = jnp.broadcast_to(actor.init(), (missions, *actor.init().shape))

    def decide(carry: Any, _: None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        state, seen, memory, flying = carry
        move, memory = act(memory, seen)
        state, step = step_all(state, move, number)
        field = step.observation.sensed
        assert isinstance(field, EventField)
        events = jnp.sum(field.count, axis=(-3, -2, -1))
        now = jnp.sum(jnp.where(flying, events, 0)), jnp.sum(flying)
        return (state, step.observation, memory, flying & (step.outcome == Outcome.RUNNING)), now

    carry = state, first.observation, memory, jnp.ones(missions, bool)
    _, (events, decisions) = jax.lax.scan(decide, carry, None, length=config.env.max_decisions)
    return jnp.sum(events), jnp.sum(decisions)


def look_call(config: Config, params: PolicyParams, scene: Scene) -> Callable[[], int]:
    """Returns what leads from poses on the host to an action there: pictures, events, code and Q-network.

    Args:
        scene: what the camera sees, level, from the world's own start, in a flight ahead.
    """
    steps = len(frame_steps(config))
    place = np.asarray(scene.start) + np.linspace(-0.3, 0.0, steps)[:, None] * np.array([1.0, 0.0, 0.0])
    poses = Flight(
        position=jnp.asarray(place, jnp.float32),
        quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (steps, 1)),
        velocity=jnp.tile(jnp.array([4.0, 0.0, 0.0]), (steps, 1)),
    )
    before, actor = at_rest(config, jax.random.key(0)), AgentActor(config)
    poses, before, memory = jax.tree.map(np.asarray, (poses, before, actor.init()))  # on the host

    @jax.jit
    def act(
        params: PolicyParams, scene: Scene, poses: Flight, before: SensorMemory, memory: Array, key: Array
    ) -> Array:
        sensed, _ = sense(config, scene, poses, before, key)
        seen = Observation(sensed=sensed, own=jnp.zeros(own_size(config)), motion=jnp.zeros(motion_size(config)))
        return actor.act(params, memory, seen, key)[0]

    params, scene, key = jax.device_put(params), jax.device_put(scene), jax.random.key(0)
    return lambda: int(act(params, scene, poses, before, memory, key))


def rows_of(policy: Policy, course: MissionSet, calls: int) -> list[dict[str, Any]]:
    """Returns what each sensor costs in these worlds; networks are as large as the policy's, and untrained."""
    seen = [
        dataclasses.replace(policy.config, env=dataclasses.replace(policy.config.env, sensor=sensor))
        for sensor in SENSORS
    ]
    params = [fresh_policy(config) for config in seen]
    looks = [look_call(config, each, course.scene()) for config, each in zip(seen, params, strict=True)]
    acts = [decision_call(config, each) for config, each in zip(seen, params, strict=True)]
    look, act = (1e3 * time_interleaved(works, calls, BLOCK) for works in (looks, acts))
    rows = []
    for number, (sensor, config) in enumerate(zip(SENSORS, seen, strict=True)):
        events = events_per_decision(policy, course) if sensor == "events" else None
        pixels = frames_per_decision(config) * config.camera.width * config.camera.height
        ratio, low, high = ratio_of(look[number], look[SENSORS.index(BESIDE)])
        rows.append(
            {
                "world": course.name,
                "sensor": sensor,
                "events_per_decision": events,
                "bytes_per_decision": BYTES_OF_A_PIXEL * pixels if events is None else BYTES_OF_AN_EVENT * events,
                "photons_to_move_ms": float(np.median(look[number])),
                "photons_to_move_p99_ms": float(np.percentile(look[number], 99)),
                "over_frames": ratio,
                "over_frames_interval": [low, high],
                "data_to_move_ms": float(np.median(act[number])),
            }
        )
    return rows


def ratio_of(times: np.ndarray, others: np.ndarray) -> tuple[float, float, float]:
    """Returns the median ratio of `times` [calls] to `others`, turn by turn, and its 95 % interval."""
    turns = [slice(begun, begun + BLOCK) for begun in range(0, len(times), BLOCK)]
    ratios = [float(np.median(times[turn]) / np.median(others[turn])) for turn in turns]
    return float(np.median(ratios)), *median_interval(ratios)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table."""
    lines = [
        "| world | sensor | events a decision | bytes a decision | photons to move, ms (99 %) | over frames "
        "(95 % interval) | data to move, ms |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in rows:
        events = "–" if row["events_per_decision"] is None else f"{row['events_per_decision']:,.0f}"
        low, high = row["over_frames_interval"]
        lines.append(
            f"| {row['world']} | {row['sensor']} | {events} | {row['bytes_per_decision']:,.0f} "
            f"| {row['photons_to_move_ms']:.2f} ({row['photons_to_move_p99_ms']:.2f}) "
            f"| {row['over_frames']:.2f} ({low:.2f} to {high:.2f}) | {row['data_to_move_ms']:.2f} |"
        )
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    args = parse(argv)
    keep_to(own_cores()[:1])  # before JAX starts its threads
    policy = load_policy(args.policy)
    if policy.config.env.sensor != "events":
        raise ConfigError(f"'{args.policy}' sees {policy.config.env.sensor}; --policy must be one that sees events")
    group.check_alone(policy.config, "this benchmark")
    courses = [load_missions(policy.config, world, args.missions) for world in args.worlds]
    rows = [row for course in courses for row in rows_of(policy, course, args.calls)]
    print(table(rows))
    report = {"cores": 1, "missions": args.missions, "calls": args.calls, "rows": rows}
    json_report.write(args.json, json_report.machine(jax.devices()) | report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
