"""Results of the classics on disk: what a classic made of a cloud is computed once."""

from __future__ import annotations

import hashlib
import importlib
import os
import time
import zipfile
from dataclasses import dataclass
from importlib.metadata import packages_distributions, version
from pathlib import Path

import numpy as np

from benchmarks.classics import Filter, unit
from benchmarks.classics.unit import Float64

DEFAULT_FOLDER = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "pointfilter", "benchmarks")
LIBRARIES = {"benchmarks.classics.cgal": "CGAL", "benchmarks.classics.open3d": "open3d"}
"""Module -> the package that its filters come from."""


@dataclass(frozen=True)
class Cache:
    """A folder of .npz files, one a result."""

    folder: Path

    def smoothed(self, settings: Filter, points: Float64) -> tuple[Float64, float]:
        """What a classic with its settings makes of (n, 3) points, and the seconds that it took when it was computed.

        Computed again where the points, the settings, the code or the library's version differ.
        """
        points = np.ascontiguousarray(points, np.float64)
        path = self.folder / f"{_key(settings, points)}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                return stored["points"], float(stored["seconds"])
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):  # absent or cut short
            pass
        started = time.perf_counter()
        smoothed = settings(points)
        seconds = time.perf_counter() - started
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}.partial")
        with partial.open("wb") as output:
            np.savez(output, points=smoothed, seconds=seconds)
        partial.replace(path)
        return smoothed, seconds


def _key(settings: Filter, points: Float64) -> str:
    """SHA-256 of the points, the settings, the code and the version of the library that computes."""
    module = type(settings).__module__
    code = [Path(str(importlib.import_module(name).__file__)).read_bytes() for name in (module, unit.__name__)]
    library = LIBRARIES.get(module, "scipy")
    versions = [f"{name} {version(name)}" for name in packages_distributions().get(library, [])]
    digest = hashlib.sha256(repr((settings, points.shape, sorted(set(versions)))).encode())
    for part in (*code, points.tobytes()):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()
