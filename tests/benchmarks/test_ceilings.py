"""C MuJoCo's own rollout, which training is held against."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from edqn_jax.devices.hardware import count_cores
from measurement import ceilings
from measurement.flags import parse_config


def test_c_mujoco_flies_the_same_airframe_on_every_core_and_every_step_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = parse_config(["--num-envs", "16"])
    measured = ceilings.Rollout(config)
    assert measured.model.opt.timestep == config.drone.physics_dt_s
    assert measured.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    assert len(measured.data) == count_cores()
    states, _ = measured.pool.rollout(measured.model, measured.data, measured.start, measured.control)
    assert states.shape[:2] == (16, ceilings.ROLLOUT_STEPS)
    # time, then place and attitude: it hovers, and each step is really taken.
    np.testing.assert_allclose(states[:, -1, 0], ceilings.ROLLOUT_STEPS * config.drone.physics_dt_s)
    np.testing.assert_allclose(states[:, -1, 1:5], np.tile([0.0, 0.0, 10.0, 1.0], (16, 1)), atol=1e-3)

    ticks = iter([0.0, 0.1, 0.2, 0.4, 0.8])  # the beginning, and before each of three calls and after the last
    monkeypatch.setattr(ceilings.time, "perf_counter", lambda: next(ticks))
    assert measured.turn() == pytest.approx(3 * 16 * ceilings.ROLLOUT_STEPS / 0.8)
