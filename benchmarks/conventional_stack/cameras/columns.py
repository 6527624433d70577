"""The level camera by image columns, in numba: the method of `edqn_jax/sim/camera/coverage.py`.

Under a level camera an upright shape covers a part of the width of each image column and one interval of its rows. So
each shape is drawn into the columns that it covers alone, and each pixel is the average over its area: of its nearest
three layers over ground and sky. Texture is computed at all visible layers of a frame in one loop of single precision,
which the compiler vectorises; all else is in double precision.

H rows, W columns, P = H x W pixels. Heights and intervals of rows are counted from the horizon, positive upwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conventional_stack.cameras.depths import nearness
from conventional_stack.cameras.optics import optics_of
from conventional_stack.cameras.shapes import (
    columns_between,
    compiled,
    extent_of_box,
    extent_of_disc,
    eye_of,
    in_frame,
    inlined,
    inverse,
    lit,
    out_of_sight,
    past_ball,
    rows_between,
    shapes_of,
    slabs,
)
from conventional_stack.stopwatch import Stopwatch
from conventional_stack.world import World
from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera.coverage import DEPTH_OF_LAYERS, LEVEL_FACE, NEAR_M
from edqn_jax.sim.scene.shapes.kind import TINY
from edqn_jax.sim.scene.shapes.plane import HORIZON_M

_WHOLE = 1.0 - 1e-6
"""Coverage from which on what lies behind is not seen: 1 but for rounding."""

_NEAR, _COVERED, _VALUE, _SLOPE = range(4)
"""Numbers of a layer."""

_HALF, _ONE, _EIGHT, _SIXTEEN, _CURVE = (np.float32(x) for x in (0.5, 1, 8, 16, 0.55))


class Work(NamedTuple):
    """Memory for one frame. T = 4 P places at which texture may be needed, one for each layer and one for a plane."""

    number: NDArray[np.int64]  # [W, H] of layers; of visible ones once they have been collected
    layers: NDArray[np.float64]  # [W, H, 3, 4] nearest first: closeness, coverage, value, slope as in our `Layer`
    share: NDArray[np.float64]  # [W, H] of a plane behind the layers; negative where layers hide it and the sky
    shown: NDArray[np.float64]  # [W, H] brightness of that plane
    places: NDArray[np.float32]  # [6, T] depth, its change over a pixel rightwards and upwards; the ray
    factor: NDArray[np.float32]  # [T] of the texture

    @classmethod
    def empty(cls, width: int, height: int) -> Work:
        """Allocates the arrays."""
        image, most = (width, height), (DEPTH_OF_LAYERS + 1) * width * height
        return cls(
            number=np.empty(image, np.int64),
            layers=np.empty((*image, DEPTH_OF_LAYERS, 4)),
            share=np.empty(image),
            shown=np.empty(image),
            places=np.empty((6, most), np.float32),
            factor=np.empty(most, np.float32),
        )


@inlined
def _meets_x_side(x, y, fx, fy, hx, hy, u):
    _, _, in_x, in_y, _, _ = slabs(x, y, fx, fy, hx, hy, u)
    return in_x > in_y


@inlined
def _insert(number, layers, column, row, closeness, coverage, value, slope):
    """Adds a layer to a pixel and keeps its nearest three."""
    at = number[column, row]
    number[column, row] = min(at + 1, DEPTH_OF_LAYERS)
    while at > 0 and closeness > layers[column, row, at - 1, _NEAR]:
        at -= 1
        if at + 1 < DEPTH_OF_LAYERS:
            for of in range(4):
                layers[column, row, at + 1, of] = layers[column, row, at, of]
    if at < DEPTH_OF_LAYERS:
        layers[column, row, at, _NEAR], layers[column, row, at, _COVERED] = closeness, coverage
        layers[column, row, at, _VALUE], layers[column, row, at, _SLOPE] = value, slope


@inlined
def _insert_side(number, layers, height, column, share, heights, bright, cap_bright, enter, leave, lean):
    """Adds one column of an upright shape to the layers of its pixels.

    Args:
        share: of the column's width that is covered.
        heights: bottom, top and visible horizontal face (0: none), in rows x metres.
        bright, cap_bright: brightness of the side and of the horizontal face.
        enter, leave: depths, metres.
        lean: change of closeness per pixel rightwards on the side, relative to closeness.
    """
    bottom, top, cap = heights
    near, far = 1.0 / max(enter, NEAR_M), 1.0 / max(leave, NEAR_M)
    low, high = bottom * near, top * near
    cap_low, cap_high = min(cap * near, cap * far), max(cap * near, cap * far)
    farthest = near if cap == 0.0 else far  # without a horizontal face, closeness is the side's
    per_row = inverse(cap)
    first, last = rows_between(height, min(low, cap_low), max(high, cap_high))
    for row in range(first, last):
        middle = 0.5 * height - 0.5 - row
        of_side = max(min(high, middle + 0.5) - max(low, middle - 0.5), 0.0)
        of_cap = max(min(cap_high, middle + 0.5) - max(cap_low, middle - 0.5), 0.0)
        coverage = (of_side + of_cap) * share
        if coverage > 0.0:
            closeness = min(max(middle * per_row, farthest), near)
            value = (of_side * bright + of_cap * cap_bright) * share
            _insert(
                number, layers, column, row, closeness, coverage, value, LEVEL_FACE if of_cap > of_side else lean * near
            )


@compiled
def _insert_uprights(shapes, optics, work, eye):
    light = optics.ambient, optics.sun[0], optics.sun[1], optics.sun[2]
    x, y, z, cos, sin = eye
    pitch, height = optics.pitch, len(optics.v)
    for n in range(len(shapes.luma)):
        is_round, luma, turn_x, turn_y = shapes.is_round[n], shapes.luma[n], shapes.turn[n, 0], shapes.turn[n, 1]
        hx, hy, hz = shapes.half[n, 0], shapes.half[n, 1], shapes.half[n, 2]
        ox, oy = x - shapes.place[n, 0], y - shapes.place[n, 1]
        if out_of_sight(optics, cos, sin, -ox, -oy, hx if is_round else math.sqrt(hx * hx + hy * hy)):
            continue
        if is_round:
            left, right = extent_of_disc(cos, sin, -ox, -oy, hx)
        else:
            left, right = extent_of_box(cos, sin, -ox, -oy, turn_x, turn_y, hx, hy)
        first, last = columns_between(optics, left, right)
        if first >= last:
            continue
        bottom, top = (shapes.place[n, 2] - z - hz) / pitch, (shapes.place[n, 2] - z + hz) / pitch
        # The top from above, the bottom from below, none in between.
        heights = bottom, top, top if top < 0.0 else max(bottom, 0.0)
        cap_bright = luma * lit(light, 0.0, 0.0, 1.0 if top < 0.0 else -1.0)
        bx, by = in_frame(turn_x, turn_y, ox, oy)
        fx, fy = in_frame(turn_x, turn_y, cos, sin)
        sx, sy = np.sign(bx), np.sign(by)
        # Of two opposite sides a ray enters by the one on the eye's side.
        x_side = luma * lit(light, sx * turn_x, sx * turn_y, 0.0)
        y_side = luma * lit(light, -sy * turn_y, sy * turn_x, 0.0)
        ex, ey = sx * hx - bx, sy * hy - by
        corner = (ex * fy - ey * fx) * inverse(ex * fx + ey * fy)  # where the two meet
        for column in range(first, last):
            low, high = max(optics.u[column] - 0.5 * pitch, left), min(optics.u[column] + 0.5 * pitch, right)
            if low >= high:
                continue
            u = 0.5 * (low + high)
            if is_round:
                dx, dy = cos + u * sin, sin - u * cos
                a = dx * dx + dy * dy
                middle = -(ox * dx + oy * dy) / a
                inside = hx * hx - ((ox + middle * dx) ** 2 + (oy + middle * dy) ** 2)
                reach = math.sqrt(max(inside, 0.0) / a)
                enter, leave = middle - reach, middle + reach
                nx, ny = (ox + enter * dx) / max(hx, TINY), (oy + enter * dy) / max(hx, TINY)
                lean = (nx * sin - ny * cos) * inverse(nx * dx + ny * dy)
                bright = luma * lit(light, nx, ny, 0.0)
            else:
                ix, iy, in_x, in_y, out_x, out_y = slabs(bx, by, fx, fy, hx, hy, u)
                enter, leave = max(in_x, in_y), min(out_x, out_y)
                lean = fy * ix if in_x > in_y else -fx * iy
                at_low = x_side if _meets_x_side(bx, by, fx, fy, hx, hy, low) else y_side
                at_high = x_side if _meets_x_side(bx, by, fx, fy, hx, hy, high) else y_side
                part = min(max((corner - low) / (high - low), 0.0), 1.0)
                bright = at_low if at_low == at_high else part * at_low + (1.0 - part) * at_high
            share = (high - low) / pitch
            _insert_side(
                work.number, work.layers, height, column, share, heights, bright, cap_bright, enter, leave, lean * pitch
            )


@compiled
def _insert_balls(shapes, optics, work, eye):
    """Adds spheres, whose coverage falls linearly over the pixel that their edge crosses."""
    light = optics.ambient, optics.sun[0], optics.sun[1], optics.sun[2]
    x, y, z, cos, sin = eye
    for n in range(len(shapes.radius)):
        radius = shapes.radius[n]
        ox, oy, oz = x - shapes.ball[n, 0], y - shapes.ball[n, 1], z - shapes.ball[n, 2]
        left, right = extent_of_disc(cos, sin, -ox, -oy, radius)
        # A silhouette fades over half a pixel on either side.
        first, last = columns_between(optics, left - optics.pitch, right + optics.pitch)
        for column in range(first, last):
            dx, dy = cos + optics.u[column] * sin, sin - optics.u[column] * cos
            for row in range(len(optics.v)):
                dz = optics.v[row]
                middle, miss, a = past_ball(ox, oy, oz, dx, dy, dz)
                if middle <= 0.0:
                    continue
                pixel = max(middle, NEAR_M) * optics.pitch
                # A sphere smaller than a pixel covers no more than its own disc.
                most = min(math.pi * (radius / pixel) ** 2, 1.0)
                coverage = min(max(0.5 + (radius - miss) / pixel, 0.0), most)
                if coverage > 0.0:
                    depth = middle - math.sqrt(max(radius * radius - miss * miss, 0.0) / a)
                    wide = max(miss, radius, TINY)
                    nx, ny, nz = (ox + depth * dx) / wide, (oy + depth * dy) / wide, (oz + depth * dz) / wide
                    value = coverage * shapes.ball_luma[n] * lit(light, nx, ny, nz)
                    _insert(work.number, work.layers, column, row, 1.0 / max(depth, NEAR_M), coverage, value, 0.0)


@inlined
def _note(places, at, depth, right, up, dx, dy, dz):
    """Notes a place at which texture is needed, see `Work.places`."""
    places[0, at], places[1, at], places[2, at] = depth, right, up
    places[3, at], places[4, at], places[5, at] = dx, dy, dz


@compiled
def _collect(shapes, optics, work, eye):
    """Notes where texture is needed, pixel by pixel: at the visible layers, then at the plane behind them.

    Returns:
        the number of these places.
    """
    light = optics.ambient, optics.sun[0], optics.sun[1], optics.sun[2]
    x, y, z, cos, sin = eye
    number, layers, places = work.number, work.layers, work.places
    pitch, count = optics.pitch, 0
    for column in range(len(optics.u)):
        dx, dy = cos + optics.u[column] * sin, sin - optics.u[column] * cos
        for row in range(len(optics.v)):
            dz = optics.v[row]
            hidden, visible = False, 0
            while visible < number[column, row] and not hidden:
                depth, slope = 1.0 / layers[column, row, visible, _NEAR], layers[column, row, visible, _SLOPE]
                if slope == LEVEL_FACE:
                    _note(places, count, depth, 0.0, -depth * inverse(dz) * pitch, dx, dy, dz)
                else:
                    _note(places, count, depth, -depth * depth * slope, 0.0, dx, dy, dz)
                count += 1
                hidden = layers[column, row, visible, _COVERED] >= _WHOLE
                visible += 1
            number[column, row] = visible
            if hidden:
                work.share[column, row] = -1.0
                continue
            depth, share, shown, change_right, change_up = math.inf, 0.0, 0.0, 0.0, 0.0
            for n in range(len(shapes.plane_luma)):
                nx, ny, nz = shapes.normal[n, 0], shapes.normal[n, 1], shapes.normal[n, 2]
                approach = nx * dx + ny * dy + nz * dz
                across, along = (nx * sin - ny * cos) * pitch, nz * pitch
                spread = abs(across) + abs(along)
                # The plane's horizon is the line n . d = 0; the part of the pixel below it is covered by the plane.
                middle = 0.5 * (approach - 0.5 * spread + min(approach + 0.5 * spread, 0.0))
                if middle >= 0.0:
                    continue
                above = nx * (x - shapes.plane[n, 0]) + ny * (y - shapes.plane[n, 1]) + nz * (z - shapes.plane[n, 2])
                per_middle = inverse(middle)
                t = -above * per_middle
                if 0.0 < t < HORIZON_M and t < depth:
                    depth, share = t, min(max(0.5 - approach * inverse(spread), 0.0), 1.0)
                    shown = shapes.plane_luma[n] * lit(light, nx, ny, nz)
                    change_right, change_up = -t * per_middle * across, -t * per_middle * along
            work.share[column, row], work.shown[column, row] = share, shown
            if share > 0.0:
                _note(places, count, depth, change_right, change_up, dx, dy, dz)
                count += 1
    return count


@compiled
def _texture(optics, work, eye, places):
    """Computes the texture's factor at all places, as `edqn_jax.sim.camera.texture.texture_factor`."""
    x, y, z, cos, sin = eye
    depth, right, up = work.places[0, :places], work.places[1, :places], work.places[2, :places]
    dx, dy, dz, factor = work.places[3, :places], work.places[4, :places], work.places[5, :places], work.factor[:places]
    factor[:] = _ONE
    for wave in range(len(optics.weights)):
        kx, ky, kz = optics.waves[wave, 0], optics.waves[wave, 1], optics.waves[wave, 2]
        at_eye = kx * x + ky * y + kz * z
        start, weight = np.float32(at_eye - math.floor(at_eye)), np.float32(optics.weights[wave])
        k0, k1, k2 = np.float32(kx), np.float32(ky), np.float32(kz)
        per_right, per_up = np.float32((kx * sin - ky * cos) * optics.pitch), np.float32(kz * optics.pitch)
        for i in range(places):
            along = k0 * dx[i] + k1 * dy[i] + k2 * dz[i]
            cycles_right = depth[i] * per_right + right[i] * along
            cycles_up = depth[i] * per_up + up[i] * along
            a, b = cycles_right * cycles_right, cycles_up * cycles_up
            a, b = (a if a < _ONE else _ONE), (b if b < _ONE else _ONE)
            left = (_ONE - a) * (_ONE - _CURVE * a) * (_ONE - b) * (_ONE - _CURVE * b)
            phase = start + depth[i] * along
            f = phase - np.floor(phase + _HALF)
            factor[i] += weight * left * (f * (_EIGHT - _SIXTEEN * abs(f)))


