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

from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, load_layer, to_yaml
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_make, write_atomically, write_error
from edqn_jax.runs.lock import LOCK, Lock
from edqn_jax.version import package_version

Resume = Literal["auto", "never", "must"]

EPISODE_COLUMNS = ("step", "return", "length", "outcome")
"""Columns of `episodes.csv`: decisions of all environments when the episode ended, undiscounted return,
decisions of the episode, and how it ended."""


_VERSION = "# edqn_jax "
"""Beginning of the first line of a `config.yaml`."""

TO_BE_DRAWN = "to be drawn"
"""What `summary.json` says of figures until they are there."""

SEED_FOLDER = "seed-"
"""Beginning of the name of a seed's folder within that of several."""


@dataclass(frozen=True)
class RunDirectory:
    """A run directory. `hold_lock` makes it on disk, `begin` writes what a run begins with."""

    path: Path
    must_be_new: bool = False
    """Whether `hold_lock` refuses an existing folder: another run may have created it meanwhile."""
    resume: Resume = "never"
    """Whether a run in it is continued: `must` refuses to begin one anew."""
    was_empty: bool = False
    """Whether `hold_lock` refuses a folder with a run in it."""

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

    @property
    def is_finished(self) -> bool:
        """Whether the run has nothing left to do: it has a summary, and its figures are drawn or cannot be."""
        try:
            return json.loads(self.summary_file.read_text(encoding="utf-8")).get("figures") != TO_BE_DRAWN
        except FileNotFoundError:
            return False
        except (OSError, ValueError, AttributeError):
            return True  # whatever it is, it is not begun anew

    @property
    def holds_results(self) -> bool:
        """Whether a new run here would delete results: a summary, a policy or a checkpoint."""
        folders = (self.checkpoints, *self.path.glob(f"{SEED_FOLDER}*/checkpoints"))
        return self.summary_file.exists() or any(any(folder.iterdir()) for folder in folders if folder.is_dir())

    def of_seed(self, seed: int) -> RunDirectory:
        """Returns the folder of one seed's run, where several are trained in one program."""
        return RunDirectory(self.path / f"{SEED_FOLDER}{seed}")

    @contextlib.contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Makes the folder if there is none, and locks it until the end of the `with` block.

        A folder that it made is deleted again if nothing has been written to it by then.

        Raises:
            ConfigError: if it cannot be made, exists although it `must_be_new`, or another run goes on in it.
        """
        there = self.path.exists()
        with contextlib.ExitStack() as held:
            try:
                self.path.mkdir(parents=True, exist_ok=not self.must_be_new)
                if not there:
                    held.callback(self._remove_if_empty)
                held.enter_context(Lock(self.path))
                if (self.is_finished and self.resume == "never") or (self.was_empty and self.config_file.exists()):
                    raise ConfigError(f"another run was made in '{self.path}' meanwhile; give another folder")
            except FileExistsError as error:
                if self.must_be_new:
                    raise ConfigError(f"another run has just created '{self.path}'; start this one again") from None
                raise write_error(self.path, f"'{error.filename}' is in the way; move it away") from None
            except OSError as error:
                raise write_error(self.path, error.strerror) from None
            yield

    def _remove_if_empty(self) -> None:
        with contextlib.suppress(OSError):
            self.path.rmdir()

    def begin(self, configs: Sequence[Config], seeds: bool = False) -> None:
        """Deletes the files of an earlier run in the locked folder, and writes those that a new one begins with.

        Args:
            configs: of each agent.
            seeds: whether each agent has a folder of its own within this one.

        Raises:
            ConfigError: if they cannot be written.
        """
        try:
            for file in (self.metrics_file, self.episodes_file, self.summary_file, self.trajectory_file):
                file.unlink(missing_ok=True)
            for folder in (self.figures, self.checkpoints, *self.path.glob(f"{SEED_FOLDER}*")):
                shutil.rmtree(folder, ignore_errors=True)
            self.checkpoints.mkdir()
            runs = [self.of_seed(config.train.seed) if seeds else self for config in configs]
            for run in runs:  # first: how many there are says how many seeds the run has
                run.path.mkdir(exist_ok=True)
            write_atomically(self.config_file, config_text(configs[0]))
            for run, config in zip(runs, configs, strict=True):
                run._begin_agent(config)
        except FileExistsError as error:
            raise write_error(self.path, f"'{error.filename}' is in the way; move it away") from None
        except OSError as error:
            raise write_error(self.path, error.strerror) from None

    def _begin_agent(self, config: Config) -> None:
        """Makes the folders of an agent's run, `config.yaml` and the header of `episodes.csv`."""
        for folder in (self.figures, self.checkpoints):
            folder.mkdir(parents=True, exist_ok=folder == self.checkpoints)
        write_atomically(self.config_file, config_text(config))
        write_atomically(self.episodes_file, ",".join(EPISODE_COLUMNS) + "\n")

    def reopen(self, configs: Sequence[Config], seeds: bool = False) -> None:
        """Prepares the locked folder of a continued run; its files are kept.

        A run that is continued beyond its end gets its new options written, and its outdated summary deleted.

        Args:
            configs, seeds: as in `begin`.

        Raises:
            ConfigError: if a file cannot be written.
        """
        runs = [self.of_seed(config.train.seed) for config in configs] if seeds else [self]
        try:
            for run, config in ((self, configs[0]), *zip(runs, configs, strict=True)):
                run.summary_file.unlink(missing_ok=True)
                if run.config_file.read_text(encoding="utf-8") != config_text(config):
                    write_atomically(run.config_file, config_text(config))
            for run in runs:
                run.figures.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(self.path, error.strerror) from None

    def append_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Adds one line to `metrics.jsonl`.

        Raises:
            ConfigError: if it cannot be written.
        """
        _append(self.metrics_file, json.dumps(to_plain_json(metrics), allow_nan=False) + "\n")

    def append_episodes(self, episodes: Iterable[tuple[int, float, int, str]]) -> None:
        """Adds rows of `EPISODE_COLUMNS` to `episodes.csv`.

        Raises:
            ConfigError: if they cannot be written.
        """
        rows = (f"{int(step)},{gain:.6g},{int(length)},{outcome}\n" for step, gain, length, outcome in episodes)
        _append(self.episodes_file, "".join(rows))

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes `summary.json` atomically.

        Raises:
            ConfigError: if it cannot be written.
        """
        write_atomically(self.summary_file, json.dumps(to_plain_json(summary), indent=2, allow_nan=False) + "\n")

    def write_trajectory(self, columns: Mapping[str, np.ndarray]) -> None:
        """Writes `trajectory.csv` from the columns [T] of `evaluation.trajectories.flight_trajectory`.

        Raises:
            ConfigError: if it cannot be written.
        """
        table = np.stack([np.asarray(column, np.float64) for column in columns.values()], axis=1)
        lines = [",".join(columns), *(",".join(f"{value:.7g}" for value in row) for row in table)]
        write_atomically(self.trajectory_file, "\n".join(lines) + "\n")

    def read_metrics(self) -> list[dict[str, Any]]:
        """Returns the lines of `metrics.jsonl`."""
        return [json.loads(line) for line in self.metrics_file.read_text(encoding="utf-8").splitlines()]

    def read_trajectory(self) -> dict[str, np.ndarray]:
        """Returns the columns of `trajectory.csv`, each [T].

        Raises:
            ValueError: if it has other columns, or something that is no number.
        """
        from edqn_jax.evaluation.trajectories import trajectory_columns  # here: it imports JAX

        with self.trajectory_file.open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
        values = sum(name.startswith("action_") for name in header)
        if tuple(header) != trajectory_columns(values or None) or not rows:
            raise ValueError("it does not have the columns of a flight")
        return dict(zip(header, np.array(rows, dtype=np.float64).T, strict=True))

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
        resume: `auto` continues an unfinished run, or a finished one of fewer decisions, and begins one where there is
            none; `must` begins none; `never` starts an unfinished run over.

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
        raise write_error(given, error.strerror) from None
    if taken and not given.is_dir():
        raise ConfigError(f"--run-dir '{given}' is a file; give a folder")
    # A run that could not write its options, on a full disk, has left empty folders.
    occupied = taken and any(path.name != LOCK and not path.is_dir() for path in given.rglob("*"))
    if occupied and not _is_ours(run.config_file):
        raise ConfigError(f"--run-dir '{given}' holds files that are not an edqn run; give a new or empty folder")
    if run.is_finished and (resume == "never" or not _asks_for_more(run, config)):
        more = "" if resume == "never" else ", or more decisions with --total-steps to continue it"
        raise ConfigError(f"--run-dir '{given}' holds a finished run; give another folder{more}")
    if resume == "must" and not occupied:
        raise ConfigError(f"--resume must: there is no run to continue in '{given}'")
    check_can_make(given)
    return RunDirectory(given, resume=resume if occupied else "never", was_empty=not occupied)


