"""Devices, JAX's settings, the compilation cache, several processes."""
