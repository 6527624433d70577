"""A saved run, flown greedily on any world and measured: `edqn evaluate`."""

from __future__ import annotations

import dataclasses
import json
import math
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from rich.console import Console
from rich.table import Table

from edqn_jax.config import Config
from edqn_jax.config.limits import validate
from edqn_jax.config.loading import apply, load_layer
from edqn_jax.course import Course, load_course
from edqn_jax.errors import ConfigError
from edqn_jax.flights import Flights, fly_missions
from edqn_jax.learn import embedding, policy, qnetwork
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.planners.astar import NoPathError, shortest_path
from edqn_jax.runs.checkpoints import load_policy
from edqn_jax.runs.directory import TRAJECTORY_COLUMNS, plain
from edqn_jax.runs.files import check_can_write, write_whole
from edqn_jax.sim import env
from edqn_jax.sim.env import Outcome, World
from edqn_jax.sim.events import EventField, divides_window
from edqn_jax.sim.moves import DIRECTIONS
from edqn_jax.sim.scene import take_scene
from edqn_jax.sim.sensor import Sensed

if TYPE_CHECKING:
    from edqn_jax.cli.arguments import EvaluateArgs

# ------------------------------------------------------------------------------------------- runs


def load_run(folder: Path) -> tuple[Config, PolicyParams]:
    """Configuration and policy of a run, or of any folder with its `config.yaml` and `checkpoints/`.

    Raises:
        ConfigError: if there is none, or its parts are incomplete or do not fit each other.
    """
    file = folder / "config.yaml"
    if not file.is_file():
        raise ConfigError(f"there is no run in '{folder}': it holds no config.yaml")
    config = apply(Config(), load_layer(file), str(file))
    validate(config)
    params = load_policy(folder / "checkpoints")
    fresh = jax.eval_shape(lambda: fresh_policy(config))
    # As policies were saved before their pixel features were written out.
    learnt = jax.eval_shape(lambda: embedding.init(config, jax.random.key(0)))
    if _shapes(params) == _shapes(dataclasses.replace(fresh, encoder=learnt)):
        params = dataclasses.replace(params, encoder=jax.tree.map(np.asarray, embedding.acting(config, params.encoder)))
    if _shapes(params) != _shapes(fresh):
        raise ConfigError(f"the policy in '{folder}' does not have the shapes that its config.yaml asks for")
    return config, params


def _shapes(params: PolicyParams) -> PolicyParams:
    return jax.tree.map(np.shape, params)


def fresh_policy(config: Config, seed: int = 0) -> PolicyParams:
    """A policy that has learnt nothing."""
    encoder_key, q_key = jax.random.split(jax.random.key(seed))
    size = policy.observation_size(config)
    return PolicyParams(
        encoder=embedding.acting(config, embedding.init(config, encoder_key)),
        q=qnetwork.init_q(config.agent, size, len(env.ACTIONS), q_key),
    )


# ---------------------------------------------------------------------------------------- figures