def _asks_for_more(run: RunDirectory, config: Config) -> bool:
    """Returns whether a finished run is asked for more decisions than it has taken."""
    before = apply_layer(Config(), load_layer(run.config_file), str(run.config_file))
    return config.train.total_steps > before.train.total_steps


def config_text(config: Config) -> str:
    """Returns the content of a run's `config.yaml`: the version of this package, and every option."""
    return f"{_VERSION}{package_version()}\n{to_yaml(config)}"


def version_of(config_file: Path) -> str | None:
    """Returns the version of this package that wrote a `config.yaml`; None where it does not say."""
    try:
        first = config_file.read_text(encoding="utf-8").partition("\n")[0]
    except (OSError, UnicodeDecodeError):
        return None
    return first.removeprefix(_VERSION).strip() if first.startswith(_VERSION) else None


def to_plain_json(value: Any) -> Any:
    """Returns `value` as plain JSON data: NumPy and JAX arrays as numbers and lists, NaN and Inf as None."""
    if isinstance(value, Mapping):
        return {str(key): to_plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return to_plain_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _append(file: Path, text: str) -> None:
    try:
        with file.open("a", encoding="utf-8", newline="") as opened:
            opened.write(text)
    except OSError as error:
        raise write_error(file, error.strerror) from None


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
        apply_layer(Config(), load_layer(config_file), str(config_file))
    except ConfigError:
        return False
    return True
