"""Docstrings as reStructuredText: results by name, which Napoleon would read as types; of our own modules alone."""

from __future__ import annotations

import re
import textwrap

from sphinx.application import Sphinx

NAMED = re.compile(r"(\w+(?:, \w+)*|\(\w+(?:, \w+)*\)): ")
"""Names of results at the beginning of a line."""

BETWEEN = re.compile(r"(?<=[.;]) (?=(?:\w+|\(\w+(?:, \w+)*\)): \[)")
"""The space between two results on one line, such as `a: [] action taken. y: [] target`."""


def with_results(lines: list[str]) -> list[str]:
    """Returns a docstring whose section `Returns:` is a field of reStructuredText, and a list if it has names."""
    out: list[str] = []
    rest = list(lines)
    while rest:
        line = rest.pop(0)
        if line != "Returns:":
            out.append(line)
            continue
        body: list[str] = []
        while rest and (not rest[0] or rest[0].startswith("    ")):
            body.append(rest.pop(0))
        results = [
            part for text in textwrap.dedent("\n".join(body)).strip().splitlines() for part in BETWEEN.split(text)
        ]
        if results and NAMED.match(results[0]):
            results = [
                NAMED.sub(r"* **\1**: ", text, count=1) if NAMED.match(text) else f"  {text}" for text in results
            ]
        out += [":returns:", *(f"    {text}" for text in results), ""]
    return out


def process(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Changes the lines of a docstring in place, before Napoleon reads them."""
    lines[:] = [line.replace("[*", r"[\*") for line in with_results(lines)]
    if what in ("attribute", "data", "property"):
        lines.insert(0, "")  # else Napoleon takes what stands before a colon for the type


def skip(app: Sphinx, what: str, name: str, thing: object, would: bool, options: object) -> bool | None:
    """Leaves out functions of other packages: imported ones, and those that `flax.struct` adds to a class."""
    module = getattr(thing, "__module__", None) or "edqn_jax"
    return True if callable(thing) and module.split(".")[0] != "edqn_jax" else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers both."""
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-skip-member", skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
