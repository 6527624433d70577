"""The task as Gymnasium environments, one drone or many in one compiled program. Needs the extra `gym`.

    import gymnasium
    import edqn_jax.interop.gymnasium

    env = gymnasium.make("EDQN/Paper-v0")
    envs = gymnasium.make_vec("EDQN/Random-v0", num_envs=64, world="rooms")

Both take the same moves, fly the same physics and pay the same rewards as `edqn_jax.make`. Importing this module
registers the two names; JAX is configured by whoever imports it (`edqn_jax.use_cpu_devices`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Unpack

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import Config
from edqn_jax.devices.forks import check_not_forked, lacks_threads
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.drone_programs import (
    Drone,
    reset_many,
    reset_one,
    reset_some,
    step_many,
    step_one,
)
from edqn_jax.interop.gym_task import TaskOptions, make_task, on_host
from edqn_jax.sim.task.outcomes import Outcome

gymnasium = require_extra("gymnasium", extra="gym")

SEEDS = 2**32
"""Seeds that differ; larger ones begin again at 0."""

RESET_TOGETHER = 16
"""Drones that one call of the program resets in the step in which they ended; more of them take several calls."""


class DroneEnv(gymnasium.Env):
    """One drone that flies to a goal. An episode ends by the task's own time-out, without a wrapper.

    Args:
        world: `paper`, the name of random worlds or an MJCF file; None takes that of `config` or `policy`.
        config: of drone, camera, sensor and task; without it the default for that world.
        render_mode: `rgb_array` or None.
        options: see `TaskOptions`.

    Raises:
        ConfigError: if the arguments do not fit each other, or the world cannot be flown.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}
    spaces_before: ClassVar[tuple[Any, Any] | None] = None
    """Spaces of observations and moves of the environment that was made last."""

    @as_tested
    def __init__(
        self,
        world: str | Path | None = None,
        config: Config | None = None,
        *,
        render_mode: str | None = None,
        **options: Unpack[TaskOptions],
    ) -> None:
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self.drone: Drone | None = None
        if lacks_threads() and DroneEnv.spaces_before is not None:
            # AsyncVectorEnv hands on what reset raises in a process, and not what making raises there.
            self.observation_space, self.action_space = DroneEnv.spaces_before
            return
        self.task = make_task(world, config, **options)
        self.observation_space = self.task.observations
        self.action_space = self.task.actions
        DroneEnv.spaces_before = self.observation_space, self.action_space

    @as_tested
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode: at rest at the start of a mission, facing its goal.

        Args:
            seed: of the drawn mission and the sensor's noise; None goes on from the one before.
            options: `{"mission": number}` flies that mission.

        Returns:
            the first observation, and an empty info.

        Raises:
            ConfigError: if there is no such option or mission, or the process was forked after JAX had been used.
        """
        check_not_forked()
        mission = self.task.mission(options, None)
        super().reset(seed=seed)
        number = self.np_random.integers(SEEDS) if seed is None else seed % SEEDS
        self.drone, observed = reset_one(*self.task.program, np.uint32(number), mission)
        return on_host(observed), {}

    @as_tested
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies one decision of 0.26 s.

        Args:
            action: number of a move, 0..26; with another `env.actions` numbers [A], clipped to [-1, 1].

        Returns:
            observation; reward; terminated: goal, collision, volume left or diverged; truncated: out of time; info
            with `outcome`, in words, and `is_success`.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, and after an episode has ended.
            gymnasium.error.InvalidAction: if there is no such action.
        """
        check_not_forked()
        if self.drone is None or self.drone.state.ended:
            raise gymnasium.error.ResetNeeded("there is no episode to step in; call reset first")
        self.drone, decided = step_one(*self.task.program, self.drone, self.task.action(action, None))
        decided = on_host(decided)
        outcome = Outcome(int(decided.outcome))
        info = {"outcome": outcome.name.lower(), "is_success": outcome is Outcome.GOAL}
        return decided.observed, float(decided.reward), bool(decided.terminated), bool(decided.truncated), info

    @as_tested
    def render(self) -> NDArray[np.uint8] | None:
        """Returns what a person would see from the drone's camera, [192, 256, 3]; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            return None
        if self.drone is None:
            raise gymnasium.error.ResetNeeded("there is nothing to see yet; call reset first")
        return self.task.picture(self.drone.state)


class DroneVectorEnv(gymnasium.vector.VectorEnv):
    """Many drones, all of whose decisions are one compiled program.

    A drone whose episode has ended spends its next step on being reset, as Gymnasium's `AutoresetMode.NEXT_STEP` has
    it: the action is ignored, the reward is 0, and the observation is the first one of a new episode. With `SAME_STEP`
    it is reset in the same step: the observation is that first one, and `info` holds what the episode ended with. Both
    fly the same episodes.

    Args:
        num_envs: how many drones.
        autoreset_mode: `NEXT_STEP` or `SAME_STEP`, or their values as words.
        max_episode_steps: decisions after which an episode is truncated, as `gymnasium.make` has it: its outcome stays
            `RUNNING`, and the task's own time-out stays; None or -1 is no such limit.
        disable_env_checker: for `gymnasium.make`, which has it; a vector is not checked at every step in any case.
        others: as in `DroneEnv`.

    Raises:
        ConfigError: as `DroneEnv`.
    """

    metadata = {**DroneEnv.metadata, "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}

    @as_tested
    def __init__(
        self,
        num_envs: int = 1,
        world: str | Path | None = None,
        config: Config | None = None,
        *,
        render_mode: str | None = None,
        autoreset_mode: Any = gymnasium.vector.AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        disable_env_checker: bool | None = None,
        **options: Unpack[TaskOptions],
    ) -> None:
        if num_envs < 1:
            raise ConfigError(f"num_envs must be at least 1, not {num_envs}")
        _check_render_mode(render_mode)
        limit = _limit(max_episode_steps)
        self.metadata = {**self.metadata, "autoreset_mode": _autoreset_mode(autoreset_mode)}
        self.task = make_task(world, config, limit, **options)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = self.task.observations
        self.single_action_space = self.task.actions
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self.drones: Drone | None = None

    @as_tested
    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode of every drone.

        Args:
            seed: of drone i it is `seed + i`, or `seed[i]`; with the same one a `DroneEnv` begins alike.
            options: `{"mission": number}`, or one for each drone.

        Returns:
            the first observations, and an empty info.

        Raises:
            ConfigError: if there is no such option or mission, or not one seed for each drone, or the process was
                forked after JAX had been used.
        """
        check_not_forked()
        missions, each = self.task.mission(options, self.num_envs), self._each(seed)
        if each is not None:
            super().reset(seed=each[0])
        numbers = self.np_random.integers(SEEDS, size=self.num_envs) if each is None else [one % SEEDS for one in each]
        self.drones, observed = reset_many(*self.task.program, np.asarray(numbers, np.uint32), missions)
        return on_host(observed), {}

    def _each(self, seed: int | Sequence[int] | None) -> list[int] | None:
        """Returns the seed of each drone; None where they go on from the ones before.

        Raises:
            ConfigError: if there is not one for each drone, or one is negative.
        """
        if seed is None:
            return None
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + number for number in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigError(f"there must be one seed, or {self.num_envs}, not {len(seed)}")
        if not all(isinstance(one, int | np.integer) and one >= 0 for one in seed):
            raise ConfigError(f"seeds must be whole numbers of at least 0, not {list(seed)}")
        return [int(one) for one in seed]

    @as_tested
    def step(self, actions: NDArray) -> tuple[Any, NDArray, NDArray, NDArray, dict[str, Any]]:
        """Flies one decision of every drone, or resets it.

        Args:
            actions: [num_envs] numbers of moves, 0..26; with another `env.actions` [num_envs, A], clipped to [-1, 1].

        Returns:
            observations; rewards [num_envs] float32; terminated and truncated [num_envs] bool; info with
            `outcome` (numbers of `edqn_jax.Outcome`) and `is_success` of the drones whose episodes ended, which
            `_outcome` and `_is_success` mark. With `SAME_STEP` these are in `final_info`, and `final_obs` has the last
            observation of each episode that ended, None of the others, as Gymnasium's own vectors have them.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            gymnasium.error.InvalidAction: if there is no such action.
        """
        check_not_forked()
        if self.drones is None:
            raise gymnasium.error.ResetNeeded("there are no episodes to step in; call reset first")
        chosen = self.task.action(actions, self.num_envs)
        self.drones, decided = step_many(*self.task.program, self.drones, chosen)
        decided = on_host(decided)
        ended = decided.terminated | decided.truncated
        info: dict[str, Any] = {}
        if ended.any():
            success = decided.outcome == Outcome.GOAL
            info = {"outcome": decided.outcome, "_outcome": ended, "is_success": success, "_is_success": ended}
            if self.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP:
                info = {"final_info": info, "_final_info": ended.copy(), "_final_obs": ended.copy()}
                info["final_obs"] = self._reset_ended(np.flatnonzero(ended), decided.observed)
        return decided.observed, decided.reward, decided.terminated, decided.truncated, info

    def _reset_ended(self, ended: NDArray[np.integer], observed: Any) -> NDArray[np.object_]:
        """Resets the drones of these numbers, in whose rows of `observed` the first observations then stand.

        Returns:
            the observations that stood there, [num_envs], None of the other drones.
        """
        final = np.full(self.num_envs, None, object)
        for number in ended:
            final[number] = jax.tree.map(lambda x, i=number: x[i].copy(), observed)  # type: ignore[misc]
        slots = min(RESET_TOGETHER, self.num_envs)
        for first in range(0, len(ended), slots):
            some = ended[first : first + slots]
            numbers = np.full(slots, self.num_envs, np.int32)  # which is no drone's
            numbers[: len(some)] = some
            self.drones, fresh = reset_some(*self.task.program, self.drones, numbers)
            for rows, new in zip(jax.tree.leaves(observed), jax.tree.leaves(fresh), strict=True):
                rows[some] = np.asarray(new)[: len(some)]
        return final

    @as_tested
    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns what a person would see from each drone's camera, [192, 256, 3]; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            return None
        if self.drones is None:
            raise gymnasium.error.ResetNeeded("there is nothing to see yet; call reset first")
        states = self.drones.state
        return tuple(
            self.task.picture(jax.tree.map(lambda x, i=i: x[i], states))  # type: ignore[misc]
            for i in range(self.num_envs)
        )


def _check_render_mode(mode: str | None) -> None:
    if mode not in (None, "rgb_array"):
        raise ConfigError(f"render_mode must be 'rgb_array' or None, not '{mode}'")


def _limit(steps: int | None) -> int | None:
    """Returns a limit of decisions as `gymnasium.make` takes it, where -1 is none."""
    if steps is None or steps == -1:
        return None
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ConfigError(f"max_episode_steps must be a whole number of at least 1, or -1 for no limit, not {steps!r}")
    return int(steps)


def _autoreset_mode(mode: Any) -> Any:
    modes = gymnasium.vector.AutoresetMode
    offered = {kind.value: kind for kind in (modes.NEXT_STEP, modes.SAME_STEP)}
    found = offered.get(getattr(mode, "value", mode))
    if found is None:
        raise ConfigError(f"autoreset_mode must be one of {', '.join(offered)}, not '{getattr(mode, 'value', mode)}'")
    return found


for _name, _which in (("Paper", "paper"), ("Random", "medium")):
    gymnasium.register(
        f"EDQN/{_name}-v0",
        entry_point=f"{__name__}:DroneEnv",
        vector_entry_point=f"{__name__}:DroneVectorEnv",
        kwargs={"world": _which},
    )
