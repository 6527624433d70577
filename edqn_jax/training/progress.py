"""Progress of a run: a live panel on a terminal and in a notebook, a line every few seconds elsewhere."""

from __future__ import annotations

import contextlib
import io
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from edqn_jax.evaluation.metrics import format_duration
from edqn_jax.evaluation.rollouts import ShowPhase, show_nothing
from edqn_jax.learn.learner import learner_metrics
from edqn_jax.watchers import has_panel, is_watched

SHOWN = {
    "decisions_per_second": ("decisions/s", "{:,.0f}"),
    "episodes": ("episodes", "{:,.0f}"),
    "success_rate": ("success", "{:.1%}"),
    "validation_success": ("validation", "{:.1%}"),
    "mean_return": ("return", "{:.1f}"),
    "epsilon": ("ε", "{:.2f}"),
    "q_loss": ("Q loss", "{:.3g}"),
    "mean_q": ("mean Q", "{:.3g}"),
    "reconstruction_loss": ("reconstruction", "{:.3g}"),
    "kl": ("KL", "{:.3g}"),
}
"""Metrics that are shown, in this order: name in `metrics.jsonl`, label and format. Others of a learner come after
them by their names."""

MAX_OWN = 6
"""Metrics of a learner that are shown by their names, the first ones."""

FORGOTTEN_S = 60.0
"""After so many seconds a measurement counts half for the time that is left: machines become slower and faster."""

CELL_COLUMNS = 100
"""Width of the panel below a notebook's cell, in characters."""

CELL_EVERY_S = 1.0
"""Between two drawings of the panel below a notebook's cell."""

LASTING = ("episodes", "success_rate", "validation_success", "mean_return")
"""Metrics that stay on show until a newer value comes; the others vanish where a chunk has none."""


class CellPanel:
    """Panel below a notebook's cell, drawn anew by a thread, as `rich.live.Live` does on a terminal.

    It is one output of plain text: what a notebook keeps of a training is the last panel.
    """

    def __init__(self, panel: Callable[[], Panel]) -> None:
        """Shows nothing before `start`; `panel` returns what is shown."""
        self._panel, self._ended = panel, threading.Event()
        self._thread = threading.Thread(target=self._tick, name="cell panel", daemon=True)
        self._handle: Any = None

    def start(self) -> None:
        """Shows the panel and goes on until `stop`."""
        display = import_module("IPython.display").display
        self._handle = display(self._data(), raw=True, display_id=True)
        self._thread.start()

    def stop(self) -> None:
        """Leaves the last state."""
        self._ended.set()
        self._thread.join()
        self._handle.update(self._data(), raw=True)

    def _tick(self) -> None:
        while not self._ended.wait(CELL_EVERY_S):
            self._handle.update(self._data(), raw=True)

    def _data(self) -> dict[str, str]:
        console = Console(file=io.StringIO(), width=CELL_COLUMNS, force_jupyter=False, color_system=None)
        with console.capture() as text:
            console.print(self._panel())
        return {"text/plain": text.get().rstrip()}


