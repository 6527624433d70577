"""Settings of a process that are not ours, each tried with each command: variables, locales, streams.

A command does what it does without the setting, or ends with one sentence that names the variable, and exit code 2.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]

EVENTS = "recording.npz"
RUN = "run"
"""Files that `prepare` makes in the folder in which commands are run."""

HANGS_S = 240.0
"""No command may take longer."""

FRESH = "fresh"
"""Stands for a folder that no other command uses."""

TINY = (
    *("--tuned-for", "cpu", "--world", str(ROOT / "tests" / "support" / "miniature.xml"), "--env.sensor", "blind"),
    *("--num-envs", "16", "--total-steps", "512", "--agent.batch-size", "16", "--agent.replay-size", "512"),
    *("--agent.learning-starts", "64", "--train.chunk-steps", "16", "--camera.width", "8", "--camera.height", "6"),
    *("--drone.physics", "rigid_body", "--env.reward", "progress", "--agent.no-turn"),
    *("--train.validation-missions", "2", "--world.missions", "16", "--train.devices", "1"),
)
"""Flags of a training of seconds."""

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "train": ("train", *TINY, "--run-dir", FRESH),
    "evaluate": ("evaluate", RUN, "--missions", "2", "--json", FRESH + ".json"),
    "check": ("check", "paper", "--policy", RUN, "--out", FRESH + ".png"),
    "record": ("record", RUN, FRESH + ".gif"),
    "report": ("report", RUN, "--missions", "1", "--out", FRESH + ".html"),
    "verify": ("verify", RUN),
    "export": ("export", "pretrained", "--out", FRESH + ".onnx"),
    "events": ("events", EVENTS),
    "picture": ("events", EVENTS, "--size", "64", "48", "--picture", FRESH + ".png"),
    "completion": ("completion", "bash"),
    "help": ("train", "--help"),
    "version": ("--version",),
}
"""Words of each command."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One setting: variables, None for one that is not set, and what is done to the streams in a shell."""

    variables: Mapping[str, str | None]
    streams: str = ""
    codes: tuple[int, ...] = (0, 2)
    """Exit codes that are right; one of 2 needs a sentence with the name of a variable, or of the stream."""

    @property
    def name(self) -> str:
        """Returns the setting as a shell would have it."""
        words = [f"{name}={'' if value is None else value}" for name, value in self.variables.items()]
        return " ".join([*words, self.streams] if self.streams else words)


def _one(name: str, *values: str | None) -> list[Setting]:
    return [Setting({name: value}) for value in values]


