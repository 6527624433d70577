"""Worlds as arrays: shapes, how they move, distances to them, and MJCF."""
