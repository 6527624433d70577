"""Programs that a later process loads without tracing them, and what they must not be mistaken for."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax import kept_programs, user_code
from edqn_jax.config import registry
from edqn_jax.devices import cache
from edqn_jax.kept_programs import Place, kept_jit, place_of
from edqn_jax.native.own_programs import is_own_program
from edqn_jax.registries import Registry

ARGUMENTS = (jnp.arange(3.0), {"keys": jax.random.split(jax.random.key(0), 2)})

COMMAND = """
import sys
import jax, jax.numpy as jnp
from pathlib import Path
from edqn_jax.devices.cache import enable_compilation_cache
from edqn_jax.devices.devices import use_cpu_devices
use_cpu_devices(2)
enable_compilation_cache()
from edqn_jax.kept_programs import named, place_of
from edqn_jax.native import products

def program(x, keys):
    print("traced")
    square = x[:, None] * x
    return products.rounded_matmul(square, square), jax.random.split(keys[0])

arguments = jnp.arange(32.0), jax.random.split(jax.random.key(0), 2)
place = place_of("squares", sys.argv[1], arguments)
[compiled] = place.load() or [None]
if compiled is None:
    traced = jax.jit(named(program, place.name)).lower(*arguments)
    if sys.argv[2:] == ["by JAX alone"]:
        compiled = traced.compile()
    else:
        [compiled] = place.compile([traced], jax.devices()[:1])
squares, keys = compiled(*arguments)
print(float(squares.sum()), jax.random.key_data(keys).tolist())
"""


def lines_of(folder: Path, *arguments: str, **variables: str) -> list[str]:
    """Returns what a process prints that compiles a program, or loads it; arguments are those of `COMMAND`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XDG_"))}
    environment = kept | {"XDG_CACHE_HOME": str(folder)} | variables
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *(arguments or ("one",))], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.whole
def test_a_program_is_traced_once_and_damaged_ones_again(tmp_path: Path) -> None:
    [traced, result] = lines_of(tmp_path)
    assert traced == "traced" and lines_of(tmp_path) == [result]
    [program], [place] = tmp_path.rglob("*.executable"), tmp_path.rglob("*.program")
    for _ in range(2):  # the same program, from elsewhere
        assert lines_of(tmp_path, "another")[-1] == result
    assert len([*tmp_path.rglob("*.program")]) == 2 and [*tmp_path.rglob("*.executable")] == [program]
    for file in (program, place):
        file.write_bytes(file.read_bytes()[:-20])
        assert lines_of(tmp_path) == ["traced", result] and lines_of(tmp_path) == [result]
    assert lines_of(tmp_path, EDQN_JAX_NATIVE="0")[0] == "traced"


