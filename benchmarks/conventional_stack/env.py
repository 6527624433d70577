"""The Gymnasium environment of one drone."""

from __future__ import annotations

from typing import Any

import numpy as np

from conventional_stack.fleet import Course, Fleet, Record
from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE
from edqn_jax.sim.task.outcomes import Outcome

gymnasium = require_extra("gymnasium")
spaces = gymnasium.spaces

_LIMIT = 1e3
"""Bound of own state and own motion, whose values are of order 1."""


def observation_space(config: Config) -> Any:
    """Returns the space of event counts [H, W] of the window before a decision, own state [10] and own motion [7]."""
    return spaces.Dict(
        {
            "events": spaces.Box(-127, 127, (config.camera.height, config.camera.width), np.int8),
            "own": spaces.Box(-_LIMIT, _LIMIT, (OWN_SIZE,), np.float32),
            "motion": spaces.Box(-_LIMIT, _LIMIT, (MOTION_SIZE,), np.float32),
        }
    )


class DroneEnv(gymnasium.Env):
    """One drone. A step is one decision; `info["outcome"]` is the name of an `Outcome`."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, config: Config, course: Course) -> None:
        """Creates the environment; missions are drawn from the course.

        Raises:
            ConfigError: if this stack does not support the configuration.
        """
        self.record = Record.empty(config, 1)
        self.fleet = Fleet(config, course, self.record, seed=0)
        self.observation_space = observation_space(config)
        self.action_space = spaces.Discrete(len(ACTIONS))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Starts a new mission, that of `options={"mission": m}` if given."""
        super().reset(seed=seed)
        if seed is not None:
            self.fleet.random = self.np_random
        self.fleet.reset([options["mission"]] if options and "mission" in options else None)
        return self._observation(self.record.own), {"outcome": Outcome.RUNNING.name}

    def step(self, action: int) -> tuple[dict, float, bool, bool, dict]:
        """Simulates one decision. After the end of an episode `reset` must be called first."""
        self.record.action[0] = action
        self.fleet.step(restart=False)
        outcome = Outcome(int(self.record.outcome[0]))
        truncated = outcome is Outcome.TIME_OUT
        terminated = outcome is not Outcome.RUNNING and not truncated
        reward = float(self.record.reward[0])
        return self._observation(self.record.final_own), reward, terminated, truncated, {"outcome": outcome.name}

    def _observation(self, own: np.ndarray) -> dict[str, np.ndarray]:
        record = self.record
        return {"events": record.events[0].copy(), "own": own[0].copy(), "motion": record.motion[0].copy()}
