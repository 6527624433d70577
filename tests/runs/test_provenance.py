"""Provenance of figures: workload, versions and digests."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from edqn_jax.runs.provenance import state_digest


def test_the_digest_knows_numbers_types_and_shapes() -> None:
    def digest(*leaves: Any) -> str:
        return state_digest(leaves)  # type: ignore[arg-type]

    zeros = jnp.zeros(4)
    assert digest(zeros) == digest(jnp.zeros(4))
    others = [
        digest(zeros.at[3].set(1.0)),
        digest(zeros.astype(jnp.int32)),  # the same bytes, as the others below
        digest(zeros.reshape(2, 2)),
        digest(zeros[:2], zeros[2:]),
    ]
    assert len({digest(zeros), *others}) == 5
    assert digest(jax.random.key(0)) != digest(jax.random.key(1))
