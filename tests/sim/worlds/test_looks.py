"""Looks of random worlds."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest

from edqn_jax.config import Config, SurfaceConfig
from edqn_jax.config.rules import validate
from edqn_jax.config.simulation import LOOKS
from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.scene import Scene, scene_shapes, stack_scenes, take_scene, with_equal_capacities
from edqn_jax.sim.scene.surface import CONTRAST, KIND, PATTERNS, PHASES, SHARES
from edqn_jax.sim.worlds.families import random_pool, world_keys, worlds_of
from edqn_jax.sim.worlds.looks import APART, BRIGHTEST, TRAINED, patterns_of, with_looks
from tests.support.marks import in_whole

OWN = [look for look in LOOKS if look != "plaid"]


@functools.cache
def plain_pool(family: str = "rooms", count: int = 64) -> Scene:
    return random_pool(family, world_keys("test", count))


@functools.cache
def pool_of(pattern: str, family: str = "rooms", count: int = 64) -> Scene:
    return with_looks(plain_pool(family, count), world_keys("test", count), SurfaceConfig(pattern=pattern))


@pytest.fixture(scope="module")
def drawn() -> Scene:
    return pool_of("drawn")


@pytest.mark.whole
def test_plaid_worlds_have_no_look_and_others_are_the_same_bodies(drawn: Scene) -> None:
    plain = plain_pool()
    assert jax.tree.structure(pool_of("plaid")) == jax.tree.structure(plain)
    for kind, shapes in plain.shapes().items():
        for field in dataclasses.fields(shapes):
            before, after = (getattr(pool.shapes()[kind], field.name) for pool in (plain, drawn))
            if field.name not in ("albedo", "surface"):
                jax.tree.map(np.testing.assert_array_equal, before, after)
    for name in ("volume", "start", "goal"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(drawn, name))


@pytest.mark.whole
@pytest.mark.parametrize("pattern", [*OWN[:3], *in_whole(*OWN[3:])])
def test_a_surface_reflects_no_more_than_it_gets_and_has_periods_within_the_limits(pattern: str) -> None:
    pool = pool_of(pattern)
    numbers, albedo = np.asarray(pool.boxes.surface.numbers), np.asarray(pool.boxes.albedo)
    present = np.abs(np.asarray(pool.boxes.position[..., 0])) < 1e5
    contrast = numbers[..., CONTRAST]
    assert (albedo * (1 + contrast[..., None]) <= BRIGHTEST + 1e-6).all()
    assert contrast.min() >= 0 and contrast.max() <= 0.8
    found = {PATTERNS[int(kind)] for kind in np.unique(numbers[..., KIND])}
    assert found == set(patterns_of(SurfaceConfig(pattern=pattern)))
    assert bool(contrast.max() > 0.7) is (pattern != "blank")
    k = np.linalg.norm(numbers[..., PHASES:].reshape(*contrast.shape, 4, 4)[..., :3], axis=-1)[present]
    if pattern in ("waves", "checks", "noise"):
        coarse = k[:, :2][k[:, :2] > 0]
        assert coarse.min() >= 0.0999 and coarse.max() < 1.01 * np.sqrt(2) / 0.2
        assert coarse.max() > 10 * coarse.min()


@pytest.mark.whole
def test_no_pattern_leaves_the_range_of_its_contrast() -> None:
    for pattern in set(OWN) - {"drawn"}:
        a, b, c, d = np.moveaxis(np.abs(np.asarray(pool_of(pattern).boxes.surface.numbers)[..., SHARES:PHASES]), -1, 0)
        most = {
            "waves": a + b + c + d,
            "noise": 1.5 * (a + b + c + d),
            "checks": a + b + c,
            "posters": a + 4 * b,
            "wood": a + d,
            "spots": a + 3 * b,
        }
        assert most.get(pattern, a).max() <= 1.2501


def test_pieces_of_a_wall_share_its_pattern_and_walls_differ_but_for_some_worlds(drawn: Scene) -> None:
    plain = plain_pool()
    apart, by_chance = [], []
    for world, surface in zip(np.asarray(plain.boxes.albedo), np.asarray(drawn.boxes.surface.numbers), strict=True):
        others = ~np.eye(len(world), dtype=bool)
        pieces = (world[:, None] == world[None]).all(-1) & others
        assert pieces.sum() > len(world)
        same = (surface[:, None, :PHASES] == surface[None, :, :PHASES]).all(-1)
        # Blank ones are all alike.
        blank = surface[:, KIND] == PATTERNS.index("blank")
        told = ~(blank[:, None] & blank[None])
        if not (pieces & told).any():
            continue
        by_chance.append(same[~pieces & others & told].mean())
        # All of a world's pieces, or none.
        apart.append(not same[pieces & told].all())
        assert same[pieces & told].mean() < 0.5 or not apart[-1]
    # One wave or stripe has no other numbers than its direction.
    assert len(apart) > 40 and abs(np.mean(apart) - APART) < 0.12 and np.mean(by_chance) < 0.1


def test_shares_of_drawn_worlds_light_and_their_keys(drawn: Scene) -> None:
    kinds = np.asarray(drawn.planes.surface.numbers[..., KIND])
    for name, share in TRAINED.items():
        assert abs((kinds == PATTERNS.index(name)).mean() - share) < 0.12
    light = drawn.daylight
    np.testing.assert_allclose(np.linalg.norm(light.sun, axis=-1), 1, rtol=1e-5)
    assert np.ptp(light.ambient) > 0.3 and np.ptp(np.asarray(light.sky)[:, 0]) > 0.3
    few = worlds_of(Config(surface=SurfaceConfig(pattern="drawn")), "rooms", "test", 64)
    jax.tree.map(np.testing.assert_array_equal, drawn, few)


@pytest.mark.whole
def test_surfaces_survive_stacking_and_padding(drawn: Scene) -> None:
    one, other = take_scene(drawn, 0), take_scene(pool_of("drawn", "dense", 2), 1)
    stacked = stack_scenes([one, other])
    for number, scene in enumerate((one, other)):
        whole = take_scene(stacked, number)
        jax.tree.map(np.testing.assert_array_equal, scene_shapes(whole), scene_shapes(scene))
        jax.tree.map(np.testing.assert_array_equal, whole.daylight, scene.daylight)
    pools = with_equal_capacities([drawn, pool_of("drawn", "dense", 2)])
    assert jax.tree.structure(pools[0]) == jax.tree.structure(pools[1])
    assert pools[0].cylinders.surface.numbers.shape[1] == pools[1].cylinders.radius.shape[1] > 0


@pytest.mark.whole
def test_shapes_that_move_have_looks() -> None:
    assert pool_of("drawn", "moving", 4).boxes.surface is not None


@pytest.mark.parametrize(
    "options, message",
    [
        ({"pattern": "brick"}, "surface.pattern: there is no 'brick'; did you mean 'bricks'?"),
        ({"pattern": "xyz"}, "surface.pattern: there is no 'xyz'; known are plaid, drawn"),
        ({"contrast": 1.2}, "surface.contrast must be between 0 and 1, not 1.2"),
        ({"shortest_m": 3.0, "longest_m": 2.0}, "surface.longest_m must be at least surface.shortest_m (3), not 2.0"),
        ({"shortest_m": 0.0}, "surface.shortest_m must be between 0.05 and 100, not 0.0"),
    ],
)
def test_options_that_no_surface_can_have_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        validate(Config(surface=SurfaceConfig(**options)))
