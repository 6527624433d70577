"""What a person sees while a drone learns: a live panel on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

SHOWN = {
    "decisions_per_second": ("decisions/s", "{:,.0f}"),
    "episodes": ("episodes", "{:,.0f}"),
    "success_rate": ("success", "{:.1%}"),
    "validation_success": ("validation", "{:.1%}"),
    "mean_return": ("return", "{:.1f}"),
    "epsilon": ("ε", "{:.2f}"),
    "q_loss": ("Q loss", "{:.3g}"),
    "reconstruction_loss": ("reconstruction", "{:.3g}"),
    "kl": ("KL", "{:.3g}"),
}
"""Metrics that are shown, in this order: name in `metrics.jsonl`, label and format."""


class Progress:
    """Live display of a run's metrics; a metric stays on show until a newer value comes."""

    def __init__(self, console: Console | None = None, every_s: float = 2.0) -> None:
        """Writes to `console`, or standard output; without a terminal, a line each `every_s` seconds."""
        self._console = console or Console()
        self._every_s = every_s
        self._live: Live | None = None
        self._metrics: dict[str, Any] = {}
        self._total = 0
        self._started = self._printed = time.monotonic()
        self._first: tuple[float, int] | None = None

    def start(self, total: int) -> None:
        """Begins to show progress towards `total` decisions."""
        self._total = total
        self._started = time.monotonic()
        self._printed = self._started - self._every_s
        if self._console.is_terminal:
            live = Live(self._panel(), console=self._console, refresh_per_second=4)
            live.start()
            self._live = live

    def update(self, metrics: Mapping[str, Any]) -> None:
        """Takes in new values: `phase`, `decisions`, and any of `SHOWN`; others are not shown."""
        changed_phase = "phase" in metrics and metrics["phase"] != self._metrics.get("phase")
        self._metrics.update({key: value for key, value in metrics.items() if value is not None})
        now = time.monotonic()
        if self._first is None and "decisions" in metrics:
            self._first = (now, int(metrics["decisions"]))
        if self._live is not None:
            self._live.update(self._panel())
        elif changed_phase or now - self._printed >= self._every_s:
            self._printed = now
            self.message(self._line())

    def message(self, text: str) -> None:
        """Prints a line that stays."""
        self._console.print(text, soft_wrap=True, markup=False, highlight=False)

    def stop(self) -> None:
        """Leaves the last state standing; harmless when nothing was started."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _decisions(self) -> int:
        return int(self._metrics.get("decisions", 0))

    def _remaining(self) -> str:
        # From the first report on: compiling came before it and does not come again.
        if self._first is None or self._decisions() <= self._first[1]:
            return "–"
        rate = (self._decisions() - self._first[1]) / max(time.monotonic() - self._first[0], 1e-9)
        return clock(max(self._total - self._decisions(), 0) / rate)

    def _values(self) -> list[tuple[str, str]]:
        return [
            (label, form.format(float(self._metrics[name])))
            for name, (label, form) in SHOWN.items()
            if name in self._metrics
        ]

    def _line(self) -> str:
        elapsed = clock(time.monotonic() - self._started)
        share = self._decisions() / self._total if self._total else 0.0
        head = f"[{elapsed}] {self._metrics.get('phase', 'training')} {self._decisions():,} ({share:.0%})"
        values = "".join(f"  {label} {value}" for label, value in self._values())
        return f"{head}{values}  left {self._remaining()}"

    def _panel(self) -> Panel:
        head = Table.grid(expand=True, padding=(0, 2))
        head.add_column()
        head.add_column(ratio=1)
        head.add_column(justify="right")
        elapsed = clock(time.monotonic() - self._started)
        head.add_row(
            Text(str(self._metrics.get("phase", "compiling")), style="bold"),
            ProgressBar(total=max(self._total, 1), completed=self._decisions()),
            f"{self._decisions():,} / {self._total:,}   {elapsed}   left {self._remaining()}",
        )
        values = Table.grid(expand=True, padding=(0, 1))
        shown = self._values()
        for _ in shown:
            values.add_column(justify="center")
        if shown:
            values.add_row(*(Text(label, style="dim") for label, _ in shown))
            values.add_row(*(value for _, value in shown))
        return Panel(Group(head, values) if shown else head, title="edqn", title_align="left")


def clock(seconds: float) -> str:
    """`m:ss`, or `h:mm:ss` from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
