"""The share of each pixel that each shape covers, kept as the few nearest layers.

Coverage is exact for the sides and caps of upright boxes and cylinders under a level camera, where sides project to
vertical lines and, within a column, each shape fills one interval of rows. Edges of spheres are exact but for their
curvature within a pixel. For all other kinds of shape it is counted over a few rays per pixel.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera.raycast import (
    Rays,
    Values,
    columns_of,
    daylight_of,
    direction_of,
    first_numbers,
    lambert_shade,
    pitch_of,
)
from edqn_jax.sim.scene.scene import Scene, Spheres, UprightBoxes, UprightCylinders
from edqn_jax.sim.scene.shapes.kind import TINY, Hits, per_shape, safe_inverse
from edqn_jax.sim.scene.shapes.sphere import nearest_to_centre
from edqn_jax.sim.scene.surface import Daylight
from edqn_jax.xla import materialise_tree

NEAR_M = 0.05
"""Shapes are clipped at this depth before they are projected; the body sphere is wider."""
FAR_U = 1e3
"""Image-plane coordinate beyond the edge of any image."""


LEVEL_FACE = 1e9
"""Value of `Layer.slope` for a face whose closeness changes with the row only."""

SLOPED = ("fields",)
"""Kinds of sampled layers with large faces, whose texture a level camera averages along slopes, as that of boxes."""

_LEVEL = 0.7  # of a unit normal: a face that is rather level than upright

DEPTH_OF_LAYERS = 3
"""Layers kept per pixel. With two, slivers of near corners hide the shapes behind them (docs/decisions)."""


@struct.dataclass
class Layer:
    """A covered part of each pixel."""

    closeness: Array  # [H, W] inverse depth, 1/m; 0 where there is nothing
    coverage: Array  # [H, W] share of the pixel's area, in [0, 1]
    value: Array  # [H, W] brightness times coverage
    slope: Array  # [H, W] change of closeness per pixel rightwards; LEVEL_FACE on horizontal faces
    shape: Array | None = None  # [H, W] its number (`raycast.first_numbers`), where `columns.has_numbers`


Layers = tuple[Layer, ...]
"""The nearest layers of each pixel, nearest first."""


def no_layers(shape: tuple[int, ...], depth: int = DEPTH_OF_LAYERS, numbered: bool = False) -> Layers:
    """Returns `depth` empty layers of pixels [H, W] = `shape`; `numbered` ones say which shape they show."""
    none = jnp.zeros(shape)
    layer = Layer(closeness=none, coverage=none, value=none, slope=none, shape=none if numbered else None)
    return (layer,) * depth


def _pick(where: Array, a: Array | None, b: Array | None) -> Array | None:
    return None if a is None or b is None else jnp.where(where, a, b)


def insert_layer(layers: Layers, new: Layer) -> Layers:
    """Adds one shape's layer and keeps the nearest at every pixel. Where its coverage is 0 its closeness must be 0."""
    kept = []
    for old in layers:
        nearer = new.closeness > old.closeness
        kept.append(
            Layer(
                closeness=jnp.maximum(new.closeness, old.closeness),
                coverage=jnp.where(nearer, new.coverage, old.coverage),
                value=jnp.where(nearer, new.value, old.value),
                slope=jnp.where(nearer, new.slope, old.slope),
                shape=_pick(nearer, new.shape, old.shape),
            )
        )
        # The farther of the two is compared with the next layer.
        new = Layer(
            closeness=jnp.minimum(new.closeness, old.closeness),
            coverage=jnp.where(nearer, old.coverage, new.coverage),
            value=jnp.where(nearer, old.value, new.value),
            slope=jnp.where(nearer, old.slope, new.slope),
            shape=_pick(nearer, old.shape, new.shape),
        )
    return tuple(kept)


