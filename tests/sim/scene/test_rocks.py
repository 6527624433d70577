"""The boulders: made by their script, each convex, so that C MuJoCo judges flights among them."""

from __future__ import annotations

import importlib.util

import pytest

from edqn_jax.sim.scene.mjcf import check_scene, load_world
from tests.support.pages import ROOT

FILE = ROOT / "scenes/examples/rocks.xml"


@pytest.mark.whole
def test_the_boulders_are_those_that_the_script_makes_and_are_convex() -> None:
    spec = importlib.util.spec_from_file_location("make_rocks", ROOT / "scripts/make_rocks.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.rocks() == FILE.read_text()
    world = load_world(FILE)
    check_scene(world.scene, 0.36, names=world.names, goal_radius=2.0)
    fields = world.scene.others["fields"]
    assert fields.position.shape == (9, 3) and len(fields.grids) == 4
    assert all(grid.is_convex for grid in fields.grids)
