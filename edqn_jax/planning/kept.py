"""What was found in a world by searching it, kept from one command to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.devices.kept_files import kept_array, name_of
from edqn_jax.kept_programs import digest_of_package, folder_without_user_code, versions
from edqn_jax.sim.scene.scene import Scene


def kept_of_scene(kind: str, scene: Scene, radius: float, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Returns an array [...] that follows from a world and a body; a command finds what an earlier one has made.

    Args:
        kind: what it is, in letters.
        scene: one world.
        radius: of the body, metres.
        make: returns it; its errors are not kept.
    """
    leaves, form = jax.tree.flatten(scene)
    here = jax.default_backend(), versions(), digest_of_package()
    told_apart = f"{form} {float(radius)!r} {[leaf.shape for leaf in leaves]} {here}"
    name = name_of(told_apart.encode(), *(np.asarray(leaf).tobytes() for leaf in leaves))
    return kept_array(folder_without_user_code(), f"{kind}-{name}", make)
