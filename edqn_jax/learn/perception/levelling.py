"""Moves the events of a camera on the body to the pixels in which a level camera would have had them.

A body that leans shifts and turns its whole picture. Roll and pitch are known to any autopilot, so an encoder need not
learn what they do: each event's direction is turned back by the body's attitude at its time, as an electronic gimbal
turns a picture. What the body's camera did not see stays empty.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera.raycast import image_plane, pitch_of
from edqn_jax.sim.sensors.event_field import EventField

LEAST_AHEAD = 0.1
"""Directions of which less than this points ahead of the body's camera are outside of its picture."""


def level_events(camera: CameraConfig, field: EventField, lean: Array, *, whole: bool) -> EventField:
    """Returns a field [..., R, H, W] of a camera on the body as a level camera of the same lens has it.

    A level pixel gets the counts around its place in the body's picture, weighted as in a bilinear interpolation and
    rounded, evenly spaced over what the nearest pixel has as its times.

    Args:
        camera: both cameras' pixels and field of view.
        field: R rows, one a frame pair, or of ON and then of OFF events.
        lean: [..., T, 2] roll and pitch at each frame, radians, as `drone.roll_and_pitch_of` has them; between two
            frames the body leans as their mean.
        whole: whether the nearest pixel's count is taken as it is; of few events a share would be rounded to none.
    """
    rows, columns, seen = level_places(camera, (lean[..., :-1, :] + lean[..., 1:, :]) / 2)
    if field.with_noise:
        rows, columns, seen = (jnp.concatenate([x, x], axis=-3) for x in (rows, columns, seen))
    near = jnp.round(rows), jnp.round(columns)
    pick = lambda array, row, column: _gather(camera, array, row.astype(jnp.int32), column.astype(jnp.int32))  # noqa: E731
    signed = field.count * field.polarity
    if whole:
        moved = pick(signed, *near)
    else:
        top, left = jnp.floor(rows), jnp.floor(columns)
        down, right = rows - top, columns - left
        signed = signed.astype(jnp.float32)
        moved = jnp.round(
            (1 - down) * ((1 - right) * pick(signed, top, left) + right * pick(signed, top, left + 1))
            + down * ((1 - right) * pick(signed, top + 1, left) + right * pick(signed, top + 1, left + 1))
        ).astype(jnp.int32)
    moved = jnp.where(seen, moved, 0)
    first, step = (pick(x, *near) for x in (field.t_first, field.t_step))
    return dataclasses.replace(
        field, count=jnp.abs(moved), polarity=jnp.sign(moved).astype(field.polarity.dtype), t_first=first, t_step=step
    )


def level_places(camera: CameraConfig, lean: Array) -> tuple[Array, Array, Array]:
    """Returns row and column [..., H, W] in the body's picture of each pixel of a level one, and whether it is in it.

    Args:
        camera: both cameras' pixels and field of view.
        lean: [..., 2] roll and pitch, radians.
    """
    across, up = (jnp.asarray(x) for x in image_plane(camera, 1, 1))
    roll, pitch = lean[..., 0, None, None], lean[..., 1, None, None]
    left, up = -across[None, :], up[:, None]
    ahead = jnp.cos(pitch) - jnp.sin(pitch) * up
    up = jnp.sin(pitch) + jnp.cos(pitch) * up
    left, up = jnp.cos(roll) * left + jnp.sin(roll) * up, jnp.cos(roll) * up - jnp.sin(roll) * left
    size = pitch_of(camera)
    near = jnp.maximum(ahead, LEAST_AHEAD)
    column = -left / near / size + (camera.width - 1) / 2
    row = -up / near / size + (camera.height - 1) / 2
    inside = (jnp.abs(column - (camera.width - 1) / 2) < camera.width / 2) & (
        jnp.abs(row - (camera.height - 1) / 2) < camera.height / 2
    )
    return (
        jnp.clip(row, 0.0, camera.height - 1.0),
        jnp.clip(column, 0.0, camera.width - 1.0),
        inside & (ahead >= LEAST_AHEAD),
    )


def _gather(camera: CameraConfig, array: Array, row: Array, column: Array) -> Array:
    """Returns values of [..., H, W] at rows and columns [..., H, W] of it; beyond the last ones theirs."""
    row, column = jnp.minimum(row, camera.height - 1), jnp.minimum(column, camera.width - 1)
    flat = array.reshape(*array.shape[:-2], -1)
    index = (row * camera.width + column).reshape(flat.shape)
    return jnp.take_along_axis(flat, index, axis=-1, mode="promise_in_bounds").reshape(array.shape)
