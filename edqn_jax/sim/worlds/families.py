"""Random worlds of every family, and their seeds; `config.registry.FAMILIES` has the families by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.config import FAMILIES, MIXTURES, Config
from edqn_jax.config.loading import suggest_nearest
from edqn_jax.errors import ConfigError
from edqn_jax.kept_programs import kept_jit
from edqn_jax.keys import FAMILY_OF_WORLD, MOTION_OF_WORLD, RANDOM_WORLDS, uniform_integers
from edqn_jax.sim.scene.scene import Scene, stack_scenes, take_scene, with_equal_capacities
from edqn_jax.sim.worlds import canyon, forest, open_worlds, rooms
from edqn_jax.sim.worlds.looks import with_looks
from edqn_jax.sim.worlds.moving import MOVING_SHARE, STILL, Bodies, Moving, in_motion
from edqn_jax.sim.worlds.reachability import has_way
from edqn_jax.user_code import check_functions, describe_object

RADIUS_M = 0.36
"""Of the sphere that has a way in every random world; the drone's."""

_BATCH = 64  # worlds that are drawn by one call

MAX_DRAWS = 256
"""Draws of one world until there is a way in it; a family in which one draw in ten has a way fails in one of 10^11."""

# ------------------------------------------------------------------------------------------- seeds

Split = Literal["training", "validation", "test"]
SPLITS: dict[Split, int] = {"training": 0, "validation": 1, "test": 2}
"""The three ranges of random worlds. They are disjoint by construction: a world's key is the fixed root
folded with its split's number, then with its index in the split."""


def world_key(split: Split, index: ArrayLike) -> Array:
    """Returns the key [] of world `index` (any non-negative integer) of a split."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(RANDOM_WORLDS), SPLITS[split]), index)


def world_keys(split: Split, count: int, first: int = 0) -> Array:
    """Returns the keys [count] of worlds `first`, `first + 1`, ... of a split."""
    return jax.vmap(partial(world_key, split))(first + jnp.arange(count))


# ------------------------------------------------------------------------------------------- worlds


@dataclasses.dataclass(frozen=True)
class Family:
    """How the worlds of a family are drawn."""

    draw: Callable[[Array], Scene]
    """Returns a world of a key, which is consumed; all worlds of a family have arrays of the same shapes."""
    size: tuple[float, float, float]
    """Of the volume at most, metres."""
    edge_m: float | None = 0.5
    """Of the lattice on which each world is checked for a way; None where no check could ever fail."""
    bodies: Bodies = dataclasses.field(default_factory=dict)
    """What can move."""
    moving_share: float = 0.0
    """Share of the bodies that move unless `world.moving_share` says otherwise."""
    detours: bool = False
    """Whether the straight line to the goal is seldom free; options then begin as in rooms (`CLOSED_WORLDS`)."""

    def __post_init__(self) -> None:
        """Checks what `draw` takes, and the sizes.

        Raises:
            ConfigError: names the field and what it must be.
        """
        check_functions(self, {"draw": "key"})
        if np.shape(self.size) != (3,) or not all(metres > 0 for metres in self.size):
            raise ConfigError(f"`size` of Family must be three lengths above 0, metres, not {self.size!r}")
        if self.edge_m is not None and not self.edge_m > 0:
            raise ConfigError(f"`edge_m` of Family must be metres above 0, or None, not {self.edge_m!r}")


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Worlds that are of one of several families."""

    shares: Mapping[str, int]
    """By the name of the family."""
    detours: bool = False
    """As of `Family`."""

    def __post_init__(self) -> None:
        """Checks the shares.

        Raises:
            ConfigError: if they are no whole numbers above 0 by name.
        """
        shares = self.shares
        if not (isinstance(shares, Mapping) and shares and all(_is_share(*each) for each in shares.items())):
            raise ConfigError(f"`shares` of Mixture must be whole numbers above 0 by name of a family, not {shares!r}")


def _is_share(name: object, share: object) -> bool:
    return isinstance(name, str) and isinstance(share, int) and share > 0


def _open(density: str) -> Family:
    return Family(
        partial(open_worlds.sample_open_world, density), open_worlds.SIZE, None, open_worlds.body_slots(density)
    )


