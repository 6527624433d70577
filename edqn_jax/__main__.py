"""`python -m edqn_jax`: the same as `edqn`."""

import sys

from edqn_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
