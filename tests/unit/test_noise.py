from __future__ import annotations

import numpy as np
import pytest

from pointfilter.errors import ParameterError
from pointfilter.noise import IMPULSE_SHARE, NOISE_KINDS, OUTLIER_SHARE, NoiseKind, add_noise, bounding_box_diagonal

COUNT = 40_000
LEVEL = 0.01


@pytest.fixture(scope="module")
def cube() -> np.ndarray:
    points = np.random.default_rng(0).uniform(size=(COUNT, 3))
    points[:2] = [[0, 0, 0], [1, 1, 1]]
    return points


def moved(points: np.ndarray, kind: NoiseKind) -> np.ndarray:
    return add_noise(points, LEVEL, np.random.default_rng(1), kind) - points


def test_the_diagonal() -> None:
    assert bounding_box_diagonal(np.array([[1.0, 2, 3], [4, 6, 15]])) == 13
    assert bounding_box_diagonal(np.empty((0, 3))) == 0
    assert bounding_box_diagonal(np.array([[1e308, 0, 0], [-1e308, 0, 0]])) == np.inf


def test_gaussian_noise_has_its_moments(cube: np.ndarray) -> None:
    offsets = moved(cube, "gaussian")
    scale = LEVEL * bounding_box_diagonal(cube)
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=4 * scale / COUNT**0.5)
    np.testing.assert_allclose(offsets.std(axis=0), scale, rtol=0.02)
    np.testing.assert_allclose(((offsets / scale) ** 4).mean(), 3, rtol=0.05)


def test_impulsive_noise_moves_one_point_in_ten_twice_as_far(cube: np.ndarray) -> None:
    offsets = moved(cube, "impulsive")
    hit = offsets.any(axis=1)
    assert hit.mean() == pytest.approx(IMPULSE_SHARE, abs=0.006)
    np.testing.assert_allclose(offsets[hit].std(axis=0), 2 * LEVEL * bounding_box_diagonal(cube), rtol=0.05)


def test_uniform_noise_fills_a_ball(cube: np.ndarray) -> None:
    lengths = np.linalg.norm(moved(cube, "uniform"), axis=1) / (LEVEL * bounding_box_diagonal(cube))
    assert lengths.max() <= 1 + 1e-9
    assert (lengths < 0.5).mean() == pytest.approx(1 / 8, abs=0.008)
    np.testing.assert_allclose(moved(cube, "uniform").mean(axis=0), 0, atol=1e-3)


def test_outliers_are_few_and_near_the_box(cube: np.ndarray) -> None:
    offsets = moved(cube, "outliers")
    far = np.linalg.norm(offsets, axis=1) > 6 * LEVEL * bounding_box_diagonal(cube)
    assert far.mean() == pytest.approx(OUTLIER_SHARE, abs=0.002)
    noisy = cube + offsets
    assert noisy[far].min() >= -0.05
    assert noisy[far].max() <= 1.05


@pytest.mark.parametrize("kind", NOISE_KINDS)
def test_noise_is_decided_by_its_generator_alone(kind: NoiseKind, cube: np.ndarray) -> None:
    points = cube[:100].copy()
    np.testing.assert_array_equal(moved(points, kind), moved(points, kind))
    assert (add_noise(points, LEVEL, np.random.default_rng(2), kind) - points != moved(points, kind)).any()
    np.testing.assert_array_equal(points, cube[:100])


@pytest.mark.parametrize("kind", ["gaussian", "impulsive", "uniform"])
def test_no_noise_is_none(kind: NoiseKind, cube: np.ndarray) -> None:
    np.testing.assert_array_equal(add_noise(cube, 0.0, np.random.default_rng(0), kind), cube)


def test_a_diagonal_of_one_s_own(cube: np.ndarray) -> None:
    offsets = add_noise(cube, LEVEL, np.random.default_rng(0), diagonal=100.0) - cube
    np.testing.assert_allclose(offsets.std(), 1.0, rtol=0.02)


@pytest.mark.parametrize(("level", "kind"), [(-0.1, "gaussian"), (float("nan"), "gaussian"), (0.1, "pink")])
def test_noise_that_there_is_not(level: float, kind: NoiseKind, cube: np.ndarray) -> None:
    with pytest.raises(ParameterError, match="noise"):
        add_noise(cube, level, np.random.default_rng(0), kind)
