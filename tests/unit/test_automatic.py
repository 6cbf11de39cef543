"""What the filter decides itself: passes by the noise, the radius by noise and density."""

from __future__ import annotations

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, automatic, filter_cloud
from pointfilter.automatic import (
    CLEAN,
    CLEAN_AT_MOST,
    ENOUGH,
    LARGEST_GROWTH,
    MOST_PASSES,
    PASSES,
    TWO_SHEETS,
    UNTOUCHED,
    Look,
    look_at,
    untouched,
    with_fitting_ball,
)
from pointfilter.errors import InvalidModelError
from pointfilter.filtering import Timings, filter_points
from pointfilter.noise import add_noise, bounding_box_diagonal
from pointfilter.patches import NeighbourIndex, stable_ids
from pointfilter.pipeline import Radius
from pointfilter.prediction import Predict
from tests.clouds import crease, pooled, still


def steps(length: float) -> Predict:
    """A network that moves every point as far."""
    return lambda patches: np.tile(np.array([0, 0, length], np.float32), (len(patches), 1))


def noisy(count: int, level: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    return add_noise(crease(count, rng), level, rng)


def radius_of(points: np.ndarray, predict: Predict, **more: object) -> float:
    timings = Timings()
    filter_points(points, predict, timings=timings, **more)  # type: ignore[arg-type]
    return timings.radius


def test_automatic_iterations_follow_the_displacement(noisy_crease: np.ndarray) -> None:
    done = []
    for length in (0.99 * CLEAN, 1.01 * CLEAN, *(1.01 * below for below, _ in PASSES)):
        timings = Timings()
        filtered = filter_points(noisy_crease, steps(length), radius=0.3, iterations="auto", timings=timings)
        fixed = filter_points(noisy_crease, steps(length), radius=0.3, iterations=timings.passes or 1)
        np.testing.assert_array_equal(filtered, fixed if timings.passes else noisy_crease)
        done.append(timings.passes)
    assert done == [0, *(passes for _, passes in PASSES), MOST_PASSES]
    assert done == sorted(done)
    assert done[0] == 0


def test_a_clean_cloud_comes_back_as_another_array(noisy_crease: np.ndarray) -> None:
    filtered = filter_points(noisy_crease, still, iterations="auto")
    assert filtered is not noisy_crease
    np.testing.assert_array_equal(filtered, noisy_crease)


def test_what_is_expected_is_what_happens(noisy_crease: np.ndarray) -> None:
    """All points are in the sample here, so the mean is that of the pass itself."""
    radius = 0.1
    ids = stable_ids(noisy_crease)
    index = NeighbourIndex(noisy_crease, radius, ids)
    expected = look_at(noisy_crease, ids, index, pooled, patch_points=500).displacement
    filtered = filter_points(noisy_crease, pooled, radius=radius, iterations=1)
    assert expected * radius == pytest.approx(np.linalg.norm(filtered - noisy_crease, axis=1).mean(), rel=1e-6)


def test_the_sample_does_not_know_the_order_of_the_rows(
    noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(automatic, "SAMPLE_POINTS", 40)

    def expected(points: np.ndarray, seed: int) -> float:
        ids = stable_ids(points)
        return look_at(points, ids, NeighbourIndex(points, 0.1, ids), pooled, 500, seed).displacement

    shuffle = np.random.default_rng(0).permutation(len(noisy_crease))
    assert expected(noisy_crease, 0) == expected(noisy_crease[shuffle], 0)
    assert expected(noisy_crease, 0) != expected(noisy_crease, 1)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_automatic_iterations_with_a_broken_network(broken: float, noisy_crease: np.ndarray) -> None:
    with pytest.raises(InvalidModelError):
        filter_points(noisy_crease, steps(broken), iterations="auto")


def test_of_few_neighbours_more_displacement_counts_as_clean() -> None:
    assert [Look(1.5 * CLEAN, count).clean for count in (10, 25, 50, 1000)] == [True, True, False, False]
    assert not Look(1.01 * CLEAN_AT_MOST, 1).clean
    assert Look(0.99 * CLEAN, 1000).clean


def test_a_clean_sparse_cloud_comes_back_and_a_noisy_one_does_not(default_engine: Engine) -> None:
    for level, passes in ((0.0, 0), (0.0025, 2)):
        _, report = filter_cloud(PointCloud(noisy(1000, level)), default_engine)
        assert report.iterations == passes


# --- the radius ---


def test_growth_is_what_brings_the_step_per_root_of_the_points_down() -> None:
    assert Look(0.1, 400.0).growth == 1.0
    assert Look(0.1, 25.0).growth == pytest.approx((0.1 / 5 / ENOUGH) ** 0.5)
    assert Look(CLEAN / 2, 1.0).growth == 1.0  # clean


def test_a_ball_grows_until_it_holds_enough(noisy_crease: np.ndarray) -> None:
    start = 0.05 * bounding_box_diagonal(noisy_crease)
    seen: list[Look] = []

    def looked(points: np.ndarray, ids: np.ndarray, index: NeighbourIndex, *more: object) -> Look:
        seen.append(Look(0.05 * start / index.radius, float(np.median(index.count(points)))))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(automatic, "look_at", looked)
        radius = radius_of(noisy_crease, still, iterations=1)
    assert [look.growth > 1 for look in seen] == [True] * (len(seen) - 1) + [False]
    assert len(seen) > 1
    assert start < radius < LARGEST_GROWTH * start


def heights(kind: str, seed: int, count: int = 4000) -> np.ndarray:
    """A noisy unit square, or two of them, three standard deviations of the noise apart."""
    rng = np.random.default_rng(seed)
    z = rng.normal(0, 0.02, count) + (0.03 * rng.choice([-1, 1], count) if kind == "two sheets" else 0)
    return np.column_stack([rng.uniform(size=(count, 2)), z])


@pytest.mark.parametrize("seed", range(4))
def test_two_sheets_in_a_ball_are_told_from_noise(seed: int) -> None:
    found = {}
    for kind in ("one sheet", "two sheets"):
        points = heights(kind, seed)
        ids = stable_ids(points)
        found[kind] = look_at(points, ids, NeighbourIndex(points, 0.15, ids), still, 192).kurtosis
    assert found["two sheets"] < TWO_SHEETS < found["one sheet"]


def test_of_too_few_points_nobody_tells_sheets() -> None:
    points = heights("two sheets", 0, 100)
    ids = stable_ids(points)
    assert look_at(points, ids, NeighbourIndex(points, 0.05, ids), still, 192).kurtosis == 3


def test_a_ball_does_not_grow_across_to_another_sheet(default_engine: Engine) -> None:
    rng = np.random.default_rng(2)
    sheet = np.column_stack([rng.uniform(size=(2500, 2)), rng.choice([0, 0.07], 2500)])
    lone = sheet * [1, 1, 0]
    for points, grows in ((lone, True), (sheet, False)):
        noisy = add_noise(points, 0.015, np.random.default_rng(0))
        radius = radius_of(noisy, default_engine, patch_points=192, iterations=1)
        assert (radius > 1.01 * 0.05 * bounding_box_diagonal(noisy)) == grows


def test_it_stops_growing_somewhere(noisy_crease: np.ndarray) -> None:
    start = 0.05 * bounding_box_diagonal(noisy_crease)
    assert radius_of(noisy_crease, steps(10.0), iterations=1) == pytest.approx(LARGEST_GROWTH * start)


def test_a_radius_that_was_given_stays(noisy_crease: np.ndarray, engine: Engine) -> None:
    assert radius_of(noisy_crease, steps(10.0), radius=0.07, iterations=1) == 0.07
    assert radius_of(noisy_crease, steps(10.0), radius=0.07, iterations="auto") == 0.07
    _, report = filter_cloud(PointCloud(noisy_crease.copy()), engine, radius=Radius.parse("5%"))
    assert report.radius == pytest.approx(0.05 * bounding_box_diagonal(noisy_crease))


def test_sparse_noisy_clouds_are_better_off(default_engine: Engine) -> None:
    points = noisy(1500, 0.015)
    start = default_engine.bundle.radius * bounding_box_diagonal(points)
    left = {}
    for name, radius in (("fixed", Radius(start, relative=False)), ("automatic", None)):
        filtered, report = filter_cloud(PointCloud(points.copy()), default_engine, radius=radius, iterations=2)
        x, _, z = filtered.xyz.T
        left[name] = float(np.minimum(np.abs(z), np.abs(z * np.cos(1.2) - x * np.sin(1.2))).mean())
    assert report.radius > 1.1 * start
    assert left["automatic"] < 0.9 * left["fixed"]


@pytest.mark.parametrize(("count", "level"), [(20_000, 0.005), (3000, 0.0)])
def test_dense_and_clean_clouds_keep_the_bundle_s(count: int, level: float, default_engine: Engine) -> None:
    points = noisy(count, level)
    _, report = filter_cloud(PointCloud(points), default_engine)
    assert report.radius == pytest.approx(default_engine.bundle.radius * bounding_box_diagonal(points))
    assert (report.iterations == 0) == (level == 0)


def test_the_radius_scales_with_the_cloud_and_knows_no_order(default_engine: Engine) -> None:
    points = noisy(800, 0.015)
    radius = radius_of(points, default_engine, patch_points=192, iterations=1)
    shuffled = np.random.default_rng(1).permutation(points)
    assert radius_of(8 * shuffled, default_engine, patch_points=192, iterations=1) == pytest.approx(8 * radius)


# --- noise in places ---

PLANE = np.column_stack([np.random.default_rng(6).uniform(size=(4000, 2)), np.zeros(4000)])


def untouched_of(lengths: np.ndarray, points: np.ndarray = PLANE, threads: int = 1) -> np.ndarray:
    return untouched(lengths, NeighbourIndex(points, 0.1, stable_ids(points)), threads)


def test_points_between_those_that_noise_moved_are_untouched() -> None:
    rng = np.random.default_rng(0)
    hit = rng.random(len(PLANE)) < 0.1
    lengths = np.where(hit, 2 * UNTOUCHED, 0.1 * CLEAN)
    np.testing.assert_array_equal(untouched_of(lengths), ~hit)
    shuffle = rng.permutation(len(PLANE))
    np.testing.assert_array_equal(untouched_of(lengths[shuffle], PLANE[shuffle], threads=2), ~hit[shuffle])


def test_where_noise_is_everywhere_no_point_is_untouched() -> None:
    for seed in range(5):
        assert not untouched_of(0.02 * np.abs(np.random.default_rng(seed).normal(size=len(PLANE)))).any()


def test_a_noisy_place_has_no_untouched_points() -> None:
    """Some steps are short there by chance: they belong to points that another pass will move."""
    rng = np.random.default_rng(0)
    lengths = np.where(PLANE[:, 0] < 0.3, np.abs(rng.normal(0, 0.1, len(PLANE))), 0.2 * CLEAN)
    found = untouched_of(lengths)
    assert not found[PLANE[:, 0] < 0.2].any()
    assert found[PLANE[:, 0] > 0.4].all()


def test_impulsive_noise_goes_and_what_it_missed_stays_bit_for_bit(default_engine: Engine) -> None:
    rng = np.random.default_rng(5)
    clean = 1000.1 + crease(12_000, rng)
    noisy = add_noise(clean, 0.01, rng, "impulsive")
    hit = (noisy != clean).any(axis=1)
    filtered = filter_points(noisy, default_engine, patch_points=default_engine.bundle.patch_points, iterations=3)
    assert (filtered == noisy).all(axis=1)[~hit].mean() > 0.9

    def distance(points: np.ndarray) -> float:
        x, _, z = (points[hit] - 1000.1).T
        return float(np.minimum(np.abs(z), np.abs(z * np.cos(1.2) - x * np.sin(1.2))).mean())

    assert distance(filtered) < 0.25 * distance(noisy)


def thin_plate(count: int, level: float) -> np.ndarray:
    """(count, 3) points on both sides of a plate, 3.5 % of its width thick, with noise."""
    rng = np.random.default_rng(8)
    sides = np.where(rng.random(count) < 0.5, 0.035, 0.0)
    return add_noise(np.column_stack([rng.uniform(size=(count, 2)), sides]), level, rng)


def fitting_radius(points: np.ndarray, engine: Engine) -> float:
    """The radius that is taken for the points, in units of the bundle's."""
    radius = engine.bundle.radius * bounding_box_diagonal(points)
    ids = stable_ids(points)
    index, _ = with_fitting_ball(NeighbourIndex(points, radius, ids), points, ids, engine, engine.bundle.patch_points)
    return index.radius / radius


def test_the_ball_shrinks_where_two_sheets_would_become_one(default_engine: Engine) -> None:
    points = thin_plate(20_000, 0.01)
    assert fitting_radius(points, default_engine) in (pytest.approx(0.8), pytest.approx(0.64))

    def between(radius: float | None) -> float:
        z = filter_points(points, default_engine, radius=radius, least_radius=0.05, patch_points=192)[:, 2]
        return float(np.minimum(np.abs(z), np.abs(z - 0.035)).mean())

    assert between(None) < 0.7 * between(0.05 * bounding_box_diagonal(points))


@pytest.mark.parametrize("level", [0.0, 0.0025, 0.03])
def test_the_ball_stays_where_the_sheets_are_apart_or_hidden(default_engine: Engine, level: float) -> None:
    assert fitting_radius(thin_plate(20_000, level), default_engine) == 1


@pytest.mark.parametrize("extent", [(1, 0, 0), (1, 1, 0)], ids=["line", "plane"])
def test_without_heights_nothing_merges(extent: tuple[float, ...]) -> None:
    points = np.random.default_rng(0).uniform(size=(400, 3)) * extent
    ids = stable_ids(points)
    look = look_at(points, ids, NeighbourIndex(points, 0.2, ids), steps(0.5), 64)
    assert (look.kept, look.merges) == (1.0, False)


def test_the_ball_does_not_shrink_on_one_sheet(default_engine: Engine) -> None:
    assert fitting_radius(noisy(20_000, 0.01), default_engine) == 1
