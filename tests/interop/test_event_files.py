"""Files of events are read as they were written, and damaged ones are refused by name."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.extras import MissingPackageError, require_extra
from edqn_jax.interop.recordings.event_files import read_events, write_events
from edqn_jax.interop.recordings.recording import Recording
from tests.oracles import event_words
from tests.support.interop.recordings import HEIGHT, WIDTH, some_events, some_recording

faery = require_extra("faery", extra="events")
h5py = require_extra("h5py", extra="events")

CAMERAS = ("a.aedat4", "evt2.raw", "evt3.raw", "a.dat", "a.es")

WORDS = {"evt2.raw": event_words.evt2, "evt3.raw": event_words.evt3}


def as_faery(events: np.ndarray) -> np.ndarray:
    held: Any = np.empty(len(events), faery.EVENTS_DTYPE)
    for key in "txy":
        held[key] = events[key]
    held["on"] = events["p"] > 0
    return held


def written(folder: Path, name: str) -> Path:
    """A camera's file that faery has written."""
    file = folder / name
    version = file.stem if file.stem.startswith("evt") else None
    stream = faery.events_stream_from_array(as_faery(some_events()), (WIDTH, HEIGHT))
    stream.to_file(file, version=version)
    return file


@pytest.mark.parametrize("name", ["a.h5", "a.hdf5", "a.npz", "a.txt"])
def test_what_is_written_is_read(tmp_path, name):
    recording = some_recording()
    write_events(tmp_path / name, recording)
    found = read_events(tmp_path / name)
    assert found.events.dtype == recording.events.dtype
    assert np.array_equal(found.events, recording.events)
    assert found.size() == (WIDTH, HEIGHT)


@pytest.mark.parametrize("name", ["a.h5", "a.npz"])
def test_a_flight_and_the_contrast_are_kept(tmp_path, name):
    flight = {"t": np.arange(3) * 20_000, "position": np.ones((3, 3)), "move": np.zeros((3, 3), np.int8)}
    write_events(tmp_path / name, some_recording(flight=flight, contrast=0.03))
    found = read_events(tmp_path / name)
    assert found.contrast == 0.03 and found.flight is not None
    assert all(np.array_equal(found.flight[key], flight[key]) for key in flight)


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.txt"])
def test_clocks_since_1970_are_kept(tmp_path, name):
    events = some_events(begin_us=1_750_000_000_000_000, seconds=5000.0)  # longer than 32 bits of microseconds
    write_events(tmp_path / name, Recording(events, WIDTH, HEIGHT))
    assert np.array_equal(read_events(tmp_path / name).events, events)


@pytest.mark.parametrize("name", CAMERAS)
def test_what_faery_writes_is_read(tmp_path, name):
    events = some_events()
    found = read_events(written(tmp_path, name))
    assert found.size() == (WIDTH, HEIGHT)
    if name.endswith(".es"):  # it does not say when it began
        events["t"] -= events["t"][0]
    assert np.array_equal(found.events, events)


@pytest.mark.parametrize("name", WORDS)
def test_prophesees_words_are_read_as_described(tmp_path, name):
    (tmp_path / name).write_bytes(WORDS[name](some_events(), WIDTH, HEIGHT))
    found = read_events(tmp_path / name)
    assert np.array_equal(found.events, some_events()) and found.size() == (WIDTH, HEIGHT)


def test_hdf5_is_in_dsecs_layout(tmp_path):
    events = some_events()
    write_events(tmp_path / "a.h5", some_recording())
    with h5py.File(tmp_path / "a.h5") as opened:
        t, index = opened["events/t"][:], opened["ms_to_idx"][:].astype(int)
        assert opened["t_offset"][()] == events["t"][0]
        assert [opened[f"events/{key}"].dtype.name for key in "xypt"] == ["uint16", "uint16", "uint8", "uint32"]
    for millisecond, first in enumerate(index):
        assert t[first] >= 1000 * millisecond
        assert millisecond == 0 or t[first - 1] < 1000 * millisecond


def test_dsecs_own_files_are_read(tmp_path):
    """Without a size, its index and offset at the top, compressed with Blosc."""
    plugin, events = require_extra("hdf5plugin", extra="events"), some_events()
    since = (events["t"] - events["t"][0]).astype(np.uint32)
    with h5py.File(tmp_path / "events.h5", "w") as opened:
        columns = {"x": events["x"], "y": events["y"], "p": (events["p"] > 0).astype(np.uint8), "t": since}
        for key, column in columns.items():
            opened.create_dataset(f"events/{key}", data=column, **plugin.Blosc(cname="zstd"))
        opened["t_offset"] = np.int64(events["t"][0])
        opened["ms_to_idx"] = np.searchsorted(since, 1000 * np.arange(2000)).astype(np.uint64)
    found = read_events(tmp_path / "events.h5", size=(640, 480))
    assert np.array_equal(found.events, events) and found.size() == (640, 480)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("", "{s:.6f} {x} {y} {on}"),
        ("# x y polarity t[ns]\n", "{x} {y} {on} {ns}"),
        ("timestamp,x,y,p\n", "{t},{x},{y},{p}"),
        (f"t,x@{WIDTH},y@{HEIGHT},on\r\n", "{t},{x},{y},{on}"),
    ],
)
def test_texts_of_other_programs_are_read(tmp_path, head, row):
    events = some_events()
    rows = [row.format(t=t, s=t / 1e6, ns=1000 * t, x=x, y=y, p=p, on=int(p > 0)) for t, x, y, p in events.tolist()]
    (tmp_path / "a.csv").write_text(head + "\n".join(rows) + "\n")
    unit = None if "ns" in head else "s" if not head else "us"
    assert np.array_equal(read_events(tmp_path / "a.csv", time_unit=unit).events, events)


