"""What a drone's state is: pose, velocities and heading.

Frames: the world has z up; the body has x ahead, y left, z up, its origin at the centre of mass. A
quaternion (w, x, y, z) turns body vectors into world vectors.

Heading is the quaternion's turn about the world's z, 2 atan2(z, w): what remains when the tilt is undone by
the shortest rotation, as a gimbal does. Unlike the Euler angle it does not change when a drone only tilts.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

Scalars = tuple[Array, Array, Array]
"""One vector, a scalar [] for each coordinate."""


@struct.dataclass
class DroneState:
    """State of the body and of its heading setpoint."""

    position: Array  # [3] of the centre of mass, metres, world
    quaternion: Array  # [4] w, x, y, z; body to world
    velocity: Array  # [3] m/s, world
    angular_velocity: Array  # [3] rad/s, body
    yaw_setpoint: Array  # [] radians


@struct.dataclass
class Flight:
    """Poses and velocities of one decision: n physics steps, each entry taken after its step."""

    position: Array  # [n, 3] metres, world
    quaternion: Array  # [n, 4]
    velocity: Array  # [n, 3] m/s, world
    time: Array | None = None  # [n] seconds of the episode, in a world that moves


def hover_state(position: Array, yaw: Array) -> DroneState:
    """Returns the state at rest and level at `position` [3] metres, nose and setpoint at `yaw` [] radians."""
    zero = jnp.zeros((), jnp.float32)
    yaw = jnp.asarray(yaw, jnp.float32)
    return DroneState(
        position=jnp.asarray(position, jnp.float32),
        quaternion=jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)]),
        velocity=jnp.zeros(3, jnp.float32),
        angular_velocity=jnp.zeros(3, jnp.float32),
        yaw_setpoint=wrap_angle(yaw),
    )


def wrap_angle(angle: Array) -> Array:
    """Returns the same angle within [-pi, pi], radians, any shape."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def yaw_of(quaternion: Array) -> Array:
    """Returns the heading [...] in [-pi, pi] of quaternions [..., 4], radians (see the module docstring)."""
    return wrap_angle(2 * jnp.arctan2(quaternion[..., 3], quaternion[..., 0]))


def roll_and_pitch_of(quaternion: Array) -> Array:
    """Returns roll in [-pi, pi] and pitch in [-pi/2, pi/2] of quaternions [..., 4], radians: [..., 2].

    The last two angles of turns about z, then y, then x, of the body; a body that looks down pitches by more than 0.
    """
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return jnp.stack([roll, jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))], axis=-1)


def yaw_rate_of(state: DroneState) -> Array:
    """Returns the rate [] of the heading of `yaw_of`, rad/s; of a level body, its angular velocity about z."""
    w, x, y, z = state.quaternion
    p, q, r = state.angular_velocity
    turn = w * (w * r + x * q - y * p) + z * (x * p + y * q + z * r)
    return turn / jnp.maximum(w * w + z * z, 1e-9)


def body_axes(w: Array, x: Array, y: Array, z: Array) -> tuple[Scalars, Scalars, Scalars]:
    """Returns the world's x, y and z axis in the body frame, for the attitude quaternion w, x, y, z, [] each."""
    up = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    ahead = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    left = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    return ahead, left, up
