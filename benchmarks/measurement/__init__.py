"""What the benchmarks share: the steady training step, its parts, how they are timed, and how reports are written."""
