"""Flies the drone along a planned path: pure pursuit (Coulter, CMU-RI-TR-92-01) with a look-ahead that corners shorten.

Airframe, controller, decision period and rules of the outcome are those of a learned policy. At every decision the
follower commands a velocity towards a point ahead on the path, of at most `env.speed_m_s`, a learned policy's speed
along each axis. The point is the furthest within reach for which the straight line there stays within a tolerance of
the path, or no further from it than the drone is now. Straight legs are therefore flown fast, and the follower slows
down before corners and cuts them by less than the reserve that `with_reserve` makes planners keep.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config, EnvConfig
from edqn_jax.devices.devices import compiler_options
from edqn_jax.errors import ConfigError
from edqn_jax.planning.path import PlanningTask
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import Airframe
from edqn_jax.sim.physics.drone import DroneState
from edqn_jax.sim.physics.flight import fly_decision
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.task.action_sets import heading_to_goal
from edqn_jax.sim.task.flights import Flights, at_start, update_tallies
from edqn_jax.sim.task.outcomes import Outcome, judge_decision

SPACING_M = 0.1
"""Metres between the points of a sampled path."""
_LANES = 2048  # points of a path are padded to a multiple of this, to compile few programs


@dataclasses.dataclass(frozen=True)
class FollowConfig:
    """Limits of following a path; the values are not from a publication."""

    reserve_m: float = 0.3
    """Clearance beyond the body's radius that planners keep for the follower, metres."""
    tolerance_m: float = 0.2
    """Largest distance between the path and the straight line to the point ahead, metres."""
    reach_m: float = 2.5
    """Largest distance of the point ahead along the path, metres."""
    window_m: float = 3.0
    """Length of the path in which the nearest point is searched, metres."""
    lag_s: float = 0.15
    """Delay until the velocity follows a command, seconds."""
    horizon_s: float = 0.25
    """Time after the delay in which the commanded velocity would reach the point ahead, seconds."""


def with_reserve(task: PlanningTask, config: FollowConfig = FollowConfig()) -> PlanningTask:  # noqa: B008 (it is frozen)
    """Returns the task with a larger body and a smaller volume, by the reserve; start and goal stay in the volume."""
    lower, upper = np.asarray(task.scene.volume, np.float64)
    lower = np.minimum(lower + config.reserve_m, np.minimum(task.start, task.goal))
    upper = np.maximum(upper - config.reserve_m, np.maximum(task.start, task.goal))
    # Rounded outwards, because float32 could put a start or goal on the boundary outside.
    volume = np.stack([np.nextafter(np.float32(lower), -np.inf), np.nextafter(np.float32(upper), np.inf)])
    scene = dataclasses.replace(task.scene, volume=volume)
    return dataclasses.replace(task, scene=scene, body_radius=task.body_radius + config.reserve_m)


def sample_path(path: np.ndarray) -> np.ndarray:
    """Returns points [K, 3] every `SPACING_M` along a path [N, 3], metres; the last is repeated to fill K."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    count = math.ceil(along[-1] / SPACING_M) + 1
    at = np.minimum(SPACING_M * np.arange(-(-count // _LANES) * _LANES), along[-1])
    return np.stack([np.interp(at, along, axis) for axis in path.T], axis=1).astype(np.float32)


def steer(
    config: EnvConfig, follow: FollowConfig, points: Array, nearest: Array, state: DroneState
) -> tuple[Array, Array]:
    """Returns the velocity to command next.

    Args:
        config: for the speed limit.
        follow: how closely and how fast.
        points: [K, 3] from `sample_path`, metres.
        nearest: [] int32, index of the nearest point at the previous decision; the search starts there.
        state: of the drone.

    Returns:
        velocity [3] m/s, world; index of the nearest point now.
    """
    window, reach = (round(metres / SPACING_M) for metres in (follow.window_m, follow.reach_m))
    last = points.shape[0] - 1
    near = jnp.minimum(nearest + jnp.arange(window), last)
    here = state.position
    away = jnp.sqrt(jnp.sum((points[near] - here[None]) ** 2, axis=1))
    nearest = near[jnp.argmin(away)]

    ahead = points[jnp.minimum(nearest + 1 + jnp.arange(reach), last)] - here[None]  # [R, 3]
    length = jnp.sqrt(jnp.sum(ahead**2, axis=1) + 1e-9)
    along = (ahead @ ahead.T) / length[:, None]  # [to, of] position of each point along the straight line to each
    along = jnp.clip(along, 0.0, length[:, None])
    off = ahead[None] - along[..., None] * (ahead / length[:, None])[:, None]
    passed = jnp.tril(jnp.ones((reach, reach), bool))
    worst = jnp.max(jnp.where(passed, jnp.sqrt(jnp.sum(off**2, axis=-1)), 0.0), axis=1)
    # The present distance from the path is allowed, so that the drone returns to it gradually.
    allowed = worst <= jnp.maximum(follow.tolerance_m, jnp.min(away))
    furthest = jnp.max(jnp.where(allowed, jnp.arange(reach), 0))

    wanted = (ahead[furthest] - follow.lag_s * state.velocity) / follow.horizon_s
    speed = jnp.sqrt(jnp.sum(wanted**2) + 1e-9)
    return wanted * jnp.minimum(1.0, config.speed_m_s / speed), nearest


def fly_path(
    config: Config, follow: FollowConfig, airframe: Airframe, scene: Scene, goal: Array, points: Array
) -> Flights:
    """Flies once along points [K, 3] from `sample_path`, from rest at the first, facing the goal [3].

    Pure; `config` and `follow` are static. The scene's own start and goal are not used.

    Raises:
        ConfigError: if balls are thrown in the scene.

    Returns:
        the figures of the flight, without return and record.
    """
    if scene.spheres.throw is not None:
        raise ConfigError("planned paths are flown where no balls are thrown; world.balls must be 0")
    away = goal - points[0]
    body = drone.hover_state(points[0], jnp.arctan2(away[1], away[0]))

    def decide(flying: tuple[DroneState, Array, Flights]) -> tuple[DroneState, Array, Flights]:
        state, nearest, flights = flying
        command, nearest = steer(config.env, follow, points, nearest, state)
        after, flight = fly_decision(config.drone, airframe, state, command, heading_to_goal(config.env, state, goal))
        verdict = judge_decision(config, scene, goal, state.position, flight, flights.decisions + 1)
        flights, _ = update_tallies(config, scene, flights, state.position, flight, *verdict)
        return after, nearest, flights

    flying = body, jnp.zeros((), jnp.int32), at_start(config, scene, body)
    return jax.lax.while_loop(lambda f: f[2].outcome == Outcome.RUNNING, decide, flying)[2]


@functools.cache
def compiled_follower():
    """Returns `fly_path`, jitted; compiled once for each configuration and shape."""
    return jax.jit(fly_path, static_argnums=(0, 1), compiler_options=compiler_options(jax.devices()[0].platform))
