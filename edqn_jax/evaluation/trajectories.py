"""Recorded flights as tables with one row per physics step, for `trajectory.csv` and `.npz` files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config
from edqn_jax.evaluation.missions import MissionSet
from edqn_jax.files import write_atomically
from edqn_jax.sim.physics.drone import DroneState, Flight, yaw_of
from edqn_jax.sim.task.action_sets import action_set
from edqn_jax.sim.task.flights import Flights
from edqn_jax.sim.task.outcomes import Outcome

POSITION, ATTITUDE, VELOCITY = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("vx", "vy", "vz")

TRAJECTORY_COLUMNS = ("t", *POSITION, *ATTITUDE, *VELOCITY, "action", "reward", "clearance")
"""Columns of `trajectory.csv`, one row a physics step: seconds, metres, a unit quaternion, m/s, the action's
number, the reward of the decision and the distance of the body's sphere from the nearest shape."""


def trajectory_columns(values: int | None = None) -> tuple[str, ...]:
    """Returns the columns of `trajectory.csv` for actions of so many values; None for those that are one number.

    >>> trajectory_columns(3)[11:14]
    ('action_0', 'action_1', 'action_2')
    """
    if values is None:
        return TRAJECTORY_COLUMNS
    at = TRAJECTORY_COLUMNS.index("action")
    return (*TRAJECTORY_COLUMNS[:at], *(f"action_{n}" for n in range(values)), *TRAJECTORY_COLUMNS[at + 1 :])


def flight_trajectory(config: Config, flights: Flights, mission: int = 0) -> dict[str, np.ndarray]:
    """Returns one recorded flight as the columns of `trajectory.csv`, each [T], one row after each physics step.

    Raises:
        ValueError: if the flights were not recorded.
    """
    steps = int(flights.physics_steps[mission])
    whole = jax.tree.map(lambda leaf: np.asarray(leaf[mission]), flights.get_record())
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
    columns = trajectory_columns(*whole.action.shape[1:])
    return dict(zip(columns, values.T, strict=True))


def columns_of(flown: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """Returns columns of a trajectory beside each other, [T, names] float64."""
    return np.stack([np.asarray(flown[name], np.float64) for name in names], axis=-1)


def actions_of(flown: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the actions [T] or [T, A] in the columns of a trajectory."""
    names = tuple(name for name in flown if name.startswith("action_"))
    return columns_of(flown, names) if names else flown["action"]


def directions(config: Config, poses: Flight, actions: np.ndarray | Array) -> Array:
    """Returns the directions [T, 3] that actions commanded, in the heading frame, see `ActionSet.direction`.

    Args:
        config: names the action set.
        poses: [T] at the ends of the decisions; what a trajectory does not hold, rates and setpoint, is none.
        actions: [T] or [T, A].
    """
    actions_flown = action_set(config)

    def direction(pose: Flight, action: jax.Array) -> jax.Array:
        still = jnp.zeros(3)
        body = DroneState(pose.position, pose.quaternion, pose.velocity, still, yaw_of(pose.quaternion))
        return actions_flown.direction(body, action)

    return jax.vmap(direction)(poses, jnp.asarray(actions, actions_flown.space.dtype))


def write_trajectories(config: Config, missions: MissionSet, flights: Flights, file: Path) -> None:
    """Writes all flights as one `.npz`, with all that another physics engine needs to check the verdicts.

    Row 0 of each flight is its start, row k its pose after physics step k; rows after the end are NaN.
    `lengths` is the number of rows of each flight. The contact of a collision is in the last segment, at the
    fraction `contact` of it. `mjcf[scene[i]]` is the world of mission i. Of several drones `hit_drone` says which
    collisions were with another; those of a group are in a row, and all begin at the same time.

    Raises:
        ConfigError: if the file cannot be written.
        ValueError: if the flights were not recorded.
    """
    record = flights.get_record()
    host_missions = jax.tree.map(np.asarray, missions.env_params.missions)
    heading = np.arctan2(*(host_missions.goal - host_missions.start)[:, 1::-1].T)
    level = np.zeros_like(heading)
    facing = np.column_stack([np.cos(heading / 2), level, level, np.sin(heading / 2)])
    longest = int(np.max(flights.physics_steps))
    columns = {
        "positions": np.concatenate([host_missions.start[:, None], record.position[:, :longest]], axis=1),
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
        "scene": host_missions.scene,
        "start": host_missions.start,
        "goal": host_missions.goal,
        "mjcf": np.array(missions.mjcf()),
        **({} if flights.hit_drone is None else {"hit_drone": flights.hit_drone}),
        "body_radius_m": np.float64(config.drone.body_radius_m),
        "physics_dt_s": np.float64(config.drone.physics_dt_s),
    }
    with tempfile.SpooledTemporaryFile() as buffer:
        np.savez_compressed(buffer, **columns)
        buffer.seek(0)
        write_atomically(file, buffer.read())
