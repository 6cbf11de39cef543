"""Looking at a cloud without filtering it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, filter_cloud, look
from pointfilter.errors import DegenerateCloudError, FilteringCancelledError, TooFewPointsError
from pointfilter.inspection import CANNOT_TELL, CLEAN, LEAST_WITH_BALL, NOISY, verdict
from tests.clouds import crease


def clean_crease() -> np.ndarray:
    return crease(3_000, np.random.default_rng(2))


def noisy_points(level: float) -> np.ndarray:
    """Gaussian noise of a standard deviation of `level` on every coordinate."""
    points = clean_crease()
    return points + level * np.random.default_rng(3).normal(size=points.shape)


def test_a_clean_cloud_is_clean(default_engine: Engine) -> None:
    found = look(PointCloud(clean_crease()), default_engine)
    assert found.verdict == CLEAN
    assert found.warnings == ()
    assert found.with_ball == 1
    assert found.would_move is not None
    assert found.would_move < 0.1
    assert found.noise is not None
    assert found.spacing is not None
    assert found.noise < 0.05 * found.spacing


@pytest.mark.parametrize("level", [0.005, 0.02])
def test_noise_is_estimated_in_the_unit_of_the_file(default_engine: Engine, level: float) -> None:
    points = noisy_points(level)
    found = look(PointCloud(points), default_engine)
    assert (found.verdict, found.warnings) == (NOISY, ())
    assert found.noise is not None
    true = np.sqrt(2 / np.pi) * level  # mean distance to the surface
    assert 0.5 * true < found.noise < 1.3 * true
    large = look(PointCloud(1_000 * points), default_engine)
    assert large.noise == pytest.approx(1_000 * found.noise, rel=0.05)
    assert large.verdict == NOISY


def test_balls_are_those_that_the_filter_takes(default_engine: Engine) -> None:
    cloud = PointCloud(noisy_points(0.01))
    found, report = look(cloud, default_engine), filter_cloud(cloud, default_engine)[1]
    assert found.ball_radii == pytest.approx((report.radius_low, report.radius, report.radius_high))
    assert found.ball_points is not None
    assert 24 <= found.ball_points[0] <= found.ball_points[1] <= found.ball_points[2] <= 3_000
    assert found.would_move is not None
    assert found.would_move * 3_000 >= report.moved
    assert (found.model, found.model_sha256) == (report.model, report.model_sha256)


def test_rows_are_counted(default_engine: Engine) -> None:
    points = noisy_points(0.01)
    rows = np.vstack([points, points[:7], np.full((40, 3), -0.01), np.full((3, 3), np.nan)])
    found = look(PointCloud(rows), default_engine)
    assert (found.points, found.skipped, found.duplicates, found.placeholders) == (3_050, 3, 7, 40)
    assert found.with_ball == pytest.approx(3_007 / 3_047)
    assert any("40 rows" in warning for warning in found.warnings)
    finite = rows[:-3]
    assert (found.low, found.high) == (tuple(finite.min(axis=0)), tuple(finite.max(axis=0)))
    assert found.diagonal == pytest.approx(np.linalg.norm(np.ptp(finite, axis=0)))
    distances = np.linalg.norm(points[:, None] - points[None, :300], axis=2)
    distances[distances == 0] = np.inf
    assert found.spacing == pytest.approx(np.median(distances.min(axis=0)), rel=0.2)
    json.dumps(found.as_dict(), allow_nan=False)


def test_too_few_points_for_a_ball(default_engine: Engine) -> None:
    found = look(PointCloud(noisy_points(0.01)[:20]), default_engine)
    assert (found.verdict, found.with_ball, found.would_move) == (CANNOT_TELL, 0, 0)
    assert (found.noise, found.ball_points, found.ball_radii) == (None, None, None)
    assert "too few points for the smallest ball" in found.warnings[0]


def test_a_model_that_tells_no_errors(engine: Engine) -> None:
    found = look(PointCloud(noisy_points(0.01)), engine)
    assert (found.verdict, found.noise, found.would_move) == (CANNOT_TELL, None, None)
    assert "adaptive model" in found.warnings[0]


def test_clouds_that_the_filter_refuses(default_engine: Engine) -> None:
    with pytest.raises(TooFewPointsError, match="has 3"):
        look(PointCloud(np.eye(3)), default_engine)
    with pytest.raises(DegenerateCloudError):
        look(PointCloud(np.ones((20, 3))), default_engine)


def test_looking_can_be_cancelled(default_engine: Engine) -> None:
    with pytest.raises(FilteringCancelledError):
        look(PointCloud(noisy_points(0.01)), default_engine, cancelled=lambda: True)


def gains(noticeable: float, small: float) -> np.ndarray:
    """1000 points: shares whose error falls noticeably and a little; it rises for the others."""
    found = np.full(1_000, 0.02)
    found[: round(1_000 * small)] = -0.02
    found[: round(1_000 * noticeable)] = -0.2
    return found


@pytest.mark.parametrize(
    ("noticeable", "small", "expected"),
    [(0.0, 0.0, CLEAN), (0.1, 0.1, CLEAN), (0.0, 0.11, CANNOT_TELL), (0.1, 1.0, CANNOT_TELL), (0.11, 0.0, NOISY)],
)
def test_the_rule_of_the_verdict(noticeable: float, small: float, expected: str) -> None:
    found, reasons = verdict(gains(noticeable, small), 1.0, 0.0)
    assert found == expected
    assert len(reasons) == (expected == CANNOT_TELL)


def test_no_verdict_on_points_without_balls() -> None:
    assert verdict(gains(0.5, 0.5), LEAST_WITH_BALL, 0.0)[0] == NOISY
    found, (reason,) = verdict(gains(0.5, 0.5), 0.2, 0.0)
    assert found == CANNOT_TELL
    assert "only 20% of the points have a ball" in reason


def test_the_margin_of_the_filter_counts() -> None:
    assert verdict(gains(0.0, 1.0), 1.0, 0.03)[0] == CLEAN
    assert verdict(gains(1.0, 1.0), 1.0, 0.3)[0] == CLEAN
