"""How much of each pixel each shape covers, and the nearest few such layers.

Exact for the sides and caps of upright boxes and cylinders under a level camera, where sides project to
vertical lines and, within a column, each shape fills one interval of rows; counted over a few rays per
pixel for everything else.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.config import CameraConfig
from edqn_jax.sim.raycast import (
    TINY,
    Rays,
    Surfaces,
    Values,
    for_shapes,
    inverse,
    per_shape,
    shade,
    unit_ball,
)
from edqn_jax.sim.scene import Scene

NEAR_M = 0.05
"""Shapes are clipped at this depth before they are projected; the body sphere is wider."""
FAR_U = 1e3
"""Image-plane coordinate that stands for beyond the edge of any image."""


LEVEL_FACE = 1e9
"""Stands in `Layer.slope` for a face whose closeness changes with the row only."""

DEPTH_OF_LAYERS = 3
"""Layers kept per pixel. With two, slivers of near corners hide what stands behind them (docs/decisions)."""


def materialised(tree):
    """The same arrays, computed once: an exact no-op that XLA does not fuse into (and repeat in) their consumers."""
    return jax.tree.map(lambda x: lax.reduce_precision(x, exponent_bits=8, mantissa_bits=23), tree)


@struct.dataclass
class Layer:
    """A covered part of each pixel."""

    closeness: Array  # [H, W] inverse depth, 1/m; 0 where there is nothing
    coverage: Array  # [H, W] share of the pixel's area, in [0, 1]
    value: Array  # [H, W] brightness times coverage
    slope: Array  # [H, W] change of closeness per pixel rightwards; LEVEL_FACE on horizontal faces


Layers = tuple[Layer, ...]
"""The nearest layers of each pixel, nearest first."""


def no_layers(shape: tuple[int, ...]) -> Layers:
    """Nothing in sight."""
    none = jnp.zeros(shape)
    return (Layer(closeness=none, coverage=none, value=none, slope=none),) * DEPTH_OF_LAYERS


def insert(layers: Layers, new: Layer) -> Layers:
    """Add one shape's layer, keeping the nearest at every pixel. Where its coverage is 0 its closeness must be 0."""
    kept = []
    for old in layers:
        nearer = new.closeness > old.closeness
        kept.append(
            Layer(
                closeness=jnp.maximum(new.closeness, old.closeness),
                coverage=jnp.where(nearer, new.coverage, old.coverage),
                value=jnp.where(nearer, new.value, old.value),
                slope=jnp.where(nearer, new.slope, old.slope),
            )
        )
        # The farther of the two goes on to compete for the next place.
        new = Layer(
            closeness=jnp.minimum(new.closeness, old.closeness),
            coverage=jnp.where(nearer, old.coverage, new.coverage),
            value=jnp.where(nearer, old.value, new.value),
            slope=jnp.where(nearer, old.slope, new.slope),
        )
    return tuple(kept)


def _extent_of_boxes(scene: Scene, origin: Array, forward: tuple[Array, Array]) -> tuple[Array, Array]:
    """Leftmost and rightmost image-plane coordinate of each upright box: [N] each; empty if left > right."""
    boxes = scene.boxes
    cos, sin = jnp.cos(boxes.yaw)[:, None], jnp.sin(boxes.yaw)[:, None]
    hx = boxes.half[:, 0:1] * jnp.asarray([[1.0, -1.0, -1.0, 1.0]])
    hy = boxes.half[:, 1:2] * jnp.asarray([[1.0, 1.0, -1.0, -1.0]])
    x = boxes.position[:, 0:1] - origin[0] + cos * hx - sin * hy
    y = boxes.position[:, 1:2] - origin[1] + sin * hx + cos * hy
    ahead, right = x * forward[0] + y * forward[1], x * forward[1] - y * forward[0]
    # Corners in front, and where edges cross the near plane.
    ahead_next, right_next = jnp.roll(ahead, -1, axis=1), jnp.roll(right, -1, axis=1)
    share = (NEAR_M - ahead) * inverse(ahead_next - ahead)
    crossing = (ahead < NEAR_M) != (ahead_next < NEAR_M)
    u = jnp.concatenate([right / jnp.maximum(ahead, NEAR_M), (right + share * (right_next - right)) / NEAR_M], axis=1)
    shown = jnp.concatenate([ahead >= NEAR_M, crossing], axis=1)
    return jnp.min(jnp.where(shown, u, jnp.inf), axis=1), jnp.max(jnp.where(shown, u, -jnp.inf), axis=1)


