"""A training's metrics as it runs: in TensorBoard, in Weights & Biases offline, and with its flights in Rerun.

Each of the three is a callback of `edqn_jax.train`:

    import edqn_jax
    from edqn_jax.interop.tracking import TensorBoard

    edqn_jax.train(edqn_jax.make_config("paper"), callback=TensorBoard("runs/board"))

They need the extra `track` (`tensorboardX`, `wandb`) or `viz` (`rerun-sdk`). `Sinks` keeps a run from what they raise.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from edqn_jax.config import Config
from edqn_jax.extras import SINKS, require_extra
from edqn_jax.report.style import OUTCOME_COLOURS
from edqn_jax.report.worlds.solids import solids_of_shape, standing_rows
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.loop import Chunk


class Sink(Protocol):
    """A callback that is closed at the end of a training."""

    def __call__(self, chunk: Chunk) -> None:
        """Writes a chunk's metrics."""

    def close(self) -> None:
        """Writes what is still to be written."""


Maker = Callable[[int], Sink]
"""Makes the sink of an agent, by its number among those that train in one program."""


class Sinks:
    """Callback that passes every chunk to sinks, made at the first; one that fails is left out, with one warning."""

    def __init__(self, makers: Mapping[str, Maker], warn: Callable[[str], None]) -> None:
        """Makes no sink yet, so that nothing is written before the run's own files.

        Args:
            makers: by the names that a warning uses.
            warn: is given a sentence.
        """
        self._makers, self._warn = dict(makers), warn
        self._made: dict[tuple[str, int], Sink] = {}

    def __call__(self, chunk: Chunk) -> None:
        """Passes a chunk on; raises nothing."""
        for name in list(self._makers):
            self._tried(name, lambda name=name: self._sink(name, chunk.agent)(chunk))

    def close(self) -> None:
        """Closes every sink; raises nothing."""
        for (name, _), sink in list(self._made.items()):
            if name in self._makers:
                self._tried(name, sink.close)
        self._made.clear()

    def _sink(self, name: str, agent: int) -> Sink:
        if (name, agent) not in self._made:
            self._made[name, agent] = self._makers[name](agent)
        return self._made[name, agent]

    def _tried(self, name: str, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # whatever other people's packages raise, the run goes on
            self._makers.pop(name, None)
            said = str(error).strip().partition("\n")[0] or type(error).__name__
            self._warn(f"{name} failed and gets nothing more; training goes on: {said}")


class TensorBoard:
    """Writes metrics as TensorBoard's event files."""

    def __init__(self, folder: str | Path) -> None:
        """Writes into `folder`, by `tensorboardX`.

        Raises:
            MissingPackageError: if it is not installed.
        """
        self._package, self._folder = require_extra(*SINKS["tensorboard"]), Path(folder)
        self._writer: Any = None

    def __call__(self, chunk: Chunk) -> None:
        """Adds the chunk's numbers at its decisions."""
        step = chunk.metrics["decisions"]
        if self._writer is None:
            # What an interrupted run wrote after its last checkpoint is written once more: drop it.
            self._writer = self._package.SummaryWriter(str(self._folder), purge_step=step)
        for name, value in numeric_metrics(chunk.metrics).items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self) -> None:
        """Closes the event file."""
        if self._writer is not None:
            self._writer.close()


class Wandb:
    """Writes metrics as an offline run of Weights & Biases, which `wandb sync FOLDER` uploads."""

    def __init__(self, folder: str | Path, config: Config | None = None, name: str | None = None) -> None:
        """Begins a run in `folder`/wandb; needs no account and no network.

        Args:
            folder: must exist.
            config: options that the run shows.
            name: of the run.

        Raises:
            MissingPackageError: if `wandb` is not installed.
        """
        wandb = require_extra(*SINKS["wandb"])
        self._run = wandb.init(
            mode="offline",
            dir=str(folder),
            project="edqn_jax",
            name=name,
            config=None if config is None else dataclasses.asdict(config),
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off", x_disable_stats=True),
        )
        self.folder = Path(self._run.dir).parent
        """Of the offline run."""

    def __call__(self, chunk: Chunk) -> None:
        """Logs the chunk's numbers at its decisions."""
        self._run.log(numeric_metrics(chunk.metrics), step=chunk.metrics["decisions"])

    def close(self) -> None:
        """Ends the run."""
        self._run.finish()