def _extent_of_boxes(boxes: UprightBoxes, origin: Array, forward: Array) -> tuple[Array, Array]:
    """Returns the least and greatest image-plane coordinate of each upright box: [N] each; empty if left > right."""
    cos, sin = jnp.cos(boxes.yaw)[:, None], jnp.sin(boxes.yaw)[:, None]
    hx = boxes.half[:, 0:1] * jnp.asarray([[1.0, -1.0, -1.0, 1.0]])
    hy = boxes.half[:, 1:2] * jnp.asarray([[1.0, 1.0, -1.0, -1.0]])
    x = boxes.position[:, 0:1] - origin[0] + cos * hx - sin * hy
    y = boxes.position[:, 1:2] - origin[1] + sin * hx + cos * hy
    ahead, right = x * forward[0] + y * forward[1], x * forward[1] - y * forward[0]
    # Corners in front, and where edges cross the near plane.
    ahead_next, right_next = jnp.roll(ahead, -1, axis=1), jnp.roll(right, -1, axis=1)
    share = (NEAR_M - ahead) * safe_inverse(ahead_next - ahead)
    crossing = (ahead < NEAR_M) != (ahead_next < NEAR_M)
    u = jnp.concatenate([right / jnp.maximum(ahead, NEAR_M), (right + share * (right_next - right)) / NEAR_M], axis=1)
    shown = jnp.concatenate([ahead >= NEAR_M, crossing], axis=1)
    return jnp.min(jnp.where(shown, u, jnp.inf), axis=1), jnp.max(jnp.where(shown, u, -jnp.inf), axis=1)


def _extent_of_cylinders(cylinders: UprightCylinders, origin: Array, forward: Array) -> tuple[Array, Array]:
    """Returns the same extents of upright cylinders, from their two tangents through the camera."""
    return _extent_of_discs(cylinders.position, cylinders.radius, origin, forward)


def _extent_of_discs(position: Array, radius: Array, origin: Array, forward: Array) -> tuple[Array, Array]:
    x, y = position[:, 0] - origin[0], position[:, 1] - origin[1]
    ahead, right = x * forward[0] + y * forward[1], x * forward[1] - y * forward[0]
    distance = jnp.sqrt(ahead**2 + right**2)
    sine = jnp.minimum(radius / jnp.maximum(distance, TINY), 1.0)
    cosine = jnp.sqrt(1 - sine**2)

    def edge(sign: float) -> Array:
        f, r = ahead * cosine - sign * right * sine, right * cosine + sign * ahead * sine
        # Above or below the disc itself there is no tangent, and it may be in any column.
        ahead_of_eye = (f > NEAR_M * 1e-3) & (distance > radius)
        return jnp.where(ahead_of_eye, r / jnp.maximum(f, NEAR_M * 1e-3), sign * FAR_U)

    behind = ahead + radius <= 0
    return jnp.where(behind, jnp.inf, edge(-1.0)), jnp.where(behind, -jnp.inf, edge(1.0))


CYLINDER_VALUES = 4
"""Numbers that the sides of a cylinder need, besides their extent and heights."""


def upright_table(config: CameraConfig, scene: Scene, origin: Array, heading: Array, value: Values) -> Array:
    """Returns what columns need of each upright shape, boxes first: [N + 1, F]; the last row covers nothing.

    Args:
        heading: [2] cosine and sine of the camera's.
    """
    parts, light = [], daylight_of(config, scene.daylight)
    if scene.boxes.yaw.shape[0]:
        parts.append(_boxes_in_table(config, light, scene.boxes, origin, heading, value["boxes"]))
    if scene.cylinders.radius.shape[0]:
        parts.append(_cylinders_in_table(config, light, scene.cylinders, origin, heading, value["cylinders"]))
    width = max((part.shape[1] for part in parts), default=2)
    parts = [jnp.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts]
    return jnp.concatenate([*parts, jnp.zeros((1, width)).at[0, :2].set(jnp.asarray([jnp.inf, -jnp.inf]))])


def _boxes_in_table(
    config: CameraConfig, light: Daylight, boxes: UprightBoxes, origin: Array, heading: Array, value: Array
) -> Array:
    left, right = _extent_of_boxes(boxes, origin, heading)
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    ox, oy = origin[0] - boxes.position[:, 0], origin[1] - boxes.position[:, 1]
    bx, by = cos * ox + sin * oy, cos * oy - sin * ox
    # Forward in the box's frame; to the right of it is (fy, -fx).
    fx, fy = cos * heading[0] + sin * heading[1], cos * heading[1] - sin * heading[0]
    hx, hy, sx, sy, zero = boxes.half[:, 0], boxes.half[:, 1], jnp.sign(bx), jnp.sign(by), jnp.zeros_like(cos)
    # Of two opposite faces a ray enters by the one on the eye's side.
    x_face = value * lambert_shade(light, sx * cos, sx * sin, zero)
    y_face = value * lambert_shade(light, -sy * sin, sy * cos, zero)
    # The edge between the two.
    ex, ey = sx * hx - bx, sy * hy - by
    corner = (ex * fy - ey * fx) * safe_inverse(ex * fx + ey * fy)
    heights = _heights(config, light, boxes.position[:, 2] - origin[2], boxes.half[:, 2], value)
    # Computed once: a GPU would otherwise compute each number for itself, with all that it depends on.
    found = materialise_tree([left, right, *heights, bx, by, fx, fy, hx, hy, x_face, y_face, corner])
    return jnp.stack(found, axis=1)


