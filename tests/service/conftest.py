"""An app around a two-line network, so that the service is tested without torch and without a trained model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from starlette.testclient import TestClient

import service.work
from pointfilter import PointCloud
from service.app import create_app
from service.settings import Settings
from tests.service.apps import Gate, start_thread, until

PATCH_POINTS = 32


def write_bundle(folder: Path, strength: float = 0.5) -> Path:
    """A model that moves each point towards the mean of its patch: tanh(strength * mean(patch))."""
    patches = onnx.helper.make_tensor_value_info("patches", onnx.TensorProto.FLOAT, ["batch", "points", 3])
    moves = onnx.helper.make_tensor_value_info("displacements", onnx.TensorProto.FLOAT, ["batch", 3])
    nodes = [
        onnx.helper.make_node("ReduceMean", ["patches"], ["mean"], axes=[1], keepdims=0),
        onnx.helper.make_node("Mul", ["mean", "strength"], ["scaled"]),
        onnx.helper.make_node("Tanh", ["scaled"], ["displacements"]),
    ]
    constant = onnx.helper.make_tensor("strength", onnx.TensorProto.FLOAT, [], [strength])
    graph = onnx.helper.make_graph(nodes, "tiny", [patches], [moves], [constant])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    folder.mkdir(parents=True)
    weights = model.SerializeToString()
    (folder / "model.onnx").write_bytes(weights)
    described = {
        "schema": 1, "name": folder.name, "version": "1.0", "sha256": hashlib.sha256(weights).hexdigest(), "opset": 17,
        "frame": "pca-mean-sign", "patch_points": PATCH_POINTS, "radius": 0.1, "iterations": 1, "parameters": 1,
        "network": {}, "training": {}, "scores": {},
    }  # fmt: skip
    (folder / "model.json").write_text(json.dumps(described), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two sound bundles, `tiny` and `other`, and a damaged one, `broken`."""
    folder = tmp_path_factory.mktemp("bundles")
    write_bundle(folder / "tiny")
    write_bundle(folder / "other", strength=0.25)
    (write_bundle(folder / "broken") / "model.onnx").write_bytes(b"not what model.json says")
    return folder


@pytest.fixture
def temp_dir(tmp_path: Path) -> Path:
    """Where the app under test keeps uploads; empty whenever nothing is going on."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    """Where the app under test keeps jobs."""
    return tmp_path / "data"


@pytest.fixture
def make_settings(bundles: Path, temp_dir: Path, data_dir: Path) -> Callable[..., Settings]:
    """One worker, small clouds without one of their own, unless said otherwise."""

    def make(**values: Any) -> Settings:
        given = {"model_dir": bundles, "model": "tiny", "temp_dir": temp_dir, "data_dir": data_dir, "threads": 1}
        return Settings(**{**given, "small_points": 0, **values})

    return make


@pytest.fixture(autouse=True)
def workers_are_threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers inside the test's process, unless a test is marked `processes`: faster, and they can be patched."""
    if "processes" not in request.keywords:
        monkeypatch.setattr("service.crew.start_process", start_thread)


@pytest.fixture
def make_client(make_settings: Callable[..., Settings]) -> Iterator[Callable[..., TestClient]]:
    """Clients of running, ready apps with the settings given."""
    with ExitStack() as stack:

        def make(**values: Any) -> TestClient:
            client = stack.enter_context(TestClient(create_app(make_settings(**values)), raise_server_exceptions=False))
            until(lambda: client.get("/health/ready").status_code == 200)
            return client

        yield make


@pytest.fixture
def client(make_client: Callable[..., TestClient]) -> TestClient:
    return make_client()


@pytest.fixture(scope="session")
def cloud() -> PointCloud:
    """500 noisy points on a unit sphere."""
    generator = np.random.default_rng(3)
    points = generator.normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points + generator.normal(scale=0.02, size=(500, 3)))


@pytest.fixture(scope="session")
def ply(cloud: PointCloud, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("clouds") / "sphere.ply"
    cloud.write(path)
    return path.read_bytes()


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate()
    monkeypatch.setattr(service.work, "filter_cloud", gate)
    yield gate
    gate.open.set()
