"""Missions flown greedily, measured, and judged again by C MuJoCo."""
