"""Spaces of actions, and the moves: one grid of directions in the heading frame, by number, vector or name."""

from __future__ import annotations

import difflib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from edqn_jax.errors import LIKE, ConfigError


class Box(NamedTuple):
    """Arrays of float32 between two bounds."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32


class Discrete(NamedTuple):
    """Whole numbers 0..n-1."""

    n: int
    dtype: Any = jnp.int32

    @property
    def shape(self) -> tuple[int, ...]:
        """Returns the shape of one action, ()."""
        return ()


ACTIONS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(27, 3)
"""The 27 moves, {-1, 0, 1}^3: ahead, left, up in the heading frame."""

_LENGTHS = np.linalg.norm(ACTIONS, axis=1)

DIRECTIONS = (ACTIONS[_LENGTHS > 0] / _LENGTHS[_LENGTHS > 0, None]).astype(np.float32)
"""Unit directions [26, 3] of the moves that go anywhere, in their order."""

HOVER = "hover"
"""Name of the move that goes nowhere."""

_WORDS = {-1: ("back", "right", "down"), 1: ("ahead", "left", "up")}

_AXES = {word: (axis, sign) for sign, words in _WORDS.items() for axis, word in enumerate(words)}


def move_name(move: ArrayLike) -> str:
    """Returns the name of a move [] 0..26, such as `ahead`, `back left up` or `hover`.

    >>> move_name(22), move_name(13)
    ('ahead', 'hover')
    """
    vector = ACTIONS[int(np.asarray(move))]
    return " ".join(_WORDS[int(sign)][axis] for axis, sign in enumerate(vector) if sign) or HOVER


def move_number(move: str | ArrayLike) -> Array:
    """Returns the number [] int32, 0..26, of a move.

    Args:
        move: its number; or its vector [3] of -1, 0 and 1 (ahead, left, up in the heading frame); or its name, words
            such as `ahead`, `left up` or `hover`, in any order.

    Raises:
        ConfigError: if there is no such move. Numbers that JAX is tracing are taken as they are.

    >>> print(move_number("ahead left"), move_number((1, 1, 0)))
    25 25
    """
    if isinstance(move, str):
        return jnp.int32(parse_move(move))
    if isinstance(move, Tracer):
        traced = jnp.asarray(_number_of(move) if move.shape == (3,) else move)
        return traced.astype(jnp.int32)
    given = np.asarray(move)
    if given.shape == () and np.issubdtype(given.dtype, np.integer) and 0 <= given < len(ACTIONS):
        return jnp.int32(given)
    if given.shape == (3,) and np.isin(given, (-1, 0, 1)).all():
        return jnp.int32(_number_of(given))
    raise ConfigError(f"a move is a number from 0 to 26, a vector of three from -1, 0 and 1, or a name, not {move!r}")


def parse_move(name: str) -> int:
    """Returns the number 0..26 of a named move, without JAX.

    Raises:
        ConfigError: if there is no such move.
    """
    return int(_number_of(_vector_of(name)))


def _number_of(vector):
    return 9 * (vector[0] + 1) + 3 * (vector[1] + 1) + vector[2] + 1


def _vector_of(name: str) -> np.ndarray:
    vector = np.zeros(3, np.int64)
    for word in name.replace("-", " ").replace("_", " ").split():
        if word == HOVER:
            continue
        if word not in _AXES:
            close = difflib.get_close_matches(word, [*_AXES, HOVER], n=1, cutoff=LIKE)
            hint = f"; did you mean '{close[0]}'?" if close else f"; moves are made of {', '.join(_AXES)}, or {HOVER}"
            raise ConfigError(f"there is no move '{word}'{hint}")
        axis, sign = _AXES[word]
        if vector[axis]:
            raise ConfigError(f"the move '{name}' names the same axis twice")
        vector[axis] = sign
    return vector
