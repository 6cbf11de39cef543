from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, PointfilterError, Radius, filter_cloud
from pointfilter.errors import DegenerateCloudError, ParameterError, TooFewPointsError
from pointfilter.filter import DEFAULT_ITERATIONS, DEFAULT_RADIUS
from tests.clouds import filter_points
from tests.ply_files import ply_bytes


@pytest.mark.parametrize(
    ("text", "value", "relative"),
    [("5%", 0.05, True), (" 5 % ", 0.05, True), ("100%", 1.0, True), ("0.02", 0.02, False), ("1e3", 1000.0, False)],
)
def test_a_radius_is_a_share_or_a_length(text: str, value: float, relative: bool) -> None:
    radius = Radius.parse(text)
    assert radius.value == pytest.approx(value)
    assert radius.relative is relative


@pytest.mark.parametrize(
    "text", ["", "%", "0", "0%", "-1", "-5%", "100.1%", "nan", "inf", "nan%", "5 percent", "1e400", "5%%"]
)
def test_a_radius_that_is_none_names_both_forms(text: str) -> None:
    with pytest.raises(ParameterError, match=r"0\.02.*5%") as caught:
        Radius.parse(text)
    assert caught.value.actual == text


def test_a_bundle_without_a_calibration_runs_in_the_paper_s_mode(engine: Engine, noisy_crease: np.ndarray) -> None:
    clean, report = filter_cloud(PointCloud(noisy_crease.copy()), engine)
    diagonal = float(np.linalg.norm(np.ptp(noisy_crease, axis=0)))
    assert report.iterations == DEFAULT_ITERATIONS
    assert report.radius == report.radius_low == report.radius_high == pytest.approx(DEFAULT_RADIUS * diagonal)
    assert report.expected_error is None
    expected = filter_points(noisy_crease, engine, patch_points=engine.bundle.patch_points)
    np.testing.assert_allclose(clean.xyz, expected, rtol=0, atol=1e-6 * report.radius)


def test_the_default_bundle_chooses_and_says_how_sure_it_is(default_engine: Engine, noisy_crease: np.ndarray) -> None:
    cloud = PointCloud(noisy_crease.copy())
    clean, report = filter_cloud(cloud, default_engine)
    assert report.moved == (clean.xyz != noisy_crease).any(axis=1).sum() > 300
    assert 0 < report.radius_low <= report.radius <= report.radius_high
    assert report.expected_error is not None
    assert 0 < report.expected_error < 0.02
    _, paper = filter_cloud(cloud, default_engine, paper=True)
    assert paper.iterations == DEFAULT_ITERATIONS
    assert paper.radius == pytest.approx(DEFAULT_RADIUS * float(np.linalg.norm(np.ptp(noisy_crease, axis=0))))


def test_strength_and_the_longest_move(default_engine: Engine, noisy_crease: np.ndarray) -> None:
    cloud = PointCloud(noisy_crease.copy())
    full = filter_cloud(cloud, default_engine)[0].xyz - noisy_crease
    none, report = filter_cloud(cloud, default_engine, strength=0.0)
    np.testing.assert_array_equal(none.xyz, noisy_crease)
    assert report.moved == 0
    half = filter_cloud(cloud, default_engine, strength=0.5)[0].xyz - noisy_crease
    np.testing.assert_allclose(half, full / 2, atol=1e-12)
    limit = float(np.median(np.linalg.norm(full, axis=1)))
    short, report = filter_cloud(cloud, default_engine, max_move=limit)
    lengths = np.linalg.norm(short.xyz - noisy_crease, axis=1)
    np.testing.assert_allclose(lengths, np.minimum(np.linalg.norm(full, axis=1), limit), atol=1e-12)
    assert report.largest_displacement <= limit * (1 + 1e-9)