def wilson_interval(successes: int, missions: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a success rate; 95 % for the default `z` (Wilson 1927)."""
    if missions == 0:
        return 0.0, 1.0
    rate = successes / missions
    scale = 1.0 + z * z / missions
    middle = (rate + z * z / (2 * missions)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / missions + z * z / (4 * missions**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def spl(success: np.ndarray, flown: np.ndarray, shortest: np.ndarray) -> float:
    """Success weighted by path length (Anderson et al. 2018): mean of S l / max(p, l) over missions [M].

    A failure's shortest path does not matter and may be NaN.
    """
    weight = shortest[success] / np.maximum(flown[success], shortest[success])
    return float(np.sum(weight) / len(success))


def shortest_paths(config: Config, world: World, wanted: np.ndarray) -> np.ndarray:
    """Length [M] of A*'s path for each of the `wanted` [M] missions, metres; NaN for the others."""
    scene_of, starts, goals = (np.asarray(x) for x in (world.missions.scene, world.missions.start, world.missions.goal))
    pool = jax.tree.map(np.asarray, world.pool)
    lengths = np.full(len(starts), np.nan)
    for i in np.flatnonzero(wanted):
        try:
            scene = take_scene(pool, scene_of[i])
            lengths[i] = shortest_path(scene, starts[i], goals[i], config.drone.body_radius_m).length_m
        except NoPathError:
            continue  # a way that the half-metre lattice has no room for
    return lengths


def summarise(flights: Flights, shortest: np.ndarray | None = None) -> dict[str, Any]:
    """The figures of a set of flights.

    Args:
        flights: M of them.
        shortest: [M] lengths of the shortest paths, metres, NaN where not known; without them there is no
            `spl` and no `path_over_shortest`.

    Returns:
        What `edqn evaluate --json` holds, less world, seed and latency. `spl` and the mean `return` are of
        all flights; the means of path, decisions and seconds, and the least clearance, of those that reached
        the goal (None if there is none). A flight ends at the goal's radius, the shortest path at the goal.
    """
    outcome = np.asarray(flights.outcome)
    counts = {kind: int(np.sum(outcome == kind)) for kind in Outcome}
    success = outcome == Outcome.GOAL
    low, high = wilson_interval(counts[Outcome.GOAL], len(outcome))
    flown = np.asarray(flights.path_length_m, np.float64)

    def mean(values: Any, over: np.ndarray) -> float | None:
        chosen = np.asarray(values, np.float64)[over]
        return float(np.mean(chosen)) if chosen.size else None

    figures: dict[str, Any] = {
        "missions": len(outcome),
        "successes": counts[Outcome.GOAL],
        "success_rate": counts[Outcome.GOAL] / len(outcome),
        "interval": [low, high],
        "collisions": counts[Outcome.COLLISION],
        "left_volume": counts[Outcome.LEFT_VOLUME],
        "timeouts": counts[Outcome.TIME_OUT],
        "diverged": counts[Outcome.DIVERGED],
        "spl": None,
        "path_over_shortest": None,
        "decisions": mean(flights.decisions, success),
        "flight_seconds": mean(flights.flight_seconds, success),
        "path_length_m": mean(flown, success),
        "return": mean(flights.episode_return, np.ones_like(success)),
        "min_clearance_m": float(np.min(flights.closest.distance[success])) if success.any() else None,
    }
    if shortest is not None:
        known = success & np.isfinite(shortest)
        # A success whose shortest path is not known counts as flown no better than it was.
        figures["spl"] = spl(success, flown, np.where(np.isfinite(shortest), shortest, flown))
        figures["path_over_shortest"] = mean(flown / np.where(known, shortest, 1.0), known)
    return figures


def decision_latency_ms(config: Config, params: PolicyParams, calls: int = 300) -> dict[str, float]:
    """Median and 99th percentile of the time that one decision takes, from host arrays to an action there."""
    median, p99 = np.percentile(1e3 * decision_seconds(config, params, calls), [50, 99])
    return {"median": float(median), "p99": float(p99)}


def decision_seconds(config: Config, params: PolicyParams, calls: int) -> np.ndarray:
    """Seconds [calls] that each of so many decisions takes, from host arrays to an action there."""
    seen = env.Observation(sensed=_anything(config), own=jnp.zeros(env.OWN_SIZE))
    seen, memory = jax.tree.map(np.asarray, (seen, policy.empty_memory(config)))  # on the host
    act = jax.jit(lambda params, memory, seen, key: policy.act(config, params, memory, seen, key))
    params, key = jax.device_put(params), jax.random.key(0)
    seconds = []
    for _ in range(calls + 1):
        began = time.perf_counter()
        int(act(params, memory, seen, key)[0])
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[1:])  # the first call compiled


