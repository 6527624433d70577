"""Train a drone to fly from events: `python train.py --help`. The same as `edqn train`."""

import sys

from edqn_jax.cli import run

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    run()
