"""What sinks of a training's metrics write can be read back, and one that fails does not end a run."""

from __future__ import annotations

import importlib.util
import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edqn_jax.cli import main
from edqn_jax.config import Config
from edqn_jax.extras import require_extra
from edqn_jax.interop.tracking import Rerun, Sinks, TensorBoard, Wandb, surfaces_of
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.history import EndedEpisodes
from edqn_jax.training.loop import Chunk
from edqn_jax.training.selection import Candidate
from tests.support.box_flight import world_with_a_box
from tests.support.meshes import bracket, mesh_world

VALUES = {64: 1.5, 128: 2.5, 192: -3.0}
"""Mean return by decisions."""

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:os.fork:RuntimeWarning")


def chunk(decisions: int, value: float, agent: int = 0, validation: Any = None) -> Chunk:
    none: Any = None
    metrics = {
        "phase": "training",
        "decisions": decisions,
        "mean_return": value,
        "q_loss": None,
        "warm_up": {"kl": [1.0]},
    }
    empty = np.zeros(0, int)
    return Chunk(metrics, EndedEpisodes(empty, empty, empty, empty), Candidate(none), none, agent, validation)


def a_validation() -> Any:
    """Two flights in one world."""
    world = world_with_a_box()
    missions = SimpleNamespace(
        scene=lambda number: world, env_params=SimpleNamespace(missions=SimpleNamespace(scene=np.zeros(2, int)))
    )
    path = np.cumsum(np.full((2, 9, 3), 0.5, np.float32), axis=1)
    flights = SimpleNamespace(
        outcome=np.array([Outcome.GOAL, Outcome.COLLISION]),
        physics_steps=np.array([9, 4]),
        record=SimpleNamespace(position=path),
    )
    return missions, flights


def scalars(folder: Path) -> list[tuple[int, float]]:
    """Returns the mean returns that TensorBoard itself reads."""
    accumulator = require_extra("tensorboard.backend.event_processing.event_accumulator", "track")
    events = accumulator.EventAccumulator(str(folder))
    events.Reload()
    assert "q_loss" not in events.Tags()["scalars"]  # it has no value
    return [(event.step, event.value) for event in events.Scalars("mean_return")]


def test_tensorboard_reads_every_value_back(tmp_path: Path) -> None:
    sink = TensorBoard(tmp_path)
    for decisions, value in VALUES.items():
        sink(chunk(decisions, value))
    sink.close()
    assert scalars(tmp_path) == list(VALUES.items())


def test_tensorboard_drops_what_a_continued_run_writes_again(tmp_path: Path) -> None:
    for steps in ((64, 128, 192), (128, 192)):
        sink = TensorBoard(tmp_path)
        for decisions in steps:
            sink(chunk(decisions, VALUES[decisions]))
        sink.close()
        if steps[0] == 64:  # files are read by their names, which begin with the second in which they were made
            (file,) = tmp_path.glob("events.*")
            file.rename(file.with_name(file.name.replace("tfevents.", "tfevents.0")))
    assert scalars(tmp_path) == list(VALUES.items())


def contents(log: bytes) -> Iterator[bytes]:
    """Yields what a `.wandb` file holds: LevelDB's log format, after a header of 7 bytes."""
    block, place, parts = 32768, 7, b""
    while place + 7 <= len(log):
        if block - place % block < 7:  # the rest of a block too small for another header
            place += block - place % block
            continue
        size, kind = struct.unpack_from("<HB", log, place + 4)
        if place + 7 + size > len(log):  # still being written
            return
        parts += log[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (1, 4):  # whole, or the last part
            yield parts
            parts = b""


def whole_log(file: Path) -> list[Any]:
    """Returns the records of a `.wandb` file once it has the last, which its own process may write after `finish`."""
    record = require_extra("wandb.proto.wandb_internal_pb2", "track").Record
    until = time.monotonic() + 60.0
    while True:
        rows = [record.FromString(content) for content in contents(file.read_bytes())]
        if (rows and rows[-1].WhichOneof("record_type") == "exit") or time.monotonic() > until:
            return rows
        time.sleep(0.1)


def test_wandb_keeps_every_value_in_an_offline_run(tmp_path: Path) -> None:
    sink = Wandb(tmp_path, Config(), "a run")
    for decisions, value in VALUES.items():
        sink(chunk(decisions, value))
    sink.close()
    (file,) = sink.folder.glob("*.wandb")
    assert sink.folder.name.startswith("offline-run-") and sink.folder.parent == tmp_path / "wandb"
    found = {}
    for row in whole_log(file):
        if row.WhichOneof("record_type") == "history":
            values = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in row.history.item}
            found[values["_step"]] = values["mean_return"]
    assert found == VALUES


