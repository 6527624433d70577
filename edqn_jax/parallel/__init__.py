"""Devices, the launch of one of several processes, and collectives."""
