"""A flight as MCAP holds what its log holds."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader  # pyright: ignore[reportMissingImports]

from edqn_jax.cli import fly as command
from edqn_jax.errors import ConfigError
from edqn_jax.fly.mcap_file import write_mcap
from edqn_jax.fly.records import EVENTS, FlightLog, read_records
from edqn_jax.fly.streams import HEADER, MAGIC, Decoder, read_stream
from tests.support.virtual_flight import CAMERA
from tests.support.virtual_pilot import Policy, make


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    log = FlightLog(tmp_path / "flight")
    pilot, wire = make(log=log)
    wire.said.append("ready to fly")
    pilot.fly()
    log.close()
    return tmp_path / "flight"


def test_it_holds_each_record_and_each_event_in_the_order_of_time(flight: Path, tmp_path: Path) -> None:
    file = tmp_path / "flight.mcap"
    count = write_mcap(flight, file)
    found = [
        (channel.topic, schema, message)
        for schema, channel, message in make_reader(io.BytesIO(file.read_bytes())).iter_messages(log_time_order=False)
    ]
    assert len(found) == count and [path.name for path in tmp_path.iterdir()] == ["flight", "flight.mcap"]
    times = [message.log_time for _, _, message in found]
    assert times == sorted(times)
    records = read_records(flight)
    told = [json.loads(m.data) for topic, _, m in found if topic not in ("/events", "/pose", "/said")]
    assert told == [each for each in records if each["kind"] != "said"]
    decoder = Decoder()
    assert not list(decoder.feed(HEADER.pack(MAGIC, *CAMERA)))
    packets = [each for topic, _, m in found if topic == "/events" for each in decoder.feed(m.data)]
    written = read_stream(flight / EVENTS)
    assert [until for until, _ in packets] == [until for until, _ in written]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(packets, written, strict=True))
    ends = [m.log_time for topic, _, m in found if topic == "/events"]
    ahead_ms = {round((until - 1e-3 * at) / 1e3) for at, (until, _) in zip(ends, packets, strict=True)}
    assert ahead_ms == {7000}  # the camera's clock
    pose, *_ = [(schema, json.loads(m.data)) for topic, schema, m in found if topic == "/pose"]
    assert pose[0] is not None and pose[0].name == "foxglove.PoseInFrame" and pose[1]["pose"]["orientation"]["w"] == 1.0
    said = [json.loads(m.data)["message"] for topic, schema, m in found if topic == "/said"]
    assert said == ["ready to fly"]


def test_a_replay_writes_it_and_bad_input_is_one_sentence(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "load_runner", lambda *_: Policy())
    words = ["a.onnx", "--replay", str(flight), "--mcap"]
    command.replay(command.parse_fly([*words, str(tmp_path / "a.mcap")]), flight)
    assert (tmp_path / "a.mcap").is_file() and "'" + str(tmp_path / "a.mcap") + "' has" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="must end in .mcap"):
        command.parse_fly([*words, "a.bag"])
    with pytest.raises(ConfigError, match="--mcap writes a flight that --replay plays"):
        command.parse_fly(["a.onnx", "--mcap", "a.mcap"])
    with pytest.raises(ConfigError, match="cannot be written: there is no folder"):
        write_mcap(flight, tmp_path / "nowhere" / "a.mcap")
    with pytest.raises(ConfigError, match="there is no flight in"):
        write_mcap(tmp_path, tmp_path / "b.mcap")
