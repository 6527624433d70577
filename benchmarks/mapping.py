"""How well does the pilot fly that a drone engineer would build, A* on a map that grows, beside the learned agent?

Both fly the same test missions and know the same: one sensor, own state, goal and fence, and no map. The pilot's map
grows from true depth (an upper bound) or from what the policy's own decoder draws of the events; it plans on the map
anew at every decision. A decision is timed on the host, from the sensor's data to the command: code, decoder, map, plan
and follower, or code and Q-network. Of each collision of the pilot the table says what its map had of what was hit when
it chose its last command.

    python benchmarks/mapping.py --worlds rooms forest canyon medium --missions 200 --json mapping.json
    python benchmarks/mapping.py --split validation --missions 48 --methods decoded --set cell_m=0.5 range_m=8
    python benchmarks/mapping.py --worlds rooms --methods decoded --mission 3 --figure map.png

With --figure one mission is flown and drawn, as a PNG of six moments or as a GIF.
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import FAMILIES
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.latency import decision_seconds, time_interleaved
from edqn_jax.evaluation.metrics import summarise_flights
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.extras import MissingPackageError
from edqn_jax.files import write_atomically
from edqn_jax.learn.actor import AgentActor, PolicyParams, blank_observation
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.motion import Aim
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors.sensor import mount_rotation
from edqn_jax.sim.task import env
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.worlds import families
from measurement import json_report
from measurement.intervals import difference_interval
from rivals.mapping import grid
from rivals.mapping.grid import MapConfig
from rivals.mapping.growing_map import Moment, animate_growth, draw_growth
from rivals.planners.follow import FollowConfig

try:
    from rivals.mapping import pilot
    from rivals.mapping.pilot import TUNED, Orders, PilotConfig, Piloted
    from rivals.mapping.route import RouteConfig
except MissingPackageError as missing:
    print(missing, file=sys.stderr)
    sys.exit(2)

Row = dict[str, Any]

METHODS = {
    "true": "A* on the growing map, true depth",
    "decoded": "A* on the growing map, depth decoded from the sensor",
    "learned": "learned agent",
}
"""Methods by name, and as the table has them."""

KNOWN, TAKEN_FOR_FREE, UNSEEN = "known", "taken for free", "unseen"
"""What a map had of a place that was hit."""

PICTURES = 6
"""Moments that a PNG shows."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = Parser("mapping", __doc__)
    parser.add_argument("--policy", type=Path, default=Path("pretrained"), help="run or policy (default pretrained)")
    parser.add_argument("--worlds", nargs="+", default=["rooms"], choices=FAMILIES, help="families (default rooms)")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS, help="(default all)")
    parser.add_argument("--missions", type=int, default=200, help="worlds of each family (default 200)")
    parser.add_argument("--split", choices=("test", "validation"), default="test", help="tune on validation worlds")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="options of the pilot, its map, ...")
    parser.add_argument("--batch", type=int, default=16, help="drones side by side (default 16)")
    parser.add_argument("--calls", type=int, default=200, help="decisions that are timed (default 200)")
    parser.add_argument("--mission", type=int, default=0, help="world of --figure (default 0)")
    parser.add_argument("--figure", type=Path, help="draw one mission of the first method, a .png or .gif")
    args = parser.parse(argv)
    for name, least in (("missions", 1), ("batch", 1), ("calls", 1), ("mission", 0)):
        if getattr(args, name) < least:
            parser.error(f"--{name} must be at least {least}, not {getattr(args, name)}")
    if args.figure is not None and args.figure.suffix not in (".png", ".gif"):
        parser.error(f"--figure must end in .png or .gif, not '{args.figure}'")
    if args.figure is not None and args.methods[0] == "learned":
        parser.error("--figure draws a map, and the learned agent has none; name --methods true or decoded")
    return args


def with_options(base: PilotConfig, words: Sequence[str]) -> PilotConfig:
    """Returns a pilot with the options NAME=VALUE, each of the pilot, its map, its routes or its follower.

    Raises:
        ConfigError: if there is no such option, or its value is not possible.
    """
    changed = base
    for word in words:
        name, _, text = word.partition("=")
        try:
            if name == "looks_ahead":
                changed = dataclasses.replace(changed, looks_ahead=bool(int(text)))
                continue
            value = float(text)
        except ValueError:
            raise ConfigError(f"--set takes NAME=NUMBER (looks_ahead=0 or 1), not '{word}'") from None
        groups = {"map": MapConfig, "route": RouteConfig, "follow": FollowConfig}
        own = {field.name for field in dataclasses.fields(PilotConfig)} - {"depth", *groups}
        for group, kind in groups.items():
            if name in {field.name for field in dataclasses.fields(kind)}:
                part = dataclasses.replace(getattr(changed, group), **{name: value})
                changed = dataclasses.replace(changed, **{group: part})
                break
        else:
            if name not in own:
                raise ConfigError(f"there is no option '{name}' of the pilot, its map, its routes or its follower")
            changed = dataclasses.replace(changed, **{name: value})
    return changed


