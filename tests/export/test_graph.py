from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from export import graph
from export.bundle import PARITY_TOLERANCE, parity_error
from export.checkpoint import Loaded
from export.graph import OPSET, build, encoder_ranges
from pointfilter.engine import ADAPTIVE_INPUTS, ADAPTIVE_OUTPUTS
from training.network import NetworkSettings, Pointfilter


def network(norm_after_pool: bool, seed: int = 0) -> Pointfilter:
    """Random weights, running statistics off their defaults, and BatchNorm scales of both signs and near zero."""
    torch.manual_seed(seed)
    return _unsettled(Pointfilter(NetworkSettings((16, 24, 40), (24, 12), norm_after_pool, False, mean_pool=False)))


def adaptive(norm_after_pool: bool, seed: int = 0, *, mean_pool: bool = True) -> Pointfilter:
    """The same, answering for queries."""
    torch.manual_seed(seed)
    return _unsettled(Pointfilter(NetworkSettings((16, 24, 40), (24, 12), norm_after_pool, True, mean_pool)))


def _unsettled(made: Pointfilter) -> Pointfilter:
    with torch.no_grad():
        for norm in [*made.encoder_norms, *made.decoder_norms]:
            norm.weight.normal_()
            norm.weight[0], norm.weight[1] = 0.0, -1e-3
            norm.bias.normal_()
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.2, 3.0)
    return made.eval()


