"""Signed distances of closed meshes of any form on the points of a lattice.

Near the surface they are exact, each block of cells against the triangles around it, in one program of JAX on the CPU.
Further away they are those to the nearest one of the triangles that are the nearest ones of neighbours closer to the
surface, less a margin. Inside is where the surface is crossed inwards more often than outwards from below, so that
solids may overlap.

F triangles of [3, 3] metres; a lattice has `counts` [3] points, `cell` metres apart, about the origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array, lax
from numpy.typing import NDArray

EXACT_CELLS = 2.5
"""Cells from the surface up to which distances are exact."""

_BLOCK = 4  # cells along each side of a block
_PIECE_CELLS = 16.0  # longest edge of the pieces that blocks are compared with
_PARTS = 4  # most parts along each edge of a triangle at whose middles a surface is looked at
_STEP = 2  # cells to the furthest neighbours whose nearest triangles a point far away is compared with
_FAR_CELLS = 0.1  # that distances further away are too small, for they are not to the nearest of all triangles
_AT_ONCE = 32  # pieces that a block is compared with in one pass
_FEW_AT_ONCE, _MOST_AT_ONCE = 2**13, 2**17  # points that are compared with one triangle each: two programs
_THREADS = 2
_PAIRS = 2**20  # numbers of an intermediate array
_BESIDE = (3.1e-5, 1.7e-5)  # of a cell: no line upwards meets an edge of a mesh that is aligned to the lattice

Numbers = NDArray[np.floating]
Integers = NDArray[np.int64]


def split_triangles(triangles: Numbers, longest_m: float) -> Numbers:
    """Returns triangles [G, 3, 3] that cover the same surface, no edge of which is longer than `longest_m`."""
    left = np.ascontiguousarray(np.moveaxis(triangles, 0, -1))  # [3, 3, F], so that sums are over whole rows
    squares = np.sum((np.roll(left, -1, axis=0) - left) ** 2, axis=1)  # [3, F] of the edges from each corner
    done = []
    while left.shape[-1]:
        longest = squares.max(0)
        is_left = longest > longest_m**2
        done.append(left[..., ~is_left])
        halves, their = [], []
        for k in range(3):
            # The longest edge, from a to b, is halved.
            which = np.flatnonzero(is_left & (squares[k] == longest))
            is_left[which] = False
            a, b, c = (left[(k + i) % 3].take(which, axis=1) for i in range(3))
            to_b, to_c, to_a = (squares[(k + i) % 3].take(which) for i in range(3))
            middle, quarter = (a + b) / 2, to_b / 4
            across = (to_c + to_a) / 2 - quarter
            halves += [np.stack([a, middle, c]), np.stack([middle, b, c])]
            their += [np.stack([quarter, across, to_a]), np.stack([quarter, to_c, across])]
        left, squares = np.concatenate(halves, axis=-1), np.concatenate(their, axis=-1)
    return np.moveaxis(np.concatenate([np.zeros((3, 3, 0)), *done], axis=-1), -1, 0)


def points_on(triangles: Numbers, longest_m: float) -> Numbers:
    """Returns points [P, 3] of a surface: the middles of triangles that cover it, no edge longer than `longest_m`."""
    pieces = split_triangles(triangles, _PARTS * longest_m)
    squares = np.max(np.sum((np.roll(pieces, -1, axis=1) - pieces) ** 2, axis=2), axis=1)
    parts = np.maximum(np.ceil(np.sqrt(squares) / longest_m - 1e-9), 1)
    found = [_middles_of_parts(n) @ pieces[parts == n] for n in range(1, _PARTS + 1)]
    return np.concatenate([points.reshape(-1, 3) for points in found])


def _middles_of_parts(n: int) -> Numbers:
    """Returns the shares [n^2, 3] of its corners that the middles of a triangle's n^2 equal parts have."""
    lower = [(3 * i + 1, 3 * j + 1) for i in range(n) for j in range(n - i)]
    upper = [(3 * i + 2, 3 * j + 2) for i in range(n) for j in range(n - i - 1)]
    b, c = np.array(lower + upper).T / (3 * n)
    return np.stack([1 - b - c, b, c], axis=1)


