from __future__ import annotations

import numpy as np
import pytest
import trimesh

from training import scanning
from training.scanning import scan
from training.shapes import Mesh, random_shape


@pytest.fixture(scope="module")
def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5 / np.sqrt(3))
    normals = np.asarray(sphere.vertex_normals)[sphere.faces]
    return Mesh(np.asarray(sphere.vertices, np.float64), np.asarray(sphere.faces, np.int64), normals)


RADIUS = 0.5 / np.sqrt(3)


@pytest.mark.parametrize("seed", range(40))
def test_scans_are_finite_of_the_size_asked_for_and_decided_by_the_seed(ball: Mesh, seed: int) -> None:
    points = scan(ball, 600, 0.01, np.random.default_rng(seed), plain_share=0.0)
    assert points.dtype == np.float64
    assert points.shape[1:] == (3,)
    assert 200 <= len(points) <= 720
    assert np.isfinite(points).all()
    far = np.abs(np.linalg.norm(points, axis=1) - RADIUS) > 0.08  # outliers
    assert far.mean() < 0.04
    np.testing.assert_array_equal(points, scan(ball, 600, 0.01, np.random.default_rng(seed), plain_share=0.0))


@pytest.mark.parametrize("seed", range(6))
def test_procedural_shapes_can_be_scanned(seed: int) -> None:
    points = scan(random_shape(seed), 900, 0.0, np.random.default_rng(seed), plain_share=0.0)
    assert 300 <= len(points) <= 1080
    assert np.isfinite(points).all()


def test_a_plain_scan_is_even_with_gaussian_noise(ball: Mesh) -> None:
    points = scan(ball, 20_000, 0.02, np.random.default_rng(0), plain_share=1.0)
    assert len(points) == 20_000
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.01)
    assert (np.linalg.norm(points, axis=1) - RADIUS).std() == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(("count", "level"), [(9, 0.01), (100, -0.1), (100, float("nan"))])
def test_settings_without_meaning(ball: Mesh, count: int, level: float) -> None:
    with pytest.raises(ValueError, match="count"):
        scan(ball, count, level, np.random.default_rng(0))


def test_a_view_point_sees_its_side_of_a_ball(ball: Mesh) -> None:
    points, _ = ball.sample(5000, np.random.default_rng(0))
    seen = scanning.visible(points, np.array([0.0, 0.0, 3.0]))
    assert seen[points[:, 2] > 0.2 * RADIUS].mean() > 0.95
    assert seen[points[:, 2] < -0.2 * RADIUS].mean() < 0.02


def test_a_flat_cloud_seen_from_its_plane_is_visible() -> None:
    flat = np.column_stack([np.random.default_rng(0).random((50, 2)), np.zeros(50)])
    assert scanning.visible(flat, np.array([3.0, 0.0, 0.0])).all()


def test_views_share_the_points_and_see_their_own_side(ball: Mesh) -> None:
    views = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    points, view = scanning.seen_from(ball, 2000, views, np.random.default_rng(0))
    assert np.bincount(view).tolist() == [1000, 1000]
    assert (np.sign(points[:, 2]) == np.where(view == 0, 1, -1)).mean() > 0.9


def test_density_falls(ball: Mesh) -> None:
    points, _ = ball.sample(2000, np.random.default_rng(0))
    falling = scanning.falling_density(points, np.random.default_rng(1))
    assert 0 < falling.min() <= 0.5
    assert falling.max() == pytest.approx(1)
    view_point = np.array([1.0, 0.0, 0.0])
    near = scanning.distance_density(points, view_point, np.random.default_rng(1))
    assert near[points[:, 0] > 0].mean() > near[points[:, 0] < 0].mean()
    assert near.max() <= 1


def test_a_plane_cuts_a_cloud_open(ball: Mesh) -> None:
    points, _ = ball.sample(2000, np.random.default_rng(0))
    for seed in range(5):
        assert 0.5 <= scanning.cut_open(points, np.random.default_rng(seed)).mean() <= 0.91


@pytest.mark.parametrize("noise", [scanning.gaussian, *scanning._NOISES], ids=lambda noise: noise.__name__)
def test_every_kind_of_noise_has_the_level_asked_for(noise: scanning.Noise) -> None:
    still = np.zeros((40_000, 3))
    rng = np.random.default_rng(0)
    assert noise(still, 0.01, rng).std() == pytest.approx(0.01, rel=0.03)
    half = np.repeat([[0.0], [0.01]], 20_000, axis=0)
    moved = noise(still, half, rng)
    assert not moved[:20_000].any()
    assert moved[20_000:].std() == pytest.approx(0.01, rel=0.05)


def test_noise_along_the_view_rays() -> None:
    rays = np.tile([0.0, 0.0, 1.0], (20_000, 1))
    moved = scanning.along_rays(np.zeros((20_000, 3)), 0.01, np.random.default_rng(0), rays)
    assert moved.std() == pytest.approx(0.01, rel=0.05)
    assert moved[:, 2].std() > 10 * moved[:, 0].std()


def test_impulsive_noise_leaves_nine_points_in_ten() -> None:
    moved = scanning.impulsive(np.zeros((5000, 3)), 0.01, np.random.default_rng(0))
    assert moved.any(axis=1).mean() == pytest.approx(0.1, abs=0.02)


def test_levels_vary_smoothly(ball: Mesh) -> None:
    points, _ = ball.sample(2000, np.random.default_rng(0))
    factor = scanning.smooth_factor(points, np.random.default_rng(1))
    assert factor.shape == (2000, 1)
    assert 0.2 <= factor.min() < factor.max() <= 1.8
    nearby = scanning.smooth_factor(points + 1e-4, np.random.default_rng(1))
    assert np.abs(nearby - factor).max() < 0.01


def test_other_defects(ball: Mesh) -> None:
    points, _ = ball.sample(2000, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    view = np.repeat([0, 1], 1000)
    shifts = scanning.misregistered(points, view, 0.01, rng) - points
    for part in (shifts[:1000], shifts[1000:]):
        np.testing.assert_allclose(part, np.tile(part[0], (1000, 1)), atol=1e-12)
        assert np.linalg.norm(part[0]) <= 0.01
    assert (shifts[0] != shifts[-1]).any()

    rounded = scanning.quantised(points, 0.01, rng)
    assert np.abs(rounded - points).max() <= 0.005 + 1e-12
    assert len(np.unique(rounded[:, 0].round(9))) <= 60

    doubled = scanning.with_duplicates(points, rng)
    assert 2000 <= len(doubled) <= 2200
    assert len(np.unique(doubled, axis=0)) == 2000

    stray = (scanning.with_outliers(points, rng) != points).any(axis=1)
    assert 0 < stray.mean() < 0.03