def answers(model: onnx.ModelProto, patches: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (answer,) = session.run(None, {"patches": patches})
    return np.asarray(answer)


def asked(batch: int, length: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random inputs of an adaptive graph: no query for the first patch, several for the others, in any order."""
    rng = np.random.default_rng(seed)
    patches = rng.uniform(-1, 1, (batch, length, 3)).astype(np.float32)
    patches[:, 0] = 0
    patches[batch // 2, 1 + length // 2 :] = 0  # padding
    owners = rng.permutation(np.repeat(np.arange(batch), np.append(0 if batch > 1 else 2, np.full(batch - 1, 3))))
    told = np.stack([rng.uniform(-0.5, 1, batch), rng.integers(2, size=batch)], axis=1).astype(np.float32)
    queries = rng.uniform(-0.45, 0.45, (len(owners), 3)).astype(np.float32)
    return {"patches": patches, "context": told, "queries": queries, "owners": owners}


def adaptive_answers(model: onnx.ModelProto, given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return dict(zip(ADAPTIVE_OUTPUTS, session.run(ADAPTIVE_OUTPUTS, given), strict=True))


@pytest.mark.parametrize("norm_after_pool", [False, True])
@pytest.mark.parametrize("mean_pool", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_onnxruntime_answers_for_queries_what_torch_answers(norm_after_pool: bool, mean_pool: bool, seed: int) -> None:
    made = adaptive(norm_after_pool, seed, mean_pool=mean_pool)
    assert (made.encoder_norms[-1].weight < 0).any()
    model = build(made)
    for batch, length in [(1, 1), (2, 7), (64, 33), (3, 700)]:
        given = asked(batch, length, seed)
        with torch.inference_mode():
            said = made.answer(*(torch.from_numpy(given[name]) for name in ("patches", "queries", "owners", "context")))
        found = adaptive_answers(model, given)
        errors = torch.stack([said.log_moved, said.log_still], dim=1)
        for name, expected in zip(ADAPTIVE_OUTPUTS, (said.displacements, errors, said.normals), strict=True):
            assert expected.abs().max() > 0.05
            np.testing.assert_allclose(found[name], expected.numpy(), rtol=1e-5, atol=PARITY_TOLERANCE)


def test_an_adaptive_graph_has_the_engine_s_inputs_and_outputs() -> None:
    model = build(adaptive(norm_after_pool=True))
    onnx.checker.check_model(model, full_check=True)
    assert {entry.name for entry in model.graph.input} == ADAPTIVE_INPUTS
    assert [entry.name for entry in model.graph.output] == ADAPTIVE_OUTPUTS
    shapes = {
        entry.name: [dimension.dim_param or dimension.dim_value for dimension in entry.type.tensor_type.shape.dim]
        for entry in [*model.graph.input, *model.graph.output]
    }
    assert shapes == {
        "patches": ["batch", "points", 3],
        "context": ["batch", 2],
        "queries": ["asked", 3],
        "owners": ["asked"],
        "displacements": ["asked", 3],
        "log_errors": ["asked", 2],
        "normals": ["asked", 3],
    }
    assert "BatchNormalization" not in [node.op_type for node in model.graph.node]


@pytest.mark.parametrize("norm_after_pool", [False, True])
@pytest.mark.parametrize("mean_pool", [False, True])
def test_int8_answers_for_queries_nearly_the_same(norm_after_pool: bool, mean_pool: bool) -> None:
    made = adaptive(norm_after_pool, mean_pool=mean_pool)
    given = asked(64, 33)
    model = build(made, encoder_ranges(made, given["patches"]))
    onnx.checker.check_model(model, full_check=True)
    exact, rounded = adaptive_answers(build(made), given), adaptive_answers(model, given)
    for name in ADAPTIVE_OUTPUTS:
        change = np.linalg.norm(rounded[name] - exact[name], axis=1).mean()
        assert 0 < change < 0.05 * np.linalg.norm(exact[name], axis=1).mean(), name
    one = {
        "patches": given["patches"][5:6],
        "context": given["context"][5:6],
        "queries": given["queries"][given["owners"] == 5],
        "owners": np.zeros(3, np.int64),
    }
    for name, values in adaptive_answers(model, one).items():
        np.testing.assert_allclose(values, rounded[name][given["owners"] == 5], rtol=0, atol=1e-6)


@pytest.mark.parametrize("norm_after_pool", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_onnxruntime_answers_what_torch_answers(norm_after_pool: bool, seed: int) -> None:
    made = network(norm_after_pool, seed)
    assert (made.encoder_norms[-1].weight < 0).any()
    model = build(made)
    rng = np.random.default_rng(seed)
    for batch, length in [(1, 1), (2, 7), (64, 33), (3, 700)]:
        patches = rng.uniform(-1, 1, (batch, length, 3)).astype(np.float32)
        with torch.inference_mode():
            expected = made(torch.from_numpy(patches)).numpy()
        assert np.abs(expected).max() > 0.05
        np.testing.assert_allclose(answers(model, patches), expected, rtol=0, atol=PARITY_TOLERANCE)


@pytest.mark.parametrize("norm_after_pool", [False, True])
def test_the_graph_is_valid_folded_and_dynamic(norm_after_pool: bool) -> None:
    model = build(network(norm_after_pool))
    onnx.checker.check_model(model, full_check=True)
    operators = [node.op_type for node in model.graph.node]
    assert "BatchNormalization" not in operators
    assert operators.count("Gemm") == 2 + 2 + 1
    assert operators.count("MatMul") == 1
    assert operators[-1] == "Tanh"
    assert model.opset_import[0].version == OPSET
    (entry,), (exit_,) = model.graph.input, model.graph.output
    sizes = [dimension.dim_param or dimension.dim_value for dimension in entry.type.tensor_type.shape.dim]
    assert sizes[2] == 3
    assert all(isinstance(size, str) for size in sizes[:2])
    assert exit_.type.tensor_type.shape.dim[1].dim_value == 3
    for weight in model.graph.initializer:
        assert np.isfinite(onnx.numpy_helper.to_array(weight)).all()


def test_scales_stay_behind_the_max_only_where_they_must() -> None:
    made = network(norm_after_pool=True)
    with torch.no_grad():
        made.encoder_norms[-1].weight.abs_()
    assert "Mul" not in [node.op_type for node in build(made).graph.node]
    assert "Mul" in [node.op_type for node in build(network(norm_after_pool=True)).graph.node]


@pytest.mark.parametrize("norm_after_pool", [False, True])
def test_int8_answers_nearly_the_same_and_the_same_for_any_batch(norm_after_pool: bool) -> None:
    made = network(norm_after_pool)
    patches = np.random.default_rng(0).uniform(-1, 1, (64, 33, 3)).astype(np.float32)
    ranges = encoder_ranges(made, patches)
    assert len(ranges) == 2
    model = build(made, ranges)
    onnx.checker.check_model(model, full_check=True)
    exact, rounded = answers(build(made), patches), answers(model, patches)
    assert 0 < np.linalg.norm(rounded - exact, axis=1).mean() < 0.03 * np.linalg.norm(exact, axis=1).mean()
    one_by_one = np.concatenate([answers(model, patch[None]) for patch in patches[:8]])
    np.testing.assert_allclose(one_by_one, rounded[:8], rtol=0, atol=1e-6)


def test_int8_products_are_products_of_integers(tmp_path: Path) -> None:
    """What onnxruntime makes of the graph; without this an int8 bundle would be slower than a float32 one."""
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    options.log_severity_level = 3
    model = build(network(norm_after_pool=True), [1.0, 1.0])
    onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    operators = [node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert {"QGemm", "MatMulIntegerToFloat"} <= set(operators)
    assert "DequantizeLinear" not in operators


def test_ranges_are_those_of_the_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    made = network(norm_after_pool=True)
    patches = np.random.default_rng(0).uniform(-1, 1, (16, 20, 3)).astype(np.float32)
    outputs: list[torch.Tensor] = []
    for norm in made.encoder_norms[:-1]:
        norm.register_forward_hook(lambda *call: outputs.append(call[2].relu()))
    with torch.inference_mode():
        made(torch.from_numpy(patches))
    monkeypatch.setattr(graph, "RARE", 0.0)
    assert encoder_ranges(made, patches) == pytest.approx([float(output.max()) for output in outputs], rel=1e-5)


def test_padding_and_order_change_nothing_in_the_exported_network() -> None:
    model = build(network(norm_after_pool=False))
    patches = np.random.default_rng(0).uniform(-1, 1, (4, 30, 3)).astype(np.float32)
    patches[:, 0] = 0
    padded = np.concatenate([patches, np.zeros((4, 90, 3), np.float32)], axis=1)
    np.testing.assert_allclose(answers(model, padded), answers(model, patches), atol=1e-6)
    np.testing.assert_allclose(answers(model, patches[:, ::-1].copy()), answers(model, patches), atol=1e-6)


@pytest.mark.parametrize("entry", range(8))
def test_the_parity_check_sees_one_wrong_weight_of_any_answer(entry: int) -> None:
    assert_seen(adaptive(norm_after_pool=True), entry, 0.01)


def test_the_parity_check_sees_answers_that_are_no_numbers() -> None:
    assert_seen(adaptive(norm_after_pool=True), 4, np.nan)


def test_the_parity_check_sees_one_wrong_weight() -> None:
    assert_seen(network(norm_after_pool=True), 1, 0.01)


def assert_seen(made: Pointfilter, entry: int, change: float) -> None:
    """That one bias of the last layer, `change` off, is more than the parity check lets through."""
    loaded = Loaded(made, patch_points=32, training={})
    model = build(loaded.network)
    assert parity_error(loaded, model.SerializeToString()) <= PARITY_TOLERANCE
    bias = next(weight for weight in model.graph.initializer if weight.name == "head_bias")
    values = onnx.numpy_helper.to_array(bias).copy()
    values[entry] += change
    bias.CopyFrom(onnx.numpy_helper.from_array(values, "head_bias"))
    assert not parity_error(loaded, model.SerializeToString()) <= PARITY_TOLERANCE
