"""The page as one HTML file: what is text is written here, what moves is drawn by `page.js` from the data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.metrics import clearance_text, summarise_flights
from edqn_jax.evaluation.rollouts import ShowPhase
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.learn.policy import Policy
from edqn_jax.policies import function_named
from edqn_jax.policies.functions import Function, FunctionPolicy, as_policy, load_function
from edqn_jax.report.page.contents import RUN_COLOURS, add_pictures, page_data, script_text
from edqn_jax.report.page.evaluated import EvaluatedRun, fly_policy, fly_run, folders_of, names_of
from edqn_jax.report.style import OUTCOME_LABELS

MAX_BYTES = 15_000_000
"""Size of the page at most."""
MAX_FLIGHTS = 256
"""Flights of all runs of a page together at most."""

_LIBRARIES = ("language.js", "vendored/three.min.js", "vendored/uPlot.iife.min.js")


Shown = str | Path | Policy | FunctionPolicy | Function
"""What a page is made of: a folder, the name of a policy or of a function, or a policy itself."""


@as_tested
def write_report(policies: Shown | Sequence[Shown], file: str | Path, *, missions: int = 128) -> None:
    """Writes the page of runs and policies as one HTML file, which replaces a file of that name.

    Args:
        policies: folders of runs, `pretrained`, policies, and functions, see `FunctionPolicy`; one, or several in a
            list.
        file: to write.
        missions: flights of each at most; of all together at most `MAX_FLIGHTS`.

    Raises:
        ConfigError: if there is nothing to show, a folder holds no run, a policy cannot fly, they are too many for one
            page, or the file cannot be written.
    """
    check_can_write(Path(file))
    shown: list[Any] = list(policies) if isinstance(policies, Sequence) and not _is_name(policies) else [policies]
    if not shown or missions < 1:
        raise ConfigError(f"a report needs a policy and at least 1 of its missions, not {len(shown)} and {missions}")
    write_atomically(Path(file), build_report(shown, missions).encode())


def build_report(
    shown: Sequence[Shown],
    most: int,
    message: Callable[[str], None] = lambda _: None,
    phase: ShowPhase | None = None,
) -> str:
    """Returns the page of runs and policies, their evaluation missions flown anew, those of folders first.

    Args:
        shown: folders of several seeds stand for each seed's.
        most: flights of a run at most.
        message: told of what takes time.
        phase: called as a phase of flying begins, and as flights end.

    Raises:
        ConfigError: if a folder holds no run, or the runs are too many for one page.
    """
    named = {str(each): load_function(str(each)) for each in shown if _is_name(each) and function_named(str(each))}
    paths = [Path(each) for each in shown if _is_name(each) and str(each) not in named]  # pyright: ignore[reportArgumentType]
    single = list(dict.fromkeys(each for folder in paths for each in folders_of(folder)))
    policies = [*named.items(), *((_own_name(each), each) for each in shown if not _is_name(each))]
    count = len(single) + len(policies)
    if count > MAX_FLIGHTS:
        raise ConfigError(f"{count} runs are too many for one page; give at most {MAX_FLIGHTS}")
    most = min(most, MAX_FLIGHTS // count)
    runs = [fly_run(folder, name, most, message, phase) for folder, name in zip(single, names_of(single), strict=True)]
    runs += [fly_policy(as_policy(policy), name, most, message, phase) for name, policy in policies]
    data = page_data(runs)
    left = MAX_BYTES - len(build_html(runs, data).encode()) - 100_000
    if left < 0:
        raise ConfigError(f"the page would have more than {MAX_BYTES / 1e6:g} MB; give fewer runs, or --missions")
    add_pictures(data, runs, left - 200 * sum(len(run["flights"]) for run in data["runs"]), message)
    return build_html(runs, data)


def _is_name(shown: Shown | Sequence[Shown]) -> bool:
    return isinstance(shown, str | Path)


def _own_name(policy: Any) -> str:
    """Returns the name of a function; of a callable without a name, that of its type."""
    function = getattr(policy, "function", policy)
    return getattr(function, "__name__", type(function).__name__)


def build_html(runs: Sequence[EvaluatedRun], data: dict[str, Any]) -> str:
    """Returns the HTML; everything that comes from a file is escaped."""
    title = runs[0].name if len(runs) == 1 else f"{len(runs)} runs"
    parts = {
        "title": escape(title),
        "made": escape(f"edqn_jax {data['version']}, {data['made']}"),
        "notes": "".join(
            f"<p class='note'>{_tag(run, number, runs)} {escape(note)}</p>"
            for number, run in enumerate(runs)
            for note in run.notes
        ),
        "comparison": comparison_table(runs),
        "options": options_table(runs),
        "style": _asset("vendored/uPlot.min.css") + _asset("page.css"),
        "libraries": "".join(f"<script>{_asset(name)}</script>" for name in _LIBRARIES),
        "data": script_text(data),
        "script": _asset("page.js"),
    }
    # One pass over the template: what is filled in is not searched for places again.
    pieces = _asset("page.html").split("{{")
    return pieces[0] + "".join(parts[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces[1:]))


def comparison_table(runs: Sequence[EvaluatedRun]) -> str:
    """Returns the table of the runs' figures: a row a figure, a column a run."""
    columns = [run_figures(run) for run in runs]
    head = "".join(f"<th>{_tag(run, number, runs, always=True)}</th>" for number, run in enumerate(runs))
    rows = "".join(
        f"<tr><th>{escape(name)}</th>" + "".join(f"<td>{escape(column[name])}</td>" for column in columns) + "</tr>"
        for name in columns[0]
    )
    return f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{rows}</tbody></table>"


