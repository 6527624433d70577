"""Exported policies and their runner ask for no more than old versions of onnxruntime and Python have."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest

from edqn_jax.extras import require_extra
from edqn_jax.interop.deployment import runner
from edqn_jax.interop.deployment.onnx_export import export_policy
from tests.support.interop.flights import untrained

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports

FLOAT, WHOLE = {"FLOAT", "INT64"}, {"INT32", "INT64"}

OPERATORS = {
    **dict.fromkeys(("Add", "Sub", "Mul", "Sign", "Greater", "Less", "Squeeze", "Slice", "Concat"), FLOAT | WHOLE),
    **dict.fromkeys(("Abs", "Clip", "Div", "Einsum", "Gemm", "LayerNormalization", "Log", "Relu", "Transpose"), FLOAT),
    **dict.fromkeys(("ConstantOfShape", "Expand", "Reshape", "ReduceMean", "Split"), FLOAT),
    "ReduceSum": FLOAT | WHOLE,
    "Equal": FLOAT | WHOLE,
    "Where": FLOAT | {"BOOL"},
    "Cast": {"BOOL", "INT32"},
}
"""Types of the inputs of each operator with which onnxruntime 1.14.1 to 1.19.2 ran exported policies."""

OF_LEVELLING = {
    **dict.fromkeys(("Floor", "GreaterOrEqual", "Max", "Mean", "Neg", "Round", "Sin"), FLOAT),
    **dict.fromkeys(("Abs", "Gather", "Reshape", "Where"), {"FLOAT", "INT32", "INT64", "BOOL"}),
    "Cast": {"BOOL", "INT32", "FLOAT"},
    "And": {"BOOL"},
    "Min": {"INT32"},
}
"""The same of policies that level events (`encoder.levelled`), from onnxruntime 1.15.0 on."""


@pytest.mark.parametrize(
    "groups",
    [
        {"agent": {"layer_norm": True}},
        {"events": {"leak_rate_hz": 5.0, "shot_rate_hz": 5.0}},
        {"env": {"sensor": "event-image"}},
        {"encoder": {"architecture": "pooled"}, "agent": {"history": 1}},
        {"camera": {"mount": "body"}, "encoder": {"levelled": True}, "events": {"sensor_pixels": 117}},
    ],
    ids=["patches", "noise", "event-image", "pooled", "levelled"],
)
def test_a_policy_has_only_operators_that_old_runtimes_run(tmp_path: Path, groups: Any) -> None:
    onnx = require_extra("onnx", extra="export")
    file = tmp_path / "policy.onnx"
    export_policy(untrained(**groups), file, checks=5)
    model = onnx.shape_inference.infer_shapes(onnx.load(file))
    assert [(each.domain, each.version) for each in model.opset_import] == [("", 18)]
    name_of = onnx.TensorProto.DataType.Name
    values = [*model.graph.value_info, *model.graph.input, *model.graph.output]
    types = {value.name: name_of(value.type.tensor_type.elem_type) for value in values}
    types |= {each.name: name_of(each.data_type) for each in model.graph.initializer}
    asked = {(node.op_type, types[given]) for node in model.graph.node for given in node.input if given}
    assert len(asked) > 10
    known = OPERATORS | OF_LEVELLING if "camera" in groups else OPERATORS
    assert {(name, kind) for name, kind in asked if kind not in known.get(name, ())} == set()


def test_the_runner_is_python_3_8() -> None:
    source = Path(runner.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 8))
    assert "from __future__ import annotations" in source  # so that `X | None` is never evaluated
    strict = [node for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg in ("strict", "slots")]
    assert strict == []  # of zip and of dataclass: Python 3.10


def test_why_a_file_cannot_be_run_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    onnxruntime, onnx = require_extra("onnxruntime", extra="export"), require_extra("onnx", extra="export")
    file = tmp_path / "policy.onnx"
    for content in (b"no policy", b""):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"policy.onnx' is not an ONNX file$"):
            runner.Runner(file)
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.INT8, [1])
    unknown = onnx.helper.make_node("NoSuchOperator", ["x"], ["y"])
    graph = onnx.helper.make_graph([unknown], "unknown", [value], [value])
    file.write_bytes(onnx.helper.make_model(graph).SerializeToString())
    with pytest.raises(
        ValueError, match=r"onnxruntime \d.* cannot run .*policy.onnx'; export it again.*NoSuchOperator"
    ):
        runner.Runner(file)
    monkeypatch.setattr(onnxruntime, "__version__", "1.13.1")
    with pytest.raises(ValueError, match=r"onnxruntime 1.13.1 is too old for exported policies; install 1.14 or newer"):
        runner.Runner(file)
