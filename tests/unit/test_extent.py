from __future__ import annotations

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, filter_cloud
from pointfilter.errors import DegenerateCloudError
from pointfilter.extent import extent, stray
from pointfilter.filtering import resolve_radius
from pointfilter.noise import add_noise, bounding_box_diagonal
from pointfilter.pipeline import Radius
from tests.clouds import crease, rotation


def far_away(cloud: np.ndarray, count: int, reach: float) -> np.ndarray:
    """(count, 3) points around a cloud, `reach` diagonals away from it."""
    directions = np.random.default_rng(5).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return cloud.mean(axis=0) + reach * bounding_box_diagonal(cloud) * directions


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    """(3000, 3) float64: two planes that meet, with noise of 0.5 %."""
    rng = np.random.default_rng(1)
    return add_noise(crease(3_000, rng), 0.005, rng)


@pytest.mark.parametrize("reach", [1, 3, 1e3, 1e7])
@pytest.mark.parametrize("count", [1, 10, 25])
def test_stray_points_do_not_stretch_the_extent(cloud: np.ndarray, count: int, reach: float) -> None:
    points = np.vstack([cloud, far_away(cloud, count, reach)])
    np.testing.assert_array_equal(stray(points), np.arange(len(points)) >= len(cloud))
    assert extent(points) == bounding_box_diagonal(cloud)
    assert resolve_radius(points, None, 0.05) == 0.05 * bounding_box_diagonal(cloud)


def test_a_clump_far_away_is_stray_too(cloud: np.ndarray) -> None:
    clump = far_away(cloud, 1, 4) + 0.001 * np.random.default_rng(0).normal(size=(5, 3))
    assert extent(np.vstack([cloud, clump])) == bounding_box_diagonal(cloud)


@pytest.mark.parametrize("level", [0.0, 0.01, 0.025])
@pytest.mark.parametrize("kind", ["gaussian", "impulsive", "uniform", "outliers"])
def test_noise_is_not_stray(level: float, kind: str) -> None:
    rng = np.random.default_rng(2)
    for count in (400, 4_000):
        points = add_noise(crease(count, rng), level, rng, kind)  # type: ignore[arg-type]
        assert extent(points) == bounding_box_diagonal(points)


def test_what_belongs_to_the_cloud_is_not_stray() -> None:
    """A mast of 60 points on a plate of 6 000; and two plates side by side, the small one with a hundredth of them."""
    rng = np.random.default_rng(3)
    plate = rng.uniform(-1, 1, (6_000, 3)) * [1, 1, 0]
    mast = np.column_stack([0.01 * rng.normal(size=(300, 2)), np.linspace(0, 3, 300)])
    for points in (np.vstack([plate, mast]), np.vstack([plate, 0.1 * plate[:60] + [6, 0, 0]])):
        assert extent(points) == bounding_box_diagonal(points)


def test_row_order_pose_and_scale_have_no_say(cloud: np.ndarray) -> None:
    rng = np.random.default_rng(4)
    points = np.vstack([cloud, far_away(cloud, 7, 5)])
    shuffled = rng.permutation(len(points))
    np.testing.assert_array_equal(stray(points[shuffled]), stray(points)[shuffled])
    np.testing.assert_array_equal(stray(1e-3 * points @ rotation(rng).T - 12), stray(points))


def test_few_equal_or_boundless_points() -> None:
    few = np.random.default_rng(0).normal(size=(6, 3))
    assert extent(few) == bounding_box_diagonal(few)
    assert extent(np.zeros((0, 3))) == 0
    assert extent(np.ones((300, 3))) == 0
    assert extent(np.vstack([np.zeros((300, 3)), np.ones((1, 3))])) == pytest.approx(np.sqrt(3))
    assert extent(np.array([[1e308, 0, 0], [-1e308, 0, 0]])) == np.inf
    with pytest.raises(DegenerateCloudError, match="stray"):
        resolve_radius(np.array([[1e308, 0, 0], [-1e308, 0, 0]]), None)


def test_a_cloud_is_filtered_as_well_with_stray_points_as_without(default_engine: Engine) -> None:
    """Two planes of 1.2 rad: how far their points lie from them. The stray points stay where they are."""
    rng = np.random.default_rng(6)
    clean = crease(4_000, rng)
    noisy = add_noise(clean, 0.01, rng)
    strays = far_away(noisy, 5, 20)
    points = np.vstack([noisy, strays])

    def distance(found: np.ndarray) -> float:
        flat = np.abs(found[:, 2])
        turned = np.abs(found[:, 0] * np.sin(1.2) - found[:, 2] * np.cos(1.2))
        return float(np.minimum(flat, turned).mean())

    alone, _ = filter_cloud(PointCloud(noisy), default_engine)
    together, report = filter_cloud(PointCloud(points), default_engine)
    assert distance(alone.xyz) < 0.4 * distance(noisy)
    assert distance(together.xyz[:4_000]) == pytest.approx(distance(alone.xyz), rel=0.05)
    np.testing.assert_array_equal(together.xyz[4_000:], strays)
    assert report.radius < 0.08 * bounding_box_diagonal(noisy)
    _, given = filter_cloud(PointCloud(points), default_engine, iterations=1, radius=Radius.parse("5%"))
    assert given.radius == 0.05 * bounding_box_diagonal(noisy)
