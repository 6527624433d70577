"""All pictures of a run, drawn from its directory and its final flight."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn import encoder
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.report.curves import draw_learning, draw_returns
from edqn_jax.report.flights import draw_path, draw_world
from edqn_jax.report.images import LOOKS, draw_reconstruction, draw_sight
from edqn_jax.runs.directory import TRAJECTORY_COLUMNS, RunDirectory
from edqn_jax.sim import camera, events, sensor
from edqn_jax.sim.drone import Flight
from edqn_jax.sim.scene import Scene

MOMENTS = 5
"""Moments of the flight that are shown."""

FINE = 8
"""How much finer than the drone's camera the pictures for people are, per axis."""


def draw_gallery(
    config: Config, run: RunDirectory, scene: Scene, params: PolicyParams, shortest: np.ndarray, outcome: str
) -> None:
    """World, path, returns, learning, what the drone sees and its reconstruction into the run's `figures/`.

    What it sees is named after its sensor; `ranges` and `blind` show no image, and nothing is reconstructed.

    Args:
        scene: where the recorded flight was flown.
        shortest: [P, 3] points of the shortest path.
        outcome: how the flight ended, as `summary.json` says it.
    """
    table = np.atleast_2d(np.loadtxt(run.trajectory_file, delimiter=",", skiprows=1))
    flown: dict[str, np.ndarray] = dict(zip(TRAJECTORY_COLUMNS, table.T, strict=True))
    draw_world(scene, run.figures / "world.png")
    draw_path(scene, flown, shortest, run.figures / "path.png", outcome, config.env.goal_radius_m)
    draw_returns(run.read_episodes(), run.figures / "returns.png")
    draw_learning(run.read_metrics(), run.figures / "learning.png")
    if sensor.sensor_of(config).image is not None:
        _draw_what_it_sees(config, run, scene, params, flown)


def _draw_what_it_sees(
    config: Config, run: RunDirectory, scene: Scene, params: PolicyParams, flown: dict[str, np.ndarray]
) -> None:
    """RGB beside what the sensor shows at moments of the flight, and what the VAE makes of that."""
    n, steps = config.drone.physics_steps, len(flown["t"])
    decisions = np.arange(1, max(steps // n, 1) + 1)  # row k stands after physics step k + 1
    offsets = np.array(sensor.frame_steps(config)) - n
    rows = np.clip(decisions[:, None] * n + offsets[None] - 1, 0, steps - 1)
    position = np.stack([flown[k] for k in ("x", "y", "z")], -1).astype(np.float32)
    quaternion = np.stack([flown[k] for k in ("qw", "qx", "qy", "qz")], -1).astype(np.float32)

    def poses(rows: np.ndarray) -> Flight:
        return Flight(position[rows], quaternion[rows], np.zeros(0))  # type: ignore

    look, has_events = LOOKS[config.env.sensor], sensor.sensor_of(config).form is sensor.Form.EVENTS
    native = _rgb(config, scene, poses(rows), 1)
    sensed = _sensed(config, scene, poses(rows), native)
    images = np.asarray(jax.vmap(events.event_image)(sensed) if has_events else sensed)
    shown = _busiest(np.abs(images).sum((1, 2)) if has_events else images.std((1, 2)), MOMENTS)
    rows, native, images, sensed = rows[shown], native[shown], images[shown], jax.tree.map(lambda x: x[shown], sensed)
    draw_sight(
        _display(_rgb(config, scene, poses(rows[:, -1:]), FINE)[:, -1]),
        _display(native[:, -1]),
        images,
        run.figures / f"{config.env.sensor}.png",
        list(rows[:, -1] * config.drone.physics_dt_s),
        look,
    )
    wanted = encoder.target(config.encoder, sensed)
    made = encoder.decode(
        config.encoder, config.camera, params.encoder, encoder.embed(config.encoder, params.encoder, sensed)
    )
    # ON and OFF together, as events per pixel again.
    seen, remembered = ((np.expm1(x) if has_events else x).sum(-3) for x in (np.asarray(wanted), np.asarray(made)))
    draw_reconstruction(seen, remembered, run.figures / "reconstruction.png", look)


def _busiest(events: np.ndarray, parts: int) -> np.ndarray:
    """Of each of `parts` equal parts of a flight the decision with the most to see; fewer in a short flight.

    `events` [decisions] is how much each has, such as its number of events.
    """
    numbers = np.array_split(np.arange(len(events)), parts)
    # Not from a part's rim, or neighbours in two parts would show one and the same thing.
    inner = [part[len(part) // 8 : len(part) - len(part) // 8] for part in numbers if len(part)]
    return np.array([part[np.argmax(events[part])] for part in inner])


def _sensed(config: Config, scene: Scene, poses: Flight, frames: np.ndarray) -> Any:
    """Returns what the sensor shows at poses [M, T], whose frames [M, T, H, W, 3] are drawn already."""
    key, noise = jax.random.split(jax.random.key(0))
    of_frames, memory = sensor.sensor_of(config).of_frames, sensor.at_rest(config, key)
    if of_frames is not None:
        luma = events.luma(jnp.asarray(frames))
        return jax.vmap(lambda f: of_frames(config, f, memory, noise)[0])(luma)

    @jax.jit
    def show(position: jax.Array, quaternion: jax.Array) -> Any:
        return sensor.sense(config, scene, Flight(position, quaternion, jnp.zeros_like(position)), memory, noise)[0]

    shown = [show(*pose) for pose in zip(poses.position, poses.quaternion, strict=True)]
    return jax.tree.map(lambda *each: jnp.stack(each), *shown)


def _rgb(config: Config, scene: Scene, poses: Flight, finer: int) -> np.ndarray:
    """[M, T, H, W, 3] linear RGB at poses [M, T], `finer` times the camera's resolution."""
    lens = dataclasses.replace(config.camera, width=config.camera.width * finer, height=config.camera.height * finer)

    @jax.jit
    def picture(position: jax.Array, quaternion: jax.Array) -> jax.Array:
        return camera.rgb(lens, scene, position, sensor.mount_rotation(config, quaternion))

    moments = np.shape(poses.position)[:2]
    wanted = [(m, t) for m in range(moments[0]) for t in range(moments[1])]
    images = [np.asarray(picture(poses.position[m, t], poses.quaternion[m, t])) for m, t in wanted]
    return np.stack(images).reshape(*moments, *images[0].shape)


def _display(linear: np.ndarray) -> np.ndarray:
    """Linear brightness as screens show it (gamma 2.2)."""
    return np.clip(linear, 0.0, 1.0) ** (1 / 2.2)
