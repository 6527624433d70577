"""Train a drone to fly from events: `python train.py --help`. The same as `edqn train`."""

import sys

from edqn_jax.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
