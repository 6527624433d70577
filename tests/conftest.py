"""Two simulated CPU devices for every test, compiled programs that all processes of a session share, strictness."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

QUICK_TO_COMPILE = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if metadata.version("jaxlib").startswith("0.10."):  # XLA ends the process at a flag that it does not know
    QUICK_TO_COMPILE += " --xla_cpu_use_fusion_emitters=false"
"""XLA's flags with which a program compiles in less than half the time: what runs once need not be fast.

Nor is it cut up for several threads, since each core has another process. What the package compiles with options of
its own (`compiler_options`) has this level, too.
"""

# For the processes that tests start as well, and before the package is imported, which adds its own. Whoever gives
# flags gets these alone: `XLA_FLAGS= pytest` compiles everything as users do.
os.environ.setdefault("XLA_FLAGS", QUICK_TO_COMPILE)

import jax
import pytest

from edqn_jax.devices.cache import private_folder
from edqn_jax.devices.devices import use_cpu_devices

CACHE = {
    "jax_compilation_cache_dir": "",
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
"""Options of JAX's compilation cache; JAX_COMPILATION_CACHE_DIR names another folder than the user's."""

LONGEST = (
    "test_layout",
    "test_two_processes",
    "test_whole_run",
    "test_seeds",
    "test_checked",
    "test_run",
    "test_examples",
    "test_rivals",
    "test_parts",
    "test_embedding",
    "test_trainer",
    "test_moving",
    "test_native",
    "test_flights",
    "test_camera",
    "test_families",
    "test_encoder",
    "test_env",
    "test_settings",
    "test_sensor",
    "test_missions",
    "test_api",
    "test_evaluate",
    "test_functions",
    "test_several_drones",
    "test_patch_encoder",
    "test_animation",
    "test_loop",
)
"""Files that take longest, which go first: a long one begun last would leave the other process idle.

`test_evaluate` flies what `test_flights` flies, so it stands some places after it and finds the program compiled.
"""

use_cpu_devices(2)

# A walk over all that JAX has traced frees next to nothing and takes a tenth of a session, so it comes seldom.
gc.set_threshold(50_000, 50, 100)


def pytest_configure(config: pytest.Config) -> None:
    """Leaves out tests of whole policies where no test was named, and shares compiled programs.

    They are shared by the processes of a session, those that tests start, and later sessions. Much of a session's
    time is XLA's, many tests compile the same, and from one session or checkout to the next few programs change. An
    entry's key holds the whole program, its options and XLA's flags, so a program that has changed is compiled again.
    The folder is the package's own (`edqn_jax.devices.cache`), which keeps to its size.
    """
    if config.args_source is config.ArgsSource.TESTPATHS and not (config.option.markexpr or config.option.keyword):
        config.option.markexpr = "not whole"
    if hasattr(config, "workerinput"):
        return  # started by a process that has done the rest
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(_programs(config))
    for name, value in (CACHE | {"jax_compilation_cache_dir": folder}).items():
        # Workers and children read the variables when they import JAX; this process has imported it.
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)


def _programs(config: pytest.Config) -> Path:
    """Returns the user's folder of compiled programs, or a temporary one where none can be kept."""
    folder = private_folder()
    if folder is None:
        folder = Path(tempfile.mkdtemp(prefix="edqn-tests-"))
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the longest files first; `--no-loadscope-reorder` keeps them there."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


def pytest_collection_finish() -> None:
    """Keeps what has been collected, as long as the session, out of the walks over what may be let go of."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def young_process() -> Iterator[None]:
    """Lets go of all that JAX has traced in a file once its tests are over.

    JAX keeps the modules of what it has compiled, and with thousands of them traces six and lowers twenty times as
    slowly; what other files compile again comes from the cache on disk.
    """
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture(autouse=True, scope="session")
def few_worlds_at_once() -> None:
    """Draws random worlds in batches of eight, not of 64.

    Tests have a handful of worlds, and a batch is filled up with copies, which are drawn as well.
    """
    from edqn_jax.sim.worlds import families

    families._BATCH = 8


@pytest.fixture
def strict_jax() -> Iterator[None]:
    """No silent rank promotion, no key used twice, no leaked tracer; for our own functions, MJX breaks it."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.numpy_rank_promotion("raise"))
        stack.enter_context(jax.debug_key_reuse(True))
        stack.enter_context(jax.checking_leaks())
        yield
