"""The drone in C MuJoCo: the airframe's MJCF as it stands in the file, stepped by `mj_step`."""

from __future__ import annotations

import mujoco
import numpy as np

from edqn_jax.sim.drone import AIRFRAME_FILE


def load() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(AIRFRAME_FILE))
    return model, mujoco.MjData(model)


def fly_thrusts(qpos: np.ndarray, qvel: np.ndarray, thrusts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """qpos [n, 7] and qvel [n, 6] after each step of thrusts [n, 4] newtons, from qpos [7] and qvel [6]."""
    model, data = load()
    data.qpos[:], data.qvel[:] = qpos, qvel
    places, speeds = [], []
    for thrust in thrusts:
        data.ctrl[:] = thrust
        mujoco.mj_step(model, data)
        places.append(data.qpos.copy())
        speeds.append(data.qvel.copy())
    return np.array(places), np.array(speeds)


def acceleration(qpos: np.ndarray, qvel: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """[6]: linear acceleration (world, m/s^2) and angular (body, rad/s^2) under rotor thrusts [4] newtons."""
    model, data = load()
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, thrust
    mujoco.mj_forward(model, data)
    return data.qacc.copy()
