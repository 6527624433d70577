"""Arguments that do not parse, as one sentence: tyro says so in boxes, and tells nobody else."""

from __future__ import annotations

import ast
import contextlib
import io
import re
from collections.abc import Callable, Sequence
from typing import TypeVar

from edqn_jax.errors import ConfigError, suggest_nearest

Args = TypeVar("Args")

_KINDS = {"int()": "a whole number", "to float": "a number"}
"""What a value was to be, by how Python says that it is none."""

_LISTS = {"[INT [INT ...]]": "whole numbers", "[FLOAT [FLOAT ...]]": "numbers"}
"""What several values were to be, by how a help says it."""


def parse_or_say(parse: Callable[[], Args], command: str) -> Args:
    """Returns what `parse` returns, a call of tyro's.

    Raises:
        ConfigError: in place of the box that tyro prints about arguments that do not parse.
        SystemExit: after a help.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return parse()
    except SystemExit as ending:
        if not ending.code:
            raise
    raise ConfigError(sentence_of(said.getvalue(), command))


def sentence_of(box: str, command: str) -> str:
    """Returns what a box of tyro's says, as a sentence; a box that is not known as it is, in one line."""
    lines = [line[2:].strip("│").rstrip() for line in box.splitlines() if line.strip()]
    lines = lines[1 if "│" in box else 2 :]  # without the title; where there is only ASCII, a rule is below it
    rules = [number for number, line in enumerate(lines) if line.strip() and not line.strip(" ─╯-")]
    about = lines[: rules[0]] if rules else lines
    text = " ".join(" ".join(about).split())
    see = f"'{command} --help' lists what there is"
    if text.startswith("Missing from"):
        # The names are indented by four, and what is said of them by eight.
        names = [line.strip() for line in about[1:] if re.match(r" {4}\S", line)]
        return f"'{command}' needs {' and '.join(names)}; see '{command} --help'"
    if found := re.match(r"Unrecognized options: (.*)", text):
        words = found[1].split(", ")
        more = "is a word" if len(words) == 1 else "are words"
        return f"{' and '.join(map(repr, words))} {more} too many; {see}"
    if found := re.match(r"invalid choice '(.*)' for argument '(.*?)'\. Expected one of (\(.*\))\.", text):
        return f"{found[2]} cannot be '{found[1]}'{suggest_nearest(found[1], _literal(found[3]) or ())}"
    if found := re.match(r"Missing value for argument '(.*?)'\. Expected (\d+)", text):
        return f"{found[1]} must be followed by {'a value' if found[2] == '1' else f'{found[2]} values'}"
    if found := re.match(r"Error parsing (\S+): (.*)", text):
        return _about_value(found[1], found[2], lines)
    return f"{text}; {see}"


def _literal(text: str) -> Sequence[str] | None:
    """Returns the words of a list or a tuple that Python wrote; None where it is cut off."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return None


def _about_value(flag: str, text: str, lines: list[str]) -> str:
    """Returns the sentence on a value that is none of its option's."""
    takes = next((line.split(flag, 1)[1].strip() for line in lines if line.strip().startswith(f"{flag} ")), "")
    given = re.search(r"(?:instantiated from|valid parse for arguments:) (\[.*)", text)
    # A value may have brackets of its own.
    ends = [end.end() for end in re.finditer(r"\]", given[1])] if given else []
    words = next((words for end in ends if given and (words := _literal(given[1][:end]))), None)
    quoted = re.findall(r"""'[^']*'|"[^"]*\"""", text)
    value = " ".join(words) if words else quoted[-1][1:-1] if quoted else "that"
    kind = next((kind for says, kind in _KINDS.items() if says in text), None)
    return f"{flag} must be {kind or _LISTS.get(takes, takes) or 'of another form'}, not '{value}'"
