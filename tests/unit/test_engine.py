from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from pointfilter import Engine, ModelBundle
from pointfilter import engine as engine_module
from pointfilter.engine import DEVICES, MAX_THREADS, Device, available_cpus
from pointfilter.errors import InvalidModelError, ParameterError, ProviderUnavailableError
from pointfilter.models import load_bundle
from pointfilter.network import Answers

CALIBRATION = {
    "balls": [24, 48], "preference": 0.1, "still_weight": 0.5, "margin": 0.0, "passes": 3, "query_reach": 0.4,
    "error_factor": 1.2,
}  # fmt: skip


def displacements(engine: Engine, patches: np.ndarray) -> np.ndarray:
    count = len(patches)
    none = np.zeros((count, 3), np.float32)
    return engine(patches, none[:, :2], none, np.arange(count)).displacements


def test_the_processor_is_always_there(bundle: ModelBundle) -> None:
    engine = Engine(bundle, "cpu", threads=3)
    assert engine.provider == "CPUExecutionProvider"
    assert (engine.device, engine.threads, engine.bundle) == ("cpu", 3, bundle)


def test_auto_takes_the_best_that_is_there(bundle: ModelBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    assert Engine(bundle).device == "cpu"


def test_a_provider_that_is_missing_is_an_error_and_no_silent_fallback(
    bundle: ModelBundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(ProviderUnavailableError, match=r"CUDAExecutionProvider.*device=auto"):
        Engine(bundle, "cuda")


def test_a_provider_gets_its_options(bundle: ModelBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as it can be seen without the provider: that what DEVICES says reaches onnxruntime."""
    seen = {}

    class Session(onnxruntime.InferenceSession):
        def __init__(
            self, weights: bytes, options: object, providers: list[str], provider_options: list[dict[str, str]]
        ) -> None:
            seen.update(zip(providers, provider_options, strict=True))
            super().__init__(weights, options, providers=["CPUExecutionProvider"])

        def get_providers(self) -> list[str]:
            return [*seen, "CPUExecutionProvider"]

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [d.provider for d in DEVICES.values()])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    engine = Engine(bundle, "openvino", threads=2)
    assert seen == {"OpenVINOExecutionProvider": {"device_type": "CPU", "num_of_threads": "2", "num_streams": "2"}}
    assert (engine.device, engine.provider) == ("openvino", "OpenVINOExecutionProvider")


def test_a_device_that_takes_one_call_at_a_time_gets_one(bundle: ModelBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(engine_module.DEVICES, "shy", Device("CPUExecutionProvider", one_call_at_a_time=True))
    engine = Engine(bundle, "shy", threads=4)
    network = engine._network
    running, most = 0, 0

    def watched(*arguments: Any) -> Answers:
        nonlocal running, most
        running += 1
        most = max(most, running)
        answer = network(*arguments)
        running -= 1
        return answer

    engine._network = watched
    patches = np.random.default_rng(0).uniform(-1, 1, (50, 64, 3)).astype(np.float32)
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda one: displacements(engine, one), [patches] * 20))
    assert most == 1
    assert all((answer == answers[0]).all() for answer in answers)


def test_a_provider_that_does_not_come_up_is_an_error(bundle: ModelBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime falls back by itself where a provider cannot start; that must not pass for the one asked for."""
    monkeypatch.setitem(engine_module.DEVICES, "other", Device("OtherExecutionProvider"))
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["OtherExecutionProvider"])
    real = onnxruntime.InferenceSession

    def fall_back(path: Path, options: object, providers: list[str], provider_options: object) -> object:
        return real(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "InferenceSession", fall_back)
    with pytest.raises(ProviderUnavailableError, match="OtherExecutionProvider was asked for"):
        Engine(bundle, "other")


@pytest.mark.parametrize("device", ["gpu", "", "CPU"])
def test_an_unknown_device(device: str, bundle: ModelBundle) -> None:
    with pytest.raises(ParameterError, match="auto, cpu, openvino, cuda, tensorrt, coreml, directml"):
        Engine(bundle, device)


@pytest.mark.parametrize("threads", [-1, MAX_THREADS + 1])
def test_threads_out_of_range(threads: int, bundle: ModelBundle) -> None:
    with pytest.raises(ParameterError, match=f"threads.*{MAX_THREADS}.*{threads}"):
        Engine(bundle, "cpu", threads)


def test_no_threads_means_what_this_process_may_use(bundle: ModelBundle) -> None:
    assert Engine(bundle, "cpu").threads == available_cpus() >= 1


@pytest.mark.parametrize(
    ("quota", "cpus"), [("max 100000", 8), ("150000 100000", 2), ("1000 100000", 1), ("9000000 100000", 8), ("?", 8)]
)
def test_the_container_s_quota_counts(quota: str, cpus: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(Path, "read_text", lambda _: quota)
    assert available_cpus() == cpus


def test_answers_have_a_row_a_patch_at_any_length(engine: Engine) -> None:
    rng = np.random.default_rng(0)
    for batch, length in [(1, 1), (3, 64), (7, 500)]:
        answer = displacements(engine, rng.uniform(-1, 1, (batch, length, 3)).astype(np.float32))
        assert answer.shape == (batch, 3)
        assert answer.dtype == np.float32
        assert (np.abs(answer) <= 1).all()


def test_an_adaptive_bundle_answers_every_query_from_its_owner_s_patch(default_engine: Engine) -> None:
    rng = np.random.default_rng(0)
    patches = rng.uniform(-1, 1, (3, 40, 3)).astype(np.float32)
    context = np.array([[0, 0], [0.5, 0], [0, 1]], np.float32)
    queries = rng.uniform(-0.3, 0.3, (7, 3)).astype(np.float32)
    owners = np.array([0, 0, 0, 1, 2, 2, 2])
    together = default_engine(patches, context, queries, owners)
    assert together.log_errors is not None
    assert together.normals is not None
    assert (together.displacements.shape, together.log_errors.shape, together.normals.shape) == ((7, 3), (7, 2), (7, 3))
    for row, owner in enumerate(owners):
        alone = default_engine(patches[[owner]], context[[owner]], queries[[row]], np.array([0]))
        for one, all_of_them in zip(alone, together, strict=True):
            np.testing.assert_allclose(one[0], all_of_them[row], rtol=0, atol=1e-5)
    assert (together.displacements[0] != together.displacements[1]).any()  # another query, the same patch
    elsewhere = default_engine(patches, context, queries, np.array([0, 0, 1, 1, 2, 2, 2]))
    assert (together.displacements[2] != elsewhere.displacements[2]).any()  # the same query, another patch


def test_padding_with_the_centre_changes_nothing(engine: Engine) -> None:
    patches = np.random.default_rng(0).uniform(-1, 1, (5, 20, 3)).astype(np.float32)
    patches[:, 0] = 0
    padded = np.concatenate([patches, np.zeros((5, 44, 3), np.float32)], axis=1)
    np.testing.assert_allclose(displacements(engine, padded), displacements(engine, patches), rtol=0, atol=1e-6)


def test_several_threads_may_call_at_once(engine: Engine) -> None:
    patches = np.random.default_rng(0).uniform(-1, 1, (8, 64, 3)).astype(np.float32)
    expected = displacements(engine, patches)
    answers: list[np.ndarray] = []
    threads = [
        threading.Thread(target=lambda: answers.extend(displacements(engine, patches) for _ in range(20)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 80
    assert all((answer == expected).all() for answer in answers)


def test_warming_up_is_one_real_inference(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    engine.warm_up()
    for wrong in (np.zeros((2, 4), np.float32), np.full((2, 3), np.nan, np.float32)):
        monkeypatch.setattr(Engine, "__call__", lambda self, *_, wrong=wrong: Answers(wrong))
        with pytest.raises(InvalidModelError, match=r"tiny.*answered a test patch"):
            engine.warm_up()


def test_weights_that_are_no_graph(bundle: ModelBundle, tmp_path: Path) -> None:
    weights = b"no graph at all"
    (tmp_path / "model.onnx").write_bytes(weights)
    with pytest.raises(InvalidModelError, match="cannot load model 'tiny'"):
        Engine(dataclasses.replace(bundle, folder=tmp_path, sha256=hashlib.sha256(weights).hexdigest()), "cpu")
    with pytest.raises(InvalidModelError, match="changed after it was checked"):
        Engine(dataclasses.replace(bundle, folder=tmp_path), "cpu")


@pytest.mark.parametrize(
    ("inputs", "output", "shape", "calibration", "message"),
    [
        (["patches", "more"], "displacements", ["b", "n", 3], None, "has inputs"),
        (["patches"], "out", ["b", "n", 3], None, "has inputs"),
        (["patches"], "displacements", ["b", "n", 3], CALIBRATION, "has inputs"),
        (["patches"], "displacements", ["b", 3, "n"], None, "takes no patches"),
        (["patches"], "displacements", ["b", "n", 4], None, "takes no patches"),
    ],
)
def test_a_graph_with_another_door(
    inputs: list[str],
    output: str,
    shape: list[object],
    calibration: dict[str, object] | None,
    message: str,
    bundle_folder: Path,
    tmp_path: Path,
) -> None:
    """A valid bundle whose graph takes something else fails when it is loaded or warmed up, as an InvalidModelError."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [helper.make_node("ReduceMax", ["patches"], [output], axes=[1], keepdims=0)]
    graph = helper.make_graph(
        nodes,
        "other",
        [helper.make_tensor_value_info(name, kind, shape) for name in inputs],
        [helper.make_tensor_value_info(output, kind, None)],
    )
    serialised = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()
    described = json.loads((bundle_folder / "model.json").read_text())
    described["sha256"] = hashlib.sha256(serialised).hexdigest()
    described["calibration"] = calibration
    (tmp_path / "model.onnx").write_bytes(serialised)
    (tmp_path / "model.json").write_text(json.dumps(described))
    bundle = load_bundle(tmp_path)
    with pytest.raises(InvalidModelError, match=f"{re.escape(tmp_path.name)}.* {message}"):
        Engine(bundle, "cpu").warm_up()
