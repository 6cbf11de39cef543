"""`pointfilter doctor`: checks the installation with one real inference."""

from __future__ import annotations

import argparse
import platform
import time

import pointfilter
from pointfilter.cli.environment import model_folders
from pointfilter.cli.output import show
from pointfilter.engine import Engine, available_cpus
from pointfilter.models import find_model

HELP = "check this installation with one real inference"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true")


def run(options: argparse.Namespace) -> int:
    import numpy as np
    import onnxruntime
    import scipy

    engine = Engine(find_model(folders=model_folders()))
    started = time.perf_counter()
    engine.warm_up()
    found = {
        "pointfilter": pointfilter.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "onnxruntime": onnxruntime.__version__,
        "providers": onnxruntime.get_available_providers(),
        "cpus": available_cpus(),
        "model": engine.bundle.name,
        "provider": engine.provider,
        "first_inference_ms": round(1e3 * (time.perf_counter() - started), 2),
    }
    show(found, options.json)
    return 0
