"""MuJoCo's C functions, callable from compiled loops without going through Python.

A model or data is passed as its address, `model._address`; an array as `array.ctypes.data`.
"""

from __future__ import annotations

from pathlib import Path

import mujoco

from edqn_jax.extras import require_extra

types = require_extra("numba").types
llvm = require_extra("llvmlite.binding")  # comes with numba

# The bindings have loaded this file already; loading it again makes its symbols known to the linker.
llvm.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))

mj_step = types.ExternalFunction("mj_step", types.void(types.uintp, types.uintp))
"""`(model, data)`: one physics step."""

mj_multi_ray = types.ExternalFunction(
    "mj_multiRay",
    types.void(
        *(types.uintp,) * 4,  # model, data, origin, directions
        types.uintp,  # geomgroup, or 0
        *(types.int32,) * 2,  # whether static geoms count, body left out or -1
        *(types.uintp,) * 3,  # geom, distance and normal of each ray
        types.int32,  # number of rays
        types.float64,  # maximum distance of a hit
    ),
)
