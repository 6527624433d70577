"""What sensors remember as episodes begin: as if drawn for every environment, and drawn for those alone that are reset.

Environments are E; their memories are compared to the last bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from edqn_jax.config import SENSORS, Config
from edqn_jax.config.loading import make_config
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.sensors.sensor import Sensor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.decision import select_tree
from edqn_jax.sim.task.group import map_drones
from edqn_jax.sim.task.renewal import PORTIONS, renew
from tests.support.miniature import miniature_world
from tests.support.registries import keep_as_they_are

H, W = 3, 4
FAULTY = make_config(
    "paper",
    camera={"width": W, "height": H},
    drone={"physics": "rigid_body"},  # compiles in less time
    events={"profile": "dvs", "law": "esim", "hot_pixel_fraction": 0.2, "faults_share": 0.5},
    light={"least_lux": 50.0, "most_lux": 500.0},
)


def draw_for_all(config: Config, is_reset: Array, key: Array, memory: Any) -> Any:
    """Stands for `renew`: the obvious way."""
    return select_tree(is_reset, sensor.at_rest(config, key), memory)


def mapped(function: Callable[..., Any], times: int = 1) -> Any:
    for _ in range(times):
        function = jax.vmap(function)
    return jax.jit(function)


def environments(config: Config, *shape: int) -> tuple[Array, Any]:
    """Returns keys for resets, and memories until then, of environments [*shape]; no two are alike."""
    keys = jax.random.split(jax.random.key(1), (2, *shape))
    return keys[0], mapped(partial(sensor.at_rest, config), len(shape))(keys[1])


def assert_equal(found: Any, wanted: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> tuple[Config, list[bytes]]:
    """A sensor of one's own with a memory of many kinds, and the keys of which it has been drawn."""
    keep_as_they_are(monkeypatch)
    drawn: list[bytes] = []

    def at_rest(config: Config, key: Array) -> Any:
        jax.debug.callback(lambda data: drawn.append(np.asarray(data).tobytes()), jax.random.key_data(key))
        first, second = jax.random.split(key)
        picture = jax.random.uniform(first, (H, W))
        return {"picture": picture, "parts": (jnp.int32(3), None, picture > 0.5), "key": second, "weak": jnp.asarray(2)}

    def show(config: Config, scene: Any, poses: Any, memory: Any, key: Array) -> Any:
        return jnp.ravel(memory["picture"]), memory

    SENSORS.register("own", Sensor(show, lambda config: (H * W,), at_rest=at_rest))
    return dataclasses.replace(FAULTY, env=dataclasses.replace(FAULTY.env, sensor="own")), drawn


@pytest.mark.parametrize("count", [1, 2, PORTIONS - 1, PORTIONS, PORTIONS + 1, 40])
def test_memories_are_those_drawn_for_all(count: int) -> None:
    keys, memory = environments(FAULTY, count)
    found, wanted = (mapped(partial(each, FAULTY)) for each in (renew, draw_for_all))
    ends = np.zeros((4, count), bool)  # no one, the last, all but the first, all
    ends[1, -1], ends[2, 1:], ends[3] = True, True, True
    for is_reset in (*ends, *(np.random.default_rng(count).random((4, count)) < [[0.05], [0.2], [0.5], [0.9]])):
        assert_equal(found(is_reset, keys, memory), wanted(is_reset, keys, memory))


def test_one_environment_alone_may_have_a_memory_of_any_kind(own: tuple[Config, list[bytes]]) -> None:
    config, drawn = own
    (key, other), memory = jax.random.split(jax.random.key(2)), sensor.at_rest(config, jax.random.key(3))
    drawn.clear()
    assert_equal(jax.jit(partial(renew, config))(False, key, memory), memory)
    jax.effects_barrier()
    assert drawn == []
    for used in (key, other):
        assert_equal(renew(config, jnp.bool_(True), used, memory), sensor.at_rest(config, used))


@pytest.mark.parametrize("shape", [(2, 5), (3, 1), (2, 3, 7)])
def test_maps_of_maps_are_one(own: tuple[Config, list[bytes]], shape: tuple[int, ...]) -> None:
    config, drawn = own
    keys, memory = environments(config, *shape)
    found, wanted = (mapped(partial(each, config), len(shape)) for each in (renew, draw_for_all))
    is_reset = np.random.default_rng(0).random(shape) < 0.4
    assert_equal(found(is_reset, keys, memory), wanted(is_reset, keys, memory))
    loops = [eqn for eqn in _equations(jax.make_jaxpr(found)(is_reset, keys, memory)) if eqn.primitive.name == "while"]
    assert len(loops) == 1 and loops[0].params["cond_jaxpr"].out_avals[0].shape == ()


def test_what_is_not_mapped_is_that_of_all(own: tuple[Config, list[bytes]]) -> None:
    keys, memory = environments(own[0], 20)
    is_reset = jnp.arange(20) % 3 == 0
    for axes in ((0, None, None), (None, 0, None), (None, None, 0), (0, 0, None), (0, None, 0)):
        given = [
            x if axis == 0 else jax.tree.map(lambda x: x[0], x)
            for x, axis in zip((is_reset, keys, memory), axes, strict=True)
        ]
        found, wanted = (jax.vmap(partial(each, own[0]), axes)(*given) for each in (renew, draw_for_all))
        assert_equal(found, wanted)


