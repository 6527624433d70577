"""Devices, how a process was started, and what processes exchange."""