def test_the_order_of_columns_can_be_given(tmp_path):
    (tmp_path / "a.txt").write_text("3 4 1 1000\n5 6 0 2000\n")
    found = read_events(tmp_path / "a.txt", columns="x,y,p,t", time_unit="us").events
    assert found.tolist() == [(1000, 3, 4, 1), (2000, 5, 6, -1)]
    with pytest.raises(ConfigError, match="must be t, x, y and p in some order"):
        read_events(tmp_path / "a.txt", columns="x,y,t")


def test_a_structured_array_in_an_npz_is_read(tmp_path):
    np.savez(tmp_path / "a.npz", events=some_events(), time_unit="us")
    assert np.array_equal(read_events(tmp_path / "a.npz").events, some_events())


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.txt", "evt2.raw", "evt3.raw", "a.dat", "a.aedat4"])
def test_a_file_that_was_cut_off_is_refused_by_name(tmp_path, name):
    if name in CAMERAS:
        file = written(tmp_path, name)
    else:
        file = tmp_path / name
        write_events(file, some_recording())
    whole = file.read_bytes()
    # Within the last event of words that follow each other; in the middle of what is packed.
    at = -1 if file.suffix in (".raw", ".dat") else -3 if file.suffix == ".txt" else len(whole) // 2
    file.write_bytes(whole[:at])
    with pytest.raises(ConfigError, match=f"'{file}' .*(damaged|no .npz file|must hold 4 numbers)"):
        read_events(file)


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.txt", "a.raw", "a.dat", "a.aedat4", "a.es"])
@pytest.mark.parametrize("content", [b"", b"\x8f\x00\xff" * 999])
def test_what_is_no_such_file_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=str(tmp_path / name)):
        read_events(tmp_path / name)


def test_an_index_that_is_not_that_of_the_times_is_refused(tmp_path):
    write_events(tmp_path / "a.h5", some_recording())
    with h5py.File(tmp_path / "a.h5", "a") as opened:
        opened["ms_to_idx"][500] += 1
    with pytest.raises(ConfigError, match="'.*' is damaged: its ms_to_idx names event .* for millisecond 500"):
        read_events(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.raw", b"% evt 2.1\n% end\n" + bytes(8), "is EVT 2.1; EVT 2.0 and 3.0 are read"),
        ("a.raw", b"% evt 3.0\n% end\n" + bytes(8), "does not say how large the image is; give --size W H"),
        ("a.bag", b"", "is of no kind that is read"),
        ("a.txt", b"1 2 3\n", "must hold 4 numbers, t, x, y, p; line 1, '1 2 3', does not"),
        ("a.txt", b"# t x y p\n", "holds no events"),
        ("a.npz", b"no archive", "is no .npz file, which is an archive"),
    ],
)
def test_what_cannot_be_read_says_what_can(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        read_events(tmp_path / name)


def test_a_size_that_is_given_stands_in_for_a_header(tmp_path):
    header, words = WORDS["evt3.raw"](some_events(), WIDTH, HEIGHT).split(b"% end\n", 1)
    (tmp_path / "a.raw").write_bytes(b"% evt 3.0\n% end\n" + words)
    assert read_events(tmp_path / "a.raw", size=(640, 480)).size() == (640, 480)
    (tmp_path / "b.raw").write_bytes(header + b"% end\n" + words)
    with pytest.raises(ConfigError, match="says that its image is 64 x 48, not 640 x 480"):
        read_events(tmp_path / "b.raw", size=(640, 480))


def test_a_pickle_is_never_opened(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.array([print], dtype=object))
    with pytest.raises(ConfigError, match="holds pickled objects, which are never loaded"):
        read_events(tmp_path / "a.npz")


def test_nothing_is_left_of_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(ConfigError, match="must end in .h5, .hdf5, .npz, .txt"):
        write_events(tmp_path / "a.aedat4", some_recording())
    with pytest.raises(ConfigError, match="cannot be written"):
        write_events(tmp_path / "none" / "a.npz", some_recording())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "package"), [("a.h5", "h5py"), ("a.es", "faery"), ("a.aedat4", "lz4.frame")])
def test_a_missing_package_names_its_extra(tmp_path, monkeypatch, name, package):
    if name in CAMERAS:
        written(tmp_path, name)
    else:
        (tmp_path / name).write_bytes(b"")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=r"pip install 'edqn-jax\[events\]'"):
        read_events(tmp_path / name)


def test_recordings_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        some_recording().width = 3  # type: ignore[misc]
