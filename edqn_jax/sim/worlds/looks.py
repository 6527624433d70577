"""What random worlds look like: patterns, albedo and light, drawn from the world's key and apart from its geometry.

Shapes of a kind and of one albedo, as the pieces of a wall are, get one pattern, which runs on from piece to piece; in
some of the `drawn` worlds each piece has its own.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import SurfaceConfig
from edqn_jax.kept_programs import kept_jit
from edqn_jax.keys import LOOK_OF_WORLD
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes.kind import PARKED
from edqn_jax.sim.scene.surface import PATTERNS, SURFACE_NUMBERS, Daylight, Surface
from edqn_jax.sim.worlds.building import make_albedos, scale_uniforms

TRAINED = {"blank": 0.15, "waves": 0.2, "noise": 0.2, "checks": 0.2, "spots": 0.25}
"""Shares of the patterns of `drawn`."""

ALIKE = 0.4
"""Share of the worlds of which all shapes have one pattern, of one period and contrast."""

APART = 0.3
"""Share of the `drawn` worlds in which the pieces of a wall have surfaces of their own, as in worlds of others, where
each solid has its own material: a pattern then ends where nothing ends."""

BRIGHTEST = 0.95
"""Most that any point of a surface reflects."""

ELEVATION_DEG, AMBIENT, SKY = (20.0, 80.0), (0.2, 0.7), (0.35, 0.95)
"""Of the sun; the part of the light that comes from everywhere; grey of the sky."""

BRICK_M, POSTER_M, RING_M = (0.3, 1.5), (1.5, 6.0), (0.15, 1.0)
"""Length of bricks, distance of posters, width of a year's growth, as they occur; options do not change them."""

_DRAWS = 40  # uniform numbers of a surface


def with_looks(pool: Scene, keys: Array, config: SurfaceConfig) -> Scene:
    """Returns worlds with the looks of `config.pattern`; under `plaid` they stay as they are.

    Args:
        pool: worlds [P].
        keys: [P] of the worlds; a look is drawn from a key of its own.
        config: static.
    """
    return pool if config.pattern == "plaid" else _add_looks(config, pool, keys)


@kept_jit(0)
def _add_looks(config: SurfaceConfig, pool: Scene, keys: Array) -> Scene:
    def one(scene: Scene, key: Array) -> Scene:
        return _with_look(config, scene, jax.random.fold_in(key, LOOK_OF_WORLD))

    return jax.vmap(one)(pool, keys)


def _with_look(config: SurfaceConfig, scene: Scene, key: Array) -> Scene:
    of_world, of_shapes, of_light = jax.random.split(key, 3)
    world = jax.random.uniform(of_world, (_DRAWS,))
    dressed: dict[str, Any] = {}
    for number, (kind, shapes) in enumerate(scene.shapes().items()):
        if hasattr(shapes, "surface"):
            draws = jax.random.uniform(jax.random.fold_in(of_shapes, number), (shapes.position.shape[0], _DRAWS))
            dressed[kind] = _with_surface(config, shapes, world, draws)
    return dataclasses.replace(scene.with_shapes(dressed), daylight=_daylight(jax.random.uniform(of_light, (7,))))


def _daylight(draw: Array) -> Daylight:
    azimuth, elevation = 2 * jnp.pi * draw[0], jnp.radians(scale_uniforms(ELEVATION_DEG, draw[1]))
    flat = jnp.cos(elevation)
    return Daylight(
        sun=jnp.stack([flat * jnp.cos(azimuth), flat * jnp.sin(azimuth), jnp.sin(elevation)]),
        ambient=scale_uniforms(AMBIENT, draw[2]),
        sky=jnp.clip(scale_uniforms(SKY, draw[3]) + 0.2 * draw[4:7] - 0.1, 0.05, BRIGHTEST),
    )


