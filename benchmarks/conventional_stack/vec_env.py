"""All drones as one vectorised environment of stable-baselines3, which observes codes and own states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conventional_stack.vae import Learner
from conventional_stack.workers import SpreadFleet
from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.observation import OWN_SIZE
from edqn_jax.sim.task.outcomes import Outcome

spaces = require_extra("gymnasium").spaces
vec_env = require_extra("stable_baselines3.common.vec_env")


def make_observations(config: Config, code: NDArray[np.float32], own: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns observations [N, code_size + 10] of codes [N, code_size] and own states [N, 10]."""
    return np.concatenate([config.agent.code_scale * code, own], axis=1, dtype=np.float32)


class CodedDrones(vec_env.VecEnv):
    """A step trains the VAE on the new event fields and encodes them, in one batch for all drones.

    Drones whose episode ended are reset within the step, as stable-baselines3 requires;
    `infos[i]["terminal_observation"]` is the last observation of the episode.
    """

    render_mode = None

    def __init__(self, config: Config, fleet: SpreadFleet, learner: Learner) -> None:
        """Takes ownership of the fleet; `close` ends it."""
        self.config, self.fleet, self.learner = config, fleet, learner
        self.stopwatch = fleet.stopwatch
        self.updates = 1
        size = config.encoder.code_size + OWN_SIZE
        super().__init__(
            num_envs=len(fleet.record.action),
            observation_space=spaces.Box(-np.inf, np.inf, (size,), np.float32),
            action_space=spaces.Discrete(len(ACTIONS)),
        )

    def reset(self) -> np.ndarray:
        """Starts new missions and returns the observations [N, code_size + 10]."""
        self.fleet.reset()
        record, vae = self.fleet.record, self.learner.acting
        return make_observations(self.config, vae.code(vae.patches(record.events), record.motion), record.own)

    def step_async(self, actions: np.ndarray) -> None:
        """Sets the actions [N] of the next step."""
        self.fleet.record.action[:] = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Returns observations [N, code_size + 10], rewards [N] as scaled for learning, ends [N], infos."""
        self.fleet.step()
        record, vae = self.fleet.record, self.learner.acting
        with self.stopwatch.time("encoder"):
            patches = vae.patches(record.events)
            codes = vae.code(patches, record.motion)
        if self.updates:
            with self.stopwatch.time("vae_update"):
                wanted = vae.target(record.events, record.nearness)
                for _ in range(self.updates):
                    self.learner.update(patches, record.motion, wanted)
        observations = make_observations(self.config, codes, record.own)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(record.outcome)
        if len(ended):
            final = make_observations(self.config, codes[ended], record.final_own[ended])
            # There are no events and no motion at the start of a mission.
            nothing = vae.code(vae.patches(np.zeros_like(record.events[:1])), np.zeros_like(record.motion[:1]))
            observations[ended] = make_observations(self.config, nothing.repeat(len(ended), axis=0), record.own[ended])
            for i, last in zip(ended, final, strict=True):
                timed_out = bool(record.outcome[i] == Outcome.TIME_OUT)
                infos[i] = {"terminal_observation": last, "TimeLimit.truncated": timed_out}
        return observations, self.config.agent.reward_scale * record.reward, record.outcome != Outcome.RUNNING, infos

    def close(self) -> None:
        """Ends the fleet's processes."""
        self.fleet.close()

    # The rest of the interface is for environments that are separate objects, which the drones are not.

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the attribute, which is the same for every drone."""
        return [getattr(self, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the attribute for all drones."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Raises AttributeError, because a drone has no methods.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"a drone has no method '{method_name}'")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Returns False for every drone."""
        return [False] * len(self._chosen(indices))

    def _chosen(self, indices: Any) -> Sequence[int]:
        return range(self.num_envs) if indices is None else np.atleast_1d(indices).tolist()
