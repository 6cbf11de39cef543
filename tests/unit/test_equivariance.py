"""The filter turns, moves and scales with the cloud, and depends on nothing but the cloud."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointfilter import Engine, Filtered
from pointfilter import filter as filter_module
from pointfilter import network as network_module
from pointfilter.adaptive.calibration import Calibration
from tests.clouds import adaptive_pooled, crease, filter_points, pooled, rotation

CALIBRATION = Calibration(
    balls=(8, 16, 32, 64), preference=0.0, still_weight=1.0, margin=0.0, passes=3, query_reach=0.4, error_factor=1.0
)

clouds = st.tuples(st.integers(0, 2**32), st.integers(30, 250), st.sampled_from(["ball", "sheet", "crease"]))


def cloud_of(drawn: tuple[int, int, str]) -> np.ndarray:
    seed, count, kind = drawn
    rng = np.random.default_rng(seed)
    if kind == "crease":
        return crease(count, rng) + 0.02 * rng.normal(size=(count, 3))
    return rng.normal(size=(count, 3)) * ([0.5, 0.4, 0.3] if kind == "ball" else [0.6, 0.5, 0.05])


@given(
    drawn=clouds,
    similarity=st.integers(0, 2**32),
    scale=st.floats(1e-3, 1e3),
    reach=st.floats(0, 100),
    patch_points=st.sampled_from([5, 12, 500]),
    iterations=st.integers(1, 2),
)
def test_rotation_translation_and_scale(
    drawn: tuple[int, int, str], similarity: int, scale: float, reach: float, patch_points: int, iterations: int
) -> None:
    points = cloud_of(drawn)
    rng = np.random.default_rng(similarity)
    turn, shift = rotation(rng), reach * rng.normal(size=3)

    def filtered(cloud: np.ndarray, radius: float) -> np.ndarray:
        return filter_points(
            cloud, pooled, radius=radius, iterations=iterations, patch_points=patch_points, seed=similarity
        )

    radius = 0.45
    moved = filtered(scale * (points @ turn.T + shift), scale * radius) / scale
    expected = filtered(points, radius)
    assert np.abs(expected - points).max() > 0.01 * radius  # there is something to turn
    np.testing.assert_allclose((moved - shift) @ turn, expected, atol=2e-5 * radius)


@pytest.mark.parametrize("seed", range(3))
def test_a_dense_cloud_turns_too(seed: int) -> None:
    """Balls of some 2 500 points, of which fewer are looked at: which ones must not depend on the pose."""
    points = cloud_of((seed, 5_000, "sheet"))
    rng = np.random.default_rng(seed)
    turn, shift = rotation(rng), rng.normal(size=3)

    def filtered(cloud: np.ndarray) -> np.ndarray:
        return filter_points(cloud, pooled, radius=0.7, iterations=1, patch_points=64)

    expected = filtered(points)
    assert np.abs(expected - points).max() > 0.01
    np.testing.assert_allclose((filtered(points @ turn.T + shift) - shift) @ turn, expected, atol=2e-5)


def test_both_sides_of_the_downsampling_are_exercised() -> None:
    """The clouds above have balls with fewer and with more neighbours than the patches have places."""
    from pointfilter.patches import NeighbourIndex

    points = cloud_of((0, 200, "sheet"))
    counts = NeighbourIndex(points, 0.45).patches(np.arange(200), np.full(200, 0.45), 1, 0).counts
    assert counts.min() < 12 < counts.max() < 500


@given(drawn=clouds, order=st.integers(0, 2**32), patch_points=st.sampled_from([5, 12, 500]))
def test_the_order_of_the_points_changes_no_bit(drawn: tuple[int, int, str], order: int, patch_points: int) -> None:
    points = cloud_of(drawn)
    points[-5:] = points[:5]
    shuffle = np.random.default_rng(order).permutation(len(points))
    expected = filter_points(points, pooled, radius=0.45, patch_points=patch_points)
    shuffled = filter_points(points[shuffle], pooled, radius=0.45, patch_points=patch_points)
    np.testing.assert_array_equal(shuffled, expected[shuffle])


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("rows", [1, 64, 1000, 10**9])
@pytest.mark.parametrize("patch_points", [8, 500])
def test_batches_and_threads_change_no_bit(
    rows: int, threads: int, patch_points: int, noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = filter_points(noisy_crease, pooled, radius=0.15, patch_points=patch_points)
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", rows)
    found = filter_points(noisy_crease, pooled, radius=0.15, patch_points=patch_points, threads=threads)
    np.testing.assert_array_equal(found, expected)


def test_the_length_that_patches_are_padded_to_changes_no_bit(
    noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for step in (1, 7, 32, 300):
        monkeypatch.setattr(network_module, "LENGTH_STEP", step)
        results.append(filter_points(noisy_crease, pooled, radius=0.15, patch_points=300))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_duplicates_stay_together(noisy_crease: np.ndarray) -> None:
    points = np.vstack([noisy_crease, noisy_crease[:50]])
    filtered = filter_points(points, pooled, radius=0.15, patch_points=20)
    np.testing.assert_array_equal(filtered[:50], filtered[-50:])


def test_the_seed_decides_where_there_is_a_choice_and_only_there(noisy_crease: np.ndarray) -> None:
    def filtered(seed: int, patch_points: int) -> np.ndarray:
        return filter_points(noisy_crease, pooled, radius=0.15, patch_points=patch_points, seed=seed)

    np.testing.assert_array_equal(filtered(1, 10), filtered(1, 10))
    assert (filtered(1, 10) != filtered(2, 10)).any(axis=1).mean() > 0.5
    np.testing.assert_array_equal(filtered(1, 600), filtered(2, 600))


# --- the adaptive mode ---


def adapted(points: np.ndarray, **options: object) -> np.ndarray:
    return filter_points(points, adaptive_pooled, calibration=CALIBRATION, patch_points=24, **options)


@given(drawn=clouds, similarity=st.integers(0, 2**32), scale=st.floats(1e-3, 1e3), reach=st.floats(0, 100))
def test_the_adaptive_mode_turns_moves_and_scales_too(
    drawn: tuple[int, int, str], similarity: int, scale: float, reach: float
) -> None:
    points = cloud_of(drawn)
    rng = np.random.default_rng(similarity)
    turn, shift = rotation(rng), reach * rng.normal(size=3)
    moved = adapted(scale * (points @ turn.T + shift)) / scale
    np.testing.assert_allclose((moved - shift) @ turn, adapted(points), atol=1e-4)


@pytest.mark.parametrize("kind", ["ball", "sheet", "crease"])
def test_row_order_threads_and_batches_change_no_bit_of_the_adaptive_mode(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = cloud_of((3, 3_000, kind))
    expected = adapted(points)
    assert (expected != points).any(axis=1).mean() > 0.5
    shuffle = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(adapted(points[shuffle], threads=3), expected[shuffle])
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", 100)
    np.testing.assert_array_equal(adapted(points), expected)


def test_a_piece_with_a_margin_gives_the_same_bits_as_the_whole() -> None:
    """Every choice is local: what lies further away than some balls has no influence. The piece is cut out of the
    middle, so that rows, probes and the bounding box of the two differ; the noise of the cloud varies along it, and
    with it the balls. What is left out is much noisier, so that no average over the cloud is the same."""
    rng = np.random.default_rng(5)
    x, y, z = rng.uniform(0, 24, 9_600), rng.uniform(0, 2, 9_600), rng.normal(size=9_600)
    piece, inner = (x > 4) & (x < 20), (x > 9.5) & (x < 14.5)
    noise = np.where(piece, 0.01 + 0.2 * np.sin(x) ** 2, 1.0)
    points = np.column_stack([x, y, noise * z])

    def choose_and_filter(cloud: np.ndarray, calibration: Calibration = CALIBRATION) -> Filtered:
        return filter_module.filter_points(
            cloud, adaptive_pooled, calibration=calibration, patch_points=24, origin=np.zeros(3)
        )

    whole, part = choose_and_filter(points), choose_and_filter(points[piece])
    for ball in CALIBRATION.balls:  # there are choices to make: no one ball is that of nearly all points
        alike = choose_and_filter(points, dataclasses.replace(CALIBRATION, balls=(ball,)))
        assert (whole.radii[inner] == alike.radii[inner]).mean() < 0.9
    assert 0.5 < whole.moved[inner].mean() < 1
    for name in ("points", "radii", "errors", "normals"):
        np.testing.assert_array_equal(getattr(part, name)[inner[piece]], getattr(whole, name)[inner], err_msg=name)


# --- with onnxruntime, whose products may add in another order for another batch ---

ENGINE_TOLERANCE = 1e-6  # of the radius


@pytest.mark.parametrize(("rows", "threads"), [(1, 1), (100, 2), (10**9, 5)])
def test_an_engine_answers_alike_in_any_batch(
    rows: int, threads: int, engine: Engine, noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def filtered(threads: int) -> np.ndarray:
        return filter_points(noisy_crease, engine, radius=0.15, iterations=1, patch_points=64, threads=threads)

    expected = filtered(1)
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", rows)
    np.testing.assert_allclose(filtered(threads), expected, rtol=0, atol=ENGINE_TOLERANCE * 0.15)


def test_an_engine_does_not_care_for_the_order_of_the_points(engine: Engine, noisy_crease: np.ndarray) -> None:
    shuffle = np.random.default_rng(0).permutation(len(noisy_crease))
    expected = filter_points(noisy_crease, engine, radius=0.15, iterations=1, patch_points=64)
    shuffled = filter_points(noisy_crease[shuffle], engine, radius=0.15, iterations=1, patch_points=64)
    np.testing.assert_allclose(shuffled, expected[shuffle], rtol=0, atol=ENGINE_TOLERANCE * 0.15)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32))
def test_an_engine_is_equivariant_too(seed: int, engine: Engine, noisy_crease: np.ndarray) -> None:
    rng = np.random.default_rng(seed)
    turn = rotation(rng)
    expected = filter_points(noisy_crease, engine, radius=0.15, iterations=1, patch_points=64)
    turned = filter_points(noisy_crease @ turn.T, engine, radius=0.15, iterations=1, patch_points=64)
    np.testing.assert_allclose(turned @ turn, expected, rtol=0, atol=1e-5 * 0.15)
