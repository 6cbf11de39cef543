from __future__ import annotations

import json

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, PointfilterError, Radius, filter_cloud, filter_points
from pointfilter.errors import DegenerateCloudError, ParameterError, TooFewPointsError


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


def test_the_defaults_are_the_bundle_s(engine: Engine, noisy_crease: np.ndarray) -> None:
    clean, report = filter_cloud(PointCloud(noisy_crease.copy()), engine)
    diagonal = float(np.linalg.norm(np.ptp(noisy_crease, axis=0)))
    assert report.iterations == engine.bundle.iterations
    assert report.radius >= engine.bundle.radius * diagonal  # more where a ball holds too few points: test_automatic.py
    expected = filter_points(
        noisy_crease,
        engine,
        radius=report.radius,
        iterations=report.iterations,
        patch_points=engine.bundle.patch_points,
    )
    np.testing.assert_allclose(clean.xyz, expected, rtol=0, atol=1e-6 * report.radius)


def test_the_report_says_what_was_done(engine: Engine, noisy_crease: np.ndarray) -> None:
    clean, report = filter_cloud(
        PointCloud(noisy_crease.copy()), engine, iterations=1, radius=Radius(0.2, False), seed=9
    )
    moved = np.linalg.norm(clean.xyz - noisy_crease, axis=1)
    assert report.mean_displacement == pytest.approx(moved.mean())
    assert report.largest_displacement == pytest.approx(moved.max())
    assert (report.points, report.skipped, report.iterations, report.radius, report.seed) == (600, 0, 1, 0.2, 9)
    assert (report.model, report.model_sha256) == (engine.bundle.name, engine.bundle.sha256)
    assert report.seconds.keys() == {"index", "patches", "infer", "drift", "total"}
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
