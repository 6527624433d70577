"""Pictures of learning: return against episode (Fig. 8 of the paper), and losses and success over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogFormatter, PercentFormatter, StrMethodFormatter

from edqn_jax.learn.learner import VAE_METRICS, learner_metrics
from edqn_jax.report.style import INK, LINE, OUTCOME_COLOURS, OUTCOME_LABELS, SECOND_LINE, open_figure

KNOWN = {"epsilon": "Exploration", "q_loss": "Q loss (Eq. 9)", "mean_q": "Mean of Q"}
"""Metrics of the package's learners, in the order in which they are drawn, and their titles."""

MAX_OWN = 6
"""Other metrics of a learner that are drawn, the first ones."""


def plot_returns(episodes: Mapping[str, np.ndarray], file: Path) -> Figure:
    """Draws return against episode, a point each in its outcome's colour, with the running mean and the shares.

    Args:
        episodes: columns `return` and `outcome`, each [episodes], in the order in which they ended.
        file: PNG to write.
    """
    returns, outcomes = np.asarray(episodes["return"], np.float64), np.asarray(episodes["outcome"])
    number = np.arange(1, len(returns) + 1)
    with open_figure(7.0, 4.2, file) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.0, 1.0))
        size = float(np.clip(30_000 / max(len(returns), 1), 1.0, 12.0))
        for name, colour in OUTCOME_COLOURS.items():
            own = outcomes == name
            if own.any():
                label = f"{OUTCOME_LABELS[name]} ({own.sum():,})"
                above.scatter(number[own], returns[own], s=size, c=colour, lw=0, alpha=0.4, label=label, gid=name)
        window = max(len(returns) // 60, 1)
        if len(returns):
            mean = running_mean(returns, window)
            above.plot(number[window - 1 :], mean, color="white", lw=3.0)
            above.plot(number[window - 1 :], mean, color=INK, lw=1.3, label=f"mean of {window:,} episodes")
        above.set_ylabel("return")
        above.set_title("Return of every training episode")
        if len(returns):
            legend = above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
            for handle in legend.legend_handles:
                if isinstance(handle, PathCollection):
                    handle.set_sizes([18.0])
                    handle.set_alpha(1.0)
        _plot_shares(below, outcomes)
        below.set_xlabel("episode")
        below.xaxis.set_major_formatter(EngFormatter(sep=""))
        below.set_xlim(0, len(returns) + 1)
    return figure


def plot_learning(metrics: Sequence[Mapping[str, Any]], file: Path) -> Figure:
    """Draws success, the learner's metrics and the VAE's losses over decisions, written to `file` as PNG.

    Args:
        metrics: the lines of `metrics.jsonl`: `decisions`, and whatever a line has of `success_rate`,
            `validation_success`, `reconstruction_loss`, `kl` and `warm_up`. What else is a number is the learner's,
            and each of these has axes of its own, the first `MAX_OWN` of them.
        file: PNG to write.
    """
    own = [name for name in learner_metrics(metrics) if name not in KNOWN]
    named = {name for row in metrics for name in row if row[name] is not None}
    shown = [name for name in KNOWN if name in named] + own[:MAX_OWN]
    vae = [name for name in VAE_METRICS if name in named or "warm_up" in named]
    rows = max(2, -(-(1 + len(shown) + bool(vae)) // 2))
    with open_figure(7.0, 2.2 * rows, file) as figure:
        free = list(figure.subplots(rows, 2).flat)
        success = free.pop(0)
        _line(success, metrics, "success_rate", LINE, "training episodes")
        _line(success, metrics, "validation_success", SECOND_LINE, "validation missions, greedy", marker="o")
        for line in success.get_lines()[-1:]:
            if line.get_gid() == "validation_success":
                line.set(lw=1.8, zorder=4)
                last = np.asarray(line.get_xydata())[-1]
                said = {
                    "xytext": (0, -13 if last[1] > 0.2 else 6),
                    "textcoords": "offset points",
                    "ha": "right",
                    "weight": "bold",
                }
                success.annotate(f"{last[1]:.1%}", (last[0], last[1]), color=SECOND_LINE, zorder=5, **said)
        success.set_title("Success")
        success.set_ylim(-0.03, 1.03)
        success.yaxis.set_major_formatter(PercentFormatter(1.0))
        drawn = [success]
        for name in shown:
            drawn.append(free.pop(0))
            drawn[-1].sharex(success)
            _plot_metric(drawn[-1], metrics, name)
        if vae:
            drawn.append(free.pop(0))
            _plot_vae(drawn[-1], metrics)  # it may learn for a short while only, so its axis is its own
        for axes in drawn:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in drawn[-2:]:
            axes.set_xlabel("decisions")
        for axes in free:
            axes.set_visible(False)
        if success.get_lines():
            success.legend(loc="best")
    return figure


def _plot_metric(axes: Axes, metrics: Sequence[Mapping[str, Any]], name: str) -> None:
    """Draws a metric of the learner over decisions."""
    _line(axes, metrics, name, LINE, name)
    axes.set_title(KNOWN.get(name, name.replace("_", " ")))
    if name == "epsilon":
        axes.set_ylabel("share of random actions ε")
        axes.set_ylim(-0.03, 1.03)
    elif name == "q_loss":
        _scale_logarithmically(axes)


def _plot_vae(axes: Axes, metrics: Sequence[Mapping[str, Any]]) -> None:
    """Draws the VAE's losses over decisions, in the warm-up those of each step."""
    fine = _each_step(metrics)
    _line(axes, fine, "reconstruction_loss", LINE, "reconstruction", broken=True)
    _line(axes, fine, "kl", SECOND_LINE, "KL, before its weight", broken=True)
    axes.set_title("VAE loss (reconstruction + KL)")
    _scale_logarithmically(axes)
    if axes.get_lines():
        axes.legend(loc="best")


def _scale_logarithmically(axes: Axes) -> None:
    if any(np.any(np.asarray(line.get_ydata()) > 0) for line in axes.get_lines()):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))  # 60 and 0.01, not powers of ten
        axes.yaxis.set_minor_formatter(LogFormatter())


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Returns the means of every `window` neighbours, [len(values) - window + 1]."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return (sums[window:] - sums[:-window]) / window


def _plot_shares(axes: Axes, outcomes: np.ndarray) -> None:
    """Draws stacked shares of the outcomes in up to 120 equal stretches of the run."""
    stretches = np.array_split(outcomes, min(120, max(len(outcomes), 1)))
    edges = np.cumsum([0, *(len(stretch) for stretch in stretches)])
    lower = np.zeros(len(stretches))
    for name, colour in OUTCOME_COLOURS.items():
        share = np.array([np.mean(stretch == name) if len(stretch) else 0.0 for stretch in stretches])
        axes.stairs(lower + share, edges, baseline=lower, fill=True, color=colour, lw=0)
        lower = lower + share
    axes.set_ylim(0, 1)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylabel("outcomes")
    axes.grid(False)


def _each_step(metrics: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Returns the metrics with each chunk of the warm-up as its training steps."""
    rows: list[Mapping[str, Any]] = []
    for row in metrics:
        steps = row.get("warm_up")
        if steps is None:
            rows.append(row)
        else:
            rows += [dict(zip(steps, values, strict=True)) for values in zip(*steps.values(), strict=True)]
    return rows


def _line(
    axes: Axes,
    metrics: Sequence[Mapping[str, Any]],
    name: str,
    colour: str,
    label: str,
    marker: str = "",
    *,
    broken: bool = False,
) -> None:
    """Draws the metric over decisions, of the rows that have it; `broken` leaves gaps where rows do not."""
    points = [(row["decisions"], np.nan if row.get(name) is None else row[name]) for row in metrics]
    found = np.array(points, np.float64).reshape(-1, 2)
    has = ~np.isnan(found[:, 1])
    if not has.any():
        return
    if broken:
        found = found[: np.flatnonzero(has)[-1] + 1]
    else:
        found = found[has]
    axes.plot(*found.T, color=colour, label=label, marker=marker, ms=4, lw=1.1, gid=name)