def _extent_of_cylinders(scene: Scene, origin: Array, forward: tuple[Array, Array]) -> tuple[Array, Array]:
    """The same for upright cylinders, by their two tangents from the camera."""
    cylinders = scene.cylinders
    x, y = cylinders.position[:, 0] - origin[0], cylinders.position[:, 1] - origin[1]
    ahead, right = x * forward[0] + y * forward[1], x * forward[1] - y * forward[0]
    distance = jnp.sqrt(ahead**2 + right**2)
    sine = jnp.minimum(cylinders.radius / jnp.maximum(distance, TINY), 1.0)
    cosine = jnp.sqrt(1 - sine**2)

    def edge(sign: float) -> Array:
        f, r = ahead * cosine - sign * right * sine, right * cosine + sign * ahead * sine
        return jnp.where(f > NEAR_M * 1e-3, r / jnp.maximum(f, NEAR_M * 1e-3), sign * FAR_U)

    behind = ahead + cylinders.radius <= 0
    return jnp.where(behind, jnp.inf, edge(-1.0)), jnp.where(behind, -jnp.inf, edge(1.0))


def _column_shares(left: Array, right: Array, u: Array, pitch: float):
    """Overlap of extents [N] with pixel columns centred at u [C]: coverage, low and high end; [N, C] each."""
    u = u[None]
    low = jnp.maximum(u - pitch / 2, left[:, None])
    high = jnp.minimum(u + pitch / 2, right[:, None])
    width = high - low
    covered = width > 0
    centre = jnp.broadcast_to(u, low.shape)
    return (
        jnp.where(covered, width / pitch, 0.0),
        jnp.where(covered, low, centre),
        jnp.where(covered, high, centre),
    )


def _box_columns(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, u: Array, value: Array):
    """Upright boxes per column, [N, C] each: coverage, entry and exit depth, brightness of the side and
    change of its closeness per pixel.
    """
    boxes = scene.boxes
    forward = (-rays.right[1], rays.right[0])
    coverage, low, high = _column_shares(*_extent_of_boxes(scene, origin, forward), u, rays.pitch)
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    ox, oy = origin[0] - boxes.position[:, 0], origin[1] - boxes.position[:, 1]
    bx, by = cos * ox + sin * oy, cos * oy - sin * ox
    # Forward and right in each box's frame.
    fx, fy = cos * forward[0] + sin * forward[1], cos * forward[1] - sin * forward[0]
    rx, ry = fy, -fx

    def slabs(at: Array):
        dx, dy = fx[:, None] + at * rx[:, None], fy[:, None] + at * ry[:, None]
        ix, iy = inverse(dx), inverse(dy)
        mx, my = -bx[:, None] * ix, -by[:, None] * iy
        hx, hy = boxes.half[:, 0:1] * jnp.abs(ix), boxes.half[:, 1:2] * jnp.abs(iy)
        zero = jnp.zeros_like(cos)
        x_faces = jnp.where(dx < 0, shade(config, cos, sin, zero)[:, None], shade(config, -cos, -sin, zero)[:, None])
        y_faces = jnp.where(dy < 0, shade(config, -sin, cos, zero)[:, None], shade(config, sin, -cos, zero)[:, None])
        near_x, near_y = mx - hx, my - hy
        face = near_x > near_y
        enter = jnp.maximum(near_x, near_y)
        # On a face x = const of the box, 1/t = dx / const, so its change is 1/t times that of log dx.
        slope = jnp.where(face, rx[:, None] * ix, ry[:, None] * iy)
        return enter, jnp.minimum(mx + hx, my + hy), slope, face, jnp.where(face, x_faces, y_faces)

    enter, leave, slope, _, _ = slabs((low + high) / 2)
    _, _, _, face_left, shade_left = slabs(low)
    _, _, _, face_right, shade_right = slabs(high)
    # The edge between the two visible sides, where they meet inside a column.
    sx, sy = jnp.sign(bx) * boxes.half[:, 0], jnp.sign(by) * boxes.half[:, 1]
    corner_ahead = (sx - bx) * fx + (sy - by) * fy
    corner_right = (sx - bx) * rx + (sy - by) * ry
    corner = (corner_right * inverse(corner_ahead))[:, None]
    share = jnp.clip((corner - low) * inverse(high - low), 0.0, 1.0)
    side = jnp.where(
        face_left == face_right,
        (shade_left + shade_right) / 2,
        share * shade_left + (1 - share) * shade_right,
    )
    side = side * value[:, None]
    enter, leave = jnp.maximum(enter, NEAR_M), jnp.maximum(leave, NEAR_M)
    return coverage, enter, leave, side, slope * rays.pitch / enter