def _cylinders_in_table(
    config: CameraConfig, light: Daylight, cylinders: UprightCylinders, origin: Array, heading: Array, value: Array
) -> Array:
    left, right = _extent_of_cylinders(cylinders, origin, heading)
    heights = _heights(config, light, cylinders.position[:, 2] - origin[2], cylinders.half_height, value)
    ox, oy = origin[0] - cylinders.position[:, 0], origin[1] - cylinders.position[:, 1]
    return jnp.stack([left, right, *heights, ox, oy, cylinders.radius, value], axis=1)


def _heights(config: CameraConfig, light: Daylight, middle: Array, half: Array, value: Array) -> tuple[Array, ...]:
    """Returns bottom, top and visible horizontal face (0: none), each in rows x metres, and the face's brightness."""
    bottom, top = (middle - half) / pitch_of(config), (middle + half) / pitch_of(config)
    zero = jnp.zeros(())
    above, below = lambert_shade(light, zero, zero, zero + 1), lambert_shade(light, zero, zero, zero - 1)
    # The top from above, the bottom from below, none in between.
    cap = jnp.where(top < 0, top, jnp.maximum(bottom, 0.0))
    return bottom, top, cap, value * jnp.where(top < 0, above, below)


def _box_sides(values: tuple[Array, ...], low: Array, high: Array) -> tuple[Array, ...]:
    """Returns entry and exit depth, brightness and lean of a box's sides from `low` to `high` of a column, all [...].

    Lean is the change of closeness per unit of u, relative to closeness.
    """
    bx, by, fx, fy, hx, hy, x_face, y_face, corner = values

    def slabs(u: Array) -> tuple[Array, ...]:
        ix, iy = safe_inverse(fx + u * fy), safe_inverse(fy - u * fx)
        return ix, iy, -bx * ix, -by * iy, hx * jnp.abs(ix), hy * jnp.abs(iy)

    ix, iy, mx, my, reach_x, reach_y = slabs((low + high) / 2)
    # On a face x = const of the box, 1/t = dx / const, so its change is 1/t times that of log dx.
    lean = jnp.where(mx - reach_x > my - reach_y, fy * ix, -fx * iy)

    def face(u: Array) -> Array:
        _, _, mx, my, reach_x, reach_y = slabs(u)
        return jnp.where(mx - reach_x > my - reach_y, x_face, y_face)

    share = jnp.clip((corner - low) * safe_inverse(high - low), 0.0, 1.0)
    at_low, at_high = face(low), face(high)
    side = jnp.where(at_low == at_high, at_low, share * at_low + (1 - share) * at_high)
    return jnp.maximum(mx - reach_x, my - reach_y), jnp.minimum(mx + reach_x, my + reach_y), side, lean


def _cylinder_sides(
    light: Daylight, values: tuple[Array, ...], low: Array, high: Array, heading: Array
) -> tuple[Array, ...]:
    """Returns the same of a cylinder's side."""
    ox, oy, radius, value = values
    u, (cos, sin) = (low + high) / 2, heading[:, None]
    dx, dy = cos + u * sin, sin - u * cos
    a = dx**2 + dy**2
    s = -(ox * dx + oy * dy) / a
    inside = radius**2 - ((ox + s * dx) ** 2 + (oy + s * dy) ** 2)
    reach = jnp.sqrt(jnp.maximum(inside, 0.0) / a)
    enter = s - reach
    per_radius = 1.0 / jnp.maximum(radius, TINY)
    nx, ny = (ox + enter * dx) * per_radius, (oy + enter * dy) * per_radius
    # On the tangent plane n . (t d) is constant, so 1/t changes like n . d.
    lean = (nx * sin - ny * cos) * safe_inverse(nx * dx + ny * dy)
    return enter, s + reach, value * lambert_shade(light, nx, ny, jnp.zeros_like(nx)), lean


