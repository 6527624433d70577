"""References for a benchmark's figures: C MuJoCo's rollout, and the highest rates of a device."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from mujoco import rollout

from edqn_jax.config import Config
from edqn_jax.devices.hardware import count_cores
from edqn_jax.learn.trainer import AXIS
from edqn_jax.sim.physics.airframe import c_model

ROLLOUT_STEPS = 130
"""Physics steps of C MuJoCo in one call for each drone: ten decisions."""
TURN_SECONDS = 0.5
"""Minimum duration of a turn of C MuJoCo."""


class Rollout:
    """C MuJoCo's threaded rollout of the same airframe on every core, with hover thrust and constraints disabled."""

    def __init__(self, config: Config) -> None:
        model = c_model(config.drone)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        threads, self.drones = count_cores(), config.train.num_envs
        data = mujoco.MjData(model)
        data.qpos[2] = 10.0
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.start = np.tile(state, (self.drones, 1))
        thrust = model.body_mass[1] * -model.opt.gravity[2] / model.nu
        self.control = np.full((self.drones, ROLLOUT_STEPS, model.nu), thrust)
        self.model, self.data = model, [mujoco.MjData(model) for _ in range(threads)]
        self.pool = rollout.Rollout(nthread=threads)

    def turn(self) -> float:
        """Returns physics steps per second."""
        began, steps = time.perf_counter(), 0
        while (passed := time.perf_counter() - began) < TURN_SECONDS:
            self.pool.rollout(self.model, self.data, self.start, self.control)
            steps += self.drones * ROLLOUT_STEPS
        return steps / passed


def ceilings(mesh: Mesh) -> dict[str, Callable[[], float]]:
    """Returns functions that measure the highest rates of one device while all devices are busy.

    Matrix products and fused arithmetic are in flop/s, copies in bytes/s.
    """
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    side, length, chains, rounds = 512, 2048, 8, 32

    def product(x: Array) -> Array:
        return jax.lax.fori_loop(0, 8, lambda _, y: jnp.clip(x @ y, -1.0, 1.0), x)

    def vector(x: Array) -> Array:
        # In cache; independent chains of multiplications and additions for every element.
        def body(_: Any, y: Array) -> Array:
            parts = [y * (0.1 * (k + 1)) for k in range(chains)]
            for _ in range(rounds):
                parts = [part * 0.999 + 0.001 for part in parts]
            return sum(parts[1:], parts[0]) * 0.1

        return jax.lax.fori_loop(0, 256, body, x)

    def timed(function: Callable[[Array], Array], shape: tuple[int, ...], work: float) -> Callable[[], float]:
        # The input is donated, because new memory pages would be timed as well.
        run = jax.jit(
            jax.shard_map(
                lambda x: function(x[0])[None], mesh=mesh, in_specs=PartitionSpec(AXIS), out_specs=PartitionSpec(AXIS)
            ),
            donate_argnums=0,
        )
        last = run(jax.device_put(jnp.full((mesh.size, *shape), 0.5), spread))

        def turn() -> float:
            nonlocal last
            jax.block_until_ready(last)
            began = time.perf_counter()
            last = jax.block_until_ready(run(last))
            return work / (time.perf_counter() - began)

        return turn

    size = 2**24
    return {
        "product_flops": timed(product, (side, side), 8 * 2.0 * side**3),
        "vector_flops": timed(vector, (length,), 256 * 2.0 * chains * (rounds + 1) * length),
        "copy_bytes": timed(lambda x: x + 1.0, (size,), 8.0 * size),
    }
