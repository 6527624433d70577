"""The events of a camera that watches a simulated flight, as a recording to exchange."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.evaluation.trajectories import ATTITUDE, POSITION, VELOCITY, actions_of, columns_of, directions
from edqn_jax.interop.recordings.recording import Recording
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.launches import aim_along
from edqn_jax.sim.sensors.contrast import nominal_contrast
from edqn_jax.sim.task.action_sets import action_set
from edqn_jax.sim.task.env import EnvParams, scene_of

ONE_SENSOR = {"least_contrast": 0.0, "most_contrast": 0.0, "faults_share": 0.0, "sensor_pixels": 1}
"""Options of events of a sensor of which nothing is drawn."""


def flight_recording(
    config: Config, env_params: EnvParams, trajectory: Mapping[str, np.ndarray], size: tuple[int, int] | None = None
) -> Recording:
    """Returns the events of a flight, with a frame at every physics step, and where the camera was.

    The camera is an ESIM sensor, which remembers each pixel's level from frame to frame. Where the policy's own law has
    no memory (`paper`, `airsim`), the contrast of an event is that law's tolerance. It has all of its faults and the
    configured contrast, whatever was drawn in the flight, and each of its pixels is one pixel.

    Args:
        config: of the policy that flew.
        env_params: of the flight, with one mission.
        trajectory: the columns of `trajectory.csv`, one row after each physics step.
        size: width and height of the image; None is the policy's own.
    """
    law = config.events
    contrast = nominal_contrast(law)
    off = law.contrast_off if law.law == "esim" else contrast
    camera = config.camera if size is None else dataclasses.replace(config.camera, width=size[0], height=size[1])
    sees = dataclasses.replace(
        config,
        camera=camera,
        events=dataclasses.replace(law, contrast_on=contrast, contrast_off=off, **ONE_SENSOR),
    )
    poses = _from_start(env_params, trajectory)
    aim = None
    if env_params.pool.spheres.throw is not None:
        places = poses.position[:: config.drone.physics_steps]
        aim = aim_along(config, scene_of(env_params, jnp.asarray(0)), places)
    stream = Environment(sees, env_params).stream(poses, law="esim", aim=aim)
    steps = round(config.drone.physics_dt_s * 1e6)
    actions = np.concatenate([np.asarray(action_set(config).still)[None], actions_of(trajectory)])
    commanded = np.asarray(directions(config, poses, actions))
    if config.env.actions == "moves":
        moves = {"move": commanded.astype(np.int8)}
    else:
        moves = {"move": commanded.astype(np.float32), "action": actions.astype(np.float32)}
    return Recording(
        stream,
        camera.width,
        camera.height,
        contrast=contrast if contrast == off else None,
        flight={
            "t": steps * np.arange(len(poses.position), dtype=np.int64),
            "position": np.asarray(poses.position, np.float32),
            "quaternion": np.asarray(poses.quaternion, np.float32),
            "velocity": np.asarray(poses.velocity, np.float32),
            **moves,
        },
    )


def _from_start(env_params: EnvParams, trajectory: Mapping[str, np.ndarray]) -> Flight:
    """Returns the poses of a flight: at rest at the mission's start, facing the goal, then after each physics step.

    Each has its time.
    """
    start, goal = (np.asarray(each[0], np.float64) for each in (env_params.missions.start, env_params.missions.goal))
    half = np.arctan2(goal[1] - start[1], goal[0] - start[0]) / 2
    first = {"position": start, "quaternion": [np.cos(half), 0.0, 0.0, np.sin(half)], "velocity": np.zeros(3)}
    names = {"position": POSITION, "quaternion": ATTITUDE, "velocity": VELOCITY}
    columns = {
        key: jnp.asarray(np.vstack([first[key], columns_of(trajectory, names[key])]), jnp.float32) for key in names
    }
    time = jnp.asarray(np.concatenate([[0.0], trajectory["t"]]), jnp.float32)
    return Flight(**columns, time=time)