def _with_surface(config: SurfaceConfig, shapes: Any, world: Array, draws: Array) -> Any:
    """Returns the shapes [N] of one kind with surfaces, from the world's uniform draws [D] and their own [N, D]."""
    if not draws.shape[0]:
        return dataclasses.replace(shapes, surface=Surface(jnp.zeros((0, SURFACE_NUMBERS)), patterns_of(config)))
    alike = jnp.all(shapes.albedo[:, None] == shapes.albedo[None], axis=-1)
    first = jnp.argmax(alike, axis=1)
    if config.pattern == "drawn":
        first = jnp.where(world[-2] < APART, jnp.arange(len(draws)), first)
    draws = draws[first]
    # The first numbers say which pattern, of which contrast and period.
    draws = jnp.where((world[-1] < ALIKE) & (jnp.arange(_DRAWS) < 3), world, draws)
    which = _which(config, draws[:, 0])
    contrast = jnp.where(which == 0, 0.0, config.contrast * draws[:, 1])
    shares, k = _numbers(config, which, draws, *_axes_of(shapes))
    centre = jnp.where(jnp.abs(shapes.position) < PARKED / 2, shapes.position, 0.0)
    shift = jnp.einsum("nij,nj->ni", k, centre) + draws[:, 3:7]
    phases = jnp.concatenate([k, (shift - jnp.round(shift))[..., None]], axis=-1).reshape(-1, 16)
    numbers = jnp.concatenate([which[:, None], contrast[:, None], shares, phases], axis=1)
    colour = jnp.minimum(make_albedos(draws[:, 7:12]), BRIGHTEST / (1.0 + contrast[:, None]))
    return dataclasses.replace(shapes, albedo=colour, surface=Surface(numbers, patterns_of(config)))


def patterns_of(config: SurfaceConfig) -> tuple[str, ...]:
    """Returns the patterns that shapes may have."""
    return tuple(TRAINED) if config.pattern == "drawn" else (config.pattern,)


def _which(config: SurfaceConfig, draw: Array) -> Array:
    """Returns the numbers of patterns [N], as floats, from uniform draws [N]."""
    if config.pattern != "drawn":
        return jnp.full(draw.shape, float(PATTERNS.index(config.pattern)))
    upper = jnp.cumsum(jnp.array(list(TRAINED.values())))[:-1]
    number = jnp.sum(draw[:, None] >= upper[None], axis=1)
    return jnp.array([PATTERNS.index(name) for name in TRAINED], jnp.float32)[number]


def _axes_of(shapes: Any) -> tuple[Array, Array]:
    """Returns two directions [N, 3] along which the faces of shapes of one kind are measured.

    The first is 1 a metre along both level edges of a box, so that every upright face shows the same.
    """
    count = shapes.position.shape[0]
    level, up = jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
    if hasattr(shapes, "yaw"):
        cos, sin = jnp.cos(shapes.yaw), jnp.sin(shapes.yaw)
        return jnp.stack([cos - sin, sin + cos, 0 * cos], axis=1), jnp.broadcast_to(up, (count, 3))
    if hasattr(shapes, "rotation"):
        return shapes.rotation[:, :, 0] + shapes.rotation[:, :, 1], shapes.rotation[:, :, 2]
    if hasattr(shapes, "normal"):
        normal = shapes.normal
        flat = jnp.abs(normal[:, 2:]) > 0.7
        along = jnp.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0]], axis=1)
        along = along / jnp.maximum(jnp.linalg.norm(along, axis=1, keepdims=True), 1e-6)
        first = jnp.where(flat, jnp.array([1.0, 0.0, 0.0]), along)
        return first, jnp.where(flat, jnp.array([0.0, 1.0, 0.0]), up)
    return jnp.broadcast_to(level, (count, 3)), jnp.broadcast_to(up, (count, 3))


