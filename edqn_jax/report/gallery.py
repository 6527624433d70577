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
from edqn_jax.report.images import draw_events, draw_reconstruction
from edqn_jax.rundir import TRAJECTORY_COLUMNS, RunDirectory
from edqn_jax.sim import camera, env, events
from edqn_jax.sim.drone import Flight
from edqn_jax.sim.scene import Scene

MOMENTS = 5
"""Moments of the flight that are shown."""

FINE = 8
"""How much finer than the drone's camera the pictures for people are, per axis."""


def draw_gallery(
    config: Config, run: RunDirectory, scene: Scene, params: PolicyParams, shortest: np.ndarray, outcome: str
) -> None:
    """World, events, path, returns, learning and reconstruction into the run's `figures/`.

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
    _draw_what_it_sees(config, run, scene, params, flown)


def _draw_what_it_sees(
    config: Config, run: RunDirectory, scene: Scene, params: PolicyParams, flown: dict[str, np.ndarray]
) -> None:
    """RGB beside events at moments of the flight, and what the VAE makes of those events."""
    n, steps = config.drone.physics_steps, len(flown["t"])
    decisions = np.arange(1, max(steps // n, 1) + 1)  # row k stands after physics step k + 1
    offsets = np.array(env.frame_steps(config)) - n
    rows = np.clip(decisions[:, None] * n + offsets[None] - 1, 0, steps - 1)
    position = np.stack([flown[k] for k in ("x", "y", "z")], -1).astype(np.float32)
    quaternion = np.stack([flown[k] for k in ("qw", "qx", "qy", "qz")], -1).astype(np.float32)

    def rgb(rows: np.ndarray, finer: int) -> np.ndarray:
        return _rgb(config, scene, Flight(position[rows], quaternion[rows], np.zeros(0)), finer)  # type: ignore

    native = rgb(rows, 1)
    frames = native[..., 0] * camera.LUMA[0] + native[..., 1] * camera.LUMA[1] + native[..., 2] * camera.LUMA[2]
    fields = jax.vmap(lambda f: _field(config, f))(jnp.asarray(frames))
    counts = np.asarray(jax.vmap(events.event_image)(fields))
    shown = _busiest(np.abs(counts).sum((1, 2)), MOMENTS)
    rows, native, counts, fields = rows[shown], native[shown], counts[shown], jax.tree.map(lambda x: x[shown], fields)
    draw_events(
        _display(rgb(rows[:, -1:], FINE)[:, -1]),
        _display(native[:, -1]),
        counts,
        run.figures / "events.png",
        list(rows[:, -1] * config.drone.physics_dt_s),
    )
    wanted = encoder.target(config.encoder, fields)
    made = encoder.decode(
        config.encoder, config.camera, params.encoder, encoder.embed(config.encoder, params.encoder, fields)
    )
    # ON and OFF together, as events per pixel again.
    seen, remembered = (np.expm1(np.asarray(x)).sum(-3) for x in (wanted, made))
    draw_reconstruction(seen, remembered, run.figures / "reconstruction.png")


def _busiest(events: np.ndarray, parts: int) -> np.ndarray:
    """Of each of `parts` equal parts of a flight the decision with the most events; fewer in a short flight."""
    numbers = np.array_split(np.arange(len(events)), parts)
    # Not from a part's rim, or neighbours in two parts would show one and the same thing.
    inner = [part[len(part) // 8 : len(part) - len(part) // 8] for part in numbers if len(part)]
    return np.array([part[np.argmax(events[part])] for part in inner])


def _field(config: Config, frames: Any) -> events.EventField:
    sensor, noise = jax.random.split(jax.random.key(0))
    memory = events.reset_memory(config.events, config.camera.height, config.camera.width, sensor)
    return events.events(config.events, memory, frames, config.events.frame_times_s, noise)[0]


def _rgb(config: Config, scene: Scene, poses: Flight, finer: int) -> np.ndarray:
    """[M, T, H, W, 3] linear RGB at poses [M, T], `finer` times the camera's resolution."""
    lens = dataclasses.replace(config.camera, width=config.camera.width * finer, height=config.camera.height * finer)

    @jax.jit
    def picture(position: jax.Array, quaternion: jax.Array) -> jax.Array:
        return camera.rgb(lens, scene, position, env.mount_rotation(config, quaternion))

    moments = np.shape(poses.position)[:2]
    wanted = [(m, t) for m in range(moments[0]) for t in range(moments[1])]
    images = [np.asarray(picture(poses.position[m, t], poses.quaternion[m, t])) for m, t in wanted]
    return np.stack(images).reshape(*moments, *images[0].shape)


def _display(linear: np.ndarray) -> np.ndarray:
    """Linear brightness as screens show it (gamma 2.2)."""
    return np.clip(linear, 0.0, 1.0) ** (1 / 2.2)