@pytest.mark.parametrize("checked", [True, False])
def test_they_are_the_same_within_shards_a_scan_and_groups(checked: bool) -> None:
    config = dataclasses.replace(FAULTY, env=dataclasses.replace(FAULTY.env, drones=3))
    keys, memory = environments(config, 12)
    is_reset = np.random.default_rng(0).random((5, 12)) < 0.3

    def run(function: Callable[..., Any]) -> Any:
        def step(carried: Any, is_reset: Array) -> Any:
            keys, memory = carried
            memory = map_drones(config, partial(function, config))(is_reset, keys, memory)
            return (jax.vmap(lambda key: jax.random.fold_in(key, 1))(keys), memory), memory

        scan = lambda is_reset, *carried: jax.lax.scan(step, carried, is_reset)[1]  # noqa: E731
        by_env, spread = PartitionSpec(None, "d"), PartitionSpec("d")
        mesh = Mesh(np.array(jax.devices()[:1]), ("d",))
        sharded = jax.shard_map(scan, mesh=mesh, in_specs=(by_env, spread, spread), out_specs=by_env, check_vma=checked)
        return jax.jit(sharded)(is_reset, keys, memory)

    assert_equal(run(renew), run(draw_for_all))


def test_none_is_drawn_for_those_that_are_not_reset(own: tuple[Config, list[bytes]]) -> None:
    config, drawn = own
    count = 4 * PORTIONS
    keys, memory = environments(config, count)
    renewed = mapped(partial(renew, config))
    for resets in (0, 1, 4, 5, count):
        is_reset = np.random.default_rng(1).permutation(count) < resets
        jax.effects_barrier()
        drawn.clear()
        jax.block_until_ready(renewed(is_reset, keys, memory))
        jax.effects_barrier()
        assert len(drawn) == -(-resets // 4) * 4  # whole portions
        of_resets = {np.asarray(data).tobytes() for data in jax.random.key_data(keys[is_reset])}
        assert of_resets <= set(drawn) and len(set(drawn) - of_resets) <= 1


def test_a_step_draws_for_those_alone_that_are_reset(own: tuple[Config, list[bytes]]) -> None:
    config, drawn = own
    world, count = miniature_world(config), 2 * PORTIONS
    state = jax.vmap(partial(env.before_reset, config, world))(jax.random.split(jax.random.key(0), count))
    state = dataclasses.replace(state, ended=jnp.arange(count) == 5)
    jax.effects_barrier()
    drawn.clear()
    after, _ = mapped(partial(env.step, config, world))(state, jnp.zeros(count, jnp.int32))
    jax.block_until_ready(after)
    jax.effects_barrier()
    assert len(drawn) == 2
    before: Any = state.memory
    changed = np.any(np.asarray(after.memory["picture"] != before["picture"]), axis=(1, 2))
    assert changed.tolist() == (np.arange(count) == 5).tolist()


def test_flights_are_as_if_drawn_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    world = miniature_world(FAULTY)
    state = jax.vmap(partial(env.before_reset, FAULTY, world))(jax.random.split(jax.random.key(0), 20))
    state = dataclasses.replace(state, ended=jnp.arange(20) % 4 == 0)
    actions = jnp.arange(6 * 20, dtype=jnp.int32).reshape(6, 20) % 27
    step = lambda s, a: jax.vmap(partial(env.step, FAULTY, world))(s, a)  # noqa: E731
    found = jax.jit(lambda s: jax.lax.scan(step, s, actions))(state)
    monkeypatch.setattr(env, "renew", draw_for_all)
    wanted = jax.jit(lambda s: jax.lax.scan(step, s, actions))(state)
    assert int(jnp.sum(found[1].is_reset)) >= 5
    assert_equal(found, wanted)


def test_small_memories_and_checked_programs_are_as_if_drawn_for_all() -> None:
    lit = make_config(
        "paper", env={"sensor": "frames"}, exposure={"real": True}, light={"least_lux": 1.0, "most_lux": 9.0}
    )
    checked = dataclasses.replace(FAULTY, train=dataclasses.replace(FAULTY.train, debug=True))
    for config in (make_config("paper", env={"sensor": "blind"}), lit, checked):
        keys, memory = environments(config, 20)
        programs = [
            str(jax.make_jaxpr(jax.vmap(partial(each, config)))(jnp.ones(20, bool), keys, memory))
            for each in (renew, draw_for_all)
        ]
        assert programs[0] == programs[1]


def _equations(jaxpr: Any) -> list[Any]:
    """Returns all equations of a program, with those inside of others."""
    found = []
    for eqn in jaxpr.eqns:
        found.append(eqn)
        for value in jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            found += _equations(value) if hasattr(value, "eqns") else []
    return found
