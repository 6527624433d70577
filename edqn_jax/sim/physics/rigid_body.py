"""A free rigid body in closed form: equal to an MJX step for an airframe without joints, contacts or drag.

Newton's and Euler's equations about the centre of mass, with axes along the principal ones, integrated as MuJoCo's
semi-implicit Euler does (MuJoCo's documentation, "Computation: numerical integration"): forces of the state before
the step change the velocities, and the changed velocities move and turn the body, the latter along a great circle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class RigidBody(NamedTuple):
    """Constants of a free rigid body."""

    mass: Array
    """[] kg."""
    inertia: Array
    """[3] kg m^2 about the body's axes, which are the principal ones."""
    gravity: Array
    """[] m/s^2, downwards."""


Motion = tuple[Array, Array, Array, Array]
"""Position [3] of the centre of mass, metres, quaternion [4] w, x, y, z, body to world, velocity [3] m/s, world, and
angular velocity [3] rad/s, body."""


def rigid_body_step(dt_s: float, body: RigidBody, wrench: Array, motion: Motion, push: Array | None = None) -> Motion:
    """Returns the body's motion after `dt_s` seconds; its quaternion has length 1.

    Args:
        dt_s: length of the step, seconds.
        body: its mass and inertia, and the gravity.
        wrench: [4] force along the body's z axis, newtons, and torque about its axes, newton metres.
        motion: before the step.
        push: [3] further force at the centre of mass, newtons, world; None is none.
    """
    mass, inertia, gravity = body
    position, quaternion, velocity, angular_velocity = motion
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
