"""Balls that are thrown at a drone: launch times, and aim at its extrapolated position.

How a ball flies once it is aimed is in `motion.py`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.config import Config
from edqn_jax.sim.scene.motion import TIME_TOLERANCE_S, Aim, aim_at, launch_times, no_aim
from edqn_jax.sim.scene.scene import Scene


def initial_aim(pool: Scene) -> Aim | None:
    """Returns the aim of one flight's balls before any is thrown; None where no world of the pool has any."""
    throw = pool.spheres.throw
    return None if throw is None else no_aim(jax.tree.map(lambda leaf: leaf[0], throw))


def update_aim(config: Config, scene: Scene, aim: Aim | None, decision: Array, here: Array, moved: Array) -> Aim | None:
    """Returns the aim after adding the balls that are thrown at the beginning of decision [] int32.

    A ball is thrown at the beginning of the decision in which it is due.

    Args:
        config: of the flight.
        scene: one world; its start and goal are those of the flight.
        aim: of the balls thrown before; None where no world has any.
        decision: [] int32, the number of those before it.
        here: [3] metres, where the drone is.
        moved: [3] metres, how far it has come within the decision before.
    """
    throw = scene.spheres.throw
    if throw is None or aim is None:
        return None
    steps, dt_s = config.drone.physics_steps, config.drone.physics_dt_s
    begins = jnp.floor((launch_times(throw, scene.start, scene.goal) + TIME_TOLERANCE_S) / (steps * dt_s)).astype(
        jnp.int32
    )
    now = begins == decision
    new = aim_at(throw, scene.goal, scene.volume, (decision * steps) * dt_s, here, moved, steps * dt_s)
    return jax.tree.map(lambda a, b: jnp.where(now if a.ndim == 1 else now[:, None], a, b), new, aim)


@partial(jax.jit, static_argnums=0)
def aim_along(config: Config, scene: Scene, places: ArrayLike) -> Aim:
    """Returns the aim of the balls of one world in a whole flight.

    Args:
        config: of the flight.
        scene: with balls; its start and goal are those of the flight.
        places: [D + 1, 3] metres, where the drone was at its start and after each decision; NaN after its end.
    """
    throw, here = scene.spheres.throw, jnp.asarray(places)
    assert throw is not None
    moved = jnp.diff(here, axis=0, prepend=here[:1])

    def decide(aim: Aim, step: tuple[Array, Array, Array]) -> tuple[Aim, None]:
        decision, place, way = step
        flies, new = jnp.all(jnp.isfinite(place)), update_aim(config, scene, aim, decision, place, way)
        return jax.tree.map(lambda a, b: jnp.where(flies, a, b), new, aim), None

    return lax.scan(decide, no_aim(throw), (jnp.arange(len(here)), here, moved))[0]
