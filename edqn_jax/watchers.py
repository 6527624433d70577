"""Who looks on at a call from Python, and a line with its phase and clock for a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # rich is imported where something is shown: commands show their first line before
    from rich.console import Console

_takers: list[str] = []
"""Titles of what shows phases on standard error already, as commands do."""


def has_panel(console: Console) -> bool:
    """Returns whether a console shows a panel that is drawn anew, as notebooks and most terminals can."""
    return console.is_jupyter or (console.is_terminal and not console.is_dumb_terminal)


def is_watched(console: Console) -> bool:
    """Returns whether somebody looks on at standard error, in a notebook or at a terminal, which FORCE_COLOR is not."""
    return has_panel(console) and (console.is_jupyter or sys.stderr.isatty())


@contextlib.contextmanager
def taken(title: str) -> Iterator[None]:
    """Keeps `shown_phases` from showing a line of its own within the block: something of this title shows phases."""
    _takers.append(title)
    try:
        yield
    finally:
        _takers.remove(title)


@contextlib.contextmanager
def shown_phases(phase: Callable[..., None] | None) -> Iterator[Callable[..., None] | None]:
    """Yields what is told of phases within the block: `phase`, or where there is none a line with a clock.

    The line is on a terminal alone, unless something else shows phases there, and gone afterwards. Elsewhere None is
    yielded: a notebook would keep it.
    """
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if phase is not None or _takers or console.is_jupyter or not is_watched(console):
        yield phase
        return
    columns = TextColumn("  {task.description}"), TextColumn("{task.fields[count]}"), TimeElapsedColumn()
    # What is printed meanwhile to a file stays there.
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as shown:
        line = shown.add_task("starting", total=None, count="")

        def show(name: str, done: int = 0, total: int = 0) -> None:
            shown.update(line, description=name, count=f"{done:,} of {total:,}" if total else "")

        yield show