SPARSE, MEDIUM, DENSE = (_open(density) for density in open_worlds.SHAPES)
MOVING = dataclasses.replace(MEDIUM, moving_share=MOVING_SHARE)
ROOMS = Family(rooms.sample_rooms, (rooms.SIDE, rooms.SIDE, rooms.HEIGHT[1]), detours=True)  # walls stand
FOREST = Family(forest.sample_forest, forest.SIZE, bodies=forest.BODIES, detours=True)
CANYON = Family(canyon.sample_canyon, canyon.SIZE, edge_m=0.7, bodies=canyon.BODIES, detours=True)
OPEN, MIXED = Mixture(MIXTURES["open"]), Mixture(MIXTURES["mixed"], detours=True)
NARROW = Mixture(MIXTURES["narrow"], detours=True)


def random_scene(family: str, key: Array) -> Scene:
    """Returns a random world with a start, a goal, and a way between them for a sphere of `RADIUS_M`.

    Motion is added to the static world of the same key; reachability is checked at time 0.

    Args:
        family: of `FAMILIES`; a world of a mixture is of one of its families.
        key: consumed.

    Raises:
        ConfigError: if there is no such family.
    """
    if isinstance(_entry(family), Mixture):
        family = families_of(family, key[None])[0]
    return take_scene(_sample_worlds(family, key[None], _moving_in(family, STILL)), 0)


def random_pool(family: str, keys: Array, moving: Moving = STILL) -> Scene:
    """Returns a pool of random worlds in which `moving` moves, one for each of `keys` [P]; see `random_scene`."""
    mixture = _entry(family)
    if not isinstance(mixture, Mixture):
        return _in_batches(family, _moving_in(family, moving), keys)
    names = np.array(families_of(family, keys))
    present = [(str(name), np.flatnonzero(names == name)) for name in np.unique(names)]
    # Padded for all families of the mixture, also for one that none of these worlds is of.
    shapes = [jax.eval_shape(partial(_unchecked, name, _moving_in(name, moving)), keys) for name in mixture.shares]
    # Most of the time is XLA's, which leaves other cores idle while it compiles one program.
    with ThreadPoolExecutor(thread_name_prefix="families") as threads:
        drawn = [threads.submit(_in_batches, name, _moving_in(name, moving), keys[which]) for name, which in present]
        by_family = [each.result() for each in drawn]
    pools = with_equal_capacities(by_family, shapes)
    order = np.argsort(np.concatenate([which for _, which in present]))
    return jax.tree.map(lambda *leaves: jax.device_put(np.concatenate(leaves)[order]), *pools)


def worlds_of(config: Config, family: str, split: Split, count: int, first: int = 0) -> Scene:
    """Returns worlds `first`, `first + 1`, ... of a split as a configuration has them: what moves, and their looks."""
    keys = world_keys(split, count, first)
    return with_looks(random_pool(family, keys, Moving.from_config(config)), keys, config.surface)


def world_of_file(config: Config, scene: Scene) -> Scene:
    """Returns the pool of one world that a file describes, with the looks of the configuration."""
    return with_looks(stack_scenes([scene]), jax.random.key(RANDOM_WORLDS)[None], config.surface)


def _entry(name: str) -> Family | Mixture:
    """Returns a family or a mixture.

    Raises:
        ConfigError: if there is none of that name.
    """
    if name not in FAMILIES:
        raise ConfigError(f"there are no random worlds '{name}'{suggest_nearest(name, FAMILIES)}")
    return FAMILIES.get(name)


def _family(name: str) -> Family:
    """Returns a family.

    Raises:
        ConfigError: if there is none of that name, or it is a mixture, of which no mixture can be made.
    """
    family = _entry(name)
    if isinstance(family, Mixture):
        raise ConfigError(f"the random worlds '{name}' are a mixture; a mixture must be of families")
    return family


def _moving_in(family: str, moving: Moving) -> Moving:
    """Returns the `Moving` of a family."""
    return dataclasses.replace(moving, share=moving.share or _family(family).moving_share)


def families_of(mixture: str, keys: Array) -> list[str]:
    """Returns the family of each world of a mixture, from the worlds' keys [P]."""
    entry = _entry(mixture)
    assert isinstance(entry, Mixture), f"{mixture} is one family"
    families = [family for family, share in entry.shares.items() for _ in range(share)]
    numbers = jax.vmap(lambda key: uniform_integers(jax.random.fold_in(key, FAMILY_OF_WORLD), (), len(families)))(keys)
    return [families[number] for number in np.asarray(numbers)]


