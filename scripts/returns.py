"""Draws the returns of training episodes of several runs in one figure, as Fig. 8 of the paper does for one.

    python scripts/returns.py docs/images/fig8.png "sparse reward" runs/sparse-* -- "metres gained" runs/progress-*

Each group is a title and the folders of its runs; `--` begins the next one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write
from edqn_jax.report.curves import running_mean
from edqn_jax.report.style import open_figure
from edqn_jax.runs.directory import RunDirectory

WINDOW = 200
"""Episodes of the running mean."""


def grouped(words: Sequence[str]) -> dict[str, list[Path]]:
    """Returns the folders of each group by its title.

    Raises:
        ConfigError: if there is no group, one has no runs, or two have one title.
    """
    if not words:
        raise ConfigError("there must be a title and the folders of runs")
    groups: dict[str, list[Path]] = {}
    rest = list(words)
    while rest:
        end = rest.index("--") if "--" in rest else len(rest)
        title, *folders = rest[:end] or [""]
        if not folders or title in groups:
            raise ConfigError(f"each group must be a title of its own and the folders of its runs, not '{title}' alone")
        groups[title], rest = [Path(folder) for folder in folders], rest[end + 1 :]
    return groups


def draw_runs(groups: Mapping[str, Sequence[np.ndarray]], window: int, file: Path) -> Figure:
    """Draws the running mean of the returns of several runs, a line for each run and a panel for each group.

    Args:
        groups: by their titles the returns [episodes] of each run, in the order in which the episodes ended.
        window: episodes of the mean.
        file: PNG to write.
    """
    columns = min(len(groups), 2)
    with open_figure(7.0, 2.0 * -(-len(groups) // 2) + 0.3, file) as figure:
        panels = figure.subplots(-(-len(groups) // columns), columns, sharex=True, squeeze=False).ravel()
        for axes, (title, runs) in zip(panels, groups.items(), strict=False):
            for number, returns in enumerate(runs):
                if not len(returns):
                    continue
                window_here = min(window, len(returns))
                mean = running_mean(np.asarray(returns, np.float64), window_here)
                axes.plot(np.arange(len(mean)) + window_here, mean, lw=0.9, alpha=0.85, color=f"C{number}")
            axes.set_title(title)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in panels[len(groups) :]:
            axes.set_visible(False)
        for axes in panels[max(len(groups) - columns, 0) : len(groups)]:
            axes.set_xlabel("episode")
            axes.tick_params(labelbottom=True)
        for axes in panels[::columns]:
            axes.set_ylabel(f"return, mean of {window:,}")
    return figure


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="PNG to write")
    parser.add_argument("groups", nargs=argparse.REMAINDER, help="title, runs, --, title, runs, ...")
    args = parser.parse_args(argv)
    try:
        check_can_write(args.file)
        returns = {
            title: [RunDirectory(folder).read_episodes()["return"] for folder in folders]
            for title, folders in grouped(args.groups).items()
        }
    except (ConfigError, OSError) as error:
        parser.error(str(error))
    draw_runs(returns, WINDOW, args.file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
