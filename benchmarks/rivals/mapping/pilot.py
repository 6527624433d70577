"""The pilot that a drone engineer would build: sense, update the map, plan on it, follow the plan; each decision anew.

It is given what a learned policy is given, one sensor, its own state, the goal and the fence, and no map. Distances
come from the true depth of the policy's camera (an upper bound, as the sensor `depth` is one) or from what the decoder
of the policy's event VAE draws of the events, so that pilot and policy see with the same encoder. Physics, episode
limit and outcomes are those of every flight, and commands those of the follower of `planners.follow`, which also flies
plans on a true map.

Drones fly side by side: what JAX computes is mapped over them, plans are computed on the host, one a core.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.devices.devices import compiler_options
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import AgentActor, Memory, PolicyParams
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics import disturbances, drone
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.physics.flight import fly_decision as fly_decision
from edqn_jax.sim.scene import launches
from edqn_jax.sim.scene.motion import Aim
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, SensorMemory, distance_of, mount_rotation
from edqn_jax.sim.task import env
from edqn_jax.sim.task.action_sets import heading_setpoint
from edqn_jax.sim.task.env import EnvParams
from edqn_jax.sim.task.flights import Flights, at_start, update_tallies
from edqn_jax.sim.task.observation import View, heading_velocity, observe, poses_at_start, sensor_poses, with_times
from edqn_jax.sim.task.outcomes import Outcome, judge_decision
from rivals.mapping.grid import Grid, MapConfig, empty_grid, grid_shape, update
from rivals.mapping.route import RouteConfig, Router
from rivals.planners.follow import FollowConfig, sample_path, steer

POINTS = 128
"""Points, `planners.follow.SPACING_M` apart, of the part of a plan that the follower is given."""


@dataclasses.dataclass(frozen=True)
class PilotConfig:
    """The pilot: its map, its routes, and how it flies them."""

    depth: Literal["true", "decoded"] = "decoded"
    """Where distances come from: the simulator, or the decoder of the policy's VAE."""
    map: MapConfig = MapConfig()
    route: RouteConfig = RouteConfig()
    follow: FollowConfig = FollowConfig(reserve_m=0.0)
    speed_m_s: float = 4.0
    """Highest speed, metres per second."""
    least_m_s: float = 1.0
    """Speed at which it flies into what it has not seen, metres per second."""
    braking_m_s2: float = 4.0
    """It flies only as fast as it can stop within what it has seen to be free, with this deceleration; 0 is at any
    speed."""
    reaction_s: float = 0.4
    """Time until it brakes: a decision and the delay of the velocity, seconds."""
    looks_ahead: bool = True
    """Turn the camera to where it flies; if not, to the goal, as the learned policy does."""
    seeing_m_s: float = 0.5
    """Speed below which events tell nothing, so that the map stays as it is, metres per second; not of true depth."""

    def __post_init__(self) -> None:
        """Checks the limits.

        Raises:
            ConfigError: names the option that is out of its limits.
        """
        for name in ("speed_m_s", "least_m_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise ConfigError(f"{name} of a pilot must be more than 0, not {getattr(self, name):g}")
        for name in ("braking_m_s2", "reaction_s", "seeing_m_s"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"{name} of a pilot must be 0 or more, not {getattr(self, name):g}")


TUNED = {
    "true": PilotConfig(depth="true"),
    "decoded": PilotConfig(
        depth="decoded",
        map=MapConfig(cell_m=0.35, range_m=6.0, hit=0.5, least=-0.8, free_share=0.8),
        route=RouteConfig(touch_m=0.7, near_m=1.4, near_weight=4.0, unknown_weight=1.2),
        speed_m_s=2.5,
    ),
}
"""By `PilotConfig.depth`, what flew best in validation worlds (docs/growing_map.md)."""


@struct.dataclass
class Piloted:
    """One drone in flight."""

    drone: DroneState
    memory: Memory  # of the encoder
    sensed: SensorMemory
    grid: Grid
    depth: Array  # [H, W] metres, the newest image
    flights: Flights
    key: Array
    aim: Aim | None = None  # of the balls thrown until now


@dataclasses.dataclass(frozen=True)
class Orders:
    """What the host tells B drones, a decision at a time."""

    points: np.ndarray
    """[B, POINTS, 3] metres, the plan."""
    speed: np.ndarray
    """[B] metres per second, the limit."""
    expanded: np.ndarray
    """[B] cells that the search expanded."""
    seconds: np.ndarray
    """[B] of one core's time for planning; NaN of drones that have arrived or failed."""


Watch = Callable[[Piloted, Orders], None]
"""Is called after every decision's planning with B drones, before they fly."""


Landed = Callable[[np.ndarray, Piloted], None]
"""Is called after every batch with the numbers [B] of its missions and its drones as their flights ended."""


def check_can_fly(config: Config, pilot: PilotConfig) -> None:
    """Raises ConfigError if the pilot cannot fly what a policy's configuration describes.

    Raises:
        ConfigError: says what is needed.
    """
    if disturbances.any_on(config):
        raise ConfigError(
            "the pilot flies without disturbances; all options of air, body, motors and noise, and env.action_delay, "
            "must be off"
        )
    if config.env.drones > 1:
        raise ConfigError(f"the pilot flies one drone in a world, not {config.env.drones}; env.drones must be 1")
    if config.drone.body_radius_m > pilot.route.body_m:
        raise ConfigError(
            f"the pilot's routes are for bodies of at most {pilot.route.body_m:g} m, not of "
            f"{config.drone.body_radius_m:g} m; body_m, touch_m and near_m of a route must grow with the body"
        )
    if pilot.depth == "decoded" and not embedding.needs_nearness(config):
        raise ConfigError("the policy's decoder draws no distances; encoder.target must be 'nearness' or 'both'")


def decoded_depth(config: Config, params: PolicyParams, memory: Memory) -> Array:
    """Returns the distances [H, W], metres, that the decoder draws of the newest code in a memory [H, D]."""
    drawn = vae.decode(config.encoder, config.camera, params.encoder, AgentActor(config).code(memory))[-1]
    return distance_of(drawn / DEPTH_SCALE)


def look(
    config: Config,
    pilot: PilotConfig,
    params: PolicyParams,
    scene: Scene,
    goal: Array,
    flying: Piloted,
    move: Array,
    poses: Flight,
) -> Piloted:
    """Returns a drone that has sensed what is around it and updated its map; `config` and `pilot` are static.

    Args:
        params: of the policy whose encoder and decoder see.
        scene: the world with its motion, for the sensor alone.
        goal: [3] metres.
        flying: so far.
        move: [3] the last command in the heading frame, in commanded speeds.
        poses: [T] at the sensor's frame times.

    A drone whose flight is over keeps the map on which its last command was chosen.
    """
    key, noise = jax.random.split(flying.key)
    body = flying.drone
    rotation = mount_rotation(config, body.quaternion)
    counts = flying.flights.outcome == Outcome.RUNNING
    sensed, memory = flying.sensed, flying.memory
    if pilot.depth == "true":
        now = scene_at(scene, None if poses.time is None else poses.time[-1])
        depth = camera.render_depth(config.camera, now, body.position, rotation)
    else:
        observation, sensed = observe(config, View(scene, goal, body, move, poses), sensed, noise)
        memory = AgentActor(config).encode(params, memory, observation)
        depth = decoded_depth(config, params, memory)
        counts &= jnp.sum(body.velocity**2) >= pilot.seeing_m_s**2
    grid = update(pilot.map, config.camera, flying.grid, depth, body.position, rotation, counts)
    return dataclasses.replace(flying, memory=memory, sensed=sensed, grid=grid, depth=depth, key=key)


def decide(
    config: Config,
    pilot: PilotConfig,
    world: EnvParams,
    params: PolicyParams,
    mission: Array,
    flying: Piloted,
    points: Array,
    speed: Array,
) -> Piloted:
    """Returns a drone after one more decision along a plan, which it has judged, and what it then sees.

    A drone whose flight is over stays as it is.

    Args:
        mission: [] int32.
        points: [POINTS, 3] metres, the plan.
        speed: [] metres per second, the limit.
    """
    scene = env.scene_of(world, mission, flying.aim)
    goal, before = world.missions.goal[mission], flying.drone
    limit = dataclasses.replace(config.env, speed_m_s=pilot.speed_m_s)
    command, _ = steer(limit, pilot.follow, points, jnp.zeros((), jnp.int32), before)
    asked = jnp.sqrt(jnp.sum(command**2) + 1e-9)
    command = command * jnp.minimum(1.0, speed / asked)
    turning = dataclasses.replace(config.env, heading="flight" if pilot.looks_ahead else "goal")
    heading = heading_setpoint(turning, before, goal, command)
    after, flight = fly_decision(config.drone, world.airframe, before, command, heading)
    outcome, end, contact = judge_decision(config, scene, goal, before.position, flight, flying.flights.decisions + 1)
    flights, _ = update_tallies(config, scene, flying.flights, before.position, flight, outcome, end, contact)
    move = heading_velocity(config.env, drone.yaw_of(before.quaternion), command)
    steps = flying.flights.decisions * config.drone.physics_steps + jnp.arange(1, config.drone.physics_steps + 1)
    poses = sensor_poses(config, before, with_times(config, flight, steps if has_motion(scene) else None))
    running = flying.flights.outcome == Outcome.RUNNING
    keep = functools.partial(jax.tree.map, lambda new, old: jnp.where(running, new, old))
    thrown = launches.update_aim(
        config, scene, flying.aim, flights.decisions, after.position, after.position - before.position
    )
    # Before looking, so that the map, by far the largest part, need not be chosen as a whole.
    flown = dataclasses.replace(
        flying, drone=keep(after, before), flights=keep(flights, flying.flights), aim=keep(thrown, flying.aim)
    )
    seen = look(config, pilot, params, scene, goal, flown, move, poses)
    others = {name: keep(getattr(seen, name), getattr(flying, name)) for name in ("memory", "sensed", "depth", "key")}
    return dataclasses.replace(seen, **others)


def at_rest(
    config: Config, pilot: PilotConfig, shape: tuple[int, int, int], world: EnvParams, mission: Array, key: Array
) -> Piloted:
    """Returns a drone at a mission's start [] int32, facing the goal, with an empty map of `shape` cells."""
    scene = env.scene_of(world, mission)
    start, goal = world.missions.start[mission], world.missions.goal[mission]
    key, rest = jax.random.split(key)
    body = drone.hover_state(start, jnp.arctan2(goal[1] - start[1], goal[0] - start[0]))
    return Piloted(
        drone=body,
        memory=AgentActor(config).init(),
        sensed=sensor.at_rest(config, rest),
        grid=empty_grid(shape, scene.volume),
        depth=jnp.full((config.camera.height, config.camera.width), jnp.inf),
        flights=at_start(config, scene, body),
        key=key,
        aim=launches.update_aim(config, scene, launches.initial_aim(world.pool), jnp.int32(0), start, jnp.zeros(3)),
    )


def _begin(
    config: Config,
    pilot: PilotConfig,
    shape: tuple[int, int, int],
    world: EnvParams,
    params: PolicyParams,
    mission: Array,
    key: Array,
) -> Piloted:
    """Returns a drone at its start that has looked ahead once."""
    flying = at_rest(config, pilot, shape, world, mission, key)
    scene = env.scene_of(world, mission)
    still = poses_at_start(config, scene, flying.drone)
    return look(config, pilot, params, scene, world.missions.goal[mission], flying, jnp.zeros(3), still)


@functools.cache
def _programs(platform: str):
    """Returns the programs that begin B flights and that fly a decision of each."""
    options = compiler_options(platform)

    @functools.partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=options)
    def begin(config, pilot, shape, world, params, missions, keys):
        return jax.vmap(functools.partial(_begin, config, pilot, shape, world, params))(missions, keys)

    @functools.partial(jax.jit, static_argnums=(0, 1), donate_argnums=5, compiler_options=options)
    def fly(config, pilot, world, params, missions, flying, points, speed):
        return jax.vmap(functools.partial(decide, config, pilot, world, params))(missions, flying, points, speed)

    return begin, fly