def lattice_axes(counts: NDArray[np.integer], cell: float) -> list[Numbers]:
    """Returns the coordinates of a lattice along each axis, metres."""
    return [cell * (np.arange(n) - (n - 1) / 2) for n in counts]


def solid_distances(
    triangles: Numbers, counts: NDArray[np.integer], cell: float, is_closed: bool = True
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns distances at the points of a lattice and in the middles of its cells, metres, negative inside.

    Args:
        triangles: [F, 3, 3] of a closed mesh.
        counts: [3] of the lattice.
        cell: metres.
        is_closed: whether there is an inside.

    Returns:
        corners: [X, Y, Z]; beyond `EXACT_CELLS` from the surface about a tenth of a cell too small.
        middles: [X - 1, Y - 1, Z - 1]; exact within `EXACT_CELLS` of the surface, elsewhere infinite.
    """
    pieces = split_triangles(triangles, _PIECE_CELLS * cell)
    cpu = jax.local_devices(backend="cpu")[0]
    with jax.default_device(cpu):
        # Put there for good: the default is a thread's own, and threads compare.
        table = jax.device_put(np.asarray(_table_of(pieces), np.float32), cpu)
        corners, middles, nearest = _near_distances(pieces, table, counts, cell)
        away = _far_distances(table, nearest, corners, cell) - _FAR_CELLS * cell
    corners[~np.isfinite(corners)] = np.maximum(away, EXACT_CELLS * cell)
    if not is_closed:
        return corners, middles
    axes = lattice_axes(counts, cell)
    for values, lattice in ((corners, axes), (middles, [axis[:-1] + cell / 2 for axis in axes])):
        np.negative(values, out=values, where=inside_of(triangles, lattice))
    return corners, middles


def _far_distances(table: Array, nearest: NDArray[np.int32], near: NDArray[np.float32], cell: float) -> Numbers:
    """Returns the distances of the points of a lattice at which those `near` [X, Y, Z] are infinite.

    Layer by layer away from the surface, a point is compared with the nearest triangles of its neighbours in the layers
    before: all that differ of them, which are two or three.
    """
    far = ~np.isfinite(near)
    places = np.argwhere(far).astype(np.int32)
    layers = np.ceil(np.asarray(scipy.ndimage.distance_transform_edt(far))[far] - 1e-3).astype(np.int32)
    order = np.argsort(layers, kind="stable")
    points = (cell * (places[order] - (np.array(near.shape) - 1) / 2)).astype(np.float32)
    known = np.pad(np.where(far, -1, nearest), _STEP, constant_values=-1).astype(np.int32)
    here = np.asarray(np.ravel_multi_index(tuple(places[order].T + _STEP), known.shape))
    apart = [int(offset @ np.array(known.strides) // known.itemsize) for offset in _neighbours()]
    known, found = known.reshape(-1), np.empty(len(places), np.float32)
    ends = np.searchsorted(layers[order], np.arange(1, layers.max(initial=0) + 2))
    for begin, end in itertools.pairwise(ends):
        rows, numbers = _differing(known, here[begin:end], apart)
        each = _distances_to(table, numbers, points[begin:end][rows])
        least = np.full(end - begin, np.inf, np.float32)
        np.minimum.at(least, rows, each)
        is_least = each == least[rows]
        known[here[begin:end][rows[is_least]]] = numbers[is_least]
        found[begin:end] = least
    back = np.empty_like(found)
    back[order] = found
    return back


def _neighbours() -> Integers:
    """Returns offsets [K, 3] of the neighbours of a point: all around it, and `_STEP` cells away but at corners."""
    around = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
    apart = np.abs(around).sum(1)
    return np.concatenate([around[apart > 0], _STEP * around[(apart > 0) & (apart < 3)]])


def _differing(known: NDArray[np.int32], here: Integers, apart: list[int]) -> tuple[Integers, NDArray[np.int32]]:
    """Returns the rows [P] of places `here` and the triangles [P] of their neighbours, each that is known once."""
    of_neighbours = np.stack([known[here + offset] for offset in apart])
    most = of_neighbours.max(0)
    least = np.where(of_neighbours < 0, most, of_neighbours).min(0)
    several = np.flatnonzero(least != most)
    # Most points have neighbours of one triangle or two: only others are sorted.
    others = of_neighbours[:, several]
    others[(others == most[several]) | (others == least[several])] = -1
    more = np.flatnonzero(others.max(0, initial=-1) >= 0)
    others = np.sort(others[:, more].T, axis=1)
    is_new = others >= 0
    is_new[:, 1:] &= others[:, 1:] != others[:, :-1]
    row, which = np.nonzero(is_new)
    rows = np.concatenate([np.arange(len(here)), several, several[more[row]]])
    return rows, np.concatenate([most, least[several], others[row, which]])


def inside_of(triangles: Numbers, axes: list[Numbers]) -> NDArray[np.bool_]:
    """Returns which points [X, Y, Z] of a lattice are within a closed mesh; evenly spaced `axes`, metres."""
    counts = [len(axis) for axis in axes]
    steps = [axis[1] - axis[0] for axis in axes]
    x, y = (axes[i] + _BESIDE[i] * steps[i] for i in range(2))
    turns = np.zeros((counts[0] * counts[1], counts[2] + 1), np.int16)
    low, high = triangles.min(1), triangles.max(1)
    first = np.stack([np.searchsorted(axis, low[:, i]) for i, axis in enumerate((x, y))], axis=1)
    number = np.stack([np.searchsorted(axis, high[:, i]) for i, axis in enumerate((x, y))], axis=1) - first
    for owner, place in _boxes(first, number):
        a, b, c = np.moveaxis(triangles[owner], 1, 0)
        at = np.stack([x[place[:, 0]], y[place[:, 1]]], axis=1)
        sides = np.stack([_turn(p, q, at) for p, q in ((b, c), (c, a), (a, b))], axis=1)
        met = np.all(sides > 0, axis=1) | np.all(sides < 0, axis=1)
        sides, place = sides[met], place[met]
        area = sides.sum(1)
        heights = np.stack([a[met, 2], b[met, 2], c[met, 2]], axis=1)
        level = np.ceil((np.sum(sides * heights, axis=1) / area - axes[2][0]) / steps[2]).astype(np.int64)
        # A triangle that looks down is crossed inwards on the way up.
        columns = place[:, 0] * counts[1] + place[:, 1]
        np.add.at(turns, (columns, np.clip(level, 0, counts[2])), -np.sign(area).astype(np.int16))
    return (np.cumsum(turns, axis=1, dtype=np.int16)[:, :-1] > 0).reshape(counts)


def _turn(p: Numbers, q: Numbers, at: Numbers) -> Numbers:
    """Returns twice the area of the level triangle of two points and a third, positive anticlockwise."""
    return (q[:, 0] - p[:, 0]) * (at[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (at[:, 0] - p[:, 0])


def _boxes(first: Integers, number: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Yields the owners [P] and places [P, D] of all members of boxes that begin at `first` [N, D], some at a time."""
    sizes = np.where((number > 0).all(1), number.prod(1), 0)
    ends = np.cumsum(sizes)
    begin = 0
    while begin < len(sizes):
        end = max(begin + 1, int(np.searchsorted(ends, (ends[begin - 1] if begin else 0) + _PAIRS, side="right")))
        owner = np.repeat(np.arange(begin, end), sizes[begin:end])
        rest = np.arange(len(owner)) - np.repeat(np.cumsum(sizes[begin:end]) - sizes[begin:end], sizes[begin:end])
        places = np.empty((len(owner), first.shape[1]), np.int64)
        for axis in reversed(range(first.shape[1])):
            rest, places[:, axis] = np.divmod(rest, np.maximum(number[owner, axis], 1))
        if len(owner):
            yield owner, first[owner] + places
        begin = end


def _near_distances(
    pieces: Numbers, table: Array, counts: NDArray[np.integer], cell: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Returns the unsigned distances of corners and middles, infinite beyond `EXACT_CELLS`, and corners' triangles."""
    blocks = -(-np.asarray(counts, np.int64) // _BLOCK)
    reach, side = EXACT_CELLS * cell, _BLOCK * cell
    corner = -cell * (np.asarray(counts) - 1) / 2
    low, high = ((pick(pieces, axis=1) - corner) / side for pick in (np.min, np.max))
    # A block holds its corners and the middles of its cells.
    first = np.clip(np.floor(low - reach / side - 1 + 0.5 / _BLOCK).astype(np.int64), 0, blocks)
    last = np.clip(np.floor(high + reach / side).astype(np.int64) + 1, 0, blocks)
    middle, most = side / 2 - cell / 4, reach + np.sqrt(3) * (side / 2 - cell / 4)
    owners, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for owner, place in _boxes(first, last - first):
        # The box around a triangle reaches further than the triangle.
        is_near = _distances_to(table, owner, corner + side * place + middle) <= most
        owners.append(owner[is_near])
        numbers.append(np.asarray(np.ravel_multi_index(tuple(place[is_near].T), tuple(blocks)), np.int64))
    owner, block = np.concatenate(owners), np.concatenate(numbers)
    order = np.argsort(block, kind="stable")
    used, begin, number = np.unique(block[order], return_index=True, return_counts=True)
    places = np.stack(np.unravel_index(used, tuple(blocks)), axis=1)
    members = jnp.asarray(_padded(owner[order], _AT_ONCE), jnp.int32)
    points = jnp.asarray(_points_of_block(cell), jnp.float32)
    spans = _padded(np.stack([begin, number], axis=1), 1).astype(np.int32)
    corners = _padded(corner + side * places, 1).astype(np.float32)
    parts = [slice(i, None, _THREADS) for i in range(_THREADS)]
    with ThreadPoolExecutor(_THREADS) as pool:
        compared = pool.map(lambda part: _compare_blocks(table, members, spans[part], corners[part], points), parts)
        squares, numbers = (np.stack(each, axis=1).reshape(-1, len(points)) for each in zip(*compared, strict=True))
    distances = np.sqrt(squares[: len(used)]).reshape(-1, 2, *[_BLOCK] * 3)
    distances[distances > reach] = np.inf
    whole = [_whole(distances[:, i], places, blocks, np.inf) for i in range(2)]
    x, y, z = counts
    nearest = _whole(numbers[: len(used)].reshape(-1, 2, *[_BLOCK] * 3)[:, 0], places, blocks, 0)
    return whole[0][:x, :y, :z].copy(), whole[1][: x - 1, : y - 1, : z - 1].copy(), nearest[:x, :y, :z]


def _whole(values: NDArray[Any], places: Integers, blocks: Integers, other: float) -> NDArray[Any]:
    """Returns a lattice with the values [B, n, n, n] of the blocks at `places`, and `other` everywhere else."""
    whole = np.full((*blocks, *[_BLOCK] * 3), other, values.dtype)
    whole[tuple(places.T)] = values
    return whole.transpose(0, 3, 1, 4, 2, 5).reshape(blocks * _BLOCK)


def _points_of_block(cell: float) -> Numbers:
    """Returns corners and middles [2 * _BLOCK^3, 3] of the cells of a block, metres from its lowest corner."""
    lattice = np.stack(np.meshgrid(*[np.arange(_BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return cell * np.concatenate([lattice, lattice + 0.5])


def _padded(rows: NDArray[np.generic], more: int) -> NDArray[np.generic]:
    """Returns rows and `more` after them, and so many that meshes of similar size share a program."""
    count = len(rows) + more
    size = 2 ** max(6, int(np.ceil(np.log2(count))))
    return np.concatenate([rows, np.zeros((size - len(rows), *rows.shape[1:]), rows.dtype)])


def _table_of(triangles: Numbers) -> Numbers:
    """Returns what `_compare_blocks` reads of each triangle: its corners, and its unit normal, 0 of a flat one."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    rows = np.concatenate([a, b, c, np.where(length > 0, normal / np.where(length > 0, length, 1), 0)], axis=1)
    return _padded(rows, 1)  # type: ignore[return-value]


@jax.jit
def _compare_blocks(table: Array, members: Array, spans: Array, corners: Array, points: Array) -> tuple[Array, Array]:
    """Returns the squared distances [B, P] of each block's points to its nearest triangle, m², and that one's number.

    Args:
        table: [T, 12] as `_table_of`.
        members: triangles of all blocks, one block after the other.
        spans: [B, 2] where those of each block begin, and how many they are.
        corners: [B, 3] of the blocks, metres.
        points: [P, 3] of a block.
    """

    def of_block(one: tuple[Array, Array]) -> tuple[Array, Array]:
        span, corner = one

        def nearer(i: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            number = members[span[0] + jnp.minimum(i * _AT_ONCE + jnp.arange(_AT_ONCE), span[1] - 1)]
            squares, which = found
            each = _squares(list(table[number].T[:, :, None]), [(points[:, i] + corner[i])[None] for i in range(3)])
            least = jnp.min(each, axis=0)
            first = jnp.max(jnp.where(each == least, number[:, None], 0), axis=0)
            return jnp.minimum(squares, least), jnp.where(least < squares, first, which)

        passes = (span[1] + _AT_ONCE - 1) // _AT_ONCE
        return lax.fori_loop(0, passes, nearer, (jnp.full(len(points), jnp.inf), jnp.zeros(len(points), jnp.int32)))

    return lax.map(of_block, (spans, corners))


@jax.jit
def _squares_to(table: Array, numbers: Array, points: Array) -> Array:
    """Returns the squared distance [P] of each point [P, 3] to the triangle of its number, m²."""
    return _squares(list(table[numbers].T), list(points.T))


def _distances_to(table: Array, numbers: NDArray[np.integer], points: Numbers) -> NDArray[np.float32]:
    """Returns the distance [P] of each point [P, 3] to the triangle of its number, metres."""
    found = np.empty(len(points), np.float32)
    for i in range(0, len(points), _MOST_AT_ONCE):
        part = slice(i, i + _MOST_AT_ONCE)
        count = len(points[part])
        size = _FEW_AT_ONCE if count <= _FEW_AT_ONCE else _MOST_AT_ONCE
        which, place = np.zeros(size, np.int32), np.zeros((size, 3), np.float32)
        which[:count], place[:count] = numbers[part], points[part]
        found[part] = np.sqrt(np.asarray(_squares_to(table, which, place)))[:count]
    return found


def _squares(row: list[Array], place: list[Array]) -> Array:
    """Returns the squared distances of points to triangles, twelve and three arrays that broadcast, m²."""
    corners, n = [row[0:3], row[3:6], row[6:9]], row[9:12]
    away = [[place[i] - corner[i] for i in range(3)] for corner in corners]
    height = sum(away[0][i] * n[i] for i in range(3))
    above = n[0] ** 2 + n[1] ** 2 + n[2] ** 2 > 0.5
    beside = jnp.inf
    for k in range(3):
        p, e = away[k], [corners[(k + 1) % 3][i] - corners[k][i] for i in range(3)]
        outward = e[1] * n[2] - e[2] * n[1], e[2] * n[0] - e[0] * n[2], e[0] * n[1] - e[1] * n[0]
        above = above & (sum(p[i] * outward[i] for i in range(3)) <= 0)
        length = jnp.maximum(e[0] ** 2 + e[1] ** 2 + e[2] ** 2, 1e-20)
        share = jnp.clip(sum(p[i] * e[i] for i in range(3)) / length, 0.0, 1.0)
        beside = jnp.minimum(beside, sum((p[i] - share * e[i]) ** 2 for i in range(3)))
    return jnp.where(above, height**2, beside)