def _anything(config: Config) -> Sensed:
    """Something that the sensor might show."""
    rng, height, width = np.random.default_rng(0), config.camera.height, config.camera.width
    if config.env.sensor in ("frames", "depth"):
        return jnp.asarray(rng.random((height, width), np.float32))
    if config.env.sensor == "ranges":
        return jnp.asarray(rng.random(len(DIRECTIONS), np.float32))
    if config.env.sensor == "blind":
        return None
    pixels = (max(len(config.events.frame_times_s) - 1, 1), height, width)
    count, times = jnp.asarray(rng.integers(0, 3, pixels), jnp.int32), jnp.zeros(pixels)
    window = config.events.frame_times_s[-1] - config.events.frame_times_s[0]
    even = divides_window(config.events, len(config.events.frame_times_s))
    return EventField(count, jnp.sign(count).astype(jnp.int8), times, times, window, even)


# -------------------------------------------------------------------------------------- one flight


def trajectory(config: Config, flights: Flights, mission: int = 0) -> dict[str, np.ndarray]:
    """One recorded flight as the columns of `trajectory.csv`, each [T]: a row after each physics step."""
    if flights.record is None:
        raise ValueError("these flights were not recorded")
    steps = int(flights.physics_steps[mission])
    whole = jax.tree.map(lambda leaf: np.asarray(leaf[mission]), flights.record)
    decision = np.arange(steps) // config.drone.physics_steps
    values = np.column_stack(
        [
            config.drone.physics_dt_s * np.arange(1, steps + 1),
            whole.position[:steps],
            whole.quaternion[:steps],
            whole.velocity[:steps],
            whole.action[decision],
            whole.reward[decision],
            whole.clearance[:steps],
        ]
    )
    return dict(zip(TRAJECTORY_COLUMNS, values.T, strict=True))


def flight_summary(flights: Flights, mission: int = 0) -> dict[str, Any]:
    """What `summary.json` says of one flight, the shortest path aside."""
    outcome = Outcome(int(flights.outcome[mission]))
    return {
        "success": outcome == Outcome.GOAL,
        "outcome": outcome.name.lower(),
        "steps": int(flights.decisions[mission]),
        "path_length_m": float(flights.path_length_m[mission]),
        "return": float(flights.episode_return[mission]),
        "min_clearance_m": float(flights.closest.distance[mission]),
        "flight_seconds": float(flights.flight_seconds[mission]),
    }


# ----------------------------------------------------------------------------------- the command


def evaluate_command(args: EvaluateArgs) -> None:
    """`edqn evaluate`: flies, prints, writes.

    Raises:
        ConfigError: if the run, the world or a file to write is not as it should be.
    """
    for file in (args.json, args.trajectories):
        if file is not None:
            check_can_write(file)
    least = 2 * len(jax.devices())
    if args.shuffle_codes and args.missions < least:
        raise ConfigError(f"--shuffle-codes needs --missions of at least {least}, not {args.missions}")
    config, params = load_run(args.run)
    if args.shuffle_codes and config.env.sensor == "blind":
        raise ConfigError(f"--shuffle-codes has nothing to shuffle: the policy of '{args.run}' sees nothing but itself")
    name = args.world or config.world.name
    course = load_course(config, name, args.missions, args.seed, args.start, args.goal)
    record = args.trajectories is not None
    flights = fly_on_all_devices(
        config, course.world, params, args.seed, record=record, shuffle_codes=args.shuffle_codes
    )
    shortest = shortest_paths(config, course.world, np.asarray(flights.outcome) == Outcome.GOAL)
    figures = {
        "world": course.name,
        "seed": args.seed,
        "shuffled_codes": args.shuffle_codes,
        **summarise(flights, shortest),
        "decision_latency_ms": decision_latency_ms(config, params),
    }
    Console().print(report(figures))
    if args.json is not None:
        write_whole(args.json, json.dumps(plain(figures), indent=2, allow_nan=False) + "\n")
    if args.trajectories is not None:
        write_trajectories(config, course, flights, args.trajectories)


