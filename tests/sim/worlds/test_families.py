"""Random worlds of all families, and their seeds."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import FAMILIES, MIXTURES
from edqn_jax.config.loading import make_config
from edqn_jax.config.registry import has_detours
from edqn_jax.errors import ConfigError
from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.free_space import find_reachable
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import check_scene, load_world, write_scene
from edqn_jax.sim.scene.scene import Scene, obstacle_count, scene_shapes, take_scene
from edqn_jax.sim.task.missions import own_missions, random_missions, spread_missions
from edqn_jax.sim.worlds import canyon, discs, families, forest, open_worlds, rooms
from edqn_jax.sim.worlds.families import SPLITS, families_of, random_pool, random_scene, world_key, world_keys
from edqn_jax.sim.worlds.free_points import CLEARANCE, FAR
from tests.support.drawn_scenes import clearances
from tests.support.marks import in_whole
from tests.support.registries import keep_as_they_are

RADIUS = 0.36
WORLDS = 8
HARD = ("rooms", "forest", "canyon")


@pytest.fixture(scope="module", params=[WORLDS, *in_whole(3 * WORLDS)])
def pools(request):
    return {family: random_pool(family, world_keys("validation", request.param)) for family in FAMILIES}


distances = jax.jit(jax.vmap(signed_distance, in_axes=(None, 0)))


def test_the_splits_never_share_a_world():
    keys = [jax.random.key_data(world_keys(split, 5000)) for split in SPLITS]
    rows = np.concatenate([np.asarray(key) for key in keys])
    assert len(np.unique(rows, axis=0)) == 3 * 5000


def test_a_worlds_key_depends_on_its_split_and_index_alone():
    batch = jax.random.key_data(world_keys("test", 3, first=7))
    single = jax.random.key_data(world_key("test", 9))
    np.testing.assert_array_equal(batch[2], single)


def assert_same_world(ours: Scene, theirs: Scene) -> None:
    """The same shapes and ends; compiled for one and for many, float32 sums may differ in the last digit."""
    for one, other in zip(scene_shapes(ours), scene_shapes(theirs), strict=True):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4), one, other)
    for name in ("volume", "start", "goal"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    "family", ["sparse", "rooms", *MIXTURES, "moving", *in_whole("medium", "dense", "forest", "canyon")]
)
@pytest.mark.slow
def test_a_key_makes_one_world_and_another_key_another(pools, family):
    first, second = take_scene(pools[family], 0), take_scene(pools[family], 1)
    assert_same_world(random_scene(family, world_key("validation", 0)), first)
    assert not np.allclose(first.start, second.start)


@pytest.mark.slow
def test_a_pool_does_not_depend_on_how_many_are_drawn_at_once(monkeypatch):
    keys = world_keys("validation", 11)
    filled = random_pool("rooms", keys)  # the second batch is filled up
    monkeypatch.setattr(families, "_BATCH", 1)
    single = random_pool("rooms", keys)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4), filled, single)


@pytest.mark.slow
@pytest.mark.parametrize("mixture", MIXTURES)
def test_worlds_of_a_mixture_are_of_its_families_in_their_shares(pools, mixture):
    names = families_of(mixture, world_keys("validation", 600))
    for i in range(len(pools[mixture].start)):
        assert_same_world(take_scene(pools[mixture], i), take_scene(pools[names[i]], i))
    counts = np.array([names.count(family) for family in MIXTURES[mixture]])
    shares = np.array(list(MIXTURES[mixture].values()))
    # The standard deviation of each count is at most 12; the keys are fixed.
    assert counts.sum() == 600 and np.abs(counts - 600 * shares / shares.sum()).max() < 3 * 12
    assert mixture == "open" or counts[:3].sum() < counts.sum() / 3


@pytest.mark.parametrize("family", FAMILIES)
def test_what_is_known_of_a_family_without_its_module_is_so(family):
    assert has_detours(family) == FAMILIES.get(family).detours


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.slow
def test_start_and_goal_are_free_and_far_apart(pools, family):
    pool = pools[family]
    missions = jax.tree.map(np.asarray, own_missions(pool))
    far = np.minimum(FAR, np.asarray(pool.volume[:, 1, 0]) / 2)
    assert (np.linalg.norm(missions.start - missions.goal, axis=1) >= far).all()
    assert (clearances(pool, missions, missions.start) >= CLEARANCE).all()
    assert (clearances(pool, missions, missions.goal) >= CLEARANCE).all()
    for i in range(len(pool.start)):
        check_scene(take_scene(pool, i), RADIUS)


@pytest.mark.parametrize("family", ["sparse", "rooms", *in_whole("medium", "dense", "forest", "canyon")])
@pytest.mark.slow
def test_there_is_a_path_in_every_random_world(pools, family):
    for i in range(2):
        scene = take_scene(pools[family], i)
        straight = np.linalg.norm(scene.start - scene.goal)
        assert shortest_path(scene, scene.start, scene.goal, RADIUS).length_m >= straight - 1e-3


@pytest.mark.parametrize("family", ["rooms", *in_whole("forest", "canyon")])
@pytest.mark.slow
def test_there_is_a_way_from_everywhere_so_that_missions_may_begin_anywhere(pools, family):
    scene = take_scene(pools[family], 1)  # the canyon has a courtyard at the edge
    found = find_reachable(scene, RADIUS, 0.5)
    cells = found.corner + found.edge_m * np.argwhere(~found.is_way)
    assert (np.asarray(distances(scene, jnp.asarray(cells, jnp.float32))) < CLEARANCE).all()


def test_no_corner_is_cut_off():
    """A disc with its middle on the floor reaches over one side at most, so that no corner is closed."""
    reach = jnp.linspace(0.5, 6.5, 40)
    draw = jax.random.uniform(jax.random.key(0), (40, 64, 2))
    places = np.asarray(discs.across_the_edge(reach, draw, (40.0, 60.0), 1.0))
    assert (places >= 0.0).all() and (places <= (40.0, 60.0)).all()
    near = np.minimum(places, (40.0, 60.0) - places) < np.asarray(reach)[:, None, None] + 1.0 - 1e-4
    assert not near.all(axis=2).any() and near.any(axis=2).any()


@pytest.mark.parametrize(("reaches", "is_large"), [(canyon.REACHES[0], True), (canyon.REACHES[1], False)])
def test_buildings_of_a_canyon_stay_in_their_discs(reaches, is_large):
    parts = jax.jit(canyon._parts)
    for reach in (*reaches, sum(reaches) / 2):
        for kind in (0.1, 0.4, 0.6, 0.9):
            low, high, there = parts(reach, kind, 0.5, is_large)
            corners = np.maximum(np.abs(low), np.abs(high))[np.asarray(there)]
            assert np.hypot(corners[:, 0], corners[:, 1]).max() <= reach + 1e-3


@pytest.mark.slow
def test_the_families_are_what_they_are_called(pools):
    for i in range(len(pools["rooms"].start)):
        scene = take_scene(pools["rooms"], i)
        height = float(scene.volume[1, 2])
        assert rooms.HEIGHT[0] <= height <= rooms.HEIGHT[1] and scene.planes.position.shape[0] == 2
        # Outer walls, and up to four pieces of each of the walls between rooms.
        assert 4 + 12 <= obstacle_count(scene) <= 4 + 4 * 12
    trees, boxes = (jax.tree.map(np.asarray, each) for each in (pools["forest"].cylinders, pools["canyon"].boxes))
    apart = np.linalg.norm(trees.position[:, :, None, :2] - trees.position[:, None, :, :2], axis=-1)
    surfaces = apart - trees.radius[:, :, None] - trees.radius[:, None, :] + 1e9 * np.eye(forest.TREES)
    nearest = surfaces.min(axis=2)
    assert nearest.min() >= forest.GAP - 1e-3 and 2.0 < np.median(nearest) < 3.0
    low, high = boxes.position[..., 2] - boxes.half[..., 2], boxes.position[..., 2] + boxes.half[..., 2]
    there = low < 1e3
    assert (high[there] <= canyon.SIZE[2] + 1e-4).all()
    full = there & (low < 1e-3) & (high > canyon.SIZE[2] - 1e-3)
    hanging = there & (low > 1.0)
    assert (full.sum(axis=1) >= 8).all() and (hanging.sum(axis=1) >= 3).all()


@pytest.mark.parametrize("family", HARD)
@pytest.mark.slow
def test_hard_worlds_are_the_same_as_mjcf(pools, family, tmp_path):
    scene = take_scene(pools[family], 3)
    write_scene(scene, tmp_path / "world.xml", title=family)
    world = load_world(tmp_path / "world.xml")
    check_scene(world.scene, RADIUS, names=world.names)
    lower, upper = np.asarray(scene.volume)
    points = np.random.default_rng(0).uniform(lower, upper, (500, 3)).astype(np.float32)
    ours, theirs = (distances(of, points) for of in (scene, world.scene))
    np.testing.assert_allclose(ours, theirs, atol=2e-5)  # written with some digits


@pytest.mark.whole
def test_a_world_without_a_way_is_drawn_again(monkeypatch):
    def draw(key):
        """Rooms with a wall all across, for two keys of three."""
        scene = rooms.sample_rooms(key)
        wall = jax.random.key_data(key)[-1] % 3 > 0
        half = scene.boxes.half.at[0].set(jnp.where(wall, jnp.array([0.2, 18.0, 4.0]), scene.boxes.half[0]))
        position = scene.boxes.position.at[0].set(jnp.where(wall, scene.volume[1] / 2, scene.boxes.position[0]))
        # Nobody starts or ends in it.
        start, goal = scene.volume[1] * jnp.array([0.1, 0.5, 0.5]), scene.volume[1] * jnp.array([0.9, 0.5, 0.5])
        boxes = dataclasses.replace(scene.boxes, half=half, position=position)
        return dataclasses.replace(scene, boxes=boxes, start=start, goal=goal)

    monkeypatch.setitem(FAMILIES._entries, "walled", dataclasses.replace(families.ROOMS, draw=draw))
    pool = families._sample_worlds("walled", world_keys("training", 12))
    half = np.asarray(pool.boxes.half[:, 0])
    assert not (half[:, 1] == 18.0).any()
    # Most first attempts had the wall, so most worlds are another than the first.
    first_half = jax.jit(jax.vmap(lambda key: rooms.sample_rooms(jax.random.fold_in(key, 0)).boxes.half[0]))
    first = first_half(world_keys("training", 12))
    assert 0 < np.isclose(half, first).all(axis=1).sum() < 8


def test_a_family_of_ones_own_and_a_mixture_with_it_are_worlds_by_their_names(monkeypatch):
    keep_as_they_are(monkeypatch)
    FAMILIES.register("columns", dataclasses.replace(families.SPARSE, size=(1.0, 1.0, 1.0), detours=True))
    FAMILIES.register("some", families.Mixture({"columns": 1, "sparse": 1}))
    keys = world_keys("test", 3)
    own, sparse = (random_pool(name, keys) for name in ("columns", "sparse"))
    jax.tree.map(np.testing.assert_array_equal, own, sparse)
    jax.tree.map(np.testing.assert_array_equal, random_pool("some", keys), sparse)
    assert set(families_of("some", world_keys("test", 20))) == {"columns", "sparse"}
    assert make_config("columns").env.reward == "geodesic" and make_config("some").env.reward == "progress"
    FAMILIES.register("nested", families.Mixture({"some": 1}))
    with pytest.raises(ConfigError, match="'some' are a mixture; a mixture must be of families"):
        random_pool("nested", keys)


def test_a_family_without_a_way_ends_with_its_name(monkeypatch):
    keep_as_they_are(monkeypatch)
    monkeypatch.setattr(families, "MAX_DRAWS", 3)

    def draw(key):
        """The goal is out of the volume."""
        scene = open_worlds.sample_open_world("sparse", key)
        return dataclasses.replace(scene, goal=scene.volume[1] + 2.0)

    FAMILIES.register("closed", families.Family(draw, open_worlds.SIZE, edge_m=2.0))
    with pytest.raises(ConfigError, match="family of random worlds 'closed' drew one world 3 times without a way from"):
        random_pool("closed", world_keys("training", 2))
    # Among worlds that have one, and of a mixture.
    FAMILIES.register("both", families.Mixture({"closed": 1, "sparse": 1}))
    with pytest.raises(ConfigError, match="family of random worlds 'closed'"):
        random_pool("both", world_keys("training", 8))
    FAMILIES.register("nothing", families.Family(lambda key: None, open_worlds.SIZE))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="`draw` of the family of random worlds 'nothing' must return a Scene, not N"):
        edqn_jax.make("nothing")


def test_an_unknown_family_names_the_nearest_or_those_there_are():
    with pytest.raises(ConfigError, match="'forrest'; did you mean 'forest'"):
        random_scene("forrest", world_key("test", 0))
    with pytest.raises(ConfigError, match="'xyz'; known are sparse, medium, .*, canyon, open, mixed"):
        random_scene("xyz", world_key("test", 0))


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("family", ["sparse", *in_whole(*HARD)])
def test_worlds_and_missions_reuse_no_key_and_promote_no_rank(family):
    with jax.debug_key_reuse(True), jax.numpy_rank_promotion("raise"), jax.checking_leaks():
        # Not by `random_pool`, which draws in threads, where none of this holds.
        pool = families._sample_worlds(family, world_keys("training", 2))
        random_missions(pool, 4, jax.random.key(0))
        spread_missions(pool, 4, 0.5, 1.0, jax.random.key(1))
