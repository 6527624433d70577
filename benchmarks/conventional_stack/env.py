"""The Gymnasium environment of one drone."""

from __future__ import annotations

from typing import Any

import numpy as np

from conventional_stack.fleet import Course, Fleet, Record
from edqn_jax.config import Config
from edqn_jax.planners.packages import require
from edqn_jax.sim.env import OWN_SIZE
from edqn_jax.sim.moves import ACTIONS
from edqn_jax.sim.outcomes import Outcome

gymnasium = require("gymnasium")
spaces = gymnasium.spaces

_OWN_LIMIT = 1e3
"""Values of the own state are of order 1; none comes near this."""


def observation_space(config: Config) -> Any:
    """Events of the window before the decision, [H, W] signed counts, and the drone's own state, [10]."""
    return spaces.Dict(
        {
            "events": spaces.Box(-127, 127, (config.camera.height, config.camera.width), np.int8),
            "own": spaces.Box(-_OWN_LIMIT, _OWN_LIMIT, (OWN_SIZE,), np.float32),
        }
    )


class DroneEnv(gymnasium.Env):
    """One drone; a step is one decision of 0.26 s. `info["outcome"]` is the name of an `Outcome`."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, config: Config, course: Course) -> None:
        """Missions are drawn from the course.

        Raises:
            ConfigError: where the configuration asks for what this stack does not have.
        """
        self.record = Record.empty(config, 1)
        self.fleet = Fleet(config, course, self.record, seed=0)
        self.observation_space = observation_space(config)
        self.action_space = spaces.Discrete(len(ACTIONS))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """A new mission; `options={"mission": m}` says which."""
        super().reset(seed=seed)
        if seed is not None:
            self.fleet.random = self.np_random
        self.fleet.reset([options["mission"]] if options and "mission" in options else None)
        return self._seen(self.record.own), {"outcome": Outcome.RUNNING.name}

    def step(self, action: int) -> tuple[dict, float, bool, bool, dict]:
        """One decision; after the episode's end, `reset` must come first."""
        self.record.action[0] = action
        self.fleet.step(restart=False)
        outcome = Outcome(int(self.record.outcome[0]))
        truncated = outcome is Outcome.TIME_OUT
        terminated = outcome is not Outcome.RUNNING and not truncated
        reward = float(self.record.reward[0])
        return self._seen(self.record.final_own), reward, terminated, truncated, {"outcome": outcome.name}

    def _seen(self, own: np.ndarray) -> dict[str, np.ndarray]:
        return {"events": self.record.events[0].copy(), "own": own[0].copy()}
