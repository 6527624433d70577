"""`python -m edqn_jax`: the same as `edqn`."""

from edqn_jax.cli import run

if __name__ == "__main__":
    run()