def column_sides(
    config: CameraConfig,
    light: Daylight,
    picked: Array,
    is_cylinder: Array | None,
    boxes: int,
    heading: Array,
    u: Array,
    numbers: Array | None = None,
) -> Array:
    """Returns what the pixels of columns need of the shapes picked for them: [B, K, 11], or 12 with `numbers`.

    Share of the column's width, bottom and top row of the side, lowest and highest of the cap, brightness of both
    times share, least and greatest closeness, closeness per row on the cap, lean, number.

    Args:
        light: of each column; coordinates of the sun are the leading axis.
        picked: [K, B, F] rows of `upright_table`.
        is_cylinder: [K, B] bool.
        boxes: number of boxes in the table, before the cylinders, static.
        heading: [B, 2].
        u: [B] middle of each column.
        numbers: [K, B] of the shapes.
    """
    pitch = pitch_of(config)
    left, right, bottom, top, cap, shown, *values = jnp.moveaxis(picked, -1, 0)
    u = u[None]
    low, high = jnp.maximum(u - pitch / 2, left), jnp.minimum(u + pitch / 2, right)
    share = jnp.maximum(high - low, 0.0) / pitch
    low, high = jnp.where(share > 0, low, u), jnp.where(share > 0, high, u)
    round_sides = partial(_cylinder_sides, light, tuple(values[:CYLINDER_VALUES]), low, high, heading.T)
    if not boxes:
        enter, leave, side, lean = round_sides()
    else:
        enter, leave, side, lean = _box_sides(tuple(values), low, high)
        if is_cylinder is not None:
            others = round_sides()
            enter, leave, side, lean = (
                jnp.where(is_cylinder, a, b) for a, b in zip(others, (enter, leave, side, lean), strict=True)
            )
    near, far = 1.0 / jnp.maximum(enter, NEAR_M), 1.0 / jnp.maximum(leave, NEAR_M)
    cap_near, cap_far = cap * near, cap * far
    found = [
        share,
        bottom * near,
        top * near,
        jnp.minimum(cap_near, cap_far),
        jnp.maximum(cap_near, cap_far),
        side * share,
        shown * share,
        jnp.where(cap == 0, near, far),  # without a cap, closeness is the side's
        near,
        safe_inverse(cap),
        lean * near * pitch,
        *([] if numbers is None else [numbers.astype(jnp.float32)]),
    ]
    # Computed once: XLA would otherwise repeat all of it for every row.
    return materialise_tree(jnp.moveaxis(materialise_tree(jnp.stack(found)), (0, 1, 2), (2, 1, 0)))


def insert_sides(config: CameraConfig, layers: Layers, columns: Array) -> Layers:
    """Adds the shapes of one column, [K, 11 or 12] of `column_sides`, to the layers of its pixels [H, 1]."""
    for column in columns:
        layers = _insert_side(config, layers, column)
    return layers


@partial(jax.jit, static_argnums=0)  # traced once for all slots
def _insert_side(config: CameraConfig, layers: Layers, column: Array) -> Layers:
    share, bottom, top, cap_low, cap_high, side, shown, far, near, per_row, lean, *number = column
    row = (config.height / 2 - 0.5 - jnp.arange(config.height, dtype=jnp.float32))[:, None]
    rows_side = jnp.maximum(jnp.minimum(top, row + 0.5) - jnp.maximum(bottom, row - 0.5), 0.0)
    rows_cap = jnp.maximum(jnp.minimum(cap_high, row + 0.5) - jnp.maximum(cap_low, row - 0.5), 0.0)
    coverage = (rows_side + rows_cap) * share
    layer = Layer(
        closeness=jnp.where(coverage > 0, jnp.clip(row * per_row, far, near), 0.0),
        coverage=coverage,
        value=rows_side * side + rows_cap * shown,
        slope=jnp.where(rows_cap > rows_side, LEVEL_FACE, lean),
        shape=jnp.broadcast_to(number[0], coverage.shape) if number else None,
    )
    return insert_layer(layers, layer)


def spheres_in_columns(config: CameraConfig, spheres: Spheres, origin: Array, heading: Array) -> Array:
    """Returns [C] bool: whether any sphere may be visible in each column, from `origin` [3], metres."""
    # A silhouette fades over half a pixel on either side.
    left, right = _extent_of_discs(spheres.position, spheres.radius, origin, heading)
    u, pitch = columns_of(config)[None], pitch_of(config)
    return jnp.any((u + 1.5 * pitch > left[:, None]) & (u - 1.5 * pitch < right[:, None]), axis=0)


