"""What a world looks like: a pattern on each of its shapes, and its light. `sim/camera/surfaces.py` draws them.

A pattern is a function of four phases in cycles, each k . (point - centre of the shape) + shift, so that it moves with
its shape. What the phases mean is the pattern's own.
"""

from __future__ import annotations

import numpy as np
from flax import struct
from jax import Array

PATTERNS = ("blank", "waves", "noise", "checks", "bricks", "posters", "wood", "spots")
"""By the number that `KIND` holds."""

KIND, CONTRAST, SHARES, PHASES = 0, 1, 2, 6
"""Where the numbers of a surface are: its pattern; the amplitude of its albedo, relative; four shares; and four phases,
each a vector k, cycles a metre, and a shift."""

SURFACE_NUMBERS = PHASES + 16


@struct.dataclass
class Surface:
    """The patterns of the shapes of one kind."""

    numbers: Array | np.ndarray  # [N, SURFACE_NUMBERS]
    patterns: tuple[str, ...] = struct.field(pytree_node=False)  # those that any shape of the world may have


@struct.dataclass
class Daylight:
    """The light of one world."""

    sun: Array  # [3] unit, towards the sun
    ambient: Array  # [] share of a surface's brightness that does not depend on the sun
    sky: Array  # [3] RGB


def blank_surfaces(patterns: tuple[str, ...], *lead: int) -> Surface:
    """Returns the surfaces of shapes [*lead] without a pattern."""
    return Surface(np.zeros((*lead, SURFACE_NUMBERS), np.float32), patterns)