def _in_batches(family: str, moving: Moving, keys: Array) -> Scene:
    """Returns a pool of one family, drawn in batches of one size, so that one program draws pools of every size."""
    count = keys.shape[0]
    if count <= 1:
        return _sample_worlds(family, keys, moving)
    # As data: the first key is used once more to fill the last batch.
    data = np.asarray(jax.random.key_data(keys))
    data = np.concatenate([data, np.broadcast_to(data[:1], (-count % _BATCH, *data.shape[1:]))])
    batches = [jax.random.wrap_key_data(jnp.asarray(data[i : i + _BATCH])) for i in range(0, count, _BATCH)]
    # XLA uses one core for a batch.
    with ThreadPoolExecutor(thread_name_prefix="drawing") as pool:
        batches_of_worlds = list(pool.map(partial(_sample_worlds, family, moving=moving), batches))
    # `jnp.concatenate` and `jnp.asarray` would compile a program for every shape of array.
    return jax.tree.map(lambda *leaves: jax.device_put(np.concatenate(leaves)[:count]), *batches_of_worlds)


def _sample_worlds(family: str, keys: Array, moving: Moving = STILL) -> Scene:
    """Returns worlds of one family, one for each key [P]; motion is added by a small program of its own.

    Raises:
        ConfigError: if one of them has no way after `MAX_DRAWS` draws.
    """
    scenes, passable = _standing(family, keys)
    if not np.all(passable):
        raise ConfigError(
            f"the family of random worlds '{family}' drew one world {MAX_DRAWS} times without a way from start to goal "
            f"for a sphere of {RADIUS_M} m; its `draw` must leave one, or its `edge_m` be finer than the gaps"
        )
    return _set_in_motion(family, moving, scenes, keys)


def _unchecked(family: str, moving: Moving, keys: Array) -> Scene:
    """As `_sample_worlds`, without the reachability check."""
    return _set_in_motion(family, moving, jax.vmap(partial(_drawn, family))(keys), keys)


def _drawn(family: str, key: Array) -> Scene:
    """Returns a world of a family, whether there is a way in it or not.

    Raises:
        ConfigError: if `draw` of the family returns something else.
    """
    scene = _family(family).draw(key)
    if not isinstance(scene, Scene):
        raise ConfigError(
            f"`draw` of the family of random worlds '{family}' must return a Scene, not {describe_object(scene)}"
        )
    return scene


def _set_in_motion(family: str, moving: Moving, scenes: Scene, keys: Array) -> Scene:
    bodies = _family(family).bodies
    if not moving.balls and not (moving.share and bodies):
        return scenes
    return _moved(family, moving, scenes, keys)


@kept_jit(0, 1)
def _moved(family: str, moving: Moving, scenes: Scene, keys: Array) -> Scene:
    def one(scene: Scene, key: Array) -> Scene:
        return in_motion(scene, moving, _family(family).bodies, jax.random.fold_in(key, MOTION_OF_WORLD))

    return jax.vmap(one)(scenes, keys)


@kept_jit(0)
def _standing(family: str, keys: Array) -> tuple[Scene, Array]:
    """Returns static worlds, and whether each [P] has a path to the goal; one without is sampled again."""
    how, edge = _family(family), _family(family).edge_m
    if edge is None:
        return jax.vmap(partial(_drawn, family))(keys), jnp.ones(keys.shape, bool)

    def one(key: Array) -> tuple[Scene, Array]:
        def attempt(number: Array) -> tuple[Array, Scene, Array]:
            scene = _drawn(family, jax.random.fold_in(key, number))
            return number, scene, has_way(scene, how.size, RADIUS_M, edge)

        def goes_on(state: tuple[Array, Scene, Array]) -> Array:
            return ~state[2] & (state[0] < MAX_DRAWS - 1)

        first = attempt(jnp.zeros((), jnp.int32))
        return lax.while_loop(goes_on, lambda state: attempt(state[0] + 1), first)[1:]

    return jax.vmap(one)(keys)
