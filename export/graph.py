"""The network as an ONNX graph, BatchNorm folded, written node by node: no tracer decides what runs in production.

    patches (B, N, 3) -> rows (B·N, 3) -> [Gemm, Relu] ... Gemm -> (B, N, C) -> ReduceMax -> [Mul] Add Relu -> features
    mean pool:     input of the last Gemm -> (B, N, C') -> MatMul with which rows are points / how many -> features
    the paper's:   features -> [Gemm, Relu] ... Gemm -> Tanh -> displacements (B, 3)
    the adaptive:  features, context (B, 2) -> Concat -> MatMul -> Gather by owners (M,) -> + Gemm of queries (M, 3)
                   -> Relu -> [Gemm, Relu] ... Gemm -> Split -> Tanh -> displacements (M, 3), log_errors (M, 2),
                   normals (M, 3)

The last encoder layer's bias and ReLU come after the max: both are the same for all points and never decreasing, so the
result is the same and N times less is added and compared. Centres and padding, whose coordinates are all zero, do not
count in the mean.

An int8 graph rounds what goes into the encoder's products from the second layer on to 256 levels, and their weights to
127 levels a channel. It is written with QuantizeLinear and DequantizeLinear, which every provider knows; onnxruntime
turns them into products of integers. Everything else stays in float32: the first layer has three inputs, the decoder
runs once a patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from pointfilter.engine import session_network
from pointfilter.network import Network
from training.network import CONTEXT, Pointfilter

OPSET = 17
IR_VERSION = 8
LARGEST_BIAS = 2.0**30  # in units of the products' sums, which are 32-bit
LEVELS = 255  # of an unsigned activation above 0
WEIGHT_LEVELS = 63  # of a signed weight on each side of 0: sums of two products fit 16 bits, which older CPUs need
RARE = 5e-6  # share of the values that are cut off in an int8 graph

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

    def product(self, value: str, matrix: Float64, bias: Float64 | None, name: str) -> str:
        inputs = [value, self.constant(f"{name}_weight", matrix.astype(np.float32))]
        if bias is None:
            return self.node("MatMul", inputs, name)
        return self.node("Gemm", [*inputs, self.constant(f"{name}_bias", bias.astype(np.float32))], name)

    def int8_product(self, value: str, largest: float, matrix: Float64, bias: Float64 | None, name: str) -> str:
        """The product with a value >= 0, which is cut off at `largest`, in integers: u8 × s8, summed in 32 bits."""
        scale = np.float32(largest / LEVELS)
        value = self._rounded(value, scale, f"{name}_input")
        largest_bias = 0.0 if bias is None else np.abs(bias) / LARGEST_BIAS / scale
        scales = np.maximum(np.abs(matrix).max(axis=0) / WEIGHT_LEVELS, largest_bias).astype(np.float32)
        scales = np.where(scales > 0, scales, np.float32(1))
        inputs = [value, self._integers(np.round(matrix / scales).astype(np.int8), scales, 1, f"{name}_weight")]
        if bias is None:
            return self.node("MatMul", inputs, name)
        steps = scale * scales  # of the sums, so also of what is added to them
        inputs.append(self._integers(np.round(bias / steps).astype(np.int32), steps, 0, f"{name}_bias"))
        return self.node("Gemm", inputs, name)

    def _rounded(self, value: str, scale: np.float32, name: str) -> str:
        """The value in whole steps of the scale; as integers it is NAME_u8."""
        constants = [
            self.constant(f"{name}_scale", np.array(scale)),
            self.constant(f"{name}_zero", np.array(np.uint8(0))),
        ]
        integers = self.node("QuantizeLinear", [value, *constants], f"{name}_u8")
        return self.node("DequantizeLinear", [integers, *constants], name)

    def by_patch(self, rows: str, channels: int, name: str) -> str:
        """Rows (B·N, C) as (B, N, C): the first two sizes are those of the input."""
        width = self.constant(f"{name}_channels", np.array([channels], np.int64))
        return self.node(
            "Reshape", [rows, self.node("Concat", ["leading_shape", width], f"{name}_shape", axis=0)], name
        )

    def _integers(self, values: NDArray[np.generic], scales: NDArray[np.float32], axis: int, name: str) -> str:
        """Constants that are integers times a scale a channel."""
        zeros = np.zeros(len(scales), values.dtype)
        inputs = [
            self.constant(f"{name}_{values.dtype}", values),
            self.constant(f"{name}_scale", scales),
            self.constant(f"{name}_zero", zeros),
        ]
        return self.node("DequantizeLinear", inputs, name, axis=axis)


def build(network: Pointfilter, ranges: Sequence[float] = ()) -> onnx.ModelProto:
    """The graph of a network in inference mode; batch and patch length are dynamic.

    ranges: makes it an int8 graph: the largest output of each encoder layer but the last that is told apart from larger
    ones, see `encoder_ranges`.
    """
    graph = _Graph()

    def product(number: int, value: str, matrix: Float64, bias: Float64 | None) -> str:
        name = f"encoder{number}"
        if ranges and number > 0:
            return graph.int8_product(value, ranges[number - 1], matrix, bias, name)
        return graph.product(value, matrix, bias, name)

    rows = graph.node("Reshape", ["patches", graph.constant("rows_shape", np.array([-1, 3], np.int64))], "rows")
    *inner, (layer, norm) = network.encoder_layers()
    for number, pair in enumerate(inner):
        rows = graph.node("Relu", [product(number, rows, *_folded(*pair))], f"encoder{number}_relu")
    if network.settings.norm_after_pool:
        matrix, (scale, shift) = _array(layer.weight).T, _affine(norm)
        shift = shift + _array(layer.bias) * scale
        flipped = scale < 0  # a negative scale does not commute with the max, so it stays behind it
        matrix = matrix * np.where(flipped, 1.0, scale)
        behind = np.where(flipped, scale, 1.0)
    else:
        (matrix, shift), behind = _folded(layer, norm), np.ones(1)
    last = product(len(inner), rows, matrix, None)
    size = graph.node("Shape", ["patches"], "patches_shape")
    graph.node(
        "Slice",
        [size, graph.constant("zero", np.array([0], np.int64)), graph.constant("two", np.array([2], np.int64))],
        "leading_shape",
    )
    points = graph.by_patch(last, matrix.shape[1], "points")
    features = graph.node("ReduceMax", [points], "pooled", axes=[1], keepdims=0)
    if np.any(behind != 1.0):
        features = graph.node("Mul", [features, graph.constant("pooled_scale", behind.astype(np.float32))], "scaled")
    features = graph.node("Add", [features, graph.constant("pooled_bias", shift.astype(np.float32))], "biased")
    features = graph.node("Relu", [features], "max_features")
    if network.settings.mean_pool:
        rounded = ranges[-1] / LEVELS if ranges and inner else None
        means = _mean(graph, f"encoder{len(inner)}_input_u8" if rounded else rows, len(matrix), rounded)
        features = graph.node("Concat", [features, means], "features", axis=1)
    inputs, outputs = _ends(network.settings.adaptive)
    for number, (layer, norm) in enumerate(network.decoder_layers()):
        matrix, bias = _folded(layer, norm)
        if number == 0 and network.settings.adaptive:
            features = _queried(graph, features, matrix, bias)
        else:
            features = graph.product(features, matrix, bias, f"decoder{number}")
        features = graph.node("Relu", [features], f"decoder{number}_relu")
    head = graph.product(features, _array(network.head.weight).T, _array(network.head.bias), "head")
    if network.settings.adaptive:
        sizes = graph.constant("answer_sizes", np.array([3, 2, 3], np.int64))
        graph.nodes.append(
            helper.make_node("Split", [head, sizes], ["moves", "log_errors", "normals"], name="answers", axis=1)
        )
        head = "moves"
    graph.node("Tanh", [head], "displacements")
    model = helper.make_model(
        helper.make_graph(graph.nodes, "pointfilter", inputs, outputs, graph.weights),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="pointfilter export",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _mean(graph: _Graph, rows: str, channels: int, step: float | None) -> str:
    """The mean (B, C) of rows (B·N, C) over the points of each patch. step: that of rows in integers, whose sum is
    exact."""
    one = graph.constant("one_axis", np.array([1], np.int64))
    coordinates = graph.node("Abs", ["patches"], "magnitudes")
    coordinates = graph.node("ReduceMax", [coordinates], "magnitude", axes=[2], keepdims=0)
    present = graph.node("Greater", [coordinates, graph.constant("no_distance", np.array(np.float32(0)))], "present")
    weights = graph.node("Cast", [present], "present_float", to=TensorProto.FLOAT)
    number = graph.node("ReduceSum", [weights, one], "present_sum", keepdims=1)
    number = graph.node("Max", [number, graph.constant("at_least_one", np.array(np.float32(1)))], "present_number")
    points = graph.by_patch(rows, channels, "mean_points")
    if step is None:
        sums = graph.node("MatMul", [graph.node("Unsqueeze", [weights, one], "weights"), points], "mean_sums")
    else:
        weights = graph.node("Cast", [present], "present_u8", to=TensorProto.UINT8)
        weights = graph.node("Unsqueeze", [weights, one], "weights")
        sums = graph.node("MatMulInteger", [weights, points], "integer_sums")
        sums = graph.node("Cast", [sums], "float_sums", to=TensorProto.FLOAT)
        sums = graph.node("Mul", [sums, graph.constant("mean_step", np.array(np.float32(step)))], "mean_sums")
    return graph.node("Div", [graph.node("Squeeze", [sums, one], "sums"), number], "mean_features")


def _ends(adaptive: bool) -> tuple[list[onnx.ValueInfoProto], list[onnx.ValueInfoProto]]:
    """Inputs and outputs of the graph."""
    float32, int64 = TensorProto.FLOAT, TensorProto.INT64
    inputs = [helper.make_tensor_value_info("patches", float32, ["batch", "points", 3])]
    if not adaptive:
        return inputs, [helper.make_tensor_value_info("displacements", float32, ["batch", 3])]
    inputs += [
        helper.make_tensor_value_info("context", float32, ["batch", 2]),
        helper.make_tensor_value_info("queries", float32, ["asked", 3]),
        helper.make_tensor_value_info("owners", int64, ["asked"]),
    ]
    answers = (("displacements", 3), ("log_errors", 2), ("normals", 3))
    return inputs, [helper.make_tensor_value_info(name, float32, ["asked", width]) for name, width in answers]


def _queried(graph: _Graph, features: str, matrix: Float64, bias: Float64) -> str:
    """The decoder's first layer: what the queries of a patch share is multiplied once."""
    width = len(matrix) - CONTEXT
    patch = graph.node("Concat", [features, "context"], "patch_features", axis=1)
    shared = np.concatenate([matrix[:width], matrix[width + 3 :]])
    patch = graph.product(patch, shared, None, "decoder0_patch")
    patch = graph.node("Gather", [patch, "owners"], "decoder0_gathered", axis=0)
    query = graph.product("queries", matrix[width : width + 3], bias, "decoder0_query")
    return graph.node("Add", [patch, query], "decoder0")


def graph_network(serialised: bytes) -> Network:
    """A serialised graph as the callable that the filter expects, on the CPU."""
    return session_network(onnxruntime.InferenceSession(serialised, providers=["CPUExecutionProvider"]))


def encoder_ranges(network: Pointfilter, patches: NDArray[np.float32]) -> list[float]:
    """Largest outputs of the encoder's layers but the last on typical patches (B, N, 3), one in 200 000 left out."""
    rows = patches.reshape(-1, 3).astype(np.float64)
    ranges = []
    for pair in network.encoder_layers()[:-1]:
        matrix, bias = _folded(*pair)
        rows = np.maximum(rows @ matrix + bias, 0)
        ranges.append(max(float(np.quantile(rows, 1 - RARE)), 1e-6))
    return ranges
