"""The built wheel in an empty environment: no checkout, no torch, no web framework."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from tests.e2e.conftest import NOISY, ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT], check=True
    )
    (built,) = folder.glob("*.whl")
    return built


def test_it_holds_the_library_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert "pointfilter/bundles/pointfilter-adaptive-int8/model.onnx" in names
    assert any(name.startswith("pointfilter/_native") and name.endswith((".so", ".pyd")) for name in names)
    assert {name.split("/")[0] for name in names} <= {"pointfilter"} | {
        name.split("/")[0] for name in names if ".dist-info/" in name
    }
    assert "abi3" in wheel.name


def test_it_filters_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *constraints, wheel], check=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    output = tmp_path / "clean.ply"
    done = subprocess.run(
        [python.with_name("pointfilter"), "filter", NOISY, output, "--iterations", "1", "--json"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert output.stat().st_size > NOISY.stat().st_size
    packages = subprocess.run([python, "-m", "pip", "list"], capture_output=True, text=True, check=True).stdout.lower()
    assert "torch" not in packages
    assert "fastapi" not in packages
