"""The label by image columns, in numba: `edqn_jax.sim.sensors.sensor.nearness_image` of a level camera."""

from __future__ import annotations

import math

from conventional_stack.cameras.shapes import (
    columns_between,
    compiled,
    extent_of_box,
    extent_of_disc,
    eye_of,
    in_frame,
    inverse,
    out_of_sight,
    past_ball,
    rows_between,
    slabs,
)
from edqn_jax.sim.scene.shapes.plane import HORIZON_M
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, HALF_NEAR_M


@compiled
def _meet_others(shapes, optics, nearest, eye):
    """Computes the depth of planes and spheres along the middle ray of each pixel; inf where there is nothing."""
    x, y, z, cos, sin = eye
    nearest[:] = math.inf
    for n in range(len(shapes.plane_luma)):
        nx, ny, nz = shapes.normal[n, 0], shapes.normal[n, 1], shapes.normal[n, 2]
        above = nx * (x - shapes.plane[n, 0]) + ny * (y - shapes.plane[n, 1]) + nz * (z - shapes.plane[n, 2])
        for column in range(len(optics.u)):
            ahead = nx * (cos + optics.u[column] * sin) + ny * (sin - optics.u[column] * cos)
            for row in range(len(optics.v)):
                approach = ahead + nz * optics.v[row]
                t = -above * inverse(approach)
                before = nearest[column, row]
                # A selection, which the compiler vectorises.
                seen = (approach < 0.0) & (t > 0.0) & (t < HORIZON_M) & (t < before)
                nearest[column, row] = t if seen else before
    for n in range(len(shapes.radius)):
        ox, oy, oz = x - shapes.ball[n, 0], y - shapes.ball[n, 1], z - shapes.ball[n, 2]
        left, right = extent_of_disc(cos, sin, -ox, -oy, shapes.radius[n])
        first, last = columns_between(optics, left, right)
        for column in range(first, last):
            dx, dy = cos + optics.u[column] * sin, sin - optics.u[column] * cos
            for row in range(len(optics.v)):
                middle, miss, a = past_ball(ox, oy, oz, dx, dy, optics.v[row])
                if miss < shapes.radius[n]:
                    t = middle - math.sqrt((shapes.radius[n] ** 2 - miss * miss) / a)
                    if 0.0 < t < nearest[column, row]:
                        nearest[column, row] = t


@compiled
def _meet_uprights(shapes, optics, nearest, eye):
    """Lowers these depths to those of the upright shapes."""
    x, y, z, cos, sin = eye
    height = len(optics.v)
    for n in range(len(shapes.luma)):
        is_round, turn_x, turn_y = shapes.is_round[n], shapes.turn[n, 0], shapes.turn[n, 1]
        hx, hy, hz = shapes.half[n, 0], shapes.half[n, 1], shapes.half[n, 2]
        ox, oy, rise = x - shapes.place[n, 0], y - shapes.place[n, 1], shapes.place[n, 2] - z
        if out_of_sight(optics, cos, sin, -ox, -oy, hx if is_round else math.sqrt(hx * hx + hy * hy)):
            continue
        if is_round:
            left, right = extent_of_disc(cos, sin, -ox, -oy, hx)
        else:
            left, right = extent_of_box(cos, sin, -ox, -oy, turn_x, turn_y, hx, hy)
        bx, by = in_frame(turn_x, turn_y, ox, oy)
        fx, fy = in_frame(turn_x, turn_y, cos, sin)
        first, last = columns_between(optics, left, right)
        for column in range(first, last):
            u = optics.u[column]
            if is_round:
                dx, dy = cos + u * sin, sin - u * cos
                a = dx * dx + dy * dy
                middle = -(ox * dx + oy * dy) / a
                inside = hx * hx - ((ox + middle * dx) ** 2 + (oy + middle * dy) ** 2)
                if inside <= 0.0:
                    continue
                reach = math.sqrt(inside / a)
                begin, end = middle - reach, middle + reach
            else:
                _, _, in_x, in_y, out_x, out_y = slabs(bx, by, fx, fy, hx, hy, u)
                begin, end = max(in_x, in_y), min(out_x, out_y)
            if begin >= end or end <= 0.0:
                continue
            above, below = 0, height
            if begin > 0.0:
                bottom, top = (rise - hz) / optics.pitch, (rise + hz) / optics.pitch
                above, below = rows_between(height, min(bottom / begin, bottom / end), max(top / begin, top / end))
            for row in range(above, below):
                per_height = inverse(optics.v[row])
                reach = hz * abs(per_height)
                enter, leave = max(begin, rise * per_height - reach), min(end, rise * per_height + reach)
                if 0.0 < enter < leave and enter < nearest[column, row]:
                    nearest[column, row] = enter


@compiled
def nearness(shapes, optics, nearest, pose, label):
    """Computes `edqn_jax.sim.sensors.sensor.nearness_image` [M, P] of M frames at poses [M, 7]; the sky is 0."""
    width = len(optics.u)
    for m in range(len(pose)):
        eye = eye_of(pose[m])
        _meet_others(shapes, optics, nearest, eye)
        _meet_uprights(shapes, optics, nearest, eye)
        for row in range(len(optics.v)):
            for column in range(width):
                metres = nearest[column, row] * math.sqrt(1.0 + optics.u[column] ** 2 + optics.v[row] ** 2)
                label[m, row * width + column] = DEPTH_SCALE / (1.0 + metres / HALF_NEAR_M)
