"""What JAX runs on: devices, kept programs, several processes."""
