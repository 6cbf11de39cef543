from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointfilter.metrics import (
    MSE_NEIGHBOURS,
    chamfer_distance,
    closest_on_surface,
    closest_on_triangle,
    mean_neighbour_distance,
    mean_square_error,
    normalised,
    point_to_surface,
)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, None] - b[None], axis=2)


def nearest_by_regions(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """By the regions of the barycentric coordinates: another way than the one in metrics.py."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    if d1 <= 0 and d2 <= 0:
        return a
    bp = p - b
    d3, d4 = ab @ bp, ac @ bp
    if d3 >= 0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return a + d1 / (d1 - d3) * ab
    cp = p - c
    d5, d6 = ab @ cp, ac @ cp
    if d6 >= 0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return a + d2 / (d2 - d6) * ac
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
    inside: np.ndarray = a + vb / (va + vb + vc) * ab + vc / (va + vb + vc) * ac
    return inside


def brute_force(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return np.array([min(np.linalg.norm(p - nearest_by_regions(p, *t)) for t in corners) for p in points])


@given(seed=st.integers(0, 2**32), m=st.integers(10, 40), n=st.integers(10, 40))
def test_distances_between_clouds_are_what_the_formulas_say(seed: int, m: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    clean, filtered = rng.normal(size=(m, 3)), rng.normal(size=(n, 3))
    between = distances(clean, filtered)
    chamfer = (between.min(axis=1) ** 2).mean() + (between.min(axis=0) ** 2).mean()
    assert chamfer_distance(clean, filtered) == pytest.approx(chamfer)
    nearest = np.sort(between, axis=1)[:, :MSE_NEIGHBOURS]
    assert mean_square_error(clean, filtered) == pytest.approx((nearest**2).mean())
    nearest = np.sort(between.T, axis=1)[:, :MSE_NEIGHBOURS]
    assert mean_neighbour_distance(clean, filtered) == pytest.approx(nearest.mean())


def test_a_cloud_is_at_no_distance_from_itself() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert chamfer_distance(points, points[::-1]) == 0


def test_normalising_gives_the_clean_cloud_a_diagonal_of_one_and_takes_the_others_along() -> None:
    clean = np.array([[10.0, 10, 10], [13, 14, 22]])
    unit, other = normalised(clean, clean + np.array([13, 0, 0]))
    assert np.linalg.norm(np.ptp(unit, axis=0)) == pytest.approx(1)
    np.testing.assert_allclose(unit.min(axis=0) + unit.max(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(other - unit, [[1, 0, 0]] * 2)


def triangles_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    corners = rng.normal(size=(25, 3, 3))
    if kind == "small":
        return 0.05 * corners + rng.normal(size=(25, 1, 3))
    if kind == "all sizes":
        return corners * 10.0 ** rng.uniform(-4, 1, (25, 1, 1)) + rng.normal(size=(25, 1, 3))
    if kind == "thin":
        corners[:, 2] = (corners[:, 0] + corners[:, 1]) / 2 + 1e-4 * rng.normal(size=(25, 3))
    if kind == "flat":
        corners[:, 2] = corners[:, 0] + rng.uniform(-1, 2, (25, 1)) * (corners[:, 1] - corners[:, 0])
    if kind == "points":
        corners[:] = corners[:, :1]
    if kind == "some points":
        corners[::2] = corners[::2, :1]
    return corners


KINDS = ["large", "small", "all sizes", "thin", "points", "some points"]


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32), kind=st.sampled_from(KINDS))
def test_the_distance_to_a_surface_is_the_least_over_all_triangles(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    corners = triangles_of(kind, rng)
    points = np.vstack([rng.normal(size=(20, 3)), corners[:5].mean(axis=1), corners[:5, 1]])
    mesh = corners.reshape(-1, 3), np.arange(75).reshape(-1, 3)
    expected = brute_force(points, corners)
    np.testing.assert_allclose(point_to_surface(points, *mesh), expected, atol=1e-9)
    places = closest_on_surface(points, *mesh)
    np.testing.assert_allclose(np.linalg.norm(points - places, axis=1), expected, atol=1e-9)
    np.testing.assert_allclose(
        brute_force(places, corners), 0, atol=1e-5
    )  # the regions of thin ones are ill-conditioned


def test_triangles_without_an_area_count_as_their_edges() -> None:
    rng = np.random.default_rng(0)
    corners = triangles_of("flat", rng)
    points = rng.normal(size=(25, 3))
    t = np.linspace(0, 1, 4001)[:, None]
    for k in range(25):
        edges = np.vstack([a + t * (b - a) for a, b in zip(corners[k], np.roll(corners[k], 1, axis=0), strict=True)])
        sampled = np.linalg.norm(edges - points[k], axis=1).min()
        assert np.linalg.norm(points[k] - closest_on_triangle(points[k : k + 1], corners[k : k + 1])) == pytest.approx(
            sampled, abs=1e-3
        )


def test_a_long_strip_beside_small_triangles() -> None:
    """The nearest triangle is one whose centre is far away."""
    strip = np.array([[-1000.0, 0, 0], [1000, 0, 0], [0, 0.001, 0]])
    small = np.array([[300.0, 5, 0], [300.1, 5, 0], [300, 5.1, 0]])
    vertices, faces = np.vstack([strip, small]), np.array([[0, 1, 2], [3, 4, 5]])
    found = point_to_surface(np.array([[300.0, -1, 0], [300.0, 4.9, 0]]), vertices, faces)
    np.testing.assert_allclose(found, [1, 0.1], atol=1e-9)


def test_distances_agree_with_trimesh() -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("rtree", reason="trimesh's proximity needs rtree")
    mesh = trimesh.creation.icosphere(2)
    points = np.random.default_rng(0).normal(size=(200, 3))
    _, expected, _ = trimesh.proximity.closest_point(mesh, points)
    np.testing.assert_allclose(point_to_surface(points, mesh.vertices, mesh.faces), expected, atol=1e-9)


def test_a_point_on_the_surface_is_at_no_distance() -> None:
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(10, 3, 3))
    weights = rng.dirichlet(np.ones(3), size=10)
    on = np.einsum("nk,nkd->nd", weights, corners)
    assert point_to_surface(on, corners.reshape(-1, 3), np.arange(30).reshape(-1, 3)).max() < 1e-12