SETTINGS = [
    Setting({}),
    *_one("PYTHONIOENCODING", "latin-1", "ascii", "cp1252", "utf-16"),
    *_one("LC_ALL", "C", "POSIX", "de_DE.ISO-8859-1", "xx_YY.nothing"),
    Setting({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    *(
        Setting({}, streams)
        for streams in (">&-", "2>&-", ">&- 2>&-", "<&-", "<&- >&- 2>&-", "| head -c 1", "2>&1 | true", ">/dev/full")
    ),
    *(Setting({"TERM": term, "FORCE_COLOR": "1", "NO_COLOR": no}) for term, no in (("dumb", ""), ("xterm", "1"))),
    *(Setting({"TTY_COMPATIBLE": "1", "FORCE_COLOR": "1", "COLUMNS": wide}, "| head -c 1") for wide in ("80", "0")),
    *_one("COLUMNS", "0", "10", "-3", "many", "99999"),
    *_one("PYTHONWARNINGS", "error", "always"),
    *_one("PYTHONOPTIMIZE", "2"),
    *_one("PYTHONUNBUFFERED", "1"),
    *_one("PYTHONDONTWRITEBYTECODE", "1"),
    *_one("PYTHONDEVMODE", "1"),
    *_one("MPLBACKEND", "module://matplotlib_inline.backend_inline", "module://nothing", "Qt5Agg", "x", ""),
    *_one("JAX_ENABLE_X64", "1", "maybe"),
    *_one("JAX_NUMPY_DTYPE_PROMOTION", "strict", "x"),
    *_one("JAX_NUMPY_RANK_PROMOTION", "raise", "warn"),
    *_one("JAX_TRANSFER_GUARD", "disallow", "log", "x"),
    *_one("JAX_TRANSFER_GUARD_HOST_TO_DEVICE", "disallow_explicit"),
    *_one("JAX_TRANSFER_GUARD_DEVICE_TO_HOST", "disallow"),
    *_one("JAX_DISABLE_JIT", "1"),
    *_one("JAX_DEBUG_NANS", "1", ""),
    *_one("JAX_DEBUG_INFS", "1"),
    *_one("JAX_DEBUG_KEY_REUSE", "1"),
    *_one("JAX_CHECK_TRACER_LEAKS", "1"),
    *_one("JAX_LOG_COMPILES", "1"),
    *_one("JAX_DEFAULT_MATMUL_PRECISION", "highest", "x"),
    *_one("JAX_DEFAULT_PRNG_IMPL", "rbg", "x"),
    *_one("JAX_THREEFRY_PARTITIONABLE", "0"),
    *_one("JAX_NUM_CPU_DEVICES", "3", "-3", "many"),
    *_one("JAX_ENABLE_COMPILATION_CACHE", "0"),
    *_one("JAX_COMPILATION_CACHE_DIR", "/proc/nothing", "/dev/null"),
    *_one("JAX_PLATFORMS", "cuda", "quantum", "cpu,cuda", "cuda,cpu", "", " CPU ", ",", "tpu"),
    *_one("JAX_PLATFORM_NAME", "gpu"),
    *_one("CUDA_VISIBLE_DEVICES", "", "-1", "99", "x"),
    *_one("XLA_FLAGS", "--xla_no_such_flag", "--xla_cpu_enable_fast_math=maybe", "no_such_file", " "),
    *_one("XDG_CACHE_HOME", "relative", "/dev/null", "/proc"),
    *_one("HOME", None, "/nonexistent", "/proc", ""),
    *_one("TMPDIR", "/nonexistent"),
    *_one("MPLCONFIGDIR", "/proc"),
    *_one("OMP_NUM_THREADS", "0", "x"),
    *_one("TZ", "Nowhere/At_All"),
    *_one("CC", "/nonexistent/cc", "'", "true"),
    *_one("EDQN_JAX_NATIVE", "0", "x"),
]
"""Every setting that is tried; the first is none."""


@dataclasses.dataclass(frozen=True)
class Ending:
    """How a command ended."""

    code: int | None  # None: it did not end
    said: str
    seconds: float


def write_recording(folder: Path) -> None:
    """Writes a recording of 200 events in 0.1 s."""
    rng, count = np.random.default_rng(0), 200
    x, y, p = (rng.integers(0, size, count).astype(np.uint16) for size in (64, 48, 2))
    np.savez(folder / EVENTS, t=np.sort(rng.integers(0, 100_000, count)), x=x, y=y, p=p.astype(np.int8))


def prepare(folder: Path) -> None:
    """Makes in `folder` what the commands read: a recording and a finished run."""
    write_recording(folder)
    ending = run(Setting({}), ("train", *TINY, "--run-dir", RUN), folder)
    if ending.code != 0:
        raise RuntimeError(f"no run to try the commands on:\n{ending.said}")


def run(setting: Setting, words: tuple[str, ...], folder: Path, fresh: str = FRESH) -> Ending:
    """Runs a command in `folder` under a setting; `fresh` is the name of the files that it makes."""
    environ = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHON": sys.executable}
    for name, value in setting.variables.items():
        environ.pop(name, None)
        if value is not None:
            environ[name] = value
    words = tuple(word.replace(FRESH, fresh, 1) if word.startswith(FRESH) else word for word in words)
    # `exec` has the shell's own streams; a pipe's code is that of the command, not of its reader.
    script = f'"$PYTHON" -m edqn_jax "$@" {setting.streams}; exit "${{PIPESTATUS[0]}}"'
    began = time.perf_counter()
    try:
        ended = subprocess.run(
            ["/bin/bash", "-c", script, "bash", *words],
            cwd=folder,
            env=environ,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=HANGS_S,
        )
    except subprocess.TimeoutExpired as hanging:
        return Ending(None, (hanging.stderr or b"").decode(errors="replace"), time.perf_counter() - began)
    said = (ended.stderr + ended.stdout).decode(errors="replace")
    return Ending(ended.returncode, said, time.perf_counter() - began)


def fault(setting: Setting, ending: Ending) -> str:
    """Returns what is wrong with how a command ended; an empty text if nothing is."""
    if ending.code is None:
        return "it hangs"
    if "Traceback" in ending.said or "Exception ignored" in ending.said:
        return "a traceback"
    if ending.code not in setting.codes:
        return f"exit code {ending.code}"
    named = any(name in ending.said for name in setting.variables) or "standard " in ending.said
    if ending.code == 2 and setting.variables and not named:
        return "refused for another reason than the setting"
    if ending.code == 2 and not setting.variables and setting.streams != ">/dev/full":
        return "refused without a reason"
    return ""
