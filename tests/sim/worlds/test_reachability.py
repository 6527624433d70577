"""The quick check for a way: as its plain version says, and never a way that A* does not find."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import jax
import numpy as np
import pytest

from edqn_jax.planning.astar import shortest_path
from edqn_jax.planning.lattice import NoPathError
from edqn_jax.sim.scene.scene import Planes, Scene, Spheres, UprightBoxes, UprightCylinders, build_scene
from edqn_jax.sim.worlds import reachability
from tests.oracles import ways_plain

RADIUS, EDGE = 0.36, 0.5
SIZE = (9.0, 9.0, 5.0)
GREY = np.full(3, 0.5)

quick = jax.jit(lambda scene: reachability.has_way(scene, SIZE, RADIUS, EDGE))


def world(seed: int) -> Scene:
    """A wall with a gap of any width, and a box, pillar and ball in the way, under a ceiling; start and goal beside."""
    rng = np.random.default_rng(seed)
    height, gap, left = rng.uniform(4.0, 5.0), rng.uniform(0.8, 4.0), rng.uniform(1.0, 4.5)
    shapes = [
        Planes(position=np.zeros(3), normal=[0, 0, 1], albedo=GREY),
        Planes(position=[0, 0, height], normal=[0, 0, -1], albedo=GREY),
        UprightBoxes(position=[4.5, left / 2, 2.5], half=[0.2, left / 2, 2.5], yaw=0.0, albedo=GREY),
        UprightBoxes(
            position=[4.5, (left + gap + 9) / 2, 2.5], half=[0.2, (9 - left - gap) / 2, 2.5], yaw=0.0, albedo=GREY
        ),
        UprightBoxes(position=[6, rng.uniform(3, 6), 1], half=[0.3, 1.5, 1], yaw=rng.uniform(0, 3), albedo=GREY),
        UprightCylinders(position=[3.3, rng.uniform(3, 6), 2], radius=0.5, half_height=2.0, albedo=GREY),
        Spheres(position=[5.5, rng.uniform(3, 6), 3], radius=0.6, albedo=GREY),
    ]
    return build_scene(shapes, volume=[(0, 0, 0), (9, 9, height)], start=[1.5, 4.5, 2], goal=[7.8, 4.5, 2.3])


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 14), marks=pytest.mark.whole)])
def test_it_says_what_the_plain_one_says_and_finds_no_way_that_astar_does_not(seeds):
    found = []
    for seed in seeds:
        scene = world(seed)
        found.append(bool(quick(scene)))
        assert found[-1] == ways_plain.has_way(scene, SIZE, RADIUS, EDGE), seed
        if found[-1]:
            shortest_path(scene, scene.start, scene.goal, RADIUS)
        else:
            # It may miss narrow ways; what it misses here is at most as wide as its own doubt.
            wider = RADIUS + EDGE / 2 + EDGE
            with pytest.raises(NoPathError):
                shortest_path(scene, scene.start, scene.goal, wider)
    assert 0 < sum(found) < len(seeds), found


def test_a_world_higher_than_a_word_is_refused():
    with pytest.raises(ValueError, match="50 nodes above each other; there may be 32"):
        reachability.has_way(world(0), (9.0, 9.0, 25.0), RADIUS, EDGE)
