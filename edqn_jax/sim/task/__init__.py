"""Missions, outcome, reward and observation: the environment as pure functions."""
