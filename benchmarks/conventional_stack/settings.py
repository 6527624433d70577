"""How the conventional stack is run and timed."""

from __future__ import annotations

import dataclasses

from edqn_jax.config import AgentConfig, Config

DRONES = 512
"""Drones simulated together by default: with fewer, the cost of PyTorch and Python for each step weighs more."""

PACKAGES = ("gymnasium", "numba", "stable-baselines3", "torch")
"""Packages of the extra `bench` whose versions the figures depend on."""

SETTINGS = ((1, 1), (2, 1), (2, 2))
"""Settings that are timed: number of simulating processes, number of PyTorch threads."""

AGENT = {"history": 1, "huber_delta": 1.0, "learning_rate": 2e-3, "target_rate": 0.01}
"""Options of the agent: stable-baselines3's DQN has a Huber loss and sees one observation, and learns with these rates
as E-DQN did while it was such an agent."""


def supported_config(config: Config) -> Config:
    """Returns the configuration with `AGENT` in place of what is E-DQN's default; what was set otherwise stays.

    Products are in float32 on every processor, as the other stack's are.
    """
    default = AgentConfig()
    changes = {name: value for name, value in AGENT.items() if getattr(config.agent, name) == getattr(default, name)}
    train = dataclasses.replace(config.train, products="float32")
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, **changes), train=train)
