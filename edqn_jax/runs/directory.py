"""Run directories: the names of their files, and when a run may write into a folder."""

from __future__ import annotations

import contextlib
import csv
import datetime
import json
import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import edqn_jax
from edqn_jax.config import Config
from edqn_jax.config.loading import apply, load_layer, to_yaml
from edqn_jax.errors import ConfigError
from edqn_jax.runs.files import check_can_make, unwritable, write_atomically
from edqn_jax.runs.lock import LOCK, Lock

Resume = Literal["auto", "never", "must"]

TRAJECTORY_COLUMNS = (
    "t", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "action", "reward", "clearance",
)  # fmt: skip
"""Columns of `trajectory.csv`, one row a physics step: seconds, metres, a unit quaternion, m/s, the action's
number, the reward of the decision and the distance of the body's sphere from the nearest shape."""

EPISODE_COLUMNS = ("step", "return", "length", "outcome")
"""Columns of `episodes.csv`: decisions of all environments when the episode ended, undiscounted return,
decisions of the episode, and how it ended."""


_VERSION = "# edqn_jax "
"""Beginning of the first line of a `config.yaml`."""

SEED_FOLDER = "seed-"
"""Beginning of the name of a seed's folder within that of several."""


@dataclass(frozen=True)
class RunDirectory:
    """A run directory. `create` makes it on disk."""

    path: Path
    must_be_new: bool = False
    """Whether `create` refuses an existing folder: another run may have created it meanwhile."""

    @property
    def config_file(self) -> Path:
        return self.path / "config.yaml"

    @property
    def metrics_file(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def episodes_file(self) -> Path:
        return self.path / "episodes.csv"

    @property
    def summary_file(self) -> Path:
        return self.path / "summary.json"

    @property
    def trajectory_file(self) -> Path:
        return self.path / "trajectory.csv"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    def of_seed(self, seed: int) -> RunDirectory:
        """Returns the folder of one seed's run, where several are trained in one program."""
        return RunDirectory(self.path / f"{SEED_FOLDER}{seed}")

    def create_for_seeds(self, configs: Sequence[Config]) -> Lock:
        """Creates the folder with the first seed's `config.yaml`, and that of every seed within it, as `create`.

        Raises:
            ConfigError: as `create`.
        """
        with self._made() as lock:
            write_atomically(self.config_file, config_text(configs[0]))
        for config in configs:
            with self.of_seed(config.train.seed).create(config):
                pass  # the lock of all is enough
        return lock

    def create(self, config: Config) -> Lock:
        """Creates the folder with `config.yaml` and the header of `episodes.csv`, and locks it for this run.

        Deletes the files of an earlier run in it; `plan_run_directory` has checked that this is wanted.

        Raises:
            ConfigError: if it cannot be written, exists although it `must_be_new`, or another run goes on in it.
        """
        with self._made() as lock:
            for folder in (self.figures, self.checkpoints):
                folder.mkdir()
            write_atomically(self.config_file, config_text(config))
            write_atomically(self.episodes_file, ",".join(EPISODE_COLUMNS) + "\n")
        return lock

    @contextlib.contextmanager
    def _made(self) -> Iterator[Lock]:
        """Makes and locks the folder, without what an earlier run of one seed or several left in it.

        Raises:
            ConfigError: if it, or what the block makes in it, cannot be made, or another run goes on in it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=not self.must_be_new)
            with contextlib.ExitStack() as unlocked_on_error:
                lock = unlocked_on_error.enter_context(Lock(self.path))
                for file in (self.metrics_file, self.episodes_file, self.summary_file, self.trajectory_file):
                    file.unlink(missing_ok=True)
                for folder in (self.figures, self.checkpoints, *self.path.glob(f"{SEED_FOLDER}*")):
                    shutil.rmtree(folder, ignore_errors=True)
                yield lock
                unlocked_on_error.pop_all()
        except FileExistsError as error:
            if self.must_be_new:
                raise ConfigError(f"another run has just created '{self.path}'; start this one again") from None
            raise unwritable(self.path, f"'{error.filename}' is in the way; move it away") from None
        except OSError as error:
            raise unwritable(self.path, error.strerror) from None

    def append_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Adds one line to `metrics.jsonl`."""
        with self.metrics_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(plain(metrics), allow_nan=False) + "\n")

    def append_episodes(self, episodes: Iterable[tuple[int, float, int, str]]) -> None:
        """Adds rows of `EPISODE_COLUMNS` to `episodes.csv`."""
        with self.episodes_file.open("a", encoding="utf-8", newline="") as file:
            rows = ((int(step), f"{gain:.6g}", int(length), outcome) for step, gain, length, outcome in episodes)
            csv.writer(file, lineterminator="\n").writerows(rows)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes `summary.json` atomically; a run that has one is finished.

        Raises:
            ConfigError: if it cannot be written.
        """
        write_atomically(self.summary_file, json.dumps(plain(summary), indent=2, allow_nan=False) + "\n")

    def write_trajectory(self, columns: Mapping[str, np.ndarray]) -> None:
        """Writes `trajectory.csv` from one [T] array for each of `TRAJECTORY_COLUMNS`.

        Raises:
            ConfigError: if it cannot be written.
        """
        table = np.stack([np.asarray(columns[name], np.float64) for name in TRAJECTORY_COLUMNS], axis=1)
        lines = [",".join(TRAJECTORY_COLUMNS), *(",".join(f"{value:.7g}" for value in row) for row in table)]
        write_atomically(self.trajectory_file, "\n".join(lines) + "\n")

    def read_metrics(self) -> list[dict[str, Any]]:
        """Returns the lines of `metrics.jsonl`."""
        return [json.loads(line) for line in self.metrics_file.read_text(encoding="utf-8").splitlines()]

    def read_episodes(self) -> dict[str, np.ndarray]:
        """Returns the columns of `episodes.csv`, each [episodes]."""
        with self.episodes_file.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))[1:]
        kinds = (np.int64, np.float64, np.int64, np.str_)
        return {
            name: np.array([row[column] for row in rows], dtype=np.str_).astype(kind)
            for column, (name, kind) in enumerate(zip(EPISODE_COLUMNS, kinds, strict=True))
        }


def plan_run_directory(given: Path | None, config: Config, resume: Resume = "auto") -> RunDirectory:
    """Returns the folder that a run may write into, without creating it.

    Args:
        given: the folder asked for; None is a new, dated one under `runs/`.
        config: gives the world and the seed for the name of a new folder.
        resume: `never` restarts an unfinished run; `auto` and `must` refuse it, since it cannot be continued yet.

    Raises:
        ConfigError: if the folder holds other files or a finished run, cannot be written, or holds no run
            although `resume` is `must`.
    """
    if given is None:
        if resume == "must":
            raise ConfigError("--resume must needs --run-dir, the folder of the run to continue")
        return RunDirectory(_fresh(Path("runs"), config), must_be_new=True)
    run = RunDirectory(given)
    try:
        taken = given.exists()
    except OSError as error:  # a name that the file system does not accept
        raise unwritable(given, error.strerror) from None
    if taken and not given.is_dir():
        raise ConfigError(f"--run-dir '{given}' is a file; give a folder")
    occupied = taken and any(path.name != LOCK for path in given.iterdir())
    if occupied and not _is_ours(run.config_file):
        raise ConfigError(f"--run-dir '{given}' holds files that are not an edqn run; give a new or empty folder")
    if run.summary_file.is_file():
        raise ConfigError(f"--run-dir '{given}' holds a finished run; give another folder")
    if resume == "must" and not occupied:
        raise ConfigError(f"--resume must: there is no run to continue in '{given}'")
    if occupied and resume != "never":
        raise ConfigError(
            f"--run-dir '{given}' holds an unfinished run, which this version cannot continue; "
            "give another folder, or --resume never to start it over"
        )
    check_can_make(given)
    return run


def config_text(config: Config) -> str:
    """Returns the content of a run's `config.yaml`: the version of this package, and every option."""
    return f"{_VERSION}{edqn_jax.__version__}\n{to_yaml(config)}"


def version_of(config_file: Path) -> str | None:
    """Returns the version of this package that wrote a `config.yaml`; None where it does not say."""
    try:
        first = config_file.read_text(encoding="utf-8").partition("\n")[0]
    except (OSError, UnicodeDecodeError):
        return None
    return first.removeprefix(_VERSION).strip() if first.startswith(_VERSION) else None


def plain(value: Any) -> Any:
    """Returns `value` as plain JSON data: NumPy and JAX arrays as numbers and lists, NaN and Inf as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _fresh(parent: Path, config: Config) -> Path:
    check_can_make(parent)
    date = datetime.datetime.now().strftime("%Y-%m-%d")
    base = f"{date}-{Path(config.world.name).stem}-s{config.train.seed}"
    path, number = parent / base, 2
    while path.exists():
        path, number = parent / f"{base}-{number}", number + 1
    return path


def _is_ours(config_file: Path) -> bool:
    """Returns whether `config.yaml` is a configuration of this package."""
    try:
        apply(Config(), load_layer(config_file), str(config_file))
    except ConfigError:
        return False
    return True
