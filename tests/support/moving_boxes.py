"""Synthetic windows for encoder tests: boxes that grow and slide between two frames, seen as events."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import CameraConfig, EventsConfig
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.event_laws import generate_events
from edqn_jax.sim.sensors.event_memory import reset_memory

BOXES = 5


def covered(low: Array, high: Array, size: int) -> Array:
    """Share of each of `size` unit cells that the interval covers, `[size]`: area averaging is exact."""
    cell = jnp.arange(size, dtype=jnp.float32)
    return jnp.clip(jnp.minimum(high, cell + 1.0) - jnp.maximum(low, cell), 0.0, 1.0)


def frames(camera: CameraConfig, key: Array, side: float = 0.0) -> Array:
    """`[2, H, W]` luma: far to near boxes over ground and sky, approached and turned a little.

    A `side` of -1 or +1 keeps every box in the left or right half.
    """
    keys = jax.random.split(key, 5)
    size = jnp.array([camera.width, camera.height], jnp.float32)
    near = jnp.linspace(0.2, 1.0, BOXES)[:, None]
    centre = jax.random.uniform(keys[0], (BOXES, 2), minval=0.0, maxval=1.0) * size
    half = (0.03 + 0.15 * jax.random.uniform(keys[1], (BOXES, 2)) * near) * size
    if side != 0.0:
        centre = centre.at[:, 0].set((0.5 + 0.25 * side) * size[0] + 0.3 * (centre[:, 0] - 0.5 * size[0]))
    albedo = jax.random.uniform(keys[2], (BOXES,), minval=0.1, maxval=0.9)
    turn = 0.4 * jax.random.normal(keys[3], (2,))
    speed = 0.05 * jax.random.uniform(keys[4], (), minval=0.2)

    def frame(time: float) -> Array:
        rows = jnp.linspace(0.8, 0.3, camera.height)[:, None]
        image = jnp.broadcast_to(rows, (camera.height, camera.width))
        zoom = 1.0 + time * speed * near
        middle = 0.5 * size + zoom * (centre - 0.5 * size) + time * turn
        for box in range(BOXES):
            low, high = middle[box] - zoom[box] * half[box], middle[box] + zoom[box] * half[box]
            across, down = covered(low[0], high[0], camera.width), covered(low[1], high[1], camera.height)
            share = down[:, None] * across[None, :]
            image = image + share * (albedo[box] - image)
        return image

    return jnp.stack([frame(0.0), frame(1.0)])


def fields(camera: CameraConfig, config: EventsConfig, key: Array, number: int, side: float = 0.0) -> EventField:
    """`number` windows, arrays `[number, 1, H, W]`."""

    def one(key: Array) -> EventField:
        memory = reset_memory(config, camera.height, camera.width, key)
        return generate_events(config, memory, frames(camera, key, side), config.frame_times_s, key)[0]

    return jax.vmap(one)(jax.random.split(key, number))
