"""Sums over the devices of one process, ours beside XLA's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from edqn_jax.native import all_sum as module
from edqn_jax.native.all_sum import all_sum
from tests.support.marks import in_whole

MESH = Mesh(np.asarray(jax.devices()[:2]), ("d",))


def spread(function):
    """`function` of one device's part, on two devices."""
    spec = PartitionSpec("d")
    return jax.jit(jax.shard_map(function, mesh=MESH, in_specs=spec, out_specs=spec, check_vma=False))


def arrays(seed: int) -> dict[str, jax.Array]:
    rng = np.random.default_rng(seed)
    floats = {f"f{n}": jnp.asarray(rng.normal(size=(2, n)), jnp.float32) for n in (1, 7, 1500, 4097)}
    return floats | {"count": jnp.asarray(rng.integers(-9, 9, (2, 3)), jnp.int32)}


def test_it_is_the_sum_that_xla_makes_to_the_bit() -> None:
    ours = spread(lambda x: all_sum(x, "d", 0.0))(arrays(0))
    theirs = spread(lambda x: lax.psum(x, "d"))(arrays(0))
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_where_there_is_a_compiler_c_adds_what_it_can() -> None:
    text = spread(lambda x: all_sum(x, "d", 0.0)).lower(arrays(0)).as_text()
    assert ("edqn_all_sum" in text) is (shutil.which("cc") is not None)
    halves = {name: x.astype(jnp.bfloat16) for name, x in arrays(0).items()}
    assert "edqn_all_sum" not in spread(lambda x: all_sum(x, "d", 0.0)).lower(halves).as_text()


def test_a_mapped_sum_is_the_sum_of_each() -> None:
    many = {name: jnp.stack([arrays(seed)[name] for seed in range(3)], axis=1) for name in arrays(0)}
    ours = spread(jax.vmap(lambda x: all_sum(x, "d", 0.0), in_axes=1, out_axes=1))(many)
    for seed in range(3):
        one = spread(lambda x: lax.psum(x, "d"))(arrays(seed))
        jax.tree.map(lambda a, b, seed=seed: np.testing.assert_array_equal(a[:, seed], b), ours, one)


def test_one_device_adds_nothing() -> None:
    x = arrays(0)
    assert all_sum(x, None, 0.0) is x


@pytest.mark.parametrize("late", [0, *in_whole(1)])
def test_a_device_that_is_late_is_waited_for(late: int) -> None:
    """Twenty sums, each of what the one before came to, with work between them on one device."""

    def chained(add, x: jax.Array) -> jax.Array:
        def body(carry, _):
            x, after = carry
            work = lax.cond(lax.axis_index("d") == late, lambda: jnp.sum(jnp.sin(jnp.outer(x[0], x[0]))), lambda: 0.0)
            total = add(x + 1e-9 * work, after)
            return (total / 2 + lax.axis_index("d"), total[0, 0]), total[0]

        return lax.scan(body, (x, jnp.float32(0)), None, length=20)[1][None]

    x = arrays(1)["f1500"]
    ours = np.asarray(spread(partial(chained, lambda x, after: all_sum(x, "d", after)))(x))
    theirs = np.asarray(spread(partial(chained, lambda x, after: lax.psum(x, "d")))(x))
    np.testing.assert_array_equal(ours[0], ours[1])
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)  # other programs


def test_where_it_is_not_at_hand_xla_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "is_available", lambda: False)
    text = spread(lambda x: all_sum(x, "d", 0.0)).lower(arrays(0)).as_text()
    assert "all_reduce" in text and "edqn_all_sum" not in text


OF_THREE = """
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from edqn_jax.native.all_sum import all_sum

jax.config.update("jax_num_cpu_devices", 3)
rng = np.random.default_rng(0)
given = {str(n): jnp.asarray(rng.normal(size=(3, n)), jnp.float32) for n in (1, 2, 1500, 4097)}
given["count"] = jnp.asarray(rng.integers(-9, 9, (3, 4)), jnp.int32)
mesh, spec = Mesh(np.asarray(jax.devices()), ("d",)), PartitionSpec("d")
spread = lambda f: jax.jit(jax.shard_map(f, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))(given)
ours, theirs = spread(lambda x: all_sum(x, "d", 0.0)), spread(lambda x: lax.psum(x, "d"))
for name, found in ours.items():
    for device in range(3):
        np.testing.assert_array_equal(found[device], found[0])
    np.testing.assert_allclose(found, theirs[name], rtol=1e-6, atol=1e-6)
print(len(jax.devices()), "devices")
"""


def test_three_devices_share_out_what_they_add() -> None:
    done = subprocess.run([sys.executable, "-c", OF_THREE], capture_output=True, text=True, timeout=300)
    assert done.stdout == "3 devices\n", done.stderr
