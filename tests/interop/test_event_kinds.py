"""Each kind of trouble in files of events: the right events, or a sentence that is true of the file."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.recordings.event_files import read_events
from edqn_jax.interop.recordings.prophesee_words import EVT3
from edqn_jax.sim.sensors.event_field import STREAM_DTYPE
from tests.oracles import event_words
from tests.oracles.aedat4_bytes import aedat4
from tests.support.interop.recordings import HEIGHT, WIDTH, some_events

faery = require_extra("faery", extra="events")
h5py = require_extra("h5py", extra="events")

SIZE = (WIDTH, HEIGHT)

DAT_HEADER = b"% Data file containing CD events.\n% Version 2\n% Height 48\n% Width 64\n"

EVT2_HEADER, EVT3_HEADER = b"% evt 2.0\n% geometry 64x48\n% end\n", b"% evt 3.0\n% geometry 64x48\n% end\n"


def at_times(*times: int) -> np.ndarray:
    events = np.zeros(len(times), STREAM_DTYPE)
    events["t"], events["x"], events["p"] = times, np.arange(len(times)), 1
    return events


def high2(microseconds: int) -> int:
    return 0x8 << 28 | microseconds >> 6


def event2(microseconds: int) -> int:
    return 0x1 << 28 | (microseconds & 63) << 22 | 5 << 11 | 7


def raw2(*words: int, header: bytes = EVT2_HEADER) -> bytes:
    return header + struct.pack(f"<{len(words)}I", *words)


def raw3(*words: int) -> bytes:
    return EVT3_HEADER + struct.pack(f"<{len(words)}H", *words)


def refusal(file: Path, **options) -> str:
    with pytest.raises(ConfigError) as refused:
        read_events(file, **options)
    said = str(refused.value)
    assert str(file) in said
    return said.replace(str(file), "FILE")


@pytest.mark.parametrize(
    ("name", "content", "times", "out_of_order", "left_out"),
    [
        # The clock's upper bits repeat an older value, and are right again before the next event.
        ("slip.raw", raw2(high2(640), event2(640), high2(704), high2(640), high2(704), event2(710)), [640, 710], 0, 0),
        # They are still old when an event comes.
        ("back.raw", raw2(high2(704), event2(704), high2(640), event2(645)), [645, 704], 1, 0),
        ("slip3.raw", raw3(0x8005, 1, 0x6009, 0x2001, 0x8006, 0x8005, 0x8006, 0x6001, 0x2002), [20489, 24577], 0, 0),
        ("wrap2.raw", raw2(high2(2**34 - 64), event2(0), high2(0), event2(3)), [2**34 - 64, 2**34 + 3], 0, 0),
        ("wrap3.raw", raw3(0x8FFF, 1, 0x6001, 0x2001, 0x8000, 0x6001, 0x2002), [4095 * 4096 + 1, 2**24 + 1], 0, 0),
        ("early2.raw", raw2(event2(1), event2(2), high2(640), event2(641)), [641], 0, 2),
        ("early3.raw", raw3(0x6007, 3, 0x2005, 0x82DC, 0x6064, 20, 0x200A), [2998372], 0, 1),
        ("percent.raw", raw2(0x80000025, event2(2373), header=EVT2_HEADER[:-6]), [37 * 64 + 5], 0, 0),
        ("text.raw", raw2(0x80002025, 0x10000000 | 5 << 11 | 10, header=EVT2_HEADER[:-6]), [0x2025 * 64], 0, 0),
        ("sign.raw", raw2(0x80414125, 0x10000000 | 5 << 11 | 10, header=EVT2_HEADER[:-6]), [0x414125 * 64], 0, 0),
        # An older value of before the clock began again.
        ("over3.raw", raw3(0x8FFF, 1, 0x2001, 0x8000, 0x8FFF, 0x6FFF, 0x2002), [2**24 - 4096, 2**24 - 1], 0, 0),
        ("CAPITALS.RAW", raw2(high2(640), event2(641)), [641], 0, 0),
        ("order.dat", event_words.dat(at_times(0, 2000, 1000, 3000), DAT_HEADER), [0, 1000, 2000, 3000], 1, 0),
        ("2d.dat", event_words.dat(at_times(0, 1000), DAT_HEADER, kind=0), [0, 1000], 0, 0),
        ("wrap.DAT", event_words.dat(at_times(2**32 - 5, 6), DAT_HEADER), [2**32 - 5, 2**32 + 6], 0, 0),
        ("overlap.aedat4", aedat4([(0, at_times(0, 100)), (0, at_times(50))], ["a"], 64, 48), [0, 50, 100], 1, 0),
        ("within.aedat4", aedat4([(0, at_times(0, 200, 100))], ["a"], 64, 48, compression=3), [0, 100, 200], 1, 0),
        ("plain.AEDAT4", aedat4([(0, at_times(0, 9))], ["a"], 64, 48, compression=0), [0, 9], 0, 0),
    ],
)  # fmt: skip
def test_times_of_cameras_are_those_that_the_file_has(tmp_path, name, content, times, out_of_order, left_out):
    (tmp_path / name).write_bytes(content)
    found = read_events(tmp_path / name)
    assert found.events["t"].tolist() == times
    assert (found.out_of_order, found.left_out) == (out_of_order, left_out)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.dat", event_words.dat(at_times(6_000_000, 6_005_000, 1_000_000), DAT_HEADER), "time goes back by 5.005 s"),
        ("a.dat", event_words.dat(at_times(0, 1_801_000_000, 1000), DAT_HEADER), "time goes back by 1801 s at event 2"),
        ("a.raw", raw2(high2(9_000_000), event2(0), high2(64), event2(0)), "time goes back by 8.99"),
        ("a.aedat4", aedat4([(0, at_times(5_000_000)), (0, at_times(0))], ["a"], 64, 48), "time goes back by 5 s"),
        ("a.aedat4", aedat4([(0, at_times(0))], ["left", "right"], 64, 48), "2 streams of events, 0 'left', 1 'right'"),
        ("a.aedat4", aedat4([(0, at_times(0))], [], 64, 48), "has no stream of events"),
        ("a.aedat4", b"#!AER-DAT3.1\r\n", "does not begin as an AEDAT4 does"),
        ("a.raw", raw3(1, 0x2001), "no word that says the time of its 1 events"),
        ("a.dat", event_words.dat(at_times(0), b"% Version 1\n"), "is DAT 1; DAT 2 is read"),
        ("a.dat", event_words.dat(at_times(0), DAT_HEADER, kind=14), "holds events of type 14"),
        ("a.dat", event_words.dat(at_times(0), b""), "has no header of Prophesee's"),
        ("a.dat", DAT_HEADER + bytes([12, 8]), "holds no events"),
    ],
)  # fmt: skip
def test_what_no_clock_of_a_camera_shows_is_refused(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    assert says in refusal(tmp_path / name)


def test_a_stream_of_several_can_be_chosen(tmp_path):
    packets = [(0, at_times(0, 10)), (1, at_times(5)), (0, at_times(20))]
    (tmp_path / "a.aedat4").write_bytes(aedat4(packets, ["left", "right"], 64, 48))
    assert read_events(tmp_path / "a.aedat4", stream=0).events["t"].tolist() == [0, 10, 20]
    assert read_events(tmp_path / "a.aedat4", stream=1).events["t"].tolist() == [5]
    assert "no stream of events 2; it has 0 'left', 1 'right'" in refusal(tmp_path / "a.aedat4", stream=2)


@pytest.mark.parametrize("name", ["evt2", "evt3"])
def test_long_recordings_count_on_when_the_clock_begins_again(tmp_path, name):
    """24 bits of EVT3 are 16.8 s, and 34 bits of EVT2 end within this recording."""
    events = some_events(20_000, seconds=70.0, begin_us=2**34 - 30_000_000)
    of_clock = events.copy()
    of_clock["t"] %= 2**34 if name == "evt2" else 2**24
    (tmp_path / "a.raw").write_bytes(getattr(event_words, name)(of_clock, *SIZE))
    found = read_events(tmp_path / "a.raw").events
    assert np.array_equal(found["t"] - found["t"][0], events["t"] - events["t"][0])


def test_words_of_many_columns_are_decoded_as_faery_does(tmp_path):
    rng = np.random.default_rng(0)
    words = []
    for high in range(300):
        words += [0x8000 | high, 0x6000 | high]
        for row in rng.integers(0, 480, 3).tolist():
            words += [row, 0x2000 | row, 0x3000 | int(rng.integers(2)) << 11 | row, 0xA001, 0xE000]
            words += [kind << 12 | int(rng.integers(256)) for kind in rng.choice([0x4, 0x5], 6).tolist()]
    content = np.array(words, "<u2")
    (tmp_path / "a.raw").write_bytes(EVT3_HEADER.replace(b"64x48", b"2048x480") + content.tobytes())
    wanted = np.concatenate(list(faery.events_stream_from_file(tmp_path / "a.raw", version_fallback="evt3")))
    found = EVT3.decode(content)
    assert len(wanted) > 3000
    for ours, theirs in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        assert np.array_equal(getattr(found, ours), wanted[theirs])


def text(form: str, head: str = "", end: str = "\n") -> bytes:
    rows = [
        form.format(t=t, s=t * 1e-6, ns=1000 * t, x=x, y=y, p=p, on=int(p > 0), word=p > 0)
        for t, x, y, p in some_events().tolist()
    ]
    return (head + end.join(rows) + end).encode()


@pytest.mark.parametrize(
    ("content", "options"),
    [
        (text("{t} {x} {y} {on}"), {"time_unit": "us"}),
        (text("{t},{x},{y},{word}", "timestamp,x,y,polarity\n"), {"time_unit": "us"}),
        (text("{t},{x},{y},{word}", "timestamp,x,y,polarity\n").lower(), {"time_unit": "us"}),
        (text("{t} {x} {y} {on}", "64 48\n"), {"time_unit": "us"}),
        (text("{x},{y},{on},{t}", "%geometry:64,48\n%camera:3\n"), {"columns": "x,y,p,t", "time_unit": "us"}),
        (text("{x},{y},{on},{t}", "X,Y,Pol,Timestamp (us)\n"), {}),
        (text("{t};{x};{y};{p:+d}", "\ufefft_us;x;y;p\r\n", "\r\n"), {}),
        (text("{s:.6f}\t{x}.0\t{y}.0\t{on}"), {"time_unit": "s"}),
        (text("{s:.6f} {x} {y} {on}", "# by v2e\n# Format is time (float s), x, y, polarity\n"), {"time_unit": "s"}),
        (text("{ns},{x},{y},{on}", '"ts_ns","x","y","p"\n'), {}),
        (text("{x},{y},{on},{t}", "a,b,c,d\n"), {"columns": "x,y,p,t", "time_unit": "us"}),
    ],
)
def test_texts_of_every_shape_are_read_rightly(tmp_path, content, options):
    (tmp_path / "a.CSV").write_bytes(content)
    found = read_events(tmp_path / "a.CSV", **options)
    assert np.array_equal(found.events, some_events())
    assert found.width == (WIDTH if b"64" in content[:20] else None)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (text("{x} {y} {t} {on}"), "does not name its columns, which may be x,y,t,p; give --columns"),
        (text("{x} {y} {s} {on}"), "which may be x,y,t,p; give --columns"),
        (text("{x},{y},{on},{t}"), "which may be x,y,p,t; give --columns"),
        (text("{on} {t} {x} {y}"), "which may be p,t,x,y; give --columns"),
        # Columns that sweep over the image rise like times.
        ("".join(f"{i // 9} {i % 48} {i * 37} {i % 2}\n" for i in range(500)).encode(), "may be t,x,y,p or x,"),
        (b"1 3 5 0\n2 4 6 1\n", "which may be "),
        (text("{t} {x} {y} 255"), "has the polarities 0 and 1, or -1 and 1, alone; the last one has 255"),
        (text("{t},{x},{y},{on}", "width,height\n64,48\n"), "line 1 of 'FILE', 'width,height', is neither"),
        (text("{t},{x},{y},{on}", "4000\n"), "line 1, '4000', does not"),
        (text("{t},{x},{y},yes", "t_us,x,y,p\n"), "line 2, '1000380,3,24,yes', does not"),
        (text("{t},{x},{y},{on},7", "t_us,x,y,p,q\n"), "line 2, '1000380,3,24,1,7', does not"),
        (text("{t},{x},{y},{on}", "t,x,y,p\n"), "which may be us or ns; give --time-unit"),
        ("1 2 3 1\n".encode("utf-16"), "bytes that are not UTF-8"),
        (b"", "holds no events"),
    ],
)  # fmt: skip
def test_no_text_is_read_in_one_of_several_ways(tmp_path, content, says):
    (tmp_path / "a.txt").write_bytes(content)
    assert says in refusal(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"events": np.zeros((400, 4))}, "not in DSEC's layout, .* holds events \\[400, 4\\]"),
        ({"davis/left/events": np.zeros((400, 4))}, "not in DSEC's layout, .* holds davis/left/events \\[400, 4\\]"),
        ({"CD/events": np.zeros(4, STREAM_DTYPE)}, "holds CD/events \\[4\\] of t, x, y, p"),
        ({}, "it holds nothing"),
        ({"t_offset": np.zeros(0, np.int64)}, "the t_offset of 'FILE' must be one number, not an array \\[0\\]"),
        ({"t_offset": "soon"}, "the t_offset of 'FILE' must be one number, not 'soon'"),
        ({"t_offset": 0.5}, "must be a whole number, not 0.5"),
        ({"ms_to_idx": np.zeros(0, np.int64)}, "does not say the unit of its times"),
    ],
)
def test_other_hdf5_is_refused_as_what_it_is(tmp_path, changes, says):
    with h5py.File(tmp_path / "a.H5", "w") as opened:
        if set(changes) & {"t_offset", "ms_to_idx"}:
            for key in "txyp":
                opened[f"events/{key}"] = some_events()[key]
        for key, value in changes.items():
            opened[key] = value
    with pytest.raises(ConfigError, match=says.replace("FILE", str(tmp_path / "a.H5"))):
        read_events(tmp_path / "a.H5", time_unit="us" if "t_offset" in changes else None)


@pytest.mark.parametrize("names", ["txyp", ("ts", "xs", "ys", "ps"), ("timestamp", "x", "y", "polarity")])
@pytest.mark.parametrize("order", ["<", ">"])
def test_columns_of_other_names_and_byte_orders_are_read(tmp_path, names, order):
    events = some_events()
    columns = [events[key].astype(events[key].dtype.newbyteorder(order)) for key in "txyp"]
    held: Any = dict(zip(names, columns, strict=True))
    with h5py.File(tmp_path / "a.h5", "w") as opened:
        for name, column in held.items():
            opened[f"events/{name}"] = column
        opened["t_offset"] = [7]
        opened["events"].attrs["width"], opened["events"].attrs["height"] = [64], [48]
    np.savez(tmp_path / "a.npz", **held, width=[64], height=[48], time_unit=["us"])
    (tmp_path / "a.npz").rename(tmp_path / "A.NPZ")
    structured = np.rec.fromarrays(columns, dtype=[(name, column.dtype) for name, column in held.items()])
    np.savez(tmp_path / "b.npz", arr_0=structured, time_unit=np.bytes_(b"us"))
    for file, offset in (("a.h5", 7), ("A.NPZ", 0), ("b.npz", 0)):
        found = read_events(tmp_path / file, time_unit="us", size=SIZE if file == "b.npz" else None)
        assert np.array_equal(found.events["t"] - offset, events["t"]) and found.size() == SIZE
        assert all(np.array_equal(found.events[key], events[key]) for key in "xyp")


@pytest.mark.parametrize(
    ("held", "says"),
    [
        ({"left": some_events(), "right": some_events()}, "must have arrays t, x, y and p, or one structured array"),
        ({"events": np.zeros((9, 4))}, "it holds events [9, 4]"),
        ({key: some_events()[key] for key in "txyp"} | {"width": [], "height": 3}, "width of 'FILE' must be one"),
        ({key: some_events()[key][:, None] for key in "txyp"}, "must be columns of one length"),
        ({key: some_events()[key] for key in "txyp"} | {"time_unit": ["day"]}, "its times are in 'day'"),
    ],
)  # fmt: skip
def test_other_npz_is_refused_as_what_it_is(tmp_path, held, says):
    np.savez(tmp_path / "a.npz", **held)
    assert says in refusal(tmp_path / "a.npz", time_unit=None if "time_unit" in held else "us")


def test_a_single_array_is_no_archive(tmp_path):
    with (tmp_path / "a.npz").open("wb") as opened:
        np.save(opened, some_events())
    assert "is no .npz file" in refusal(tmp_path / "a.npz")


def test_every_event_behind_a_later_one_is_counted(tmp_path):
    """The second packet of 100 begins before the first ends: all but its first step forward."""
    t = np.concatenate((np.arange(0, 10_000, 10), np.arange(9_005, 12_005, 10)))
    ones = np.ones(len(t), np.int64)
    np.savez(tmp_path / "a.npz", t=t, x=ones, y=ones, p=ones, time_unit="us")
    found = read_events(tmp_path / "a.npz")
    assert found.out_of_order == 99
    assert np.array_equal(found.events["t"], np.sort(t))
