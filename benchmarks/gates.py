"""How far does a drone come that does not look? Flies the test missions of random worlds without a policy.

`hover` stays where it starts; `straight` takes at every decision the move whose direction is nearest to that of the
goal. With the policies of the sensors `blind`, `depth` and `depth-motion` (benchmarks/success.py) they say what a world
asks for: a policy that sees must be well ahead of these two and of the blind one.

    python benchmarks/gates.py --world moving
    python benchmarks/gates.py --world medium --missions 1000 -- --world.balls 8

Arguments after -- are options of train.py. The interval is Wilson's, 95 %.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import FAMILIES, Config
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.evaluation.intervals import rate_interval
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import flight_keys
from edqn_jax.keys import run_streams
from edqn_jax.sim.actions import DIRECTIONS, move_number
from edqn_jax.sim.physics.drone import DroneState, yaw_of
from edqn_jax.sim.task.env import EnvParams, EnvState
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of
from measurement import json_report
from measurement.flags import parse_options, split, with_test_worlds_only


def hover(body: DroneState, goal: Array) -> Array:
    """Returns the move [] that goes nowhere."""
    return move_number("hover")


def straight(body: DroneState, goal: Array) -> Array:
    """Returns the move [] whose direction is nearest to that of the goal [3], metres."""
    way = goal - body.position
    yaw = yaw_of(body.quaternion)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    ahead = jnp.stack([cos * way[0] + sin * way[1], cos * way[1] - sin * way[0], way[2]])
    nearest = jnp.argmax(DIRECTIONS @ ahead)
    return nearest + (nearest >= move_number("hover"))  # DIRECTIONS has no hovering among them


GATES: dict[str, Callable[[DroneState, Array], Array]] = {"hover": hover, "straight": straight}
"""By name: the move [] of a drone that is on its way to a goal."""


@partial(jax.jit, static_argnums=(0, 2))
def outcomes(config: Config, world: EnvParams, gate: str, key: Array) -> Array:
    """Returns the outcome [M] int32 of each of the world's M missions."""
    number, task = jnp.arange(world.missions.scene.shape[0]), task_of(config)
    keys, _ = flight_keys(key, len(number))

    def decide(flying: tuple[EnvState, Array, Array]) -> tuple[EnvState, Array, Array]:
        state, outcome, _ = flying
        action = jax.vmap(GATES[gate])(state.drone, world.missions.goal[state.mission])
        state, step = task.map(partial(task.step, world))(state, action, number)
        return state, jnp.where(outcome == Outcome.RUNNING, step.outcome, outcome), step.episode_length

    start = jax.vmap(partial(task.begin, world))(keys, number), jnp.zeros_like(number), number
    return jax.lax.while_loop(lambda flying: jnp.any(flying[1] == Outcome.RUNNING), decide, start)[1]


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0; 2 for invalid input."""
    words, flags = split(argv)
    parser = Parser("gates", __doc__, json="write the rows to this file")
    parser.add_argument("--world", default="moving", choices=FAMILIES, help="(default moving)")
    parser.add_argument("--missions", type=at_least_one, default=1000, help="test missions (default 1000)")
    args = parser.parse(words)
    config = with_test_worlds_only(parse_options(["--world", args.world, "--env.sensor", "blind", *flags]))
    use_cpu_devices()
    missions = load_missions(config, args.world, args.missions)
    names = [outcome.name.lower().replace("_", " ") for outcome in Outcome if outcome != Outcome.RUNNING]
    print(f"| gate | success | 95 % interval | {' | '.join(names)} |\n| --- | ---: | --- |{' ---: |' * len(names)}")
    rows = []
    for gate in GATES:
        flown = np.asarray(outcomes(config, missions.env_params, gate, run_streams(0).flights))
        counts = Counter(Outcome(int(kind)).name.lower().replace("_", " ") for kind in flown)
        low, high = rate_interval((flown == Outcome.GOAL)[None])
        rows.append({"gate": gate, "missions": args.missions, "interval": [low, high], **counts})
        cells = " | ".join(str(counts[name]) for name in names)
        print(f"| {gate} | {counts['goal'] / args.missions:.1%} | {low:.1%} to {high:.1%} | {cells} |", flush=True)
    report = {"benchmark": "gates", "world": args.world, "options": flags, "rows": rows}
    json_report.write(args.json, report | json_report.machine(jax.devices()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
