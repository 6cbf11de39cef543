"""The network as an ONNX graph, BatchNorm folded, written node by node: no tracer decides what runs in production.

    patches (B, N, 3) -> rows (B·N, 3) -> [Gemm, Relu] ... Gemm -> (B, N, C) -> ReduceMax -> [Mul] Add Relu
            -> [Gemm, Relu] ... Gemm -> Tanh -> displacements (B, 3)

The last encoder layer's bias and ReLU come after the max: both are the same for all points and never decreasing, so the
result is the same and N times less is added and compared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from training.network import Pointfilter

OPSET = 17
IR_VERSION = 8

Float64 = NDArray[np.float64]


def _array(tensor: Tensor | None) -> Float64:
    assert tensor is not None
    values: Float64 = tensor.detach().double().numpy()
    return values


def _affine(norm: nn.BatchNorm1d) -> tuple[Float64, Float64]:
    """Scale and shift that BatchNorm is at inference."""
    scale = _array(norm.weight) / np.sqrt(_array(norm.running_var) + norm.eps)
    return scale, _array(norm.bias) - _array(norm.running_mean) * scale


def _folded(layer: nn.Linear, norm: nn.BatchNorm1d) -> tuple[Float64, Float64]:
    """norm(layer(x)) as one matrix (in, out) and one bias."""
    scale, shift = _affine(norm)
    return (_array(layer.weight) * scale[:, None]).T, _array(layer.bias) * scale + shift


class _Graph:
    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def constant(self, name: str, values: NDArray[np.generic]) -> str:
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def gemm(self, value: str, matrix: Float64, bias: Float64 | None, name: str) -> str:
        inputs = [value, self.constant(f"{name}_weight", matrix.astype(np.float32))]
        if bias is not None:
            inputs.append(self.constant(f"{name}_bias", bias.astype(np.float32)))
        return self.node("Gemm", inputs, name)


def build(network: Pointfilter) -> onnx.ModelProto:
    """The graph of a network in inference mode; batch and patch length are dynamic."""
    graph = _Graph()
    rows = graph.node("Reshape", ["patches", graph.constant("rows_shape", np.array([-1, 3], np.int64))], "rows")
    *inner, (layer, norm) = network.encoder_layers()
    for number, pair in enumerate(inner):
        rows = graph.node("Relu", [graph.gemm(rows, *_folded(*pair), f"encoder{number}")], f"encoder{number}_relu")
    if network.settings.norm_after_pool:
        matrix, (scale, shift) = _array(layer.weight).T, _affine(norm)
        shift = shift + _array(layer.bias) * scale
        flipped = scale < 0  # a negative scale does not commute with the max, so it stays behind it
        matrix = matrix * np.where(flipped, 1.0, scale)
        behind = np.where(flipped, scale, 1.0)
    else:
        (matrix, shift), behind = _folded(layer, norm), np.ones(1)
    rows = graph.gemm(rows, matrix, None, f"encoder{len(inner)}")
    # (B·N, C) -> (B, N, C): the first two sizes are those of the input.
    size = graph.node("Shape", ["patches"], "patches_shape")
    leading = graph.node(
        "Slice",
        [size, graph.constant("zero", np.array([0], np.int64)), graph.constant("two", np.array([2], np.int64))],
        "leading_shape",
    )
    channels = graph.constant("channels", np.array([matrix.shape[1]], np.int64))
    shape = graph.node("Concat", [leading, channels], "points_shape", axis=0)
    points = graph.node("Reshape", [rows, shape], "points")
    features = graph.node("ReduceMax", [points], "pooled", axes=[1], keepdims=0)
    if np.any(behind != 1.0):
        features = graph.node("Mul", [features, graph.constant("pooled_scale", behind.astype(np.float32))], "scaled")
    features = graph.node("Add", [features, graph.constant("pooled_bias", shift.astype(np.float32))], "biased")
    features = graph.node("Relu", [features], "features")
    for number, pair in enumerate(network.decoder_layers()):
        features = graph.node(
            "Relu", [graph.gemm(features, *_folded(*pair), f"decoder{number}")], f"decoder{number}_relu"
        )
    head = graph.gemm(features, _array(network.head.weight).T, _array(network.head.bias), "head")
    graph.node("Tanh", [head], "displacements")
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "pointfilter",
            [helper.make_tensor_value_info("patches", TensorProto.FLOAT, ["batch", "points", 3])],
            [helper.make_tensor_value_info("displacements", TensorProto.FLOAT, ["batch", 3])],
            graph.weights,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="pointfilter export",
    )
    onnx.checker.check_model(model, full_check=True)
    return model
