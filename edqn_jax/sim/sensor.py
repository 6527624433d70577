"""What a drone is shown of the world around it: events, or what its rivals see in their place.

`events` is the method's sensor. `frames` is the newest brightness frame of the same camera, `depth` its true depth,
`ranges` the true free way along each move, `blind` nothing at all: for comparison at the same budget.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import CameraConfig, Config
from edqn_jax.sim import camera, drone, events, raycast
from edqn_jax.sim.drone import Flight
from edqn_jax.sim.events import EventField, EventMemory
from edqn_jax.sim.moves import DIRECTIONS
from edqn_jax.sim.raycast import Rays
from edqn_jax.sim.scene import Scene

Sensed = EventField | Array | None
"""What the sensor shows: an event field, a picture [H, W] of `frames` or `depth`, the nearness [26] of what lies along
each of `moves.DIRECTIONS`, or None for `blind`. All but events is of order 1."""

MID_GREY = -1.0
"""Log brightness that is 0 in a frame: about the middle of what there is to see."""

HALF_NEAR_M = 4.0
"""Distance of nearness a half, metres: what a drone flies along an axis in a second."""

DEPTH_SCALE = 3.0
"""What depth shows at contact: its pictures then vary as much as frames do, and the VAE weighs both alike."""


def frame_steps(config: Config) -> tuple[int, ...]:
    """Physics steps of a decision, 0..n, after which the sensor looks."""
    n = config.drone.physics_steps
    times = config.events.frame_times_s if config.env.sensor == "events" else (0.0,)
    return tuple(n + round(t / config.drone.physics_dt_s) for t in times)


def frames_per_decision(config: Config) -> int:
    """Pictures that are drawn for one decision."""
    return 0 if config.env.sensor in ("ranges", "blind") else len(frame_steps(config))


def view(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Luma frame [H, W] of the camera on a body at `position` [3] with attitude `quaternion` [4]."""
    return camera.luma(config.camera, scene, position, mount_rotation(config, quaternion))


def mount_rotation(config: Config, quaternion: Array) -> Array:
    """[3, 3] body-to-world rotation of the camera: the heading alone when level, else the full attitude."""
    if config.camera.mount == "level":
        w, z = quaternion[0], quaternion[3]
        scale = jax.lax.rsqrt(jnp.maximum(w * w + z * z, 1e-9))
        quaternion = jnp.stack([w * scale, jnp.zeros_like(w), jnp.zeros_like(w), z * scale])
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def at_rest(config: Config, key: Array) -> EventMemory | None:
    """What the sensor carries from one window to the next, before the first; None where it carries nothing."""
    if config.env.sensor != "events":
        return None
    return events.reset_memory(config.events, config.camera.height, config.camera.width, key)


def sense(
    config: Config, scene: Scene, poses: Flight, memory: EventMemory | None, key: Array
) -> tuple[Sensed, EventMemory | None]:
    """What the sensor shows at the end of a decision, and its memory after it.

    Args:
        poses: [T, ...] after the physics steps of `frame_steps`, in order.
        memory: from `at_rest` or the decision before.
        key: consumed only by noise events.
    """
    if config.env.sensor == "events":
        assert memory is not None
        frames = jax.vmap(lambda p, q: view(config, scene, p, q))(poses.position, poses.quaternion)
        return events.events(config.events, memory, frames, config.events.frame_times_s, key)
    position, quaternion = poses.position[-1], poses.quaternion[-1]
    match config.env.sensor:
        case "frames":
            return brightness(config, view(config, scene, position, quaternion)), None
        case "depth":
            metres = camera.depth(config.camera, scene, position, mount_rotation(config, quaternion))
            return DEPTH_SCALE * nearness(metres), None
        case "ranges":
            return nearness(ranges(config.camera, scene, position, drone.yaw_of(quaternion))), None
    return None, None


def brightness(config: Config, luma: Array) -> Array:
    """What `frames` shows of a luma frame [..., H, W]: log brightness (Eq. 1), of whose changes events are made.

    In the logarithm a contrast is the same in light and in shade; brightness itself varies so little that the VAE
    leaves part of its code unused (docs/baselines.md).
    """
    return events.log_brightness(config.events, luma) - MID_GREY


def nearness(distance: Array) -> Array:
    """`1 / (1 + distance / HALF_NEAR_M)`: 1 at contact, 0 at infinity, steepest where it matters."""
    return 1.0 / (1.0 + distance / HALF_NEAR_M)


def ranges(config: CameraConfig, scene: Scene, position: Array, yaw: Array) -> Array:
    """Metres [26] from `position` [3] to the nearest shape or the end of the flight volume along each move.

    Exact rays from the body's centre along `moves.DIRECTIONS` at heading `yaw`, for a centre that is in the volume and
    in no shape.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    ahead, left, up = jnp.asarray(DIRECTIONS.T)
    way = jnp.stack([cos * ahead - sin * left, sin * ahead + cos * left, up])
    # One row of rays; what belongs to a pixel's area does not matter for where they meet a shape.
    rays = Rays(
        dx=way[None, 0],
        dy=way[None, 1],
        dz=way[None, 2],
        right=jnp.zeros(3),
        up=jnp.zeros(3),
        pitch=0.0,
        across=1,
        down=1,
    )
    met = raycast.nearest_depth(config, scene, position, rays)[0]
    lower, upper = (jnp.abs(corner - position)[:, None] for corner in scene.volume)
    along = jnp.where(way > 0, upper, lower) / jnp.maximum(jnp.abs(way), raycast.TINY)
    fence = jnp.min(jnp.where(jnp.abs(way) > raycast.TINY, along, jnp.inf), axis=0)
    return jnp.minimum(met, fence)
