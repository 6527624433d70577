"""What a configuration describes as a task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.sim.physics import flight
from edqn_jax.sim.task.task import shaped_task, task_of
from tests.support.miniature import WORLD, miniature_world

GROUPS: dict[str, dict[str, Any]] = {
    "default": {},
    "frames of real exposures": {
        "env": {"sensor": "frames"},
        "exposure": {"real": True},
        "light": {"least_lux": 1.0, "most_lux": 9.0},
    },
    "continuous actions in gusts": {"env": {"actions": "velocity"}, "air": {"gusts_m_s": 2.0}},
    "a camera on the body, motors that lag": {"camera": {"mount": "body"}, "motors": {"lag_s": 0.05}},
}


@pytest.mark.parametrize("groups", GROUPS.values(), ids=GROUPS)
def test_what_is_traced_for_shapes_has_those_of_the_task(
    monkeypatch: pytest.MonkeyPatch, groups: dict[str, Any]
) -> None:
    config: Config = make_config(str(WORLD), **groups)
    assert config.drone.physics == "mjx"
    world, key = miniature_world(config), jax.random.key(0)
    own, quick = task_of(config), shaped_task(config)

    def refused(*_: Any) -> Any:
        raise AssertionError("MJX is slow to trace")

    state = jax.eval_shape(lambda: own.begin(world, key, jnp.int32(0)))
    with monkeypatch.context() as patched:  # before the other, whose trace JAX would find again
        patched.setattr(flight, "_mjx_step", refused)
        shaped = jax.eval_shape(quick.step, world, state, jnp.asarray(own.still))
    found = [jax.eval_shape(own.step, world, state, jnp.asarray(own.still)), shaped]
    assert jax.tree.structure(found[0]) == jax.tree.structure(found[1])
    one, other = ([(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(each)] for each in found)
    assert one == other