def course_of(policy: Policy, family: str, split: families.Split, missions: int, first: int = 0) -> EnvParams:
    """Returns one mission in each of `missions` worlds of a split, from world `first` on."""
    pool = families.worlds_of(policy.config, family, split, missions, first=first)
    return EnvParams(load_airframe(policy.config.drone), pool, own_missions(pool))


def look_up_contact(log_odds: np.ndarray, cell_m: float, scene: Scene, position: np.ndarray, radius: float) -> str:
    """Returns what a map had of the place that a body touches: `KNOWN`, `TAKEN_FOR_FREE` or `UNSEEN`.

    It is known if a cell is occupied within a cell of that place, unseen if all of these are unknown.

    Args:
        log_odds: [X, Y, Z].
        cell_m: edge of the cells, metres.
        scene: the true world.
        position: [3] of the body's centre, metres.
        radius: of the body, metres.
    """
    away = np.asarray(jax.grad(lambda at: signed_distance(scene, at))(jnp.asarray(position)))
    at = ((position - radius * away - np.asarray(scene.volume)[0]) // cell_m).astype(int)
    at = np.clip(at, 0, np.array(log_odds.shape) - 1)
    near = log_odds[tuple(slice(max(0, i - 1), i + 2) for i in at)]
    if (near > 0).any():
        return KNOWN
    return UNSEEN if (near == 0).all() else TAKEN_FOR_FREE


def decision_ms(policy: Policy, flown: PilotConfig, world: EnvParams, planning: np.ndarray, calls: int) -> np.ndarray:
    """Returns milliseconds [calls] of a decision: what JAX computes of data on the host, and a plan of a flight.

    Args:
        policy: whose encoder and decoder see.
        flown: the pilot.
        world: the missions.
        planning: [N] seconds of planning in flight.
        calls: that are timed.
    """
    config, volume = policy.config, np.asarray(world.pool.volume)
    shape = grid.grid_shape(flown.map, volume)
    seen, memory = jax.tree.map(np.asarray, (blank_observation(config), AgentActor(config).init()))
    picture = np.full((config.camera.height, config.camera.width), 5.0, np.float32)
    position = np.asarray(world.missions.start)[0]
    rotation = mount_rotation(config, jnp.array([1.0, 0.0, 0.0, 0.0]))

    @jax.jit
    def integrate(params: PolicyParams, seen: Observation, memory: Any, picture: Any, known: grid.Grid):
        depth = picture
        if flown.depth == "decoded":
            memory = AgentActor(config).encode(params, memory, seen)
            depth = pilot.decoded_depth(config, params, memory)
        return memory, grid.update(flown.map, config.camera, known, depth, position, rotation)

    known = grid.empty_grid(shape, jnp.asarray(volume[0]))
    params = jax.device_put(policy.params)
    (seconds,) = time_interleaved(
        [lambda: jax.block_until_ready(integrate(params, seen, memory, picture, known))], calls
    )
    return 1e3 * (seconds + np.random.default_rng(0).choice(planning, calls))


def pilot_row(policy: Policy, flown: PilotConfig, world: EnvParams, batch: int, calls: int) -> Row:
    """Returns the row of a pilot."""
    had: list[str] = []

    def landed(missions: np.ndarray, flying: Piloted) -> None:
        outcome, position = np.asarray(flying.flights.outcome), np.asarray(flying.flights.closest.position)
        time_s, radius = flying.flights.closest.time, policy.config.drone.body_radius_m
        for lane in np.flatnonzero(outcome[: len(missions)] == Outcome.COLLISION):
            aim = jax.tree.map(lambda leaf, lane=lane: leaf[lane], flying.aim)
            scene = scene_at(env.scene_of(world, jnp.asarray(missions[lane]), aim), time_s[lane])
            log_odds = np.asarray(flying.grid.log_odds[lane])
            had.append(look_up_contact(log_odds, flown.map.cell_m, scene, position[lane], radius))

    flights, planning = pilot.fly(
        policy.config, flown, world, policy.params, jax.random.key(0), batch=batch, landed=landed
    )
    return {
        **figures(flights, decision_ms(policy, flown, world, planning, calls)),
        "plan_ms": float(1e3 * np.median(planning)),
        "hit": {what: had.count(what) for what in (KNOWN, TAKEN_FOR_FREE, UNSEEN)},
        "options": dataclasses.asdict(flown),
    }


def learned_row(policy: Policy, world: EnvParams, calls: int) -> Row:
    """Returns the row of the learned agent."""
    flights = fly_on_all_devices(policy.config, world, policy.params)
    return figures(flights, 1e3 * decision_seconds(policy.config, policy.params, calls))


def figures(flights: Flights, milliseconds: np.ndarray) -> Row:
    """Returns what the rows of all methods have; milliseconds [calls] of a decision."""
    return {
        **summarise_flights(flights),
        "decision_ms": float(np.median(milliseconds)),
        "decision_p99_ms": float(np.percentile(milliseconds, 99)),
        "arrived": (np.asarray(flights.outcome) == Outcome.GOAL).tolist(),
    }


def table(rows: Sequence[Row]) -> str:
    """Returns the rows as a Markdown table."""
    lines = [
        "| world | method | missions | success | 95 % interval | behind the agent, points | collisions: known, taken "
        "for free, unseen | left the volume | time-outs | decisions | a decision, ms (99 %) |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    agents = {row["world"]: row["arrived"] for row in rows if row["method"] == "learned"}
    for row in rows:
        low, high = row["interval"]
        behind = "–"
        if row["method"] != "learned" and row["world"] in agents:
            agent, own = (np.array([arrived], bool) for arrived in (agents[row["world"]], row["arrived"]))
            least, most = difference_interval(agent, own)
            gap = agent.mean() - own.mean()
            behind = f"{100 * gap:.1f} ({100 * least:.1f} to {100 * most:.1f})"
        hit = "" if "hit" not in row else ": " + ", ".join(str(count) for count in row["hit"].values())
        took = "–" if row["decisions"] is None else f"{row['decisions']:.0f}"
        lines.append(
            f"| {row['world']} | {METHODS[row['method']]} | {row['missions']} | {row['success_rate']:.1%} "
            f"| {low:.1%} to {high:.1%} | {behind} | {row['collisions']}{hit} | {row['left_volume']} "
            f"| {row['timeouts']} | {took} | {row['decision_ms']:.1f} ({row['decision_p99_ms']:.1f}) |"
        )
    return "\n".join(lines)


def record_first_flight(
    policy: Policy, flown: PilotConfig, world: EnvParams
) -> tuple[list[Moment], Outcome, Aim | None]:
    """Returns what the pilot knew at each decision of the first mission, how it ended, and where balls were thrown."""
    moments: list[Moment] = []
    seconds = policy.config.drone.physics_steps * policy.config.drone.physics_dt_s
    places: list[np.ndarray] = []
    aims: list[Aim | None] = []

    def watch(flying: Piloted, orders: Orders) -> None:
        places.append(np.array(flying.drone.position[0]))
        aims.append(jax.tree.map(lambda leaf: np.array(leaf[0]), flying.aim))
        moments.append(
            Moment(
                time_s=float(flying.flights.decisions[0]) * seconds,
                log_odds=np.array(flying.grid.log_odds[0]),
                flown=np.array(places),
                plan=orders.points[0],
                depth=np.array(flying.depth[0]),
            )
        )

    flights, _ = pilot.fly(policy.config, flown, world, policy.params, jax.random.key(0), batch=1, watch=watch)
    return moments, Outcome(int(flights.outcome[0])), aims[-1]


def draw(policy: Policy, args: argparse.Namespace) -> None:
    """Flies and draws one mission."""
    method = args.methods[0]
    flown = with_options(TUNED[method], args.set)
    world = course_of(policy, args.worlds[0], args.split, 1, first=args.mission)
    moments, outcome, aim = record_first_flight(policy, flown, world)
    scene = env.scene_of(world, jnp.asarray(0), aim)
    if args.figure.suffix == ".png":
        chosen = np.unique(np.linspace(0, len(moments) - 1, PICTURES).round().astype(int))
        draw_growth(scene, flown.map.cell_m, [moments[i] for i in chosen], args.figure)
    else:
        title = f"A* on the map so far, {'depth from events' if method == 'decoded' else 'true depth'}"
        write_atomically(args.figure, animate_growth(scene, flown.map.cell_m, moments, title))
    print(f"{args.worlds[0]} {args.mission}: {outcome.name.lower()} after {len(moments)} decisions, in {args.figure}")


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0; 2 for invalid input."""
    args = parse(argv)
    use_cpu_devices()
    policy = load_policy(args.policy)
    pilots = {name: with_options(TUNED[name], args.set) for name in args.methods if name != "learned"}
    for flown in pilots.values():
        pilot.check_can_fly(policy.config, flown)
    if args.figure is not None:
        draw(policy, args)
        return 0
    rows: list[Row] = []
    for family in args.worlds:
        world = course_of(policy, family, args.split, args.missions)
        measure: dict[str, Callable[[], Row]] = {
            name: lambda flown=flown, world=world: pilot_row(policy, flown, world, args.batch, args.calls)
            for name, flown in pilots.items()
        }
        measure["learned"] = lambda world=world: learned_row(policy, world, args.calls)
        for name in args.methods:
            rows.append({"name": f"{family} {name}", "world": family, "method": name, **measure[name]()})
            print(f"{family}, {METHODS[name]}: {rows[-1]['success_rate']:.1%}", file=sys.stderr)
    print(table(rows))
    report = {"benchmark": "mapping", "split": args.split, "policy": str(args.policy), "rows": rows}
    json_report.write(args.json, report | json_report.machine(jax.devices()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
