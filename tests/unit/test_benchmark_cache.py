"""The classics' cache: computed once for the same points and settings, and again where anything differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh", reason="the benchmarks extra is not installed")

from benchmarks.cache import Cache
from benchmarks.classics import Filter, MovingLeastSquares


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[Filter]:
    calls: list[Filter] = []

    def smooth(self: MovingLeastSquares, points: np.ndarray) -> np.ndarray:
        calls.append(self)
        return points + self.radius

    monkeypatch.setattr(MovingLeastSquares, "__call__", smooth)
    return calls


def test_a_result_is_computed_once(tmp_path: Path, computed: list[Filter]) -> None:
    cache = Cache(tmp_path / "new" / "folder")
    settings, points = MovingLeastSquares(0.02, 0.02, 1), np.random.default_rng(0).random((20, 3))
    first = cache.smoothed(settings, points)
    again = cache.smoothed(settings, points.copy())
    np.testing.assert_array_equal(first[0], points + 0.02)
    np.testing.assert_array_equal(first[0], again[0])
    assert first[1] == again[1] > 0
    assert len(computed) == 1


def test_other_points_settings_or_code_are_other_results(
    tmp_path: Path, computed: list[Filter], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = Cache(tmp_path)
    settings, points = MovingLeastSquares(0.02, 0.02, 1), np.random.default_rng(0).random((20, 3))
    cache.smoothed(settings, points)
    cache.smoothed(settings, points + 1e-9)
    cache.smoothed(MovingLeastSquares(0.02, 0.02, 2), points)
    assert len(computed) == 3
    monkeypatch.setattr(Path, "read_bytes", lambda self: b"other code")
    cache.smoothed(settings, points)
    assert len(computed) == 4


def test_a_file_that_was_cut_short_is_computed_again(tmp_path: Path, computed: list[Filter]) -> None:
    cache = Cache(tmp_path)
    settings, points = MovingLeastSquares(0.02, 0.02, 1), np.zeros((20, 3))
    cache.smoothed(settings, points)
    (stored,) = tmp_path.iterdir()
    for damaged in (stored.read_bytes()[:-30], b"", b"PK"):
        stored.write_bytes(damaged)
        np.testing.assert_array_equal(cache.smoothed(settings, points)[0], points + 0.02)
    assert len(computed) == 4