def test_rerun_reads_metrics_and_flights_back(tmp_path: Path) -> None:
    file = tmp_path / "training.rrd"
    sink = Rerun(file, spawn=False)
    for decisions, value in VALUES.items():
        sink(chunk(decisions, value, validation=a_validation() if decisions == 128 else None))
    sink.close()
    found: dict[str, list[Any]] = {}
    for part in require_extra("rerun.chunk", "viz").RrdReader(str(file)).stream():
        found.setdefault(part.entity_path, []).append(part.to_record_batch())
    assert {"/world/solids", "/world/flights", "/world/ends"} < set(found) and "/metrics/q_loss" not in found
    rows = {}
    for batch in found["/metrics/mean_return"]:
        (values,) = (name for name in batch.schema.names if "scalars" in name.lower())
        rows |= dict(zip(batch["decisions"].to_pylist(), batch[values].to_pylist(), strict=True))
    assert rows == {decisions: [value] for decisions, value in VALUES.items()}


def test_rerun_shows_a_mesh_itself(tmp_path: Path) -> None:
    vertices, faces = bracket()
    scene = load_scene(
        mesh_world(tmp_path, '<geom type="mesh" mesh="bracket" pos="9 5 3" euler="0 0 90"/>', bracket=(vertices, faces))
    )
    ((points, rings, _),) = surfaces_of(scene)
    turned = np.stack([-vertices[:, 1], vertices[:, 0], vertices[:, 2]], axis=1) + [9, 5, 3]
    # To the precision of MJCF's degrees.
    np.testing.assert_allclose(points[rings].reshape(-1, 9), turned[faces].reshape(-1, 9), atol=1e-5)


def test_a_sink_that_fails_is_left_out_with_one_warning(tmp_path: Path) -> None:
    class Broken:
        def __call__(self, chunk: Chunk) -> None:
            raise OSError("no space left on device\nmore")

        def close(self) -> None:
            raise AssertionError("a sink that failed is not closed")

    said: list[str] = []
    sinks = Sinks({"wandb": lambda agent: Broken(), "tensorboard": lambda agent: TensorBoard(tmp_path)}, said.append)
    assert [sinks(chunk(decisions, value)) for decisions, value in VALUES.items()] == [None] * 3
    sinks.close()
    assert said == ["wandb failed and gets nothing more; training goes on: no space left on device"]
    assert scalars(tmp_path) == list(VALUES.items())


def test_a_sink_that_cannot_be_made_or_closed_only_warns() -> None:
    class Unclosable:
        def __call__(self, chunk: Chunk) -> None:
            pass

        def close(self) -> None:
            raise RuntimeError

    def unmade(agent: int) -> Any:
        raise PermissionError("denied")

    said: list[str] = []
    sinks = Sinks({"one": unmade, "other": lambda agent: Unclosable()}, said.append)
    sinks(chunk(64, 1.0))
    sinks.close()
    assert [text.partition(" ")[0] for text in said] == ["one", "other"]


def test_each_agent_has_a_sink_of_its_own(tmp_path: Path) -> None:
    sinks = Sinks({"tensorboard": lambda agent: TensorBoard(tmp_path / str(agent))}, pytest.fail)
    for decisions, value in VALUES.items():
        for agent in (0, 1):
            sinks(chunk(decisions, value + agent, agent))
    sinks.close()
    assert scalars(tmp_path / "1") == [(decisions, value + 1) for decisions, value in VALUES.items()]


@pytest.mark.parametrize(("flag", "package"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_a_missing_package_is_said_before_anything_is_done(flag, package, tmp_path, monkeypatch, capsys) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == package else found(name, *rest)
    )
    assert main(["train", "--track", flag, "--run-dir", str(tmp_path / "run")]) == 2
    assert f"--track {flag} needs {package}; run pip install 'edqn-jax[track]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
