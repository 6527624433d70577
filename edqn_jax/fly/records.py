"""The log of a flight: a folder with `flight.jsonl`, a line a record, and `events.bin`, the camera's stream."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.fly.faults import Action, Command, Fault, Inputs, Limits, Odometry, Settings
from edqn_jax.fly.streams import HEADER, MAGIC, packet_bytes
from edqn_jax.interop.recordings.lens import Lens

RECORDS, EVENTS = "flight.jsonl", "events.bin"


class FlightLog:
    """Writes records as they come, so that a flight that is cut off is there up to its end."""

    def __init__(self, folder: Path) -> None:
        """Makes the folder.

        Raises:
            ConfigError: if it holds a flight already, or cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._records = (folder / RECORDS).open("x", encoding="utf-8")
            with contextlib.ExitStack() as stack:
                stack.callback(self._records.close)
                self._events = (folder / EVENTS).open("xb")
                stack.pop_all()
        except FileExistsError:
            raise ConfigError(f"'{folder}' holds a flight already; name another folder in --out") from None
        except OSError as error:
            raise ConfigError(f"the log of the flight cannot be written to '{folder}': {error}") from error
        self._until_us: int | None = None

    def write(self, kind: str, **fields: Any) -> None:
        """Writes a record."""
        json.dump({"kind": kind, **fields}, self._records, default=_plain)
        self._records.write("\n")
        if kind != "tick":
            self._records.flush()

    def write_events(self, size: tuple[int, int], packets: list[tuple[int, NDArray]]) -> None:
        """Writes packets of the camera: `until` and events [N]."""
        if self._until_us is None:
            self._events.write(HEADER.pack(MAGIC, *size))
            self._until_us = -1
        for until, events in packets:
            self._events.write(packet_bytes(until, events))

    def close(self) -> None:
        """Closes the files."""
        self._records.close()
        self._events.close()


def read_records(folder: Path) -> list[dict[str, Any]]:
    """Returns the records of a flight; a last line that was cut off is left out.

    Raises:
        ConfigError: if there is no flight, or a line of it is not as it was written.
    """
    file = folder / RECORDS
    if not file.is_file():
        raise ConfigError(f"there is no flight in '{folder}': it holds no {RECORDS}")
    lines = file.read_text(encoding="utf-8").split("\n")[:-1]
    try:
        return [json.loads(line) for line in lines]
    except json.JSONDecodeError as error:
        raise ConfigError(f"'{file}' is damaged: {error}") from error


def inputs_of(record: dict[str, Any]) -> Inputs:
    """Returns inputs as a record holds them."""
    fields = dict(record)
    if fields["odometry"] is not None:
        own = fields["odometry"]
        fields["odometry"] = Odometry(own["at"], np.array(own["position"]), np.array(own["velocity"]), own["resets"])
    if fields["command"] is not None:
        wanted = fields["command"]
        fields["command"] = Command(wanted["at"], np.array(wanted["velocity"]), wanted["yaw"])
    fields["camera"] = None if fields["camera"] is None else tuple(fields["camera"])
    return Inputs(**fields)


def settings_of(record: dict[str, Any]) -> Settings:
    """Returns settings as a record holds them."""
    fields = dict(record)
    fields["goal"], fields["fence"] = np.array(fields["goal"]), np.array(fields["fence"])
    fields["camera"] = tuple(fields["camera"])
    fields["actions"] = {Fault(fault): Action(action) for fault, action in fields["actions"].items()}
    fields["after_hover"], fields["at_goal"] = Action(fields["after_hover"]), Action(fields["at_goal"])
    limits = fields["limits"]
    # Where a log is older than `unseen_s`, every lens that saw too little for `covered_s` was covered.
    before: dict[str, Any] = {"unseen_s": limits["covered_s"], "dark_stops": False}  # where a log does not say it
    fields["limits"] = Limits(**before | limits)
    return Settings(**fields)


def lens_of(record: dict[str, Any] | None) -> Lens | None:
    """Returns a lens as a record holds it; None if it holds none."""
    if record is None:
        return None
    size, matrix, coefficients = (tuple(record[name]) for name in ("size", "matrix", "coefficients"))
    return Lens(size, matrix, record["model"], coefficients)


def _plain(value: Any) -> Any:
    """Returns what JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a record cannot hold {type(value).__name__}")