def fly_on_all_devices(
    config: Config,
    world: World,
    params: PolicyParams,
    seed: int = 0,
    *,
    record: bool = False,
    shuffle_codes: bool = False,
) -> Flights:
    """`fly_missions` on all devices that there are; the flights come back to the host."""
    mesh = Mesh(np.asarray(jax.devices()), ("mission",))
    world, params = jax.device_put((world, params), NamedSharding(mesh, PartitionSpec()))
    flights = fly_missions(
        config, world, params, jax.random.key(seed), record=record, shuffle_codes=shuffle_codes, mesh=mesh
    )
    return jax.tree.map(np.asarray, flights)


def report(figures: dict[str, Any]) -> Table:
    """The figures as a table for people."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else form.format(value)

    low, high = figures["interval"]
    latency = figures["decision_latency_ms"]
    title = f"{figures['world']}, seed {figures['seed']}" + (", shuffled codes" if figures["shuffled_codes"] else "")
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column()
    table.add_column(justify="right")
    rate = f"{figures['successes']} of {figures['missions']} ({figures['success_rate']:.1%})"
    table.add_row("reached the goal", rate)
    table.add_row("95 % interval", f"{low:.1%} – {high:.1%}")
    for name in ("collisions", "left_volume", "timeouts", "diverged"):
        table.add_row(name.replace("_", " "), str(figures[name]))
    table.add_section()
    table.add_row("SPL", number(figures["spl"], "{:.3f}"))
    table.add_row("path / shortest path", number(figures["path_over_shortest"], "{:.3f}"))
    table.add_row("path", number(figures["path_length_m"], "{:.1f} m"))
    table.add_row("decisions", number(figures["decisions"], "{:.1f}"))
    table.add_row("flight time", number(figures["flight_seconds"], "{:.1f} s"))
    table.add_row("least clearance", number(figures["min_clearance_m"], "{:.2f} m"))
    table.add_section()
    table.add_row("decision latency, median", f"{latency['median']:.2f} ms")
    table.add_row("decision latency, 99th percentile", f"{latency['p99']:.2f} ms")
    return table


def write_trajectories(config: Config, course: Course, flights: Flights, file: Path) -> None:
    """All flights as one `.npz`, enough to check every verdict in another physics engine.

    Row 0 of each flight is its start, row k stands after physics step k; rows after the end are NaN.
    `lengths` is the number of rows of each flight. A collision touches within the last segment, `contact` of
    the way along it. `mjcf[scene[i]]` is the world of mission i.
    """
    record = flights.record
    if record is None:
        raise ValueError("these flights were not recorded")
    missions = jax.tree.map(np.asarray, course.world.missions)
    heading = np.arctan2(*(missions.goal - missions.start)[:, 1::-1].T)
    level = np.zeros_like(heading)
    facing = np.column_stack([np.cos(heading / 2), level, level, np.sin(heading / 2)])
    longest = int(np.max(flights.physics_steps))
    columns = {
        "positions": np.concatenate([missions.start[:, None], record.position[:, :longest]], axis=1),
        "attitudes": np.concatenate([facing[:, None], record.quaternion[:, :longest]], axis=1),
        "times": config.drone.physics_dt_s * np.arange(longest + 1),
        "lengths": flights.physics_steps + 1,
        "actions": record.action,
        "rewards": record.reward,
        "outcome": np.array([Outcome(int(kind)).name.lower() for kind in flights.outcome]),
        "contact": flights.contact,
        "flight_seconds": flights.flight_seconds,
        "closest_distance": flights.closest.distance,
        "closest_time": flights.closest.time,
        "closest_position": flights.closest.position,
        "closest_attitude": flights.closest.quaternion,
        "scene": missions.scene,
        "start": missions.start,
        "goal": missions.goal,
        "mjcf": np.array(course.mjcf()),
        "body_radius_m": np.float64(config.drone.body_radius_m),
        "physics_dt_s": np.float64(config.drone.physics_dt_s),
    }
    with tempfile.SpooledTemporaryFile() as buffer:
        np.savez_compressed(buffer, **columns)
        buffer.seek(0)
        write_whole(file, buffer.read())
