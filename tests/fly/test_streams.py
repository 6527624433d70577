"""Streams of events: in pieces, over sockets, from recordings, and what is known of the newest of them."""

from __future__ import annotations

import socket
import threading

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.fly.simulated.camera import EventCamera, EventServer
from edqn_jax.fly.streams import (
    EVENT,
    HEADER,
    MAGIC,
    Decoder,
    Events,
    Recorded,
    SocketStream,
    open_events,
    packet_bytes,
    read_stream,
)


def some(count: int, since: int, until: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(since, until, count))
    events["x"], events["y"], events["p"] = rng.integers(0, 64, count), rng.integers(0, 48, count), 1
    return events


def test_a_stream_is_decoded_in_whatever_pieces_it_comes(tmp_path) -> None:
    packets = [(1000 * (k + 1), some(n, 1000 * k, 1000 * (k + 1), k)) for k, n in enumerate((5, 0, 300, 1))]
    stream = HEADER.pack(MAGIC, 64, 48) + b"".join(packet_bytes(*packet) for packet in packets)
    for size in (1, 7, 1000, len(stream)):
        decoder = Decoder()
        pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
        found = [packet for piece in pieces for packet in decoder.feed(piece)]
        assert decoder.size == (64, 48) and [until for until, _ in found] == [until for until, _ in packets]
        for (_, got), (_, sent) in zip(found, packets, strict=True):
            np.testing.assert_array_equal(got, sent)
    (tmp_path / "a.bin").write_bytes(stream[:-3])
    assert [until for until, _ in read_stream(tmp_path / "a.bin")] == [1000, 2000, 3000]


def test_what_is_no_stream_of_events_is_refused() -> None:
    with pytest.raises(ConfigError, match="EVS1"):
        list(Decoder().feed(b"HTTP/1.1 400 Bad Request"))


def test_windows_hold_what_lies_in_them_and_old_packets_are_forgotten() -> None:
    events = Events((64, 48), keep_us=5000)
    for k in range(20):
        events.add(some(100, 1000 * k, 1000 * (k + 1), k), 1000 * (k + 1), 0.001 * (k + 1))
    window = events.window(16_500, 18_500)
    assert window.size and window["t"].min() >= 16_500 and window["t"].max() < 18_500
    assert events.window(0, 10_000).size == 0
    assert events.until_us == 20_000 and events.packet_at == 0.02
    assert events.rate_hz(0.02) == pytest.approx(600 / 0.1)
    assert events.rate_hz(1.0) == 0.0
    assert events.offset.value == pytest.approx(0.0)
    assert [until for until, _ in events.since(18_000)] == [19_000, 20_000]


def test_events_beyond_the_image_tell_of_another_camera() -> None:
    events = Events((32, 24))
    events.add(some(500, 0, 1000), 1000, 0.0)
    assert events.size == (64, 48)


def test_a_clock_that_begins_anew_leaves_no_old_events() -> None:
    events = Events((64, 48))
    events.add(some(10, 0, 9000), 9000, 1.0)
    events.add(some(10, 0, 1000), 1000, 1.01)
    assert events.until_us == 1000 and events.window(0, 10_000).size == 10


def test_packets_come_over_a_socket_and_a_stream_that_ends_is_silent() -> None:
    server = EventServer((64, 48))
    source = SocketStream(server.address)
    assert source.events.size == (64, 48) and source.events.packet_at is None
    server.send(1000, some(50_000, 0, 1000))
    server.send(2000, some(0, 0, 1000))
    source.read(3.0, 2000)
    assert source.events.until_us == 2000 and source.events.packet_at == 3.0
    assert source.events.window(0, 1000).size == 50_000
    server.close()
    source.read(4.0)
    source.read(5.0)
    assert source.events.packet_at == 3.0
    source.close()


def test_a_port_of_another_program_is_one_sentence() -> None:
    with pytest.raises(ConfigError, match="no camera at"):
        open_events("tcp:127.0.0.1:1")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def talk() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"SSH-2.0-OpenSSH")

        thread = threading.Thread(target=talk)
        thread.start()
        with pytest.raises(ConfigError, match="no stream of events"):
            open_events(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        thread.join()
    with pytest.raises(ConfigError, match="no camera and no file"):
        open_events("camera")


def test_a_recording_is_played_at_its_own_speed_and_then_silent(tmp_path) -> None:
    source = Recorded(some(1000, 5_000_000, 6_000_000), (64, 48))
    source.read(100.0)
    source.read(100.25)
    assert source.events.until_us == int(source._events["t"][0]) + 250_000
    assert 200 < source.events.window(5_000_000, 6_000_000).size < 300
    source.read(100.6)
    source.read(102.0)
    assert source.events.packet_at == 100.6
    from edqn_jax.interop.recordings.event_files import write_events
    from edqn_jax.interop.recordings.recording import Recording

    write_events(tmp_path / "a.npz", Recording(source._events, 64, 48))
    assert open_events(str(tmp_path / "a.npz")).events.size == (64, 48)


def test_a_lens_that_is_covered_darkens_the_whole_picture_and_a_moving_scene_does_not() -> None:
    rng = np.random.default_rng(3)
    scene = np.exp(0.5 * rng.normal(size=(48, 400)))
    camera = EventCamera(lambda place, _: scene[:, int(place[0]) : int(place[0]) + 64] * place[1], lambda _: np.eye(3))
    events, light, seen = Events((64, 48)), 1.0, []
    for k in range(120):
        light = light if k < 80 else max(0.01, 0.5 * light)  # from 0.4 s on it is covered within 35 ms
        until, new = camera.frame(0.005 * k, np.array([2.0 * k, light, 0.0]), np.zeros(4))
        events.add(new, until, 0.005 * k)
        seen.append(events.darkening(0.005 * k))
    assert np.abs(seen[:80]).max() < 0.8
    assert max(seen) == pytest.approx(np.log(100) / 0.2, abs=1.0)
    assert events.darkening(0.9) == 0.0
    assert Events().darkening(0.0) == 0.0
