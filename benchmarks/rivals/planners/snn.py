"""SNN: a planner by a wave of spikes through a lattice of place cells.

The method is that of the SNN which the paper compares with (its Table 2; Chao et al., Front. Neurorobotics 2023,
17:1111861) after Ponulak and Hopfield (Front. Comput. Neurosci. 2013, 7:98). There is a leaky integrate-and-fire place
cell in the middle of every cube of 1 m. Cells where the drone does not fit never fire. The cells at the goal are made
to fire; each spike makes the resting neighbours fire, so that a wave spreads from the goal. Every pair of neighbours
then changes its two synapses by spike-timing-dependent plasticity, which makes them asymmetric, and the synaptic vector
field sum_j (w_ij - w_ji) (x_j - x_i) points to where the wave came from. The path goes from the start from cell to
cell, each time over the strengthened synapse that is closest to the direction of the field.

Neighbours are the 26 of the surrounding cube: with 6 the path would be sqrt(3) times too long along a diagonal. A
synapse exists only if the drone's sphere passes straight between its two cells, so no path cuts a corner.

A cell fires once (the refractory time is longer than the wave), so that pairwise plasticity is a function of the two
cells' spike times and is computed where it is needed. A time step is the delay of a synapse, and one spike is enough to
make a neighbour fire, so the spike time is the number of hops, as in a breadth-first search.

The budget's step is one time step of the wave. At least one cell fires in each, so the wave ends.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.planning.path import MARGIN, PlannedPath, PlanningTask, not_found, path_as_plan
from edqn_jax.sim.scene.distance import segment_contact, shape_distances, signed_distance
from edqn_jax.sim.scene.scene import Scene
from rivals.planners.planner import Budget, refusal

DIRECTIONS = np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)])
"""[26, 3] from a cell to its neighbours; the opposite of direction k is 25 - k."""

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # [8, 3]
_CHUNK = 4096  # cells near a surface that are checked together: their distances to all shapes fit into the cache
_LEG_SAMPLES = 128  # of a segment of at most sqrt(3) cells: undetected penetration of at most 0.07 mm


@dataclasses.dataclass(frozen=True)
class SnnConfig:
    """Table 2 of the paper; it does not give the threshold, the synaptic current and the time step.

    Raises:
        ValueError: if one spike does not make a neighbour fire, because then there is no wave.
    """

    membrane_time_s: float = 0.002
    """Time constant of the leak."""
    resistance_ohm: float = 20e6
    """Membrane resistance; the rest potential is 0 mV."""
    threshold_v: float = 0.010
    """Potential at which a cell fires; not in Table 2."""
    synaptic_current_a: float = 2e-9
    """Current that one spike drives through a synapse for one time step; not in Table 2, enough for the threshold."""
    step_s: float = 0.001
    """Time step and synaptic delay; not in Table 2."""
    strengthening: float = 1.0
    """Change of a synapse at zero lag if its source fires first ("pre-amplitude")."""
    weakening: float = 1.0
    """The same if its target fires first ("post-amplitude")."""
    strengthening_time_s: float = 0.0168
    """Time constant of the change over the lag ("pre-time constant")."""
    weakening_time_s: float = 0.0337
    """The same if the target fires first ("post-time constant")."""

    def __post_init__(self) -> None:
        reached = self.resistance_ohm * self.synaptic_current_a * (1 - self.kept)
        if reached < self.threshold_v:
            raise ValueError(
                f"one spike raises a place cell to {reached:g} V, below its threshold of {self.threshold_v:g} V"
            )

    @property
    def kept(self) -> float:
        """Returns the fraction of the potential that remains after a time step."""
        return math.exp(-self.step_s / self.membrane_time_s)


@struct.dataclass
class Synapses:
    """The lattice. [X, Y, Z] are its cells."""

    middles: Array  # [X, Y, Z, 3] metres
    free: Array  # [X, Y, Z] bool: the sphere fits
    joined: Array  # [X, Y, Z] int32: bit k is set if the sphere passes straight to the neighbour in direction k


# ------------------------------------------------------------------------------------------ lattice


def lattice_shape(volume: np.ndarray, cell: float = 1.0) -> tuple[int, int, int]:
    """Returns the number of cells of `cell` metres along each axis of a volume [2, 3].

    Raises:
        ValueError: if the volume is narrower than one cell.
    """
    x, y, z = (int(n) for n in np.floor((volume[1] - volume[0]) / cell + 1e-5))
    if min(x, y, z) < 1:
        raise ValueError(f"a flight volume of {x} x {y} x {z} cells of {cell:g} m holds no place cell")
    return x, y, z


def synapses(scene: Scene, radius: ArrayLike, shape: tuple[int, int, int], cell: float = 1.0) -> Synapses:
    """Returns which cells are free, and between which neighbours a sphere passes straight.

    The distance to a convex shape is convex, so its tangent at a cell is a lower bound along the half of the edge that
    begins there. An edge is accepted if the bounds of both halves are at least the radius. Along flat walls that is
    exact; around corners it rejects some edges that are just free, and accepts none that is not.

    Args:
        scene: one world.
        radius: of the sphere, metres.
        shape: of the lattice, static; it is centred in the scene's volume.
        cell: metres, static.
    """
    lower = (scene.volume[0] + scene.volume[1] - cell * jnp.array(shape, jnp.float32)) / 2
    index = jnp.stack(jnp.meshgrid(*(jnp.arange(n, dtype=jnp.float32) for n in shape), indexing="ij"), axis=-1)
    middles = lower[None, None, None] + cell * (index + 0.5)
    points = middles.reshape(-1, 3)
    distance = jax.vmap(lambda point: signed_distance(scene, point))(points)
    free = distance >= radius
    # Half an edge is at most sqrt(3) / 2 cells long: cells with more clearance need no check of their edges.
    near = free & (distance < radius + math.sqrt(3) / 2 * cell)
    where = jnp.nonzero(near, size=points.shape[0], fill_value=points.shape[0])[0]
    where = jnp.concatenate([where, jnp.full(_CHUNK, points.shape[0], where.dtype)])

    def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
        first, leaves = state
        cells = lax.dynamic_slice_in_dim(where, first, _CHUNK)
        halves = _free_halves(scene, points.at[cells].get(mode="clip"), radius, cell)
        return first + _CHUNK, leaves.at[cells].set(halves, mode="drop")

    everything = (1 << len(DIRECTIONS)) - 1
    leaves = jnp.where(free, everything, 0)
    count = jnp.sum(near)
    _, leaves = lax.while_loop(lambda state: state[0] < count, check, (jnp.zeros((), where.dtype), leaves))
    leaves = leaves.reshape(shape)
    back = [_shift(leaves, step) >> (25 - k) & 1 for k, step in enumerate(DIRECTIONS)]
    arrives = functools.reduce(jnp.bitwise_or, (bit << k for k, bit in enumerate(back)))
    return Synapses(middles, free.reshape(shape), leaves & arrives)


def _free_halves(scene: Scene, points: Array, radius: ArrayLike, cell: float) -> Array:
    """Returns [C] int32: bit k is set if the first half of the edge from `points` [C, 3] in direction k is free."""
    if not shape_distances(scene, points[0]):
        return jnp.full(points.shape[0], (1 << len(DIRECTIONS)) - 1)

    def distances(point: Array) -> Array:
        return jnp.concatenate(list(shape_distances(scene, point).values()))

    def with_gradient(point: Array) -> tuple[Array, Array]:
        value, pull = jax.vmap(lambda tangent: jax.jvp(distances, (point,), (tangent,)), out_axes=(None, 0))(jnp.eye(3))
        return value, pull

    distance, slope = jax.vmap(with_gradient)(points)  # [C, K], [C, 3, K]
    bits = jnp.zeros(points.shape[0], jnp.int32)
    for k, step in enumerate(DIRECTIONS):
        along = sum(float(s) * slope[:, axis] for axis, s in enumerate(step) if s)
        nearest = jnp.min(distance + cell / 2 * jnp.minimum(along, 0.0), axis=1)
        bits |= (nearest >= radius).astype(jnp.int32) << k
    return bits


def _shift(field: Array, step: np.ndarray) -> Array:
    """Returns, for each cell, the field [X, Y, Z] at its neighbour one `step` [3] on; zero outside the lattice."""
    padded = jnp.pad(field, 1)
    x, y, z = (int(s) + 1 for s in step)
    nx, ny, nz = field.shape
    return padded[x : x + nx, y : y + ny, z : z + nz]


def cells_at(scene: Scene, network: Synapses, point: Array, radius: ArrayLike, cell: float = 1.0) -> Array:
    """Returns [X, Y, Z] bool: the cells, at most 8, to which the sphere passes straight from a point [3], metres."""
    base = jnp.floor((point - network.middles[0, 0, 0]) / cell).astype(jnp.int32)
    corners = jnp.clip(base[None] + _CORNERS, 0, np.array([network.free.shape]) - 1)
    x, y, z = corners.T
    ends = network.middles[x, y, z]
    touch = jax.vmap(lambda end: segment_contact(scene, point, end, radius, samples=_LEG_SAMPLES)[0])(ends)
    passable = network.free[x, y, z] & ~touch
    return jnp.zeros(network.free.shape, bool).at[x, y, z].max(passable)


# --------------------------------------------------------------------------------------------- wave


def spike_wave(
    config: SnnConfig, network: Synapses, goal: Array, start: Array | None = None, steps: ArrayLike = 2**30
) -> tuple[Array, Array]:
    """Returns the spike times of the wave that starts from the cells at the goal.

    The current is constant within a time step, over which tau dV/dt = -V + R I is solved exactly.

    Args:
        config: of the cells.
        network: the lattice.
        goal: [X, Y, Z] bool, cells that fire at time 0.
        start: [X, Y, Z] bool, cells whose first spike ends the wave; None for the whole wave.
        steps: maximum number of time steps.

    Returns:
        hops: [X, Y, Z] int32, time step in which each cell fired, -1 if it did not. taken: number of time steps.
    """
    ends = jnp.zeros_like(goal) if start is None else start

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        now, spikes, potential, hops = state
        arriving = jnp.zeros(spikes.shape, jnp.int32)
        active = spikes.astype(jnp.int32)
        for k, direction in enumerate(DIRECTIONS):
            arriving += _shift(active, direction) & (network.joined >> k)
        driven = config.resistance_ohm * config.synaptic_current_a * arriving
        potential = config.kept * potential + (1 - config.kept) * driven
        fired = (potential >= config.threshold_v) & (hops < 0)  # a cell without synapses gets no current
        return now + 1, fired, jnp.where(fired, 0.0, potential), jnp.where(fired, now + 1, hops)

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Array:
        now, spikes, _, _ = state
        return jnp.any(spikes) & ~jnp.any(spikes & ends) & (now < steps)

    goal = goal & network.free
    state = jnp.zeros((), jnp.int32), goal, jnp.zeros(goal.shape), jnp.where(goal, 0, -1)
    taken, _, _, hops = lax.while_loop(goes_on, step, state)
    return hops, taken


# --------------------------------------------------------------------------------- plasticity, path


def stdp(config: SnnConfig, lag: Array) -> Array:
    """Returns the change of a synapse whose target fired `lag` seconds [...] after its source, for each pair of spikes.

    A+ exp(-lag / tau+) if the source fired first, -A- exp(lag / tau-) if the target did, 0 for the same time.
    """
    strengthened = config.strengthening * jnp.exp(-jnp.abs(lag) / config.strengthening_time_s)
    weakened = -config.weakening * jnp.exp(-jnp.abs(lag) / config.weakening_time_s)
    return jnp.where(lag > 0, strengthened, jnp.where(lag < 0, weakened, 0.0))


def asymmetry(config: SnnConfig, network: Synapses, hops: Array, cell: Array) -> Array:
    """Returns w_ij - w_ji of a cell i with its 26 neighbours j; w_ij is the synapse from j to i.

    All synapses are equal at first. The difference is 0 without a synapse or if one of the two cells did not fire.

    Args:
        config: of the plasticity.
        network: the lattice.
        hops: [X, Y, Z] from `spike_wave`.
        cell: [3] index.

    Returns:
        [26], in the order of `DIRECTIONS`.
    """
    x, y, z = jnp.clip(cell[None] + DIRECTIONS, 0, np.array([hops.shape]) - 1).T
    mine, theirs = hops[cell[0], cell[1], cell[2]], hops[x, y, z]
    joined = (network.joined[cell[0], cell[1], cell[2]] >> jnp.arange(len(DIRECTIONS)) & 1) == 1
    lag = (mine - theirs) * config.step_s
    change = stdp(config, lag) - stdp(config, -lag)
    return jnp.where(joined & (mine >= 0) & (theirs >= 0), change, 0.0)


def synaptic_field(asymmetries: Array) -> Array:
    """Returns the synaptic vector field [3] of one cell, in cells: sum_j (w_ij - w_ji) (x_j - x_i)."""
    return asymmetries @ DIRECTIONS.astype(np.float32)


def follow(config: SnnConfig, network: Synapses, hops: Array, start: Array, goal: Array) -> tuple[Array, Array, Array]:
    """Follows the synaptic vector field from cell to cell.

    The next cell is the neighbour j with w_ij > w_ji that is closest to the direction of the field. Such neighbours
    fired earlier, so the path has at most as many steps as the start has hops.

    Args:
        config: of the plasticity.
        network: the lattice.
        hops: [X, Y, Z] from `spike_wave`.
        start: [3] index of a cell that fired.
        goal: [X, Y, Z] bool, where the path may end.

    Returns:
        cells: [X * Y * Z, 3] index of the path's cells, the last repeated. count: number of cells on the path.
        arrived: bool, whether the last is at the goal.
    """
    unit = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    most = hops.size

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        cells, count, here, _ = state
        gain = asymmetry(config, network, hops, here)
        aligned = jnp.where(gain > 0, unit.astype(np.float32) @ synaptic_field(gain), -jnp.inf)
        best = jnp.argmax(aligned)
        stuck = ~(gain[best] > 0)
        there = jnp.where(stuck, here, here + jnp.asarray(DIRECTIONS)[best])
        cells = cells.at[count].set(there, mode="drop")
        return cells, count + ~stuck, there, stuck

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Array:
        _, count, here, stuck = state
        return ~goal[here[0], here[1], here[2]] & ~stuck & (count < most)

    cells = jnp.broadcast_to(start, (most, 3))
    cells, count, here, _ = lax.while_loop(goes_on, step, (cells, jnp.ones((), jnp.int32), start, jnp.zeros((), bool)))
    return cells, count, goal[here[0], here[1], here[2]]


# --------------------------------------------------------------------------------------------- plan


@struct.dataclass
class Walk:
    """The result of `solve`."""

    points: Array  # [X * Y * Z, 3] metres, middles of the path's cells, the last repeated
    count: Array  # [] int32, number of cells on the path
    arrived: Array  # [] bool
    fired: Array  # [] bool, whether the wave reached the start
    taken: Array  # [] int32, time steps of the wave


def solve(
    config: SnnConfig,
    scene: Scene,
    start: Array,
    goal: Array,
    radius: ArrayLike,
    steps: ArrayLike,
    *,
    shape: tuple[int, int, int],
    cell: float = 1.0,
) -> Walk:
    """Returns the path from `start` [3] to `goal` [3], metres, by lattice, wave and plasticity; `config` is static."""
    network = synapses(scene, radius, shape, cell)
    near_start, near_goal = (cells_at(scene, network, point, radius, cell) for point in (start, goal))
    hops, taken = spike_wave(config, network, near_goal, near_start, steps)
    # Of several cells with the fewest hops the one with the shortest detour, because others may lead backwards.
    hops_near_start = jnp.where(near_start & (hops >= 0), hops, jnp.iinfo(hops.dtype).max)
    detour = sum(jnp.sqrt(jnp.sum((network.middles - end[None, None, None]) ** 2, axis=-1)) for end in (start, goal))
    first = jnp.argmin(jnp.where(hops_near_start == jnp.min(hops_near_start), detour, jnp.inf))
    begin = jnp.stack(jnp.unravel_index(first, shape)).astype(jnp.int32)
    cells, count, arrived = follow(config, network, hops, begin, near_goal)
    return Walk(network.middles[tuple(cells.T)], count, arrived, jnp.any(near_start & (hops >= 0)), taken)


@functools.lru_cache(maxsize=8)
def _compiled(config: SnnConfig, shape: tuple[int, int, int], cell: float, structure: Any, leaves: Any) -> Any:
    """Returns `solve`, compiled for scenes of these capacities."""
    scene = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(leaf, jnp.float32) for leaf in leaves])
    point, number = jax.ShapeDtypeStruct((3,), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32)
    program = jax.jit(functools.partial(solve, config, shape=shape, cell=cell))
    return program.lower(scene, point, point, number, jax.ShapeDtypeStruct((), jnp.int32)).compile()


def plan(
    task: PlanningTask,
    budget: Budget = Budget(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    config: SnnConfig = SnnConfig(),  # noqa: B008
    cell: float = 1.0,
) -> PlannedPath:
    """Returns the path along the synaptic vector field. The wave is deterministic: `seed` is unused.

    Raises:
        ValueError: if the flight volume is narrower than one cell.
    """
    del seed
    refused = refusal(task)
    if refused:
        return not_found(refused)
    leaves, structure = jax.tree.flatten(task.scene)
    shape = lattice_shape(np.asarray(task.scene.volume), cell)
    program = _compiled(config, shape, cell, structure, tuple(np.shape(leaf) for leaf in leaves))
    steps = math.prod(shape) if budget.steps is None else budget.steps
    began = time.perf_counter()
    ends = np.float32(task.start), np.float32(task.goal)
    walk = program(task.scene, *ends, np.float32(task.body_radius + MARGIN), np.int32(steps))
    walk = jax.device_get(walk)
    path = np.concatenate([task.start[None], walk.points[: walk.count], task.goal[None]])
    seconds, taken = time.perf_counter() - began, int(walk.taken)
    if not walk.fired:
        ran_out = taken >= steps
        why = (
            f"no spike reached the start within {taken} time steps" if ran_out else "the wave does not reach the start"
        )
        return not_found(why, seconds, taken)
    if not walk.arrived:
        return not_found("the synaptic vector field does not lead to the goal", seconds, taken)
    return path_as_plan(path, seconds, taken)
