"""Many drones in one compiled program, as a vector environment of stable-baselines3. Needs the extra `bench`.

    import stable_baselines3
    from edqn_jax.interop.stable_baselines3 import DroneVecEnv

    model = stable_baselines3.PPO("MlpPolicy", DroneVecEnv("EDQN/Random-v0", 64, observation="kinematics"))

A drone whose episode has ended is reset in the same step, so that no row of a reset becomes a transition.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.task.outcomes import Outcome

gymnasium = require_extra("gymnasium", extra="gym")
require_extra("edqn_jax.interop.gymnasium", extra="gym")  # registers the names
vec_env = require_extra("stable_baselines3.common.vec_env", extra="bench")


class DroneVecEnv(vec_env.VecEnv):
    """Drones of a Gymnasium environment of ours, stepped together.

    Its `infos` are what stable-baselines3 reads: `TimeLimit.truncated` of every drone, and of a drone whose episode
    ended `terminal_observation`, `outcome` in words and `is_success`. `VecMonitor` adds returns and lengths.

    Args:
        name: `EDQN/Paper-v0` or `EDQN/Random-v0`.
        num_envs: how many drones.
        options: of `DroneVectorEnv`, such as `observation="code"`.

    Raises:
        ConfigError: as `DroneVectorEnv`.
    """

    def __init__(self, name: str, num_envs: int = 16, **options: Any) -> None:
        same = gymnasium.vector.AutoresetMode.SAME_STEP
        self.envs = gymnasium.make_vec(name, num_envs=num_envs, autoreset_mode=same, **options)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)
        self._actions: NDArray | None = None

    def reset(self) -> Any:
        """Begins an episode of every drone; returns the first observations. Seeds and options are used once."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        names = {name for each in self._options for name in each}
        options = {name: [each.get(name) for each in self._options] for name in names}
        observed, _ = self.envs.reset(seed=seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        return observed

    def step_async(self, actions: NDArray) -> None:
        """Keeps the actions [num_envs, ...] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray, NDArray, list[dict[str, Any]]]:
        """Flies one decision of every drone, and resets those whose episodes end by it.

        Returns:
            observations, of a reset drone the first of its new episode; rewards [num_envs] float32; dones [num_envs]
            bool; infos.
        """
        observed, rewards, terminated, truncated, info = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for number in np.flatnonzero(dones):
            final = info["final_info"]
            infos[number] = {
                "TimeLimit.truncated": bool(truncated[number]),
                "terminal_observation": info["final_obs"][number],
                "outcome": Outcome(int(final["outcome"][number])).name.lower(),
                "is_success": bool(final["is_success"][number]),
            }
        return observed, rewards, dones, infos

    def close(self) -> None:
        """Closes the vector."""
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Returns what a person would see from each drone's camera, [192, 256, 3], with `render_mode="rgb_array"`."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of the vector, once for each drone; all have the same."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the vector, of all drones.

        Raises:
            ConfigError: if it is asked of some of them.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ConfigError(f"'{attr_name}' is set of all drones or of none, since one program flies them")
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Refuses: a drone has no methods of its own.

        Raises:
            ConfigError: names what has.
        """
        raise ConfigError(f"a drone has no method '{method_name}', since one program flies all; `envs` has methods")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Returns False of each drone: what wraps is `VecMonitor` and other wrappers of vectors."""
        return [False for _ in self._get_indices(indices)]