def _numbers(config: SurfaceConfig, which: Array, draws: Array, along: Array, up: Array) -> tuple[Array, Array]:
    """Returns the shares [N, 4] and the vectors [N, 4, 3], cycles a metre, of N patterns."""
    shares, vectors = jnp.zeros((len(which), 4)), jnp.zeros((len(which), 4, 3))
    for name in patterns_of(config):
        if name == "blank":
            continue
        of_name = _OF_PATTERN[name](config, draws, along, up)
        here = which == PATTERNS.index(name)
        shares = jnp.where(here[:, None], jnp.stack(jnp.broadcast_arrays(*of_name[0]), axis=1), shares)
        vectors = jnp.where(here[:, None, None], jnp.stack(of_name[1], axis=1), vectors)
    return shares, vectors


Numbers = tuple[list[Array], list[Array]]
"""Four shares, each [N], and four vectors, each [N, 3]."""


def _log_between(low: float, high: float, draw: Array) -> Array:
    return low * (high / low) ** draw


def _period(config: SurfaceConfig, draw: Array) -> Array:
    return _log_between(config.shortest_m, config.longest_m, draw)


def _unit(draws: Array) -> Array:
    """Returns directions [N, 3], uniform over the sphere, from uniform draws [N, 2]."""
    z, turn = 2 * draws[:, 0] - 1, 2 * jnp.pi * draws[:, 1]
    flat = jnp.sqrt(jnp.maximum(1 - z * z, 0.0))
    return jnp.stack([flat * jnp.cos(turn), flat * jnp.sin(turn), z], axis=1)


def _rotate_in_face(along: Array, up: Array, angle: Array) -> tuple[Array, Array]:
    """Returns two directions [N, 3] turned within the face by angles [N]."""
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return cos * along + sin * up, cos * up - sin * along


