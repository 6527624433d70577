"""Where the page's own program puts obstacles that move, in headless Chromium, against the simulator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import edqn_jax.report.page
from edqn_jax.report.page.worlds import ball_data, world_data
from edqn_jax.sim.scene.scene import PARKED, scene_at, take_scene
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.moving import Moving

TIMES = [0.0, 0.7, 2.9, 4.4, 6.1, 13.3, 51.9, 203.7]


def test_obstacles_of_the_page_are_where_the_simulators_are(browser: Any) -> None:
    moving = Moving(share=0.9, balls=6, ball_gravity_m_s2=4.0)
    scene = take_scene(random_pool("medium", world_keys("test", 1), moving), 0)
    world = json.loads(json.dumps(world_data(scene)))
    world["shapes"] += json.loads(json.dumps(ball_data(scene)))
    script = (Path(edqn_jax.report.page.__file__).parent / "page.js").read_text(encoding="utf-8")
    begin = script.index("  function placeOf(")
    program = script[begin : script.index("\n  }\n", begin) + 5]
    page = browser.new_page()
    found = page.evaluate(
        f"([world, times]) => {{ {program}; return world.shapes.filter((s) => s.moves)"
        ".map((s) => times.map((t) => placeOf(s, world, t))); }",
        [world, TIMES],
    )
    page.close()
    now = jax.vmap(lambda t: scene_at(scene, t))(jnp.float32(TIMES))
    ours = np.concatenate(
        [np.asarray(getattr(now, kind).position) for kind in ("boxes", "cylinders", "spheres")], axis=1
    )
    assert len(found) > 20 and any(place is None for shape in found for place in shape)
    for shape in found:
        theirs = np.array([[PARKED] * 3 if place is None else place for place in shape])
        # The page has millimetres, and rates of six digits.
        assert np.abs(ours - theirs[:, None]).max(axis=(0, 2)).min() < 0.01