def _cylinder_columns(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, u: Array, value: Array):
    """The same for upright cylinders."""
    cylinders = scene.cylinders
    forward = (-rays.right[1], rays.right[0])
    coverage, low, high = _column_shares(*_extent_of_cylinders(scene, origin, forward), u, rays.pitch)
    at = (low + high) / 2
    dx, dy = forward[0] + at * rays.right[0], forward[1] + at * rays.right[1]
    ox, oy = (origin[i] - cylinders.position[:, i : i + 1].T.reshape(-1, 1) for i in range(2))
    a = dx**2 + dy**2
    s = -(ox * dx + oy * dy) / a
    inside = cylinders.radius[:, None] ** 2 - ((ox + s * dx) ** 2 + (oy + s * dy) ** 2)
    reach = jnp.sqrt(jnp.maximum(inside, 0.0) / a)
    enter, leave = s - reach, s + reach
    per_radius = 1.0 / jnp.maximum(cylinders.radius[:, None], TINY)
    nx, ny = (ox + enter * dx) * per_radius, (oy + enter * dy) * per_radius
    side = shade(config, nx, ny, jnp.zeros_like(nx)) * value[:, None]
    # On the tangent plane n . (t d) stays put, so 1/t changes like n . d.
    slope = (nx * rays.right[0] + ny * rays.right[1]) * inverse(nx * dx + ny * dy)
    enter, leave = jnp.maximum(enter, NEAR_M), jnp.maximum(leave, NEAR_M)
    return coverage, enter, leave, side, slope * rays.pitch / enter


def upright_layers(
    config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values, layers: Layers
) -> Layers:
    """Layers of upright boxes and cylinders under a level camera, in closed form."""
    parts = []
    u = (jnp.arange(config.width) + 0.5 - config.width / 2) * rays.pitch
    if scene.boxes.yaw.shape[0]:
        parts.append(_box_columns(config, scene, origin, rays, u, value.boxes))
    if scene.cylinders.radius.shape[0]:
        parts.append(_cylinder_columns(config, scene, origin, rays, u, value.cylinders))
    if not parts:
        return layers
    share, enter, leave, side, slope = (jnp.concatenate(part) for part in zip(*parts, strict=True))
    # One array, computed once: XLA would otherwise repeat all of the above for every row, and LLVM
    # gives up vectorising a loop that reads from too many (docs/decisions).
    columns = materialised(jnp.stack([share, side * share, 1.0 / enter, 1.0 / leave, slope], axis=1))

    middle = jnp.concatenate([scene.boxes.position[:, 2], scene.cylinders.position[:, 2]]) - origin[2]
    half = jnp.concatenate([scene.boxes.half[:, 2], scene.cylinders.half_height])
    albedo = jnp.concatenate([value.boxes, value.cylinders])
    zero = jnp.zeros(())
    above, below = shade(config, zero, zero, zero + 1), shade(config, zero, zero, zero - 1)
    per_pitch = 1.0 / rays.pitch
    bottom, top = (middle - half) * per_pitch, (middle + half) * per_pitch
    # The horizontal face in view: the top from above, the bottom from below, none in between.
    cap = jnp.where(top < 0, top, jnp.maximum(bottom, 0.0))
    shown = albedo * jnp.where(top < 0, above, below)
    row = config.height / 2 - 0.5 - jnp.arange(config.height, dtype=jnp.float32)
    low, high = (row - 0.5)[:, None], (row + 0.5)[:, None]
    # Closeness of the cap in each row; where there is no cap, anything beyond the side's.
    level = materialised(jnp.where(cap[:, None] == 0, 1.0 / NEAR_M, row[None] * inverse(cap)[:, None]))
    for n in range(share.shape[0]):
        covered, bright, near, far, lean = columns[n][:, None]
        cap_near, cap_far = cap[n] * near, cap[n] * far
        rows_side = jnp.minimum(top[n] * near, high) - jnp.maximum(bottom[n] * near, low)
        rows_cap = jnp.minimum(jnp.maximum(cap_near, cap_far), high) - jnp.maximum(jnp.minimum(cap_near, cap_far), low)
        rows_side, rows_cap = jnp.maximum(rows_side, 0.0), jnp.maximum(rows_cap, 0.0)
        coverage = (rows_side + rows_cap) * covered
        layer = Layer(
            closeness=jnp.where(coverage > 0, jnp.clip(level[n][:, None], far, near), 0.0),
            coverage=coverage,
            value=rows_side * bright + rows_cap * (shown[n] * covered),
            slope=jnp.where(rows_cap > rows_side, LEVEL_FACE, lean),
        )
        layers = insert(layers, layer)
    return layers