def _waves(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """One to four plane waves of any directions and periods."""
    count = 1 + jnp.floor(4 * draws[:, 12:13])
    share = jnp.where(jnp.arange(4) < count, 0.1 + draws[:, 13:17], 0.0)
    share = share / jnp.sum(share, axis=1, keepdims=True)
    periods = [_period(config, draws[:, n]) for n in (2, 17, 18, 19)]
    vectors = [_unit(draws[:, 20 + 2 * n : 22 + 2 * n]) / period[:, None] for n, period in enumerate(periods)]
    return list(share.T), vectors


def _noise(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Eight waves of four octaves, of which half are finer ones made of the others (`camera/surfaces.py`)."""
    share = 0.5 + draws[:, 13:17]
    share = share / jnp.sum(share, axis=1, keepdims=True) / 1.2
    period = jnp.maximum(_period(config, draws[:, 2]), 4 * config.shortest_m)
    sizes = [period, period * (0.6 + 0.3 * draws[:, 17]), period * 0.5, period * (0.3 + 0.15 * draws[:, 18])]
    return list(share.T), [_unit(draws[:, 20 + 2 * n : 22 + 2 * n]) / size[:, None] for n, size in enumerate(sizes)]


def _checks(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Stripes, checks, or stripes that cross, of hard edges and any width; half of them turned within the face."""
    style, zero = draws[:, 12], jnp.zeros(len(draws))
    stripes, crossed = style < 1 / 3, style > 2 / 3
    first, second = _rotate_in_face(along, up, jnp.where(draws[:, 13] < 0.5, 0.0, 2 * jnp.pi * draws[:, 14]))
    swap = (draws[:, 17] < 0.5)[:, None]
    first, second = jnp.where(swap, second, first), jnp.where(swap, first, second)
    period = _period(config, draws[:, 2])
    other = jnp.clip(period * _log_between(0.4, 2.5, draws[:, 15]), config.shortest_m, config.longest_m)
    width = scale_uniforms((0.2, 0.8), draws[:, 16])
    shares = [jnp.where(stripes, 1.0, jnp.where(crossed, 0.5, zero)), jnp.where(stripes | crossed, zero, 1.0)]
    shares += [jnp.where(crossed, 0.5, zero), width]
    none = jnp.zeros_like(along)
    return shares, [first / period[:, None], second / other[:, None], none, none]


def _bricks(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Courses of bricks, shifted by half a brick, with joints that are darker or lighter."""
    length = _log_between(*BRICK_M, draws[:, 2])
    height = length * scale_uniforms((0.25, 0.5), draws[:, 13])
    joint = scale_uniforms((0.1, 0.25), draws[:, 14])  # share of a course's height
    tone = jnp.where(draws[:, 12] < 0.5, -1.0, 1.0)
    none = jnp.zeros_like(along)
    vectors = [along / length[:, None], up / (2 * height[:, None]), none, none]
    return [tone, joint, joint * height / length, 0 * tone], vectors


def _posters(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Rectangles of noise on blank walls."""
    apart = _log_between(*POSTER_M, draws[:, 2])
    fine = apart * scale_uniforms((0.1, 0.4), draws[:, 13])
    tone = scale_uniforms((-0.4, 0.4), draws[:, 12])
    first, second = _rotate_in_face(along, up, 2 * jnp.pi * draws[:, 14])
    vectors = [along / apart[:, None], up / (apart * scale_uniforms((0.5, 1.0), draws[:, 15]))[:, None]]
    vectors += [first / fine[:, None], (second + 0.4 * first) / (0.6 * fine[:, None])]
    shares = [
        tone,
        jnp.full(len(tone), 0.15),
        scale_uniforms((0.3, 0.7), draws[:, 16]),
        scale_uniforms((0.3, 0.7), draws[:, 17]),
    ]
    return shares, vectors


def _wood(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Stripes that bend over several of their periods, and a fine grain along them."""
    ring = _log_between(*RING_M, draws[:, 2])
    first, second = _rotate_in_face(along, up, jnp.where(draws[:, 12] < 0.5, 0.0, jnp.pi / 2))
    longer = ring * scale_uniforms((10.0, 25.0), draws[:, 13])
    vectors = [first / ring[:, None], (second + 0.3 * first) / longer[:, None]]
    vectors += [(second - 0.6 * first) / (0.5 * longer[:, None]), (first + 0.05 * second) / (0.35 * ring[:, None])]
    strength = jnp.full(len(ring), 0.8)
    return [
        strength,
        scale_uniforms((0.3, 0.8), draws[:, 14]),
        scale_uniforms((0.25, 0.5), draws[:, 15]),
        0.25 * strength,
    ], vectors


def _spots(config: SurfaceConfig, draws: Array, along: Array, up: Array) -> Numbers:
    """Patches of another tone, most of them with something finer in them; their edges are hard or fade."""
    apart = _period(config, draws[:, 2])
    other = apart * _log_between(0.4, 2.5, draws[:, 12])
    signed = 2 * draws[:, 13] - 1
    tone = 0.8 * signed * jnp.abs(signed)
    depth = jnp.where(draws[:, 14] < 0.3, 0.0, (1 - jnp.abs(tone)) / 3)
    fine = jnp.maximum(apart * _log_between(0.05, 0.5, draws[:, 15]), config.shortest_m)
    width = scale_uniforms((0.15, 0.7), draws[:, 16])
    edge = jnp.minimum(width, 1 - width) * _log_between(1 / 16, 1.0, draws[:, 17])
    directions = [_unit(draws[:, 20 + 2 * n : 22 + 2 * n]) for n in range(4)]
    sizes = [apart, other, fine, fine * (0.5 + draws[:, 18])]
    vectors = [direction / size[:, None] for direction, size in zip(directions, sizes, strict=True)]
    return [tone, depth, width, edge], vectors


_OF_PATTERN = {
    "waves": _waves,
    "noise": _noise,
    "checks": _checks,
    "bricks": _bricks,
    "posters": _posters,
    "wood": _wood,
    "spots": _spots,
}
