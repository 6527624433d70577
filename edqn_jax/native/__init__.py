"""Functions in C that XLA calls on CPUs or GPUs."""
