"""Errors whose message is one sentence for the person who runs a command."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LIKE = 0.6
"""Similarity (difflib's) from which a word is taken for another one misspelt: below it `radar` is `frame-pair`."""


def error_sentence(error: Exception) -> str:
    """Returns what an error says in one line, with escapes in place of what no line can show, as in names of files."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(error))


def suggest_nearest(word: object, known: Iterable[str], or_else: str = "") -> str:
    """Returns `; did you mean '...'?` with the closest known word, else a list of them; `or_else` after both."""
    known = list(known)
    close = difflib.get_close_matches(str(word), known, n=1, cutoff=LIKE)
    return f"; did you mean '{close[0]}'{or_else}?" if close else f"; known are {', '.join(known)}{or_else}"


class ConfigError(ValueError):
    """The input is invalid; the message names what is wrong and what would be right."""


class DamagedError(ConfigError):
    """What was saved is not what is there now; the message names the file."""


class DivergedError(RuntimeError):
    """Nothing is learnt any more because numbers are not finite; the message says which were first, and when."""


class CheckError(RuntimeError):
    """A check of `--debug`, `edqn verify` or `edqn check` failed; the message says which."""


class StoppedError(RuntimeError):
    """Training stopped on request, after saving; the message says where."""
