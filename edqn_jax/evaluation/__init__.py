"""Missions, greedy rollouts, metrics, decision latency, and verdicts by C MuJoCo."""
