"""Errors whose message is one sentence for the person who runs a command."""

from __future__ import annotations


class ConfigError(ValueError):
    """The input is invalid; the message names what is wrong and what would be right."""


class DivergedError(RuntimeError):
    """A loss became NaN or Inf; the message says which one and at which step."""


class StoppedError(RuntimeError):
    """Training stopped on request, after saving; the message says where."""