@pytest.mark.whole
def test_what_jax_has_kept_runs_and_is_kept_here_from_the_next_time_on(tmp_path: Path) -> None:
    """XLA writes a program that it has loaded itself without its functions, so that it could not be run."""

    def of_jax() -> list[Path]:
        return list(tmp_path.rglob("jit_kept_squares-*"))

    [_, result] = lines_of(tmp_path, "one", "by JAX alone")
    assert len(of_jax()) == 1
    assert lines_of(tmp_path) == ["traced", result]
    assert not of_jax() and not list(tmp_path.rglob("*.executable"))
    assert lines_of(tmp_path) == ["traced", result] and lines_of(tmp_path) == [result]
    assert not of_jax()


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The folder in which this process keeps programs, for the time of a test."""
    monkeypatch.setattr(cache, "_enabled", [tmp_path])
    # Not what other tests of this process have imported and registered.
    monkeypatch.setattr(user_code, "IMPORTED", [])
    for entries in vars(registry).values():
        if isinstance(entries, Registry) and entries.own:
            built_in = {name: entries._entries[name] for name in entries.names if name not in entries.own}
            monkeypatch.setattr(entries, "_entries", built_in)
    return tmp_path


def place(made_of: object = "one", arguments: Any = ARGUMENTS) -> Place:
    return place_of("program", made_of, arguments)


def test_programs_are_told_apart_by_what_they_are_made_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values, keys = ARGUMENTS
    others = [
        place("two"),
        place(arguments=(values[1:], keys)),
        place(arguments=(values.astype(jnp.int32), keys)),
        place(arguments=(values, keys["keys"])),
    ]
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        others.append(place())
    with monkeypatch.context() as patch:
        patch.setattr(kept_programs, "digest_of_package", lambda: "of an earlier version")
        others.append(place())
    assert place() == place(arguments=(values + 1, {"keys": jax.random.split(jax.random.key(1), 2)}))
    assert len({each.file for each in [place(), *others]}) == 7


def test_one_text_with_other_arguments_is_another_program(folder: Path) -> None:
    def first(values: jax.Array, unused: Any) -> jax.Array:
        return values + 1

    values = jnp.arange(3.0)
    first.__name__ = f"first_{time.time_ns()}"  # or JAX has it from an earlier session, and it is not kept
    for unused in (values, values[1:], (values, values)):
        for _ in range(2):
            here, traced = place(arguments=(values, unused)), jax.jit(first).lower(values, unused)
            [added] = here.load() or here.compile([traced], jax.devices()[:1])
            assert added(values, unused).tolist() == [1, 2, 3]
    assert len(list(folder.glob("*.executable"))) == len(list(folder.glob("*.program"))) == 3


def test_programs_are_loaded_once_in_a_process(folder: Path) -> None:
    def first(values: jax.Array) -> jax.Array:
        return values + 1

    first.__name__ = f"first_{time.time_ns()}"  # as above
    values, traced = jnp.arange(3.0), []

    def trace() -> list[jax.stages.Lowered]:
        traced.append(None)
        return [jax.jit(first).lower(values)]

    def found() -> jax.stages.Compiled:
        [program] = place(arguments=values).load_or_compile(trace, jax.devices()[:1])
        return program

    program = found()
    for file in folder.iterdir():
        file.unlink()
    assert found() is program and len(traced) == 1 and place(arguments=values).holds_programs()


def test_nothing_is_kept_beside_code_of_users(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert place().file is not None
    assert place(made_of=[lambda: None]) == Place(None)
    with monkeypatch.context() as patch:
        patch.setattr(user_code, "IMPORTED", ["mine.py"])
        assert place() == Place(None)
    monkeypatch.setitem(registry.SENSORS._entries, "mine", object())
    assert place() == Place(None)


def test_nothing_is_kept_unless_a_command_has_asked_for_it(tmp_path: Path) -> None:
    nowhere = place()
    assert nowhere == Place(None) and not nowhere.holds_programs() and nowhere.load() is None
    [same] = nowhere.compile([jax.jit(lambda x: x).lower(1.0)], jax.devices()[:1])
    assert same(2.0) == 2.0


def test_a_program_that_calls_python_is_not_kept(folder: Path) -> None:
    def ask(x: jax.Array) -> jax.Array:
        return jax.pure_callback(lambda x: x, x, x)

    here = place()
    for _ in range(2):
        [asking] = here.load() or here.compile([jax.jit(ask).lower(1.0)], jax.devices()[:1])
        assert asking(2.0) == 2.0
    assert not list(folder.glob("*.executable"))


def test_a_function_is_loaded_whatever_it_is_given_by(folder: Path) -> None:
    traced = []

    def scaled(values: jax.Array, times: int = 2, shift: Any = 0.0) -> jax.Array:
        traced.append(times)
        return values * times + shift

    scaled.__name__ = f"scaled_{time.time_ns()}"  # or JAX has it from an earlier session, and it is not kept

    def outcomes(function: Any) -> list[list[float]]:
        values = jnp.arange(3.0)
        results = [function(values), function(values, times=2), function(values, 3, shift=values)]
        return [np.asarray(each).tolist() for each in (*results, jax.vmap(function)(values))]

    expected = [[0, 2, 4], [0, 2, 4], [0, 4, 8], [0, 2, 4]]
    assert outcomes(kept_programs.kept_jit(1)(scaled)) == expected and traced == [2, 3, 2]  # the last in `jax.vmap`
    again = kept_programs.kept_jit(1)(scaled)
    assert outcomes(again) == expected and traced == [2, 3, 2]
    other = jax.device_put(jnp.arange(3.0), jax.devices()[-1])
    assert again(other).devices() == other.devices() and again(np.arange(3.0, dtype=np.float32)).tolist() == [0, 2, 4]


def test_what_only_tracing_needs_is_not_imported_before() -> None:
    """MJX takes as long to import as JAX, and the parts of SciPy half of that."""
    program = (
        "import sys; import edqn_jax.training.loop, edqn_jax.evaluation.world_check, edqn_jax.cli.train;"
        "print([name for name in ('mujoco.mjx', 'trimesh', 'scipy.ndimage', 'scipy.spatial') if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said == "[]\n"


def test_kept_functions_are_lowered_as_the_packages_own_and_others_with_them_are_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own: list[bool] = []

    def noted(values: jax.Array) -> jax.Array:
        own.append(is_own_program())
        return values + 1

    kept_jit()(noted)(jnp.arange(3.0))
    within = kept_jit()(noted)
    jax.jit(lambda values: within(values))(jnp.arange(4.0))
    monkeypatch.setattr(cache, "_enabled", [])
    kept_jit()(noted)(jnp.arange(5.0))
    assert own == [True, False, True]