class Progress:
    """Shows the phases of a run, each with a clock, and the metrics of its training."""

    def __init__(
        self,
        console: Console | None = None,
        every_s: float = 2.0,
        tell: ShowPhase = show_nothing,
        began: float | None = None,
        last_time: Callable[[str], float | None] = lambda phase: None,
    ) -> None:
        """Writes to `console`, or standard output; without terminal or notebook, a line for each phase and `every_s`.

        `tell` is called with the name of each phase, and with how much of it is done. The clock runs from `began` on,
        seconds of `time.monotonic`, or from now on. `last_time` returns the seconds that a phase took the last time.
        """
        self._tell, self._last_time = tell, last_time
        self._console = console or Console()
        self._every_s = every_s
        self._live: Live | CellPanel | None = None
        self._metrics: dict[str, Any] = {}
        self._phase, self._total, self._counted = "starting", 0, (0, 0)
        self._phase_started = time.monotonic()
        self._started = self._phase_started if began is None else began
        self._printed = self._phase_started - every_s
        self._updated: tuple[float, int] | None = None  # when, and after how many decisions
        self._paused_s = self._all_paused_s = self._all_trained_s = 0.0  # validations since then, all, and training
        self._share = 0.0  # of validations in training's time, after the last of them
        self._measured_s, self._measured = 0.0, 0.0  # seconds and decisions that the rate is made of

    @property
    def elapsed_s(self) -> float:
        """Seconds since the clock began."""
        return time.monotonic() - self._started

    def phase(self, name: str, *, total: int = 0, done: int = 0) -> None:
        """Shows that the phase `name` begins; if it is training, with the decisions in all and those taken before."""
        returning = total == 0 and name == "training"  # from a validation
        if returning:
            self._paused_s += time.monotonic() - self._phase_started
        self._tell(name)
        self._phase, self._phase_started, self._counted = name, time.monotonic(), (0, 0)
        self._total = total or self._total
        if total:
            self._metrics.setdefault("decisions", done)
            self._updated = (time.monotonic(), self._decisions())
        if has_panel(self._console):
            self._start_live()
        elif not returning:
            self.message(f"[{format_duration(self.elapsed_s)}] {name}")

    def count(self, done: int, total: int) -> None:
        """Shows how many parts of the phase are done, such as missions that have ended, of how many."""
        self._counted = done, total
        self._tell(self._phase, done, total)

    def update(self, metrics: Mapping[str, Any]) -> None:
        """Takes in new values: `phase`, `decisions`, any of `SHOWN`, and what else a learner tells."""
        lasting = {key: self._metrics[key] for key in LASTING if key in self._metrics}
        self._metrics = lasting | {key: value for key, value in metrics.items() if value is not None}
        self._phase = str(metrics.get("phase", self._phase))
        self._tell(self._phase)
        now = time.monotonic()
        self._measure(now)
        if self._live is None and now - self._printed >= self._every_s:
            self._printed = now
            self.message(self._line())

    def message(self, text: str) -> None:
        """Prints a line that stays."""
        self._console.print(text, soft_wrap=True, markup=False, highlight=False)

    def stop(self) -> None:
        """Ends the live panel and leaves its last state on the terminal; does nothing if none was started."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _start_live(self) -> None:
        if self._live is None and self._console.is_jupyter:
            self._live = CellPanel(self._panel)
            self._live.start()
        elif self._live is None:
            # Drawn anew by a thread of its own, so that the clock runs on while the host waits.
            # What is printed meanwhile appears above it, unless it goes into a pipe.
            self._live = Live(
                get_renderable=self._panel,
                console=self._console,
                refresh_per_second=4,
                redirect_stdout=sys.stdout.isatty(),
            )
            self._live.start()

    def _decisions(self) -> int:
        return int(self._metrics.get("decisions", 0))

    def _measure(self, now: float) -> None:
        """Adds the newest decisions to the rate, unless the VAE was trained, too: then they take much longer."""
        if self._updated is not None and self._phase not in ("warm-up", "retraining"):
            took = max(now - self._updated[0] - self._paused_s, 0.0)
            if self._paused_s and self._all_trained_s:
                self._all_paused_s += self._paused_s
                self._share = self._all_paused_s / self._all_trained_s
            self._all_trained_s += took
            kept = 0.5 ** (took / FORGOTTEN_S)
            self._measured_s = kept * self._measured_s + took
            self._measured = kept * self._measured + self._decisions() - self._updated[1]
        self._updated, self._paused_s = (now, self._decisions()), 0.0

    def _remaining(self) -> str:
        """Returns the time that the rest of training takes at the rate of late, with its share of validations, as text.

        Nothing is known in the warm-up, and a retraining of the VAE that is still to come is not in it.
        """
        if self._measured <= 0:
            return "–"
        left = max(self._total - self._decisions(), 0) * self._measured_s / self._measured
        left *= 1.0 + self._share
        return format_duration(max(left - (time.monotonic() - (self._updated or (0.0, 0))[0]), 0.0))

    def _values(self) -> list[tuple[str, str]]:
        own = [name for name in learner_metrics([self._metrics]) if name not in SHOWN][:MAX_OWN]
        shown = SHOWN | {name: (name.replace("_", " "), "{:.3g}") for name in own}
        return [
            (label, form.format(float(self._metrics[name])))
            for name, (label, form) in shown.items()
            if name in self._metrics
        ]

    def _line(self) -> str:
        share = self._decisions() / self._total if self._total else 0.0
        head = f"[{format_duration(self.elapsed_s)}] {self._phase} {self._decisions():,} ({share:.0%})"
        values = "".join(f"  {label} {value}" for label, value in self._values())
        return f"{head}{values}  training left {self._remaining()}"

    def _panel(self) -> Panel:
        head = Table.grid(expand=True, padding=(0, 2))
        head.add_column()
        head.add_column(ratio=1)
        head.add_column(justify="right")
        done, count = self._counted
        counted = f", {done:,} of {count:,}," if count > 1 else ""
        clock = format_duration(time.monotonic() - self._phase_started)
        last = None if self._total else self._last_time(self._phase)
        before = "" if last is None else f", last time {format_duration(last)}"
        phase = Text(f"{self._phase}{counted} {clock}{before}", style="bold")
        total = f"{format_duration(self.elapsed_s)} in all"
        if self._total:
            bar = ProgressBar(total=self._total, completed=self._decisions())
            taken = f"{self._decisions():,} / {self._total:,}"
            left = f"training left {self._remaining()}" if self._decisions() < self._total else "trained"
            head.add_row(phase, bar, f"{taken}   {left}   {total}")
        else:
            head.add_row(phase, "", total)
        values = Table.grid(expand=True, padding=(0, 1))
        shown = self._values()
        for _ in shown:
            values.add_column(justify="center")
        if shown:
            values.add_row(*(Text(label, style="dim") for label, _ in shown))
            values.add_row(*(value for _, value in shown))
        return Panel(Group(head, values) if shown else head, title="edqn", title_align="left")


@contextlib.contextmanager
def shown_progress(progress: bool | None) -> Iterator[Progress | None]:
    """Shows within the block, on standard error or below a notebook's cell, what a training in Python does.

    Args:
        progress: True shows it anywhere, False nowhere, None on a terminal and in a notebook.

    Yields:
        what takes phases and metrics; None if nothing is shown.
    """
    console = Console(stderr=True)
    if progress is None:
        progress = is_watched(console)
    if not progress:
        yield None
        return
    shown = Progress(console)
    try:
        yield shown
    finally:
        shown.stop()
