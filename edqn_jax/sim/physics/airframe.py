"""The airframe: mass, inertia and rotors of a quadrotor, read from MJCF.

`drone.airframe` names an entry of `AIRFRAMES`, the path of an MJCF file. Another quadrotor is such a file and an entry.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import DroneConfig
from edqn_jax.config.registry import AIRFRAMES
from edqn_jax.errors import ConfigError

SKYDIO_X2 = Path(__file__).with_name("skydio_x2.xml")
"""The entry `skydio_x2`."""


@struct.dataclass
class Airframe:
    """Constants of the airframe, of controller, rotors and `rigid_body`. R = 4 rotors.

    MJX flies mass, inertia and gravity of the MJCF file (`flight.py`), whatever these say.
    """

    mass: Array  # [] kg
    inertia: Array  # [3] kg m^2 about the body's axes
    gravity: Array  # [] m/s^2
    max_thrust: Array  # [] newtons of one rotor
    wrench: Array  # [4, R] collective thrust (N) and torque about x, y, z (N m) per rotor thrust (N)
    mixer: Array  # [R, 4] its inverse


def c_model(config: DroneConfig) -> mujoco.MjModel:
    """Returns the airframe's C MuJoCo model, without shapes that only a viewer needs.

    Raises:
        ConfigError: if there is no such airframe, or MuJoCo cannot read its file.
    """
    file = AIRFRAMES.get(config.airframe)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        return _without_shapes(spec, config.physics_dt_s).compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"the airframe '{config.airframe}' is no MJCF that MuJoCo can read: {reason}") from None


def _without_shapes(spec: mujoco.MjSpec, dt_s: float) -> mujoco.MjSpec:
    spec.option.timestep = dt_s
    # MJX solves a sparse mass matrix by unrolled arithmetic, a dense one by a LAPACK call per environment.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    for shape in list(spec.geoms):
        spec.delete(shape)
    return spec


def wrench_of_thrust(model: mujoco.MjModel) -> np.ndarray:
    """Returns the [4, R] collective thrust and torque about x, y, z (N m) per rotor thrust (N) of the rotor layout."""
    arm = model.site_pos[model.actuator_trnid[:, 0]]
    push, twist = model.actuator_gear[:, 2], model.actuator_gear[:, 5]
    return np.stack([push, arm[:, 1] * push, -arm[:, 0] * push, twist])


def mixer_of(model: mujoco.MjModel) -> np.ndarray:
    """Returns the [R, 4] rotor thrusts per collective thrust (N) and torque about x, y, z (N m) of the rotor layout."""
    return np.linalg.inv(wrench_of_thrust(model))


def load_airframe(config: DroneConfig) -> Airframe:
    """Returns the constants of the airframe, with the mixer that follows from its rotor layout.

    Raises:
        ConfigError: if there is no such airframe, or its file has something that a physics step or the controller
            would ignore.
    """
    model = c_model(config)
    _check(model, config.airframe)
    return Airframe(
        mass=jnp.float32(model.body_mass[1]),
        inertia=jnp.asarray(model.body_inertia[1], jnp.float32),
        gravity=jnp.float32(-model.opt.gravity[2]),
        max_thrust=jnp.float32(model.actuator_ctrlrange[0, 1]),
        wrench=jnp.asarray(wrench_of_thrust(model), jnp.float32),
        mixer=jnp.asarray(mixer_of(model), jnp.float32),
    )


def _check(model: mujoco.MjModel, name: str) -> None:
    free = model.nq == 7 and model.nv == 6 and not model.ngeom
    in_vacuum = not model.opt.density and not model.opt.viscosity and not model.opt.wind.any()
    centred = np.allclose(model.body_ipos[1], 0.0) and np.allclose(np.abs(model.body_iquat[1]), [1, 0, 0, 0])
    rotors = model.actuator_trnid[:, 0]
    # Otherwise `mjx.euler` computes accelerations of its own.
    undamped = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    upright = not model.actuator_gear[:, [0, 1, 3, 4]].any() and np.allclose(model.site_quat[rotors], [1, 0, 0, 0])
    if not (free and in_vacuum and centred and upright and undamped):
        raise ConfigError(
            f"the airframe '{name}' must be one free body in a vacuum, its frame at the centre of mass and along the "
            "principal axes of inertia, under rotors that push along its z, with eulerdamp disabled; no other model is "
            "supported"
        )
    if not _is_quadrotor(model):
        raise ConfigError(
            f"the airframe '{name}' must have four rotors of the same range from 0, at places and of turns that share "
            "thrust and torque about z equally; the controller knows no other"
        )


def _is_quadrotor(model: mujoco.MjModel) -> bool:
    """Returns whether the controller can share thrust and torque about z equally between four rotors."""
    ranges = model.actuator_ctrlrange
    if model.nu != 4 or not np.all(ranges == [0.0, ranges[0, 1]]) or np.linalg.matrix_rank(wrench_of_thrust(model)) < 4:
        return False
    mixer = mixer_of(model)
    return np.allclose(mixer[:, 0], mixer[0, 0]) and np.allclose(np.abs(mixer[:, 3]), np.abs(mixer[0, 3]))