@compiled
def _blend(optics, work, luma):
    """Blends the layers over plane and sky, into luma [P]."""
    width, place = len(optics.u), 0
    for column in range(width):
        for row in range(len(optics.v)):
            visible, share = work.number[column, row], work.share[column, row]
            behind = optics.sky if share >= 0.0 else 0.0
            if share > 0.0:
                behind += share * (work.shown[column, row] * work.factor[place + visible] - behind)
            for k in range(visible - 1, -1, -1):
                behind -= work.layers[column, row, k, _COVERED] * behind
                behind += work.layers[column, row, k, _VALUE] * work.factor[place + k]
            place += visible + (1 if share > 0.0 else 0)
            luma[row * width + column] = behind


@compiled
def draw(shapes, optics, work, pose, luma):
    """Computes the luma [M, P] of M frames.

    Args:
        pose: [M, 7] position and quaternion; roll and pitch are removed.
    """
    for m in range(len(pose)):
        eye = eye_of(pose[m])
        work.number[:] = 0
        _insert_uprights(shapes, optics, work, eye)
        _insert_balls(shapes, optics, work, eye)
        _texture(optics, work, eye, _collect(shapes, optics, work, eye))
        _blend(optics, work, luma[m])


class ColumnCamera:
    """A `Camera` by columns."""

    block = 32

    def __init__(self, config: CameraConfig, world: World, drones: int) -> None:
        """Allocates the memory of a frame, whatever the number of drones.

        Raises:
            ConfigError: if the world has other shapes than upright ones, spheres and planes.
        """
        del drones
        self.shapes, self.optics = shapes_of(world.geoms), optics_of(config)
        self.work = Work.empty(config.width, config.height)
        self.nearest = np.empty((config.width, config.height))

    def draw(
        self,
        stopwatch: Stopwatch,
        poses: NDArray[np.float64],
        luma: NDArray[np.float64],
        label: NDArray[np.float32] | None,
    ) -> None:
        """Draws as `Camera.draw`."""
        with stopwatch.time("columns"):
            for at in range(2):
                draw(self.shapes, self.optics, self.work, poses[at], luma[at])
            if label is not None:
                nearness(self.shapes, self.optics, self.nearest, poses[1], label)
