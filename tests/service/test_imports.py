"""What the service may bring along."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_no_torch_and_no_training() -> None:
    program = "import service.app, service.__main__, sys; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(result.stdout.split())
    assert {"service", "pointfilter", "fastapi", "onnxruntime"} <= loaded
    assert loaded & {"torch", "training", "export", "onnx", "pytest"} == set()


def test_modules_stay_small() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in (ROOT / "service").rglob("*.py")}
    assert lengths[ROOT / "service" / "app.py"] < 120
    assert max(lengths.values()) < 250
