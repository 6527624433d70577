"""Every policy of the package as ONNX."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edqn_jax.errors import CheckError
from edqn_jax.interop.deployment import onnx_export
from edqn_jax.policies import SHIPPED
from edqn_jax.runs.policies import load_policy


@pytest.mark.parametrize("name", SHIPPED)
def test_it_is_exported_and_nearly_all_inputs_are_compared(name: str, tmp_path: Path) -> None:
    policy = load_policy(name)
    found = onnx_export.export_policy(policy, tmp_path / "policy.onnx")
    assert found.checks == 1000 and found.largest_difference < 1e-4
    assert (found.on_edges > 0) == policy.config.encoder.levelled and found.on_edges < 100


def test_another_network_is_refused_also_where_inputs_are_left_out(tmp_path: Path, monkeypatch) -> None:
    policy = load_policy("pretrained-body")
    by_jax = onnx_export._by_jax

    def changed(policy, precision):
        """As JAX has them, the first one part in a thousand off."""
        values = by_jax(policy, precision)
        return lambda inputs: (values(inputs)[0] * np.where(np.arange(27) == 0, 1.001, 1.0), values(inputs)[1])

    monkeypatch.setattr(onnx_export, "_by_jax", changed)
    with pytest.raises(CheckError, match="ONNX and JAX differ by .* nothing was written"):
        onnx_export.export_policy(policy, tmp_path / "policy.onnx", checks=50)
    assert not list(tmp_path.iterdir())


def test_rows_differ_by_shares_of_their_own_largest_number() -> None:
    wanted = np.array([[0.5, -0.1], [4.0, -8.0]])
    np.testing.assert_allclose(onnx_export._shares_apart(wanted + [[0.1, 0.0], [0.0, 0.4]], wanted), [0.1, 0.05])