class Rerun:
    """Shows metrics, the world and the validation flights in the Rerun viewer, and writes them as a recording."""

    def __init__(self, file: str | Path, spawn: bool | None = None) -> None:
        """Begins a recording.

        Args:
            file: `.rrd` to write, which `rerun FILE.rrd` opens.
            spawn: whether to open the viewer, too; by default where there is a screen.

        Raises:
            MissingPackageError: if `rerun-sdk` is not installed.
        """
        self._rerun = rerun = require_extra(*SINKS["rerun"])
        self._stream = rerun.RecordingStream("edqn_jax")
        sinks = [rerun.FileSink(str(file))]
        if _has_screen() if spawn is None else spawn:
            rerun.spawn(connect=False)
            sinks.append(rerun.GrpcSink())
        self._stream.set_sinks(*sinks)
        self._drawn = False

    def __call__(self, chunk: Chunk) -> None:
        """Logs the chunk's numbers and, of a chunk with a validation, its flights."""
        self._stream.set_time("decisions", sequence=chunk.metrics["decisions"])
        for name, value in numeric_metrics(chunk.metrics).items():
            self._stream.log(f"metrics/{name}", self._rerun.Scalars(value))
        if chunk.validation is not None:
            self._log_flight(*chunk.validation)

    def _log_flight(self, missions: Any, flights: Any) -> None:
        """Draws the world of the first mission, and the flights of all missions in it."""
        if not self._drawn:
            self._stream.log("world/solids", self._mesh(missions.scene(0)), static=True)
            self._drawn = True
        scene = np.asarray(missions.env_params.missions.scene)
        here = np.flatnonzero(scene == scene[0])
        lengths = np.asarray(flights.physics_steps)
        paths = [np.asarray(flights.record.position[i])[: int(lengths[i])] for i in here]
        kinds = [Outcome(int(flights.outcome[i])).name.lower() for i in here]
        colours = [_rgb(OUTCOME_COLOURS[kind]) for kind in kinds]
        self._stream.log("world/flights", self._rerun.LineStrips3D(paths, colors=colours, radii=0.12))
        self._stream.log("world/ends", self._rerun.Points3D([path[-1] for path in paths], colors=colours, radii=0.4))

    def _mesh(self, scene: Any) -> Any:
        """Returns the solids of a world as one mesh; of a mesh that is not convex up to 50,000 triangles."""
        corners, triangles, colours, count = [], [], [], 0
        for points, rings, colour in surfaces_of(scene):
            corners.append(points)
            triangles.append(rings + count)
            colours.append(np.tile(np.round(255 * colour).astype(np.uint8), (len(points), 1)))
            count += len(points)
        if not corners:
            return self._rerun.Clear(recursive=False)
        return self._rerun.Mesh3D(
            vertex_positions=np.concatenate(corners),
            triangle_indices=np.concatenate(triangles),
            vertex_colors=np.concatenate(colours),
        )

    def close(self) -> None:
        """Writes what is still to be written."""
        self._stream.flush()
        self._stream.disconnect()


def numeric_metrics(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Returns the numbers of a line of `metrics.jsonl` by their names, but for the decisions."""
    return {
        name: float(value)
        for name, value in metrics.items()
        if isinstance(value, int | float) and not isinstance(value, bool) and name != "decisions"
    }


def surfaces_of(scene: Any) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yields vertices [V, 3] in the world, triangles [T, 3] and colour [3] of what stands in a world."""
    for kind, shape in standing_rows(scene):
        drawn = {} if kind.page is None else kind.page(shape)
        if drawn.get("kind") == "mesh":
            turned = np.asarray(drawn["vertices"]) @ np.reshape(drawn["turn"], (3, 3)).T
            yield shape.position + turned, np.asarray(drawn["triangles"]), np.asarray(shape.albedo)
            continue
        for solid in solids_of_shape(kind, shape):
            for face in solid.faces:
                fan = [(0, k, k + 1) for k in range(1, len(face) - 1)]
                yield np.asarray(face), np.array(fan), solid.colour


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def _has_screen() -> bool:
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
