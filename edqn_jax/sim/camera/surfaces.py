"""Patterns of surfaces, each the average over a pixel: what `pictures.h` draws, in JAX.

Over a pixel a phase is taken to change linearly, by `right` and `up` cycles from edge to edge. The average of a wave is
then a product of two sincs (`texture.py`), and that of pulses a difference of their integral. Averages of products are
taken for products of averages, and what is warped for as steep as it is in the pixel's middle. The errors are those of
`tests/sim/camera/test_surfaces.py`.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from edqn_jax.sim.camera.raycast import Rays
from edqn_jax.sim.camera.texture import box_filter, smooth_wave
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.surface import CONTRAST, KIND, PATTERNS, PHASES, SHARES, Surface, blank_surfaces

EDGE = 1.0 / 64
"""Least width of an edge, periods: narrower ones would show the rounding of phases."""

OVERTONE = 0.5
"""Weight of the four finer waves of noise, relative to those that they are made of."""


class Phase(NamedTuple):
    """Cycles at the middle of each pixel, and their change over it."""

    at: Array
    right: Array
    up: Array

    def times(self, factor: float, other: Phase | None = None, weight: float = 0.0) -> Phase:
        """Returns `factor` x this + `weight` x another phase."""
        if other is None:
            return Phase(*(factor * mine for mine in self))
        return Phase(*(factor * mine + weight * its for mine, its in zip(self, other, strict=True)))

    def shift(self, cycles: float | Array) -> Phase:
        """Returns this phase [...], `cycles` further."""
        return self._replace(at=self.at + cycles)


def smooth(phase: Phase) -> Array:
    """Returns the average of a wave between -1 and 1 over each pixel: [...]."""
    return box_filter(phase.right) * box_filter(phase.up) * smooth_wave(phase.at)


def pulse(phase: Phase, width: float | Array, edge: float | Array = EDGE) -> Array:
    """Returns the average of pulses of height 1, less their mean, over each pixel: [...].

    The pixel is taken for as wide an interval of phases as its diagonal is, on which the average is exact; where both
    of its edges are long, pulses fade as waves do, and are gone where each is a period.

    Args:
        phase: pulses are centred where it is whole.
        width: of a pulse, a share of the period.
        edge: width of its slopes, a share of the period.
    """
    across, along = jnp.abs(phase.right), jnp.abs(phase.up)
    longer, shorter = jnp.maximum(across, along), jnp.minimum(across, along)
    # The root of the squares' sum, to 3 %.
    size = jnp.maximum(jnp.maximum(longer, 0.9 * longer + 0.47 * shorter), edge)
    x = jnp.minimum(shorter * shorter, 1.0)

    def integral(at: Array) -> Array:
        """Returns the integral of the pulses, which has period 1 as they have."""
        f = at - jnp.round(at)
        return jnp.clip(f, -width / 2, width / 2) - width * f

    at = phase.at - jnp.round(phase.at)
    return (1.0 - x * x) * (integral(at + size / 2) - integral(at - size / 2)) / size


def _waves(shares: list[Array], phases: list[Phase]) -> Array:
    parts = [share * smooth(phase) for share, phase in zip(shares, phases, strict=True)]
    return functools.reduce(jnp.add, parts)


def overtones(p: list[Phase]) -> list[Phase]:
    """Returns the four finer phases of noise."""
    return [
        p[2].times(1.0, p[3], 1.0),
        p[2].times(2.0, p[1], -1.0),
        p[3].times(2.0, p[0], 1.0),
        p[2].times(3.0, p[3], -2.0),
    ]


def _noise(shares: list[Array], phases: list[Phase]) -> Array:
    return _waves(shares, phases) + OVERTONE * _waves(shares, overtones(phases))


def _checks(shares: list[Array], phases: list[Phase]) -> Array:
    stripes, checks, across, width = shares
    per_height = 1.0 / jnp.maximum(width, 1 - width)
    first, second = (pulse(phase, width) * per_height for phase in phases[:2])
    return stripes * first + checks * (first * second) + across * second


def _bricks(shares: list[Array], phases: list[Phase]) -> Array:
    tone, level_joint, upright_joint, _ = shares
    along, courses = phases[:2]
    level = pulse(courses.times(2.0).shift(0.5), level_joint) + level_joint
    even = pulse(courses, 0.5) + 0.5
    here, shifted = (pulse(along.shift(by), upright_joint) + upright_joint for by in (0.0, 0.5))
    upright = even * here + (1 - even) * shifted
    return tone * (level + upright - level * upright)


def _posters(shares: list[Array], phases: list[Phase]) -> Array:
    tone, depth, width, height = shares
    fine = [phases[2], phases[3], phases[2].times(1.0, phases[3], 1.0), phases[2].times(2.0, phases[3], -1.0)]
    picture = tone + depth * sum(smooth(phase) for phase in fine)
    return (pulse(phases[0], width) + width) * (pulse(phases[1], height) + height) * picture


def _spots(shares: list[Array], phases: list[Phase]) -> Array:
    tone, depth, width, edge = shares
    fine = [phases[2], phases[3], phases[3].times(2.0, phases[2], 1.0)]
    here = (pulse(phases[0], width, edge) + width) * (pulse(phases[1], width, edge) + width)
    return here * (tone + depth * sum(smooth(phase) for phase in fine))


def _warp(phase: Phase, by: Phase, amount: Array) -> Phase:
    """Returns a phase plus `amount` x a wave of another."""
    f = by.at - jnp.round(by.at)
    slope = amount * (8.0 - 32.0 * jnp.abs(f))
    return Phase(phase.at + amount * smooth_wave(by.at), phase.right + slope * by.right, phase.up + slope * by.up)


def _wood(shares: list[Array], phases: list[Phase]) -> Array:
    rings, warp, width, grain = shares
    bent = _warp(_warp(phases[0], phases[1], warp), phases[2], 0.5 * warp)
    return rings * pulse(bent, width) / jnp.maximum(width, 1 - width) + grain * smooth(phases[3])


_OF_PATTERN = {
    "waves": _waves,
    "noise": _noise,
    "checks": _checks,
    "bricks": _bricks,
    "posters": _posters,
    "wood": _wood,
    "spots": _spots,
}


def relative_albedo(patterns: tuple[str, ...], numbers: list[Array], phases: list[Phase]) -> Array:
    """Returns the albedo of pixels [...] relative to their surfaces' own: 1 + contrast x pattern.

    Args:
        patterns: those that surfaces may have.
        numbers: the first `PHASES` numbers of each pixel's surface, each [...].
        phases: its four phases, of [...].
    """
    shares = numbers[SHARES:PHASES]
    drawn = jnp.zeros_like(phases[0].at)
    for pattern in patterns:
        if pattern != "blank":
            here = numbers[KIND] == PATTERNS.index(pattern)
            drawn = jnp.where(here, _OF_PATTERN[pattern](shares, phases), drawn)
    return 1.0 + numbers[CONTRAST] * drawn


def _at_eye(numbers: Array, position: Array, origin: Array) -> Array:
    """Returns surfaces [N, SURFACE_NUMBERS] whose shifts are the phases at `origin` [3], not at `position` [N, 3]."""
    rows = numbers[:, PHASES:].reshape(-1, 4, 4)
    apart = origin[None] - position
    k = rows[..., :3]
    phase = (k[..., 0] * apart[:, None, 0] + k[..., 1] * apart[:, None, 1]) + k[..., 2] * apart[:, None, 2]
    phase = phase + rows[..., 3]
    seen = jnp.concatenate([k, (phase - jnp.round(phase))[..., None]], axis=-1)
    return jnp.concatenate([numbers[:, :PHASES], seen.reshape(-1, 16)], axis=1)


def surfaces_at_eye(scene: Scene, first: dict[str, int], origin: Array) -> Surface | None:
    """Returns the surfaces of all shapes of a world, in the order of their numbers; None where they have none.

    Args:
        scene: one world.
        first: number of the first shape of each kind (`raycast.first_numbers`).
        origin: [3] metres, where the phases are taken.
    """
    own = scene.boxes.surface
    if own is None:
        return None
    parts = []
    for kind in sorted(first, key=first.__getitem__):
        shapes = scene.shapes()[kind]
        surface = getattr(shapes, "surface", None) or blank_surfaces((), shapes.position.shape[0])
        parts.append(_at_eye(jnp.asarray(surface.numbers), shapes.position, origin))
    return Surface(jnp.concatenate(parts), own.patterns)


def albedo_factor(
    surfaces: Surface, shape: Array, rays: Rays, depth: Array, slope_right: Array, slope_up: Array
) -> Array:
    """Returns the pattern's factor on each pixel's brightness: [H, W].

    Args:
        surfaces: of `surfaces_at_eye`.
        shape: [H, W] number of the shape that each pixel shows, as floats; any where `depth` is 0.
        depth: [H, W] finite.
        slope_right, slope_up: [H, W] change of depth per pixel on the surface.
    """
    shown = jnp.asarray(surfaces.numbers).at[jnp.maximum(shape, 0).astype(jnp.int32)].get(mode="clip")
    numbers = list(jnp.moveaxis(shown, -1, 0))
    phases = []
    for first in range(PHASES, PHASES + 16, 4):
        kx, ky, kz, shift = numbers[first : first + 4]
        along = (kx * rays.dx + ky * rays.dy) + kz * rays.dz
        right = (kx * rays.right[0] + ky * rays.right[1] + kz * rays.right[2]) * rays.pitch
        up = (kx * rays.up[0] + ky * rays.up[1] + kz * rays.up[2]) * rays.pitch
        phases.append(Phase(shift + depth * along, depth * right + slope_right * along, depth * up + slope_up * along))
    return relative_albedo(surfaces.patterns, numbers[:PHASES], phases)
