"""A free rigid body in closed form: equal to an MJX step for an airframe without joints, contacts or drag.

Newton's and Euler's equations about the centre of mass, with axes along the principal ones, integrated as MuJoCo's
semi-implicit Euler does (MuJoCo's documentation, "Computation: numerical integration"): forces of the state before
the step change the velocities, and the changed velocities move and turn the body, the latter along a great circle.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def rigid_body_step(
    dt_s: float,
    mass: Array,
    inertia: Array,
    gravity: Array,
    wrench: Array,
    position: Array,
    quaternion: Array,
    velocity: Array,
    angular_velocity: Array,
    push: Array | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Returns the body's state after `dt_s` seconds.

    Args:
        dt_s: length of the step, seconds.
        mass: [] kg.
        inertia: [3] kg m^2 about the body's axes, which are the principal ones.
        gravity: [] m/s^2, downwards.
        wrench: [4] force along the body's z axis, newtons, and torque about its axes, newton metres.
        position: [3] of the centre of mass, metres, world.
        quaternion: [4] w, x, y, z; body to world.
        velocity: [3] m/s, world.
        angular_velocity: [3] rad/s, body.
        push: [3] further force at the centre of mass, newtons, world; None is none.

    Returns:
        position, quaternion, velocity, angular_velocity after the step; the quaternion has length 1.
    """
    force, torque_x, torque_y, torque_z = wrench
    w, x, y, z = quaternion
    p, q, r = angular_velocity
    ix, iy, iz = inertia

    lift = force / mass
    gained = jnp.stack(
        [2 * (x * z + w * y) * lift, 2 * (y * z - w * x) * lift, (1 - 2 * (x * x + y * y)) * lift - gravity]
    )
    if push is not None:
        gained = gained + push / mass
    velocity = velocity + dt_s * gained

    p, q, r = (
        p + dt_s * (torque_x - (iz - iy) * q * r) / ix,
        q + dt_s * (torque_y - (ix - iz) * r * p) / iy,
        r + dt_s * (torque_z - (iy - ix) * p * q) / iz,
    )
    rate = jnp.sqrt(p * p + q * q + r * r)
    half = 0.5 * dt_s * rate
    cos, share = jnp.cos(half), jnp.sin(half) / jnp.maximum(rate, 1e-12)
    a, b, c = share * p, share * q, share * r
    turned = (
        w * cos - x * a - y * b - z * c,
        w * a + x * cos + y * c - z * b,
        w * b - x * c + y * cos + z * a,
        w * c + x * b - y * a + z * cos,
    )
    unit = jax.lax.rsqrt(sum(part * part for part in turned))
    return (
        position + dt_s * velocity,
        jnp.stack([part * unit for part in turned]),
        velocity,
        jnp.stack([p, q, r]),
    )
