"""Pictures and depth of a world from a pose, in JAX and in C."""