def order(
    pilot: PilotConfig, router: Router, log_odds: np.ndarray, position: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, float, int]:
    """Returns the plan of one drone: points [POINTS, 3] metres, the speed limit in metres per second, cells expanded.

    Args:
        router: of the volume.
        log_odds: [X, Y, Z] of the drone's grid.
        position: [3] metres.
        goal: [3] metres.
    """
    route = router.plan(log_odds, position, goal)
    speed = pilot.speed_m_s
    if pilot.braking_m_s2 > 0:
        free = router.known_length_m(log_odds, route.points)
        # v with v t + v^2 / 2 a = free: the way until it brakes, and that of braking.
        lag = pilot.braking_m_s2 * pilot.reaction_s
        speed = min(speed, max(pilot.least_m_s, -lag + float(np.sqrt(lag**2 + 2 * pilot.braking_m_s2 * free))))
    return sample_path(route.points)[:POINTS], speed, route.expanded


def fly(
    config: Config,
    pilot: PilotConfig,
    world: EnvParams,
    params: PolicyParams,
    key: Array,
    *,
    batch: int = 16,
    watch: Watch | None = None,
    landed: Landed | None = None,
) -> tuple[Flights, np.ndarray]:
    """Flies each of the world's M missions once.

    Args:
        config: of the policy.
        pilot: how it maps, plans and flies.
        world: the missions.
        params: of the policy; only its encoder and decoder are used, and nothing of it with true depth.
        key: consumed by the sensor's noise.
        batch: drones that fly side by side, which decides the memory that maps need and no result.
        watch: sees drones and plans before every decision.
        landed: sees drones and their maps after their flights.

    Returns:
        the flights [M] without record, on the host; seconds [N] of one core's time for planning, a decision each.

    Raises:
        ConfigError: if the pilot cannot fly what `config` describes, or the map has too many cells.
    """
    check_can_fly(config, pilot)
    shape = grid_shape(pilot.map, world.pool.volume)
    begin, step = _programs(jax.devices()[0].platform)
    scenes, goals, volumes = (np.asarray(x) for x in (world.missions.scene, world.missions.goal, world.pool.volume))
    count = len(scenes)
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(jnp.arange(count))
    flown, seconds = [], []
    for first in range(0, count, batch):
        # The last batch is filled up with its first mission, so that one program flies all.
        chosen = np.arange(first, first + batch)
        number = jnp.asarray(np.where(chosen < count, chosen, first))
        routers = [Router(pilot.route, pilot.map.cell_m, volumes[scenes[m]]) for m in np.asarray(number)]
        flying = begin(config, pilot, shape, world, params, number, keys[number])
        while True:
            running = np.asarray(flying.flights.outcome) == Outcome.RUNNING
            running &= chosen < count
            if not running.any():
                break
            orders = _orders(pilot, routers, flying, goals[np.asarray(number)], running)
            seconds.append(orders.seconds[running])
            if watch is not None:
                watch(flying, orders)
            flying = step(config, pilot, world, params, number, flying, orders.points, orders.speed)
        if landed is not None:
            landed(chosen[chosen < count], flying)
        flown.append(jax.tree.map(np.asarray, flying.flights))
    flights = jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *flown)
    return flights, np.concatenate(seconds)


def _orders(
    pilot: PilotConfig, routers: list[Router], flying: Piloted, goals: np.ndarray, running: np.ndarray
) -> Orders:
    """Returns the plans of B drones; those that are not running [B] get none."""
    log_odds, position = np.asarray(flying.grid.log_odds), np.asarray(flying.drone.position, np.float64)
    batch = len(routers)
    points = np.zeros((batch, POINTS, 3), np.float32)
    speed, expanded, seconds = np.zeros(batch, np.float32), np.zeros(batch, int), np.full(batch, np.nan)

    def plan(b: int) -> None:
        began = time.thread_time()
        points[b], speed[b], expanded[b] = order(
            pilot, routers[b], log_odds[b], position[b], goals[b].astype(np.float64)
        )
        seconds[b] = time.thread_time() - began

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(plan, np.flatnonzero(running)))
    return Orders(points, speed, expanded, seconds)
