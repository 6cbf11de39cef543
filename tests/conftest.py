"""Fixtures that several folders of tests share."""

from __future__ import annotations

import os

os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read when onnxruntime is first imported

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from pointfilter import Engine, ModelBundle, load_bundle
from pointfilter.models import DEFAULT_MODEL, open_model
from pointfilter.noise import add_noise
from tests.clouds import crease
from tests.ply_files import ply_bytes

# The same examples on every machine; `--hypothesis-profile explore` looks for new ones.
settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.register_profile("explore", settings.get_profile("repeatable"), derandomize=False, max_examples=300)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def bundle_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of a small network with random weights, exported as any other."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from export.bundle import write_bundle
    from export.checkpoint import Loaded
    from training.network import NetworkSettings, Pointfilter

    torch.manual_seed(0)
    network = Pointfilter(NetworkSettings(encoder=(16, 32), decoder=(16,), adaptive=False))
    network(torch.randn(64, 20, 3))  # moves the running statistics off their defaults
    folder = tmp_path_factory.mktemp("bundles") / "tiny"
    write_bundle(Loaded(network.eval(), patch_points=64, training={}), folder, "0.0.1")
    return folder


@pytest.fixture(scope="session")
def bundle(bundle_folder: Path) -> ModelBundle:
    return load_bundle(bundle_folder)


@pytest.fixture(scope="session")
def engine(bundle: ModelBundle) -> Engine:
    return Engine(bundle, "cpu", threads=2)


@pytest.fixture(scope="session")
def default_engine() -> Engine:
    """The bundled model that is used where nobody names one."""
    return Engine(open_model(DEFAULT_MODEL), threads=2)


@pytest.fixture(scope="session")
def noisy_crease() -> np.ndarray:
    """(600, 3) float64: two planes that meet, with noise."""
    rng = np.random.default_rng(1)
    return add_noise(crease(600, rng), 0.005, rng)


@pytest.fixture
def noisy_file(tmp_path: Path, noisy_crease: np.ndarray) -> Path:
    """The same cloud as a binary file with a column that is none of ours."""
    path = tmp_path / "noisy.ply"
    rows = [(*map(float, np.float32(row)), number % 251) for number, row in enumerate(noisy_crease)]
    path.write_bytes(ply_bytes("binary_little_endian", rows, ["float x", "float y", "float z", "uchar mark"]))
    return path
