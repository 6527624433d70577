"""Registries: what can be named in an option, the package's own entries and other people's.

Built-in entries are held as `module:name` and imported when they are first asked for, so that the names are known
before JAX is imported. What somebody registers is checked at once, by the function that a registry is made with.
`config.registry` has all registries.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError, suggest_nearest
from edqn_jax.user_code import check_takes, describe_object

OWN = "one that --import registers"
"""What else a name may be."""

Take = Callable[[str, Any], Any]
"""(the entry in words, what was given) → the entry as it is held; raises ConfigError if it is none."""


def instance_of(wanted: str, *classes: str) -> Take:
    """Returns a check that takes instances of these classes, `module:name`, which are `wanted` in words."""

    def take(what: str, entry: Any) -> Any:
        if not isinstance(entry, tuple(map(_import_name, classes))):
            raise ConfigError(f"{what} must be {wanted}, not {describe_object(entry)}")
        return entry

    return take


def module_made_of(arguments: str) -> Take:
    """Returns a check that takes classes of flax modules, and functions, which are called with these arguments."""
    wanted = "the class of a flax module, or a function that makes one, of"

    def take(what: str, entry: Any) -> Any:
        if isinstance(entry, type) and not issubclass(entry, _import_name("flax.linen:Module")):
            raise ConfigError(f"{what} must be {wanted} ({arguments}), not {describe_object(entry)}")
        check_takes(entry, arguments, what, wanted)
        return entry

    return take


def existing_file(what: str, entry: Any) -> Path:
    """Returns the absolute path of a file, of its path as text or `Path`.

    Raises:
        ConfigError: if it is none, or there is no such file.
    """
    if not isinstance(entry, str | Path):
        raise ConfigError(f"{what} must be the path of an MJCF file, not {describe_object(entry)}")
    file = Path(entry).expanduser().resolve()
    if not file.is_file():
        raise ConfigError(f"{what} must be the path of an MJCF file, and there is no file '{entry}'")
    return file


def _import_name(name: str) -> Any:
    """Imports what `module:name` stands for."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


class Registry:
    """Entries of one kind by name."""

    def __init__(
        self,
        kind: str,
        option: str,
        entries: Mapping[str, str],
        about: Mapping[str, str] | None = None,
        *,
        take: Take,
        reserved: Collection[str] = (),
    ) -> None:
        """Holds built-in entries.

        Args:
            kind: what an entry is, for messages.
            option: that names one, such as `agent.learner`.
            entries: `module:name` by name.
            about: what help texts say of entries, by name.
            take: checks what is registered.
            reserved: names that the option has for something else.
        """
        self.kind = kind
        self.option = option
        self._take = take
        self._reserved = reserved
        self._built_in = tuple(entries)
        self._entries: dict[str, Any] = dict(entries)
        self._about = dict(about or {})

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the names, built-in ones first."""
        return tuple(self._entries)

    @property
    def own(self) -> tuple[str, ...]:
        """Returns the names that are not built in."""
        return self.names[len(self._built_in) :]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def describe(self) -> str:
        """Returns the names with what is said of them; neighbours of which the same is said stand together."""
        groups = itertools.groupby(self.names, lambda name: self._about.get(name, ""))
        listed = [(", ".join(f"`{name}`" for name in names), about) for about, names in groups]
        return "; ".join(f"{names}: {about}" if about else names for names, about in listed)

    def register(self, name: str, entry: Any, about: str = "") -> None:
        """Adds an entry of one's own, with what help texts say of it.

        Raises:
            ConfigError: if the name is taken, reserved, or no identifier with hyphens, or the entry is not what the
                registry is of.
        """
        if not isinstance(name, str) or name.startswith("-") or not name.replace("-", "_").isidentifier():
            raise ConfigError(
                f"the name of a {self.kind} must be letters, digits, - and _, and begin with a letter, not {name!r}"
            )
        if name in self._entries:
            raise ConfigError(f"the {self.kind} '{name}' is there already; give yours another name")
        if name in self._reserved:
            raise ConfigError(f"'{name}' is something else in {self.option}; give your {self.kind} another name")
        if not isinstance(about, str):
            raise ConfigError(f"`about` of the {self.kind} '{name}' must be text, not {describe_object(about)}")
        self._entries[name] = self._take(f"the {self.kind} '{name}'", entry)
        self._about[name] = about

    def check(self, name: str) -> None:
        """Raises unless there is an entry of that name.

        Raises:
            ConfigError: with the nearest name, or all of them.
        """
        if name not in self._entries:
            raise ConfigError(
                f"{self.option}: there is no {self.kind} '{name}'{suggest_nearest(name, self, f', or {OWN}')}"
            )

    def get(self, name: str) -> Any:
        """Returns the entry of that name.

        Raises:
            ConfigError: as `check`.
        """
        self.check(name)
        entry = self._entries[name]
        if isinstance(entry, str):
            entry = self._entries[name] = _import_name(entry)
        return entry
