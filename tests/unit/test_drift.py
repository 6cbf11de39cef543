"""What the passes took away on average comes back, chance does not."""

from __future__ import annotations

import numpy as np
import pytest

from pointfilter import drift, filtering
from pointfilter.drift import FEWEST, SIGNIFICANT, WINDOWS, without_drift
from pointfilter.errors import FilteringCancelledError
from pointfilter.filtering import filter_points
from pointfilter.patches import NeighbourIndex, stable_ids
from tests.clouds import pooled, rotation

RADIUS = 0.2
NOISE = 0.05


def plane(count: int = 4_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A noisy plane and the same points on the plane."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(size=(count, 2)), np.zeros(count)])
    return flat + NOISE * rng.normal(size=(count, 1)) * [0, 0, 1], flat


def restored(moved: np.ndarray, original: np.ndarray, threads: int = 1) -> np.ndarray:
    return without_drift(moved, original, stable_ids(original), RADIUS, threads)


def test_a_surface_that_was_pulled_away_comes_back() -> None:
    noisy, flat = plane()
    sunk = flat - [0, 0, 0.5 * NOISE]
    result = restored(sunk, noisy)
    assert np.abs(result[:, 2]).mean() < 0.25 * 0.5 * NOISE
    assert np.abs(result[:, :2] - flat[:, :2]).max() < 0.1 * NOISE


def test_noise_does_not_come_back() -> None:
    noisy, flat = plane()
    result = restored(flat, noisy)
    assert (result == flat).all(axis=1).mean() > 0.98
    assert np.abs(result - flat).max() < 0.1 * NOISE


def test_the_definition_point_by_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "POINTS_PER_TASK", 37)
    noisy, flat = plane(600)
    moved = flat - 0.4 * NOISE * np.sin(3 * flat[:, :1]) * [0, 0, 1]
    expected = moved
    for window in WINDOWS:
        back = np.zeros_like(expected)
        for row, centre in enumerate(expected):
            near = np.linalg.norm(expected - centre, axis=1) < window * RADIUS
            lost = (noisy - expected)[near]
            mean, squared = lost.mean(axis=0), np.square(lost.mean(axis=0)).sum()
            variance = lost.var(axis=0, ddof=1).sum() / near.sum()
            if near.sum() >= FEWEST:
                back[row] = max(0.0, 1 - SIGNIFICANT * variance / squared) * mean
        expected = expected + back
    assert 0.1 < (expected != moved).any(axis=1).mean() < 1  # there are points of both kinds
    np.testing.assert_allclose(restored(moved, noisy), expected, atol=1e-12)


def test_points_that_no_pass_moved_stay() -> None:
    noisy, flat = plane()
    sunk = flat - [0, 0, NOISE]
    sunk[::7] = noisy[::7]
    result = restored(sunk, noisy)
    np.testing.assert_array_equal(result[::7], noisy[::7])
    assert (result != sunk).any(axis=1).sum() > 3_000


def test_a_handful_of_points_says_nothing() -> None:
    original = np.random.default_rng(0).uniform(size=(FEWEST - 1, 3)) * 0.1
    np.testing.assert_array_equal(restored(original - 0.01, original), original - 0.01)


def test_points_at_one_place() -> None:
    original = np.ones((50, 3))
    assert np.isfinite(restored(original - np.array([0, 0, 0.1]), original)).all()


@pytest.mark.parametrize("threads", [1, 3])
def test_neither_threads_nor_order_matter(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    noisy, flat = plane()
    sunk = flat - [0, 0, NOISE]
    expected = restored(sunk, noisy)
    monkeypatch.setattr(drift, "POINTS_PER_TASK", 211)
    shuffle = np.random.default_rng(1).permutation(len(noisy))
    np.testing.assert_array_equal(restored(sunk[shuffle], noisy[shuffle], threads), expected[shuffle])


def test_it_turns_moves_and_scales_with_the_cloud() -> None:
    noisy, flat = plane()
    sunk = flat - [0, 0, NOISE]
    turn, shift = rotation(np.random.default_rng(2)), np.array([3.0, -1.0, 2.0])
    result = without_drift(
        5 * (sunk @ turn.T + shift), 5 * (noisy @ turn.T + shift), stable_ids(noisy), 5 * RADIUS
    )  # the same ids: which points a dense ball is thinned to is not the question here
    np.testing.assert_allclose((result / 5 - shift) @ turn, restored(sunk, noisy), atol=1e-9)


def test_a_cancellation_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "POINTS_PER_TASK", 100)
    noisy, flat = plane()
    asked = 0

    def check() -> None:
        nonlocal asked
        asked += 1
        raise FilteringCancelledError("filtering was cancelled")

    with pytest.raises(FilteringCancelledError):
        without_drift(flat, noisy, stable_ids(noisy), RADIUS, check=check)
    assert asked == 1


def test_the_filter_gives_drift_back_from_the_third_pass_on(
    noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes = {done: filter_points(noisy_crease, pooled, radius=0.15, iterations=done) for done in (2, 3)}
    monkeypatch.setattr(filtering, "DRIFT_FROM", 99)
    bare = {done: filter_points(noisy_crease, pooled, radius=0.15, iterations=done) for done in (2, 3)}
    np.testing.assert_array_equal(passes[2], bare[2])
    offset = (noisy_crease.min(axis=0) + noisy_crease.max(axis=0)) / 2
    ids = stable_ids(noisy_crease - offset)
    expected = without_drift(bare[3] - offset, noisy_crease - offset, ids, 0.15) + offset
    np.testing.assert_allclose(passes[3], expected, atol=1e-12)
    assert np.abs(passes[3] - bare[3]).max() > 1e-3


# --- means over balls ---


def test_averages_are_means_over_balls() -> None:
    rng = np.random.default_rng(3)
    points, vectors = rng.uniform(size=(500, 3)), rng.normal(size=(500, 3))
    index = NeighbourIndex(points, 0.3, stable_ids(points))
    means, squares, counts = index.averages(vectors[index.order].copy(), 100, 160, 10_000)
    for row, centre in enumerate(points[index.order[100:160]]):
        near = np.linalg.norm(points - centre, axis=1) < 0.3
        assert counts[row] == near.sum()
        np.testing.assert_allclose(means[row], vectors[near].mean(axis=0), atol=1e-14)
        assert squares[row] == pytest.approx(np.square(vectors[near]).sum(axis=1).mean())


def test_of_a_dense_ball_a_share_is_looked_at() -> None:
    points = np.random.default_rng(4).uniform(size=(5_000, 3))
    index = NeighbourIndex(points, 2.0, stable_ids(points))  # all are everybody's neighbours
    _, _, counts = index.averages(np.ones((5_000, 3)), 0, 5_000, 300)
    assert counts.min() >= 300
    assert counts.max() < 1_200


def test_averages_beyond_the_index_are_refused() -> None:
    points = np.random.default_rng(5).uniform(size=(20, 3))
    index = NeighbourIndex(points, 0.5, stable_ids(points))
    with pytest.raises(ValueError, match="positions"):
        index.averages(np.ones((20, 3)), 15, 21, 10)
    with pytest.raises(ValueError, match="vectors"):
        index.averages(np.ones((19, 3)), 0, 20, 10)
    with pytest.raises(TypeError, match="vectors"):
        index.averages(np.ones((20, 3), np.float32), 0, 20, 10)