def run_figures(run: EvaluatedRun) -> dict[str, str]:
    """Returns what a run is compared by, as text; a dash where it is not known."""
    summary, metrics = run.summary, summarise_flights(run.flights)
    low, high = metrics["interval"]

    def of(name: str, form: str) -> str:
        value = summary.get(name)
        return form.format(value) if isinstance(value, int | float) else "–"

    outcome = run.outcomes[0]
    shortest = summary.get("shortest_path_m")
    first = f"{OUTCOME_LABELS[outcome]}, {float(run.flights.flight_seconds[0]):.1f} s"
    path = f"{float(run.flights.path_length_m[0]):.1f} m"
    if isinstance(shortest, int | float):
        path += f" (shortest {shortest:.1f} m)"
    # No-break spaces before the percent signs.
    share = f"{100 * metrics['success_rate']:.1f}\u00a0%; 95\u00a0% Wilson {100 * low:.0f} to {100 * high:.0f}\u00a0%"
    return {
        "trained in": "–" if run.params is None else Path(run.config.world.name).name,
        "sensor": run.config.env.sensor,
        "seed": str(run.config.train.seed),
        "flights on this page": f"{metrics['missions']} in {Path(run.missions.name).name}"
        + (f", first in {Path(run.config.world.flown).name}" if run.config.world.flown else ""),
        "reached the goal": f"{metrics['successes']} ({share})",
        "collisions": str(metrics["collisions"]),
        "time-outs": str(metrics["timeouts"]),
        "left the volume": str(metrics["left_volume"]),
        "mean return": f"{metrics['return']:.1f}",
        "mean flight time of successes": "–"
        if metrics["flight_seconds"] is None
        else f"{metrics['flight_seconds']:.1f} s",
        "least clearance of successes": clearance_text(metrics["min_clearance_m"]),
        "first flight": first,
        "its path": path,
        "training decisions": of("train_decisions", "{:,}"),
        "training time": of("train_seconds", "{:.0f} s"),
        "decisions per second": of("decisions_per_second", "{:,.0f}"),
        "processor": str(summary.get("processor") or "–"),
        "state": "finished" if summary else "not finished, or a policy by itself",
    }


def options_table(runs: Sequence[EvaluatedRun]) -> str:
    """Returns the runs' options and versions; of several runs, first what differs between them."""
    parts = [_differences(runs)] if len(runs) > 1 else []
    for number, run in enumerate(runs):
        versions = run.summary.get("versions")
        found = versions if isinstance(versions, dict) else {}
        said = ", ".join(f"{name} {version}" for name, version in found.items()) or "versions are not recorded"
        parts.append(
            f"<details><summary>{_tag(run, number, runs, always=True)}: all options</summary>"
            f"<p>{escape(said)}</p><pre>{escape(run.config_text)}</pre></details>"
        )
    return "".join(parts)


def _differences(runs: Sequence[EvaluatedRun]) -> str:
    """Returns a table of the options in which the runs differ."""
    columns = [_lines(run) for run in runs]
    differ = [name for name in columns[0] if len({column.get(name) for column in columns}) > 1]
    if not differ:
        return "<p>All options are the same.</p>"
    head = "".join(f"<th>{_tag(run, number, runs)}</th>" for number, run in enumerate(runs))
    rows = "".join(
        f"<tr><th>{escape(name)}</th>"
        + "".join(f"<td>{escape(column.get(name, '–'))}</td>" for column in columns)
        + "</tr>"
        for name in differ
    )
    return (
        "<p>Options that differ:</p><div class='wide'><table>"
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _lines(run: EvaluatedRun) -> dict[str, str]:
    """Returns the options of a run as text, by their names with their groups."""
    return {
        f"{group}.{name}": str(value)
        for group, options in dataclasses.asdict(run.config).items()
        for name, value in options.items()
    }


def _tag(run: EvaluatedRun, number: int, runs: Sequence[EvaluatedRun], *, always: bool = False) -> str:
    """Returns a run's name behind a dot of its colour; nothing of a single run unless `always`."""
    if len(runs) == 1 and not always:
        return ""
    colour = RUN_COLOURS[number % len(RUN_COLOURS)]
    return f"<span class='tag'><i style='background:{colour}'></i>{escape(run.name)}</span>"


def _asset(name: str) -> str:
    return resources.files("edqn_jax.report.page").joinpath(name).read_text(encoding="utf-8")
