"""A logged flight as MCAP, which Foxglove and others read: its records as JSON, where the drone was, what was said."""

from __future__ import annotations

import contextlib
import heapq
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.files import check_can_write
from edqn_jax.fly.records import EVENTS, read_records
from edqn_jax.fly.streams import EVENT, packet_bytes, read_stream

FOXGLOVE = {"pose": "foxglove.PoseInFrame", "said": "foxglove.Log"}
"""Schemas that Foxglove knows by name."""

Message = tuple[int, str, bytes]
"""Nanoseconds of the host's clock, topic, data."""


def write_mcap(folder: Path, file: Path) -> int:
    """Writes the flight in a folder as one MCAP file, which replaces one of that name, and returns its messages.

    Times are the host's; a packet of events has that of its end, by the camera's offset at the decision that had the
    newest events. Packets are on `/events` as in `edqn_jax.fly.streams`.

    Raises:
        ConfigError: if there is no flight in the folder, or the file cannot be written.
        MissingPackageError: if mcap is not installed.
    """
    writing = require_extra("mcap.writer", extra="fly")
    records = read_records(folder)
    check_can_write(file)
    partial, count = file.with_name(file.name + ".partial"), 0
    try:
        with contextlib.closing(partial.open("wb")) as opened:
            writer = writing.Writer(opened)
            writer.start(profile="", library="edqn_jax")
            channels: dict[str, int] = {}
            for at_ns, topic, data in heapq.merge(_records(records), _packets(folder, records)):
                if topic not in channels:
                    channels[topic] = _channel(writer, topic)
                writer.add_message(channels[topic], log_time=at_ns, publish_time=at_ns, data=data, sequence=count)
                count += 1
            writer.finish()
        partial.replace(file)
    except OSError as error:
        raise ConfigError(f"'{file}' cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return count


def _channel(writer: Any, topic: str) -> int:
    if topic == "events":
        about = {"dtype": str(EVENT.descr), "layout": "int64 until, uint32 N, N events"}
        return writer.register_channel("/events", "edqn-events", 0, about)
    schema = writer.register_schema(FOXGLOVE.get(topic, f"edqn.{topic}"), "jsonschema", b'{"type": "object"}')
    return writer.register_channel(f"/{topic}", "json", schema)


def _records(records: list[dict[str, Any]]) -> Iterator[Message]:
    """Yields a message for each record, and the pose at each decision; one without a time has that of the last."""
    at_ns = next((_ns(each["now"]) for each in records if "now" in each), 0)
    for record in records:
        at_ns = max(at_ns, _ns(record.get("now", record.get("at", 1e-9 * at_ns))))
        kind = record["kind"]
        if kind == "said":
            log = {"timestamp": _stamp(at_ns), "level": 2, "message": record["text"], "name": "vehicle"}
            yield at_ns, "said", json.dumps(log).encode()
            continue
        yield at_ns, kind, json.dumps(record).encode()
        if kind == "decision":
            (x, y, z), (w, *axis) = record["asked"]["position"], record["asked"]["quaternion"]
            place = {"x": x, "y": y, "z": z}
            turn = dict(zip("xyz", axis, strict=True)) | {"w": w}
            pose = {"timestamp": _stamp(at_ns), "frame_id": "world", "pose": {"position": place, "orientation": turn}}
            yield at_ns, "pose", json.dumps(pose).encode()


def _packets(folder: Path, records: list[dict[str, Any]]) -> Iterator[Message]:
    """Yields a message for each packet of the camera."""
    stream = folder / EVENTS
    packets = read_stream(stream) if stream.is_file() else []
    if not packets:
        return
    decisions = [each for each in records if each["kind"] == "decision"]
    offset_us = min((1e6 * each["at"] - each["asked"]["until_us"] for each in decisions), default=None)
    if offset_us is None:
        first = next((each["now"] for each in records if "now" in each), 0.0)
        offset_us = 1e6 * first - packets[0][0]
    last_ns = 0
    for until, events in packets:
        last_ns = max(last_ns, _ns(1e-6 * (until + offset_us)))
        yield last_ns, "events", packet_bytes(until, events)


def _ns(seconds: float) -> int:
    return max(0, round(1e9 * seconds))


def _stamp(at_ns: int) -> dict[str, int]:
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}
