"""The classic filters of the benchmark: they take noise away, in place, and stand what clouds are made of."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.classics import (
    SETTINGS,
    BilateralSmoothing,
    Filter,
    JetSmoothing,
    MovingLeastSquares,
    Open3dBilateral,
    Open3dMls,
    Rimls,
    Wlop,
    available,
    smooth,
    tuned,
)
from benchmarks.classics.mls import filtered_normals, oriented_normals
from benchmarks.classics.tuning import variations

OURS: list[Filter] = [MovingLeastSquares(0.08, 0.08, 1), Rimls(0.06, 0.05, 0.5, 1, 0.8, 1)]
CGAL: list[Filter] = [Wlop(0.06, 4), BilateralSmoothing(40, 40, 30.0, 2), JetSmoothing(40, 1)]
OPEN3D: list[Filter] = [Open3dMls(0.05, 40, 1), Open3dBilateral(0.05, 40, 0.025, 0.03, 1)]


def named(method: object) -> str:
    return type(method).__name__


def noisy_sphere(points: int = 3000, noise: float = 0.01, seed: int = 1) -> np.ndarray:
    """Radius 1, noise along the normals, away from the origin."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (1 + noise * rng.normal(size=(points, 1))) + [5.0, 6.0, 7.0]


def off_sphere(points: np.ndarray) -> float:
    return float(np.abs(np.linalg.norm(points - [5.0, 6.0, 7.0], axis=1) - 1).mean())


@pytest.fixture(params=[*OURS, *CGAL, *OPEN3D], ids=named)
def method(request: pytest.FixtureRequest) -> Filter:
    if request.param in CGAL:
        pytest.importorskip("CGAL", reason="pip install cgal")
    if request.param in OPEN3D and available()["Open3D MLS"]:
        pytest.skip(available()["Open3D MLS"])
    chosen: Filter = request.param
    return chosen


def test_takes_most_of_the_noise_away(method: Filter) -> None:
    noisy = noisy_sphere(noise=0.03)
    before = noisy.copy()
    filtered = method(noisy)
    assert filtered.shape == noisy.shape
    assert filtered.dtype == np.float64
    assert off_sphere(filtered) < 0.6 * off_sphere(noisy)
    np.testing.assert_array_equal(noisy, before)


def test_keeps_rows_in_order(method: Filter) -> None:
    if isinstance(method, Wlop):
        pytest.skip("WLOP returns its points in an order of CGAL's own")
    noisy = noisy_sphere()
    assert np.linalg.norm(method(noisy) - noisy, axis=1).max() < 0.1


def test_settings_are_fractions_of_the_diagonal(method: Filter) -> None:
    noisy = noisy_sphere(points=1000)
    scaled = method(noisy * 8)
    if isinstance(method, Wlop):  # the order is shuffled
        assert off_sphere(scaled / 8) == pytest.approx(off_sphere(method(noisy)), rel=0.1)
    else:
        np.testing.assert_allclose(scaled / 8, method(noisy), atol=1e-6)


@pytest.mark.parametrize("points", [0, 1, 2, 3, 9, 10, 12])
def test_stands_few_points(method: Filter, points: int) -> None:
    filtered = method(noisy_sphere()[:points])
    assert filtered.shape == (points, 3)
    assert np.isfinite(filtered).all()


def test_stands_duplicates(method: Filter) -> None:
    noisy = noisy_sphere(points=1000)
    filtered = method(np.repeat(noisy, 3, axis=0))
    assert np.isfinite(filtered).all()
    if not isinstance(method, Wlop):
        np.testing.assert_array_equal(filtered[::3], filtered[1::3])
        np.testing.assert_allclose(filtered[::3], method(noisy), atol=1e-9)
    same = np.ones((50, 3))
    np.testing.assert_array_equal(method(same), same)


def test_stands_lines_planes_and_outliers(method: Filter) -> None:
    along = np.linspace(0, 1, 60)
    line = np.stack([along, along, along], axis=1)
    square = np.stack([*np.meshgrid(along[::3], along[::3]), np.zeros((20, 20))], axis=-1).reshape(-1, 3)
    lonely = np.vstack([noisy_sphere(points=500), [[50.0, 0.0, 0.0]]])
    for cloud in (line, square, lonely):
        filtered = method(cloud)
        assert filtered.shape == cloud.shape
        assert np.isfinite(filtered).all()


