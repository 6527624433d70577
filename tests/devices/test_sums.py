"""Sums on CPUs: right under our compiler options, and under a user's own `jax.jit` once the package is imported."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax import xla_flags
from edqn_jax.devices import sums
from edqn_jax.devices.devices import compiler_options
from edqn_jax.errors import ConfigError
from edqn_jax.xla_flags import YNN_OPTION, disable_ynn_fusions
from tests.support.marks import rows_in_whole

SIZES = (16_384, 16_385, 32_768, 32_769, 49_153, 65_535, 65_537, 98_305, 131_071, 131_072, 131_073)

OWN = {"defaults": {}, "ours": dict(compiler_options("cpu"))}
"""Compiler options: those of a user's own `jax.jit`, and those of the package."""


@pytest.mark.parametrize("options", OWN)
@pytest.mark.parametrize("rows", SIZES)
def test_squared_norms_are_right_at_sizes_around_the_thresholds(rows, options):
    assert sums.count_wrong_sums(rows, OWN[options]) == 0


@pytest.mark.parametrize("options", OWN)
@pytest.mark.parametrize("rows", [16_385, 32_769, 65_537])
def test_sums_over_rows_and_columns_of_products_are_right(rows, options):
    draw = np.random.default_rng(rows)
    # Small whole numbers: every partial sum is exact in float32, whatever its order.
    x, w = draw.integers(-4, 5, (rows, 13)).astype(np.float32), draw.integers(-2, 3, (13, 6)).astype(np.float32)

    def products(x, w):
        return jnp.sum(x @ w, axis=0), jnp.sum((x @ w) * x[:, :6], axis=1), x.T @ x

    got = jax.jit(products, compiler_options=OWN[options])(x, w)
    for numbers, wanted in zip(got, products(x.astype(np.float64), w.astype(np.float64)), strict=True):
        np.testing.assert_array_equal(np.asarray(numbers), np.asarray(wanted, np.float32))


@pytest.mark.parametrize("options", OWN)
def test_the_same_sum_is_the_same_at_every_call(options):
    ones = jnp.ones((1024, 1))
    total = jax.jit(lambda a: jnp.sum(jnp.broadcast_to(a, (2, 1024, 1024))), compiler_options=OWN[options])
    assert {float(total(ones)) for _ in range(20)} == {2.0 * 1024 * 1024}


PROGRAM = """
import {first}
import jax, jax.numpy as jnp
import {second}
from edqn_jax.devices.sums import count_wrong_sums
narrow = jnp.sum(jnp.ones((3, 1, 2, 2, 8, 8, 8)) * jnp.ones((3, 1, 2, 2, 8, 8, 8)), axis=3)
wide = jax.jit(lambda a, b: jnp.sum(a[..., None, None, None, None, None] * b, axis=2))
print(count_wrong_sums(), float(narrow.sum()))
print(float(wide(jnp.ones((2, 2, 6)), jnp.ones((2, 2, 6, 3, 3, 3, 3, 3))).sum()))
"""
"""Sums that end the process with a signal where they are wrong (jax-ml/jax#39257, #40412), so in one of their own."""


@pytest.mark.parametrize(("first", "second"), [("edqn_jax", "jax"), *rows_in_whole(("jax", "edqn_jax"))])
def test_a_users_own_programs_get_right_sums_after_the_import(first, second):
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    program = PROGRAM.format(first=first, second=second)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0", str(3.0 * 2 * 2 * 512), str(2.0 * 2 * 6 * 243)]


def test_wrong_sums_are_refused_with_a_sentence_that_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(sums, "count_wrong_sums", lambda options: 1)
    monkeypatch.setattr(sums, "private_folder", lambda: tmp_path)
    with pytest.raises(ConfigError, match=f"wrong sums on this CPU; set XLA_FLAGS=--{YNN_OPTION}= or install"):
        sums.check_sums({})
    assert not list(tmp_path.iterdir())


def test_sums_are_checked_once_for_each_set_of_options(tmp_path, monkeypatch):
    checked = []
    monkeypatch.setattr(sums, "count_wrong_sums", lambda options: checked.append(options) or 0)
    monkeypatch.setattr(sums, "private_folder", lambda: tmp_path)
    for options in ({}, {}, {"a": "1"}, {"a": "1"}):
        sums.check_sums(options)
    assert checked == [{}, {"a": "1"}]


def test_a_user_whose_jax_was_used_before_is_warned_of_wrong_sums(monkeypatch):
    monkeypatch.setattr(xla_flags, "jax_was_imported", True)
    monkeypatch.setattr(sums, "count_wrong_sums", lambda: 1)
    sums.check_default_sums.cache_clear()
    with pytest.warns(RuntimeWarning, match="JAX was used before edqn_jax was imported; import edqn_jax first"):
        sums.check_default_sums()
    with warnings.catch_warnings():  # once a process
        warnings.simplefilter("error")
        sums.check_default_sums()
    sums.check_default_sums.cache_clear()


@pytest.mark.parametrize(
    ("version", "given", "then"),
    [
        ("0.10.2", "", f"--{YNN_OPTION}="),
        ("0.12.0.1", "--xla_a=b", f"--xla_a=b --{YNN_OPTION}="),
        ("0.10.2", f"--{YNN_OPTION}=LIBRARY_FUSION_TYPE_DOT", f"--{YNN_OPTION}=LIBRARY_FUSION_TYPE_DOT"),
        ("0.10.0", "", ""),
        ("0.13.0", "--xla_a=b", "--xla_a=b"),
        ("1.0rc1", "", ""),
    ],
)
def test_the_flag_is_given_to_versions_that_know_it_and_to_nobody_who_chose(version, given, then, monkeypatch):
    monkeypatch.setattr(xla_flags.metadata, "version", lambda _: version)
    environ = {"XLA_FLAGS": given}
    disable_ynn_fusions(environ)
    assert environ["XLA_FLAGS"] == then
