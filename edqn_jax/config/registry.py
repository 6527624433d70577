"""Registries: what can be named in an option, the package's own entries and other people's.

Built-in entries are held as `module:name` and imported when they are first asked for, so that the names are known
before JAX is imported.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from typing import Any

from edqn_jax.errors import ConfigError


class Registry:
    """Entries of one kind by name."""

    def __init__(self, kind: str, option: str, entries: Mapping[str, str]) -> None:
        """Holds built-in entries.

        Args:
            kind: what an entry is, for messages.
            option: that names one, such as `agent.learner`.
            entries: `module:name` by name.
        """
        self.kind = kind
        self.option = option
        self._entries: dict[str, Any] = dict(entries)

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the names, built-in ones first."""
        return tuple(self._entries)

    def register(self, name: str, entry: Any) -> None:
        """Adds an entry of one's own.

        Raises:
            ConfigError: if the name is taken or is no identifier with hyphens.
        """
        if not name.replace("-", "_").isidentifier():
            raise ConfigError(f"the name of a {self.kind} must be letters, digits, - and _, not '{name}'")
        if name in self._entries:
            raise ConfigError(f"there is a {self.kind} '{name}' already; give yours another name")
        self._entries[name] = entry

    def check(self, name: str) -> None:
        """Raises unless there is an entry of that name.

        Raises:
            ConfigError: with the nearest name, or all of them.
        """
        if name not in self._entries:
            near = difflib.get_close_matches(name, self._entries, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"it must be one of {', '.join(self._entries)}"
            raise ConfigError(f"{self.option}: there is no {self.kind} '{name}'; {hint}")

    def get(self, name: str) -> Any:
        """Returns the entry of that name.

        Raises:
            ConfigError: as `check`.
        """
        self.check(name)
        entry = self._entries[name]
        if isinstance(entry, str):
            module, _, attribute = entry.partition(":")
            entry = self._entries[name] = getattr(importlib.import_module(module), attribute)
        return entry


LEARNERS = Registry(
    "learner",
    "agent.learner",
    {"dqn": "edqn_jax.learn.dqn.learner:DQN", "pqn": "edqn_jax.learn.pqn.learner:PQN"},
)
"""How the network that chooses moves learns: `edqn_jax.learn.learner.Learner`."""

ACTION_SETS = Registry(
    "set of actions",
    "env.actions",
    {
        "moves": "edqn_jax.sim.task.action_sets:MOVES",
        "velocity": "edqn_jax.sim.task.action_sets:VELOCITY",
        "body-rates": "edqn_jax.sim.task.action_sets:BODY_RATES",
    },
)
"""What actions are and what they command: `edqn_jax.sim.task.action_sets.ActionSet`."""
