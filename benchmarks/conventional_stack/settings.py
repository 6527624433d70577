"""How the conventional stack is run and timed."""

from __future__ import annotations

DRONES = 512
"""Drones simulated together by default: with fewer, the cost of PyTorch and Python for each step weighs more."""

PACKAGES = ("gymnasium", "numba", "stable-baselines3", "torch")
"""Packages of the extra `bench` whose versions the figures depend on."""

SETTINGS = ((1, 1), (2, 1), (2, 2))
"""Settings that are timed: number of simulating processes, number of PyTorch threads."""