def test_mls_is_exact_on_a_quadric() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, size=(2, 4000))
    graph = np.stack([x, y, 0.05 * (x * x - y * y + x * y)], axis=1)
    inside = np.abs(graph[:, :2]).max(axis=1) < 0.7
    moved = MovingLeastSquares(0.05, 0.05, 1)(graph)
    assert np.abs(moved - graph)[inside].max() < 1e-4


def test_mls_moves_few_neighbours_to_their_plane() -> None:
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), [0.0]), axis=-1).reshape(-1, 3)
    moved = MovingLeastSquares(1.2 / np.hypot(5, 5), 0.1, 1)(grid)
    np.testing.assert_allclose(moved, grid, atol=1e-9)


def test_rimls_keeps_an_edge_that_mls_rounds() -> None:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, 1, size=(2, 4000))
    roof = np.stack([u - 0.5, v, -np.abs(u - 0.5)], axis=1)
    noisy = roof + 0.003 * rng.normal(size=roof.shape)

    def off_ridge(points: np.ndarray) -> float:
        ridge = (np.abs(points[:, 0]) < 0.03) & (np.abs(points[:, 1] - 0.5) < 0.4)
        return float(np.abs(points[ridge, 2] + np.abs(points[ridge, 0])).mean() / np.sqrt(2))

    kept = off_ridge(Rimls(0.06, 0.04, 0.3, 4, 0.4, 1)(noisy))
    rounded = off_ridge(MovingLeastSquares(0.06, 0.06, 1)(noisy))
    assert kept < 0.6 * rounded


def test_normals_point_one_way_and_get_better() -> None:
    noisy = noisy_sphere(noise=0.02)
    outward = (noisy - [5.0, 6.0, 7.0]) / np.linalg.norm(noisy - [5.0, 6.0, 7.0], axis=1, keepdims=True)
    normals = oriented_normals(noisy, 0.2)
    alignment = np.einsum("nd,nd->n", normals, outward)
    assert (alignment > 0.5).all()
    better = np.einsum("nd,nd->n", filtered_normals(noisy, normals, 0.3, 0.5), outward)
    assert better.mean() > alignment.mean()


def test_normals_of_separate_pieces_all_point_up_at_their_top() -> None:
    first = noisy_sphere(points=500)
    pieces = np.vstack([first, first + 100.0])
    normals = oriented_normals(pieces, 0.4)
    for piece in (slice(0, 500), slice(500, 1000)):
        centre = pieces[piece].mean(axis=0)
        assert (np.einsum("nd,nd->n", normals[piece], pieces[piece] - centre) > 0).all()


def test_nearest_settings_are_chosen() -> None:
    for method, entries in SETTINGS.items():
        for (noise, points), settings in entries.items():
            assert tuned(method, noise, points) == settings
            assert tuned(method, noise * 1.05, int(points * 0.95)) == settings
        for noise, points in ((0.0, 1), (1.0, 10**9)):
            assert tuned(method, noise, points) in entries.values()


def test_available_names_every_method_and_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(available()) == set(SETTINGS)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert available()["CGAL WLOP"] == "pip install cgal"
    assert available()["Open3D MLS"].startswith("pip install 'open3d-cpu>=0.20'")
    assert available()["RIMLS"] == ""


@pytest.mark.parametrize(("installed", "usable"), [("0.19.0", False), ("0.20.0", True), ("1.0.0rc1", True)])
def test_an_older_open3d_is_left_out(installed: str, usable: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    monkeypatch.setattr("benchmarks.classics.packages_distributions", lambda: {"open3d": ["open3d-cpu"]})
    monkeypatch.setattr("benchmarks.classics.version", lambda name: installed)
    assert (available()["Open3D bilateral"] == "") == usable


@pytest.mark.parametrize("name", list(SETTINGS))
def test_smooth_uses_the_tuned_settings(name: str) -> None:
    if available()[name]:
        pytest.skip(available()[name])
    noisy = noisy_sphere(points=2000, noise=0.02)
    filtered = smooth(name, noisy.astype(np.float32), 0.005)
    assert filtered.dtype == np.float64
    assert filtered.shape == noisy.shape


def test_variations_change_one_setting_each() -> None:
    for settings in (*OURS, *CGAL, *OPEN3D):
        for other in variations(settings):
            changed = [name for name, value in vars(settings).items() if vars(other)[name] != value]
            assert len(changed) == 1
            assert type(vars(other)[changed[0]]) is type(vars(settings)[changed[0]])