def sphere_layers(
    config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values, layers: Layers
) -> Layers:
    """Adds layers [H, W] of spheres, for any camera: coverage falls linearly over the pixel that an edge crosses."""
    spheres, (dx, dy, dz) = scene.spheres, direction_of(rays)
    if spheres.radius.shape[0] == 0:
        return layers
    ox, oy, oz = (per_shape(origin[i] - spheres.position[:, i]) for i in range(3))
    radius = per_shape(spheres.radius)
    depth, nearest, miss = nearest_to_centre((ox, oy, oz), radius, (dx, dy, dz))
    pixel = jnp.maximum(nearest, NEAR_M) * rays.pitch
    # A sphere smaller than a pixel covers no more than its own disc.
    most = jnp.minimum(jnp.pi * (radius / pixel) ** 2, 1.0)
    coverage = jnp.where(nearest > 0, jnp.clip(0.5 + (radius - miss) / pixel, 0.0, most), 0.0)
    per_miss = 1.0 / jnp.maximum(jnp.maximum(miss, radius), TINY)
    normal = (ox + depth * dx, oy + depth * dy, oz + depth * dz)
    light, number = daylight_of(config, scene.daylight), first_numbers(value)["spheres"]
    bright = lambert_shade(light, *(n * per_miss for n in normal)) * per_shape(value["spheres"])
    closeness = jnp.where(coverage > 0, 1.0 / jnp.maximum(depth, NEAR_M), 0.0)
    for n in range(coverage.shape[0]):
        share, flat = coverage[n], jnp.zeros_like(coverage[n])
        shape = None if layers[0].shape is None else jnp.full_like(share, number + n)
        layer = Layer(closeness=closeness[n], coverage=share, value=share * bright[n], slope=flat, shape=shape)
        layers = insert_layer(layers, layer)
    return layers


def add_sampled_layers(
    met: Hits, brightness: Array, first: int, rays: Rays, layers: Layers, has_slopes: bool = False
) -> Layers:
    """Adds layers of any shapes from `across` x `down` rays per pixel: the share of rays that meet the shape.

    Args:
        met: where the rays meet N shapes.
        brightness: [N, R, C] there.
        first: number of the first of these shapes.
        rays: of all pixels.
        layers: of what was drawn before.
        has_slopes: whether the texture is averaged along slopes, as on the large faces of `SLOPED`.
    """
    shape = jnp.broadcast_shapes(rays.dx.shape, rays.dz.shape)
    rows, columns = shape[0] // rays.down, shape[1] // rays.across

    def mean(x: Array) -> Array:
        return jnp.mean(materialise_tree(x).reshape(rays.down, rows, rays.across, columns), axis=(0, 2))

    def slope_of(hit: Array, depth: Array, normal: list[Array], coverage: Array) -> Array:
        """Returns `Layer.slope`, that of each ray's plane: along it closeness is n . d over the distance."""
        lean = (normal[0] * rays.right[0] + normal[1] * rays.right[1] + normal[2] * rays.right[2]) * rays.pitch
        ahead = normal[0] * rays.dx + normal[1] * rays.dy + normal[2] * rays.dz
        slope = mean(jnp.where(hit, lean * safe_inverse(depth) * safe_inverse(ahead), 0.0))
        level = mean((hit & (jnp.abs(normal[2]) > _LEVEL)).astype(jnp.float32))
        return jnp.where(level > coverage / 2, LEVEL_FACE, slope / jnp.maximum(coverage, TINY))

    def add(layers: Layers, one: tuple[Array, ...]) -> tuple[Layers, None]:
        hit, depth, bright, *others = one
        number, normal = others[3 * has_slopes :], others[: 3 * has_slopes]
        coverage = mean(hit.astype(jnp.float32))
        inverse_depth = mean(jnp.where(hit, safe_inverse(depth), 0.0))
        layer = Layer(
            closeness=inverse_depth / jnp.maximum(coverage, TINY),
            coverage=coverage,
            value=mean(jnp.where(hit, bright, 0.0)),
            slope=slope_of(hit, depth, normal, coverage) if has_slopes else jnp.zeros_like(coverage),
            shape=jnp.broadcast_to(number[0], coverage.shape) if number else None,
        )
        return insert_layer(layers, layer), None

    given = (met.hit, met.depth, brightness, *(met.normal if has_slopes else ()))
    many = tuple(jnp.broadcast_to(x, x.shape[:1] + shape) for x in given)
    if layers[0].shape is not None:
        many += (first + jnp.arange(many[0].shape[0], dtype=jnp.float32),)
    return lax.scan(add, layers, many)[0]