def sphere_layers(
    config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values, layers: Layers
) -> Layers:
    """Layers of spheres for any camera: coverage falls linearly over the pixel that the silhouette crosses."""
    spheres, rays = scene.spheres, for_shapes(rays)
    if spheres.radius.shape[0] == 0:
        return layers
    ox, oy, oz = (per_shape(origin[i] - spheres.position[:, i]) for i in range(3))
    radius = per_shape(spheres.radius)
    depth, nearest, miss = unit_ball(ox, oy, oz, radius, rays)
    pixel = jnp.maximum(nearest, NEAR_M) * rays.pitch
    # A sphere smaller than a pixel covers no more than its own disc.
    most = jnp.minimum(jnp.pi * (radius / pixel) ** 2, 1.0)
    coverage = jnp.where(nearest > 0, jnp.clip(0.5 + (radius - miss) / pixel, 0.0, most), 0.0)
    per_miss = 1.0 / jnp.maximum(jnp.maximum(miss, radius), TINY)
    normal = (ox + depth * rays.dx, oy + depth * rays.dy, oz + depth * rays.dz)
    bright = shade(config, *(n * per_miss for n in normal)) * per_shape(value.spheres)
    closeness = jnp.where(coverage > 0, 1.0 / jnp.maximum(depth, NEAR_M), 0.0)
    for n in range(coverage.shape[0]):
        share, flat = coverage[n], jnp.zeros_like(coverage[n])
        layers = insert(layers, Layer(closeness=closeness[n], coverage=share, value=share * bright[n], slope=flat))
    return layers


def counted_layers(surfaces: Surfaces, rays: Rays, layers: Layers) -> Layers:
    """Layers of any shapes from `across` x `down` rays per pixel: the share of rays that meet the shape."""
    shape = jnp.broadcast_shapes(rays.dx.shape, rays.dz.shape)
    rows, columns = shape[0] // rays.down, shape[1] // rays.across

    def mean(x: Array) -> Array:
        return jnp.mean(materialised(x).reshape(rays.down, rows, rays.across, columns), axis=(0, 2))

    def add(layers: Layers, one: Surfaces) -> tuple[Layers, None]:
        coverage = mean(one.hit.astype(jnp.float32))
        inverse_depth = mean(jnp.where(one.hit, inverse(one.depth), 0.0))
        layer = Layer(
            closeness=inverse_depth / jnp.maximum(coverage, TINY),
            coverage=coverage,
            value=mean(jnp.where(one.hit, one.value, 0.0)),
            slope=jnp.zeros_like(coverage),
        )
        return insert(layers, layer), None

    many = jax.tree.map(lambda x: jnp.broadcast_to(x, x.shape[:1] + shape), surfaces)
    return lax.scan(add, layers, many)[0]