@pytest.mark.parametrize("options", [{"strength": 1.5}, {"strength": -0.1}, {"max_move": 0.0}, {"max_move": np.nan}])
def test_limits_that_make_no_sense_are_named(
    options: dict[str, float], engine: Engine, noisy_crease: np.ndarray
) -> None:
    with pytest.raises(ParameterError, match=next(iter(options))):
        filter_cloud(PointCloud(noisy_crease.copy()), engine, **options)


def test_placeholders_and_coarse_coordinates_are_warned_of(
    engine: Engine, default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path
) -> None:
    _, report = filter_cloud(PointCloud(np.vstack([noisy_crease, np.zeros((40, 3))])), engine)
    assert report.placeholders == 40
    assert any("40 rows" in warning for warning in report.warnings)
    far = tmp_path / "far.ply"
    rows = [tuple(row) for row in (noisy_crease + np.array([5e6, 0, 0])).tolist()]
    far.write_bytes(ply_bytes("ascii", rows, ["float x", "float y", "float z"]))
    _, report = filter_cloud(PointCloud.read(far), default_engine)
    assert any("float32" in warning for warning in report.warnings)


def test_the_report_says_what_was_done(engine: Engine, noisy_crease: np.ndarray) -> None:
    clean, report = filter_cloud(
        PointCloud(noisy_crease.copy()), engine, iterations=1, radius=Radius(0.2, False), seed=9
    )
    moved = np.linalg.norm(clean.xyz - noisy_crease, axis=1)
    assert report.mean_displacement == pytest.approx(moved.mean())
    assert report.largest_displacement == pytest.approx(moved.max())
    assert (report.points, report.skipped, report.iterations, report.radius, report.seed) == (600, 0, 1, 0.2, 9)
    assert (report.model, report.model_sha256) == (engine.bundle.name, engine.bundle.sha256)
    assert report.seconds.keys() == {"index", "balls", "patches", "infer", "total"}
    json.dumps(report.as_dict())
    for fact in (report.model, report.model_version, report.model_sha256[:16], "iterations 1", "radius 0.2", "seed 9"):
        assert fact in report.comment
    assert report.comment.isascii()
    assert report.comment.isprintable()


def test_rows_without_a_place_are_passed_through(engine: Engine, noisy_crease: np.ndarray) -> None:
    holes = noisy_crease.copy()
    holes[::7, 1] = np.nan
    holes[3] = np.inf
    cloud = PointCloud(holes)
    clean, report = filter_cloud(cloud, engine, radius=Radius(0.15, False))
    assert report.skipped == (~cloud.finite).sum()
    np.testing.assert_array_equal(clean.xyz[~cloud.finite], holes[~cloud.finite])
    alone, _ = filter_cloud(PointCloud(holes[cloud.finite]), engine, radius=Radius(0.15, False))
    np.testing.assert_array_equal(clean.xyz[cloud.finite], alone.xyz)


@pytest.mark.parametrize("radius", [None, Radius(0.1, True), Radius(1.0, False)])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_are_too_few_whatever_the_radius(count: int, radius: Radius | None, engine: Engine) -> None:
    cloud = PointCloud(np.vstack([np.eye(3)[:count], np.full((5, 3), np.nan)]))
    with pytest.raises(TooFewPointsError, match=f"has {count}"):
        filter_cloud(cloud, engine, radius=radius)


def test_no_extent_is_an_error_for_a_share_of_it_only(engine: Engine) -> None:
    cloud = PointCloud(np.ones((20, 3)))
    with pytest.raises(DegenerateCloudError):
        filter_cloud(cloud, engine)
    _, report = filter_cloud(cloud, engine, radius=Radius(1.0, False))
    assert report.radius == 1.0


def test_progress_and_cancellation_reach_the_filter(engine: Engine, noisy_crease: np.ndarray) -> None:
    seen: list[tuple[int, int]] = []
    filter_cloud(PointCloud(noisy_crease.copy()), engine, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (1200, 1200)
    with pytest.raises(PointfilterError, match="cancelled"):
        filter_cloud(PointCloud(noisy_crease.copy()), engine, cancelled=lambda: True)
