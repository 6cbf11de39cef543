"""Places, balls, which points move, and when the passes end."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointfilter.adaptive.balls import probe_balls
from pointfilter.adaptive.calibration import Calibration
from pointfilter.adaptive.places import PLACEHOLDER_ROWS, distinct_places, neighbourhood_keys
from pointfilter.adaptive.sharing import ANSWERS, Means, patch_centres, reached, thinned
from pointfilter.errors import InvalidModelError
from pointfilter.filter import filter_points
from pointfilter.grids import Grids
from pointfilter.network import Answers, Network
from pointfilter.patches import mixed, sampling_key
from tests.clouds import adaptive_pooled, pooled_displacements, rotation

CALIBRATION = Calibration(
    balls=(24, 48, 96, 192), preference=0.0, still_weight=1.0, margin=0.0, passes=4, query_reach=0.4, error_factor=2.0
)


def plane(count: int, seed: int = 0, noise: float = 0.01) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(size=(count, 2)), noise * rng.normal(size=count)])


def saying(gains: dict[int, float], step: float = 0.01, later: float | None = None):
    """A network that answers for balls of 2^k points with the logarithm gains[k] of its error as a share of the error
    without a displacement; in later passes with `later`."""

    def ask(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        sizes = np.round(np.exp2(6 * (context[:, 0] + 1))).astype(int)
        gain = np.array([gains[min(gains, key=lambda known: abs(known - size))] for size in sizes], np.float32)
        if later is not None:
            gain = np.where(context[:, 1] > 0, np.float32(later), gain)
        still = np.full(len(owners), -1.0, np.float32)
        moves = np.tile(np.array([0, 0, step], np.float32), (len(owners), 1))
        return Answers(moves, np.stack([still + gain[owners], still], axis=1), moves)

    return ask


# --- places ---


@pytest.mark.parametrize("count", [500, 20_000])
def test_rows_at_one_place_share_an_answer(count: int) -> None:
    points = plane(count)
    twice = np.vstack([points, points])
    once = filter_points(points, adaptive_pooled, calibration=CALIBRATION, patch_points=50)
    both = filter_points(twice, adaptive_pooled, calibration=CALIBRATION, patch_points=50)
    np.testing.assert_array_equal(both.points, np.vstack([once.points, once.points]))
    assert both.placeholder_rows == 0
    assert (once.points != points).any()


def test_a_place_with_far_more_rows_than_its_surroundings_is_left_and_counted() -> None:
    points = plane(500)
    with_zeros = np.vstack([points, np.zeros((PLACEHOLDER_ROWS, 3))])
    result = filter_points(with_zeros, adaptive_pooled, calibration=CALIBRATION, patch_points=50)
    alone = filter_points(points, adaptive_pooled, calibration=CALIBRATION, patch_points=50, origin=None)
    assert result.placeholder_rows == PLACEHOLDER_ROWS
    np.testing.assert_array_equal(result.points[500:], 0)
    np.testing.assert_allclose(result.points[:500], alone.points, atol=1e-6)
    fewer = np.vstack([points, np.zeros((PLACEHOLDER_ROWS - 1, 3))])
    assert distinct_places(fewer).placeholder_rows == 0


def test_a_cloud_of_copies_has_no_placeholder() -> None:
    places = distinct_places(np.repeat(plane(200), 20, axis=0))
    assert places.placeholder_rows == 0
    assert len(places.points) == 200
    np.testing.assert_array_equal(np.bincount(places.rows), 20)


def test_one_place_alone() -> None:
    assert len(distinct_places(np.ones((1000, 3))).points) == 1


@given(seed=st.integers(0, 2**32), scale=st.floats(1e-3, 1e3))
def test_keys_do_not_know_the_pose(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(100, 3))
    keys, reach = neighbourhood_keys(points)
    turned, turned_reach = neighbourhood_keys(scale * (points @ rotation(rng).T) + 10 * scale)
    assert (keys == turned).mean() > 0.98
    np.testing.assert_allclose(turned_reach, scale * reach, rtol=1e-9)
    assert len(set(keys.tolist())) == 100


# --- balls ---


def balls(points: np.ndarray, network: object, **changes: object) -> tuple[np.ndarray, np.ndarray]:
    keys, reach = neighbourhood_keys(points)
    calibration = dataclasses.replace(CALIBRATION, **changes)
    probes = probe_balls(points, keys, reach, network, calibration, 50, 1, 2, lambda: None)
    radii, _, gains, _ = probes.spread(points, 2)
    return radii, gains


@pytest.mark.parametrize("best", [24, 48, 96, 192])
def test_the_ball_with_the_least_share_of_the_error(best: int) -> None:
    points = plane(2_000, noise=0.0)
    gains = {size: (-2.0 if size == best else -1.0) for size in CALIBRATION.balls}
    radii, gain = balls(points, saying(gains))
    expected = np.sqrt(best / (2_000 * np.pi))
    inner = (np.abs(points[:, :2] - 0.5) < 0.3).all(axis=1)
    np.testing.assert_allclose(np.median(radii[inner]), expected, rtol=0.15)
    np.testing.assert_allclose(gain, -2.0, atol=1e-5)


def test_the_larger_ball_at_a_tie_and_the_preferred_one() -> None:
    points = plane(2_000, noise=0.0)
    same = dict.fromkeys(CALIBRATION.balls, -1.0)
    largest, _ = balls(points, saying(same))
    smallest, _ = balls(points, saying(same), preference=0.1)
    assert np.median(largest) / np.median(smallest) == pytest.approx(np.sqrt(192 / 24), rel=0.15)


def test_shares_or_errors_are_compared() -> None:
    """Each ball expects the same share, and an error in proportion to its radius."""
    points, same = plane(2_000, noise=0.0), dict.fromkeys(CALIBRATION.balls, -1.0)
    by_share, _ = balls(points, saying(same), still_weight=1.0)
    by_error, _ = balls(points, saying(same), still_weight=0.0)
    assert np.median(by_share) / np.median(by_error) == pytest.approx(np.sqrt(192 / 24), rel=0.15)


def test_balls_larger_than_the_cloud_are_left_out() -> None:
    radii, _ = balls(plane(60), saying({24: -1.0, 48: -1.5, 96: -9.0, 192: -9.0}))
    assert np.isfinite(radii).all()


def test_a_network_that_does_not_say_its_errors_has_no_use_for_a_calibration() -> None:
    def silent(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        return Answers(pooled_displacements(patches)[owners])

    with pytest.raises(InvalidModelError, match="expected errors"):
        balls(plane(200), silent)


# --- what a point takes from the patches around it ---


def test_a_point_takes_the_mean_of_what_the_patches_that_reach_it_answer() -> None:
    """Each patch answers with half the way to its centre: the mean of those is half the way to the mean centre."""

    def half_way(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        gain = np.tile(np.array([-1.0, 0.0], np.float32), (len(owners), 1))
        return Answers(-queries / 2, gain, -queries)

    points, radius = plane(800) - 0.5, 0.25
    result = filter_points(
        points, half_way, calibration=CALIBRATION, patch_points=50, radius=radius, iterations=1, origin=np.zeros(3)
    )
    keys, _ = neighbourhood_keys(points, 1)
    rows, radii = np.arange(len(points)), np.full(len(points), radius)
    pass_keys = mixed(keys ^ np.uint64(sampling_key(0, 0)))
    centres = np.unique(patch_centres(Grids(points), rows, radii, pass_keys, CALIBRATION.query_reach, 1, lambda: None))
    near = np.linalg.norm(points[:, None] - points[centres], axis=2) <= CALIBRATION.query_reach * radius
    assert near.any(axis=1).all()
    assert near.sum(axis=1).max() > 2
    mean = (near @ points[centres]) / near.sum(axis=1, keepdims=True)
    few = near.sum(axis=1) <= ANSWERS
    assert few.mean() > 0.5
    np.testing.assert_allclose(result.points[few], (points + mean)[few] / 2, atol=1e-6)


def test_a_point_asks_a_few_of_the_patches_that_reach_it_and_always_its_own() -> None:
    rng = np.random.default_rng(2)
    keys = rng.integers(2**64, size=1_000, dtype=np.uint64)
    centres = np.arange(100)
    rows, sizes = np.tile(np.arange(1_000), 100), np.full(100, 1_000)  # every centre reaches every point
    nearest = rng.integers(100, size=1_000)
    left, counts = thinned(rows, centres, sizes, nearest, keys)
    centre = np.repeat(centres, counts)
    assert len(left) == counts.sum()
    assert np.bincount(left).mean() == pytest.approx(ANSWERS + 1, rel=0.05)
    assert set(zip(range(1_000), nearest.tolist(), strict=True)) <= set(
        zip(left.tolist(), centre.tolist(), strict=True)
    )
    few, same = thinned(rows[:3_000], centres[:3], sizes[:3], nearest % 3, keys)
    np.testing.assert_array_equal(few, rows[:3_000])
    np.testing.assert_array_equal(same, sizes[:3])


def test_the_order_of_answers_does_not_matter_to_their_mean() -> None:
    rng = np.random.default_rng(0)
    rows, steps, logs = rng.integers(20, size=500), rng.normal(size=(500, 3)), rng.normal(size=(500, 2))
    means = []
    for order in (np.arange(500), rng.permutation(500)):
        means.append(Means(np.full(30, 0.1)))
        for part in np.array_split(order, 7):
            means[-1].add(rows[part], steps[part], logs[part])
    every = np.arange(30)
    for first, second in zip(means[0].of(every), means[1].of(every), strict=True):
        np.testing.assert_array_equal(first, second)
    expected = [steps[rows == row].mean(axis=0) for row in range(20)]
    np.testing.assert_allclose(means[0].of(np.arange(20))[0], expected, atol=1e-12)
    assert np.isnan(means[0].of(every)[0][20:]).all()


def test_which_points_a_centre_reaches() -> None:
    rng = np.random.default_rng(1)
    points, radii = rng.random((300, 3)), rng.uniform(0.1, 0.4, 300)
    rows, centres = np.flatnonzero(rng.random(300) < 0.7), np.arange(0, 300, 10)
    found, sizes = reached(points, rows, centres, radii, 0.5, 1)
    for centre, part in zip(centres, np.split(found, np.cumsum(sizes)[:-1]), strict=True):
        near = np.linalg.norm(points[rows] - points[centre], axis=1) <= 0.5 * radii[centre]
        assert sorted(part) == list(rows[near])


# --- which points move, and when it ends ---


def test_where_no_ball_helps_nothing_moves() -> None:
    points = plane(500)
    network = saying(dict.fromkeys(CALIBRATION.balls, 0.1))
    result = filter_points(points, network, calibration=CALIBRATION, patch_points=50)
    np.testing.assert_array_equal(result.points, points)
    assert result.passes == 0
    assert not result.moved.any()


def test_points_whose_balls_do_not_help_stay_while_others_move() -> None:
    flat, noisy = plane(1_000, noise=0.0), plane(1_000, seed=1, noise=0.02) + np.array([0, 0, 5])

    def by_thickness(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        gain = np.where(np.abs(patches[:, :, 2]).max(axis=1) < 1e-3, 0.5, -1.0).astype(np.float32)[owners]
        moves = np.tile(np.array([0, 0, 0.01], np.float32), (len(owners), 1))
        return Answers(moves, np.stack([gain, np.zeros_like(gain)], axis=1), moves)

    points = np.vstack([flat, noisy])
    result = filter_points(points, by_thickness, calibration=CALIBRATION, patch_points=50)
    np.testing.assert_array_equal(result.points[:1_000], flat)
    assert result.moved[1_000:].all()


def test_the_expected_error_is_the_geometric_mean_over_the_passes() -> None:
    network = saying(dict.fromkeys(CALIBRATION.balls, -1.0), later=-0.5)
    result = filter_points(
        plane(500), network, calibration=CALIBRATION, patch_points=50, radius=0.2, iterations=3, origin=np.zeros(3)
    )
    expected = CALIBRATION.error_factor * 0.2 * np.exp((-2.0 - 1.5 - 1.5) / 3)
    np.testing.assert_allclose(result.errors, expected, rtol=1e-6)


def test_each_point_of_a_patch_moves_or_stays_by_its_own_errors() -> None:
    def near_the_centre(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        gain = np.where(np.linalg.norm(queries, axis=1) < 0.2, -1.0, 1.0).astype(np.float32)
        still = np.full_like(gain, -1.0)
        moves = np.tile(np.array([0, 0, 0.01], np.float32), (len(owners), 1))
        return Answers(moves, np.stack([still + gain, still], axis=1), moves)

    points = plane(500)
    result = filter_points(points, near_the_centre, calibration=CALIBRATION, patch_points=50, radius=0.2, iterations=1)
    assert 0.05 < result.moved.mean() < 0.95
    np.testing.assert_array_equal(result.points[~result.moved], points[~result.moved])
    unit = CALIBRATION.error_factor * 0.2
    np.testing.assert_allclose(result.errors[~result.moved], unit * np.exp(-1.0), rtol=1e-6)
    moved = result.errors[result.moved]  # a mean over patches, some of which may speak against it
    assert (moved < unit * np.exp(-1.0)).all()
    assert moved.min() == pytest.approx(unit * np.exp(-2.0))


def test_points_without_a_ball_stay_while_others_move() -> None:
    """40 points so close together, and so far from the rest, that the grid cannot reach the 48th neighbour."""
    clump = np.array([50.0, 0, 0]) + 1e-4 * np.random.default_rng(1).normal(size=(40, 3))
    network = saying(dict.fromkeys((48, 96), -1.0))
    result = filter_points(
        np.vstack([plane(3_000), clump]),
        network,
        calibration=dataclasses.replace(CALIBRATION, balls=(48, 96)),
        patch_points=50,
    )
    assert not result.moved[3_000:].any()
    assert result.moved[:3_000].mean() > 0.9


@pytest.mark.parametrize(("margin", "radius", "moves"), [(0.4, None, True), (0.6, None, False), (0.6, 0.2, True)])
def test_the_ball_must_lower_the_error_by_the_margin(margin: float, radius: float | None, moves: bool) -> None:
    """A radius that somebody gives is taken as it is."""
    network = saying(dict.fromkeys(CALIBRATION.balls, -0.5))
    result = filter_points(
        plane(500),
        network,
        calibration=dataclasses.replace(CALIBRATION, margin=margin),
        patch_points=50,
        radius=radius,
    )
    assert result.moved.all() == moves
    assert result.moved.any() == moves


def test_the_margin_is_not_asked_for_in_every_pass() -> None:
    points = plane(500)
    network = saying(dict.fromkeys(CALIBRATION.balls, -0.5), later=-0.1)
    calibration = dataclasses.replace(CALIBRATION, margin=0.4)
    assert filter_points(points, network, calibration=calibration, patch_points=50).passes == CALIBRATION.passes


def test_the_filter_ends_when_another_pass_would_not_help() -> None:
    points = plane(500)
    network = saying(dict.fromkeys(CALIBRATION.balls, -1.0), later=0.2)
    seen: list[int] = []
    result = filter_points(
        points, network, calibration=CALIBRATION, patch_points=50, after_pass=lambda passes, _: seen.append(passes)
    )
    assert result.passes == 2  # the second one finds that nothing is to be done
    one = filter_points(points, network, calibration=CALIBRATION, patch_points=50, iterations=1)
    np.testing.assert_array_equal(result.points, one.points)
    assert one.moved.all()
    np.testing.assert_allclose(result.errors, 2.0 * np.exp(-1.0) * result.radii, rtol=0.5)
    most = filter_points(points, network, calibration=CALIBRATION, patch_points=50, iterations=1)
    np.testing.assert_array_equal(most.points, result.points)
    endless = saying(dict.fromkeys(CALIBRATION.balls, -1.0))
    assert filter_points(points, endless, calibration=CALIBRATION, patch_points=50).passes == CALIBRATION.passes


@pytest.mark.parametrize(
    "network",
    [
        adaptive_pooled,
        saying(dict.fromkeys(CALIBRATION.balls, -1.0), later=0.2),
        saying(dict.fromkeys(CALIBRATION.balls, 0.1)),
    ],
    ids=["some move", "ends early", "no pass"],
)
def test_progress_has_its_bound_from_the_start_and_never_goes_back(network: Network) -> None:
    calls: list[tuple[int, int]] = []
    filter_points(
        plane(800),
        network,
        calibration=CALIBRATION,
        patch_points=50,
        progress=lambda done, total: calls.append((done, total)),
    )
    done = [call[0] for call in calls]
    assert {call[1] for call in calls} == {CALIBRATION.passes * 800}
    assert done == sorted(done)
    assert done[-1] == CALIBRATION.passes * 800


def test_a_ball_with_too_few_points_moves_nothing_whatever_is_expected_of_it() -> None:
    """Three points have no frame to speak of, so the answer must not decide whether they stay in play."""
    three = np.array([[9.0, 9, 9], [9.1, 9, 9], [9, 9.1, 9]])
    network = saying({2: -5.0, 192: -1.0})
    result = filter_points(
        np.vstack([plane(500), three]), network, calibration=CALIBRATION, patch_points=50, radius=0.2, iterations=1
    )
    np.testing.assert_array_equal(result.points[500:], three)
    assert result.moved[:500].all()
    assert np.isnan(result.errors[500:]).all()  # nothing is known of them
    assert np.isfinite(result.errors[:500]).all()


def test_the_error_of_points_that_no_ball_helps_is_that_without_a_filter() -> None:
    points = plane(800)
    result = filter_points(points, saying({24: 0.5, 192: 0.5}), calibration=CALIBRATION, patch_points=50)
    assert not result.moved.any()
    assert result.passes == 0
    keys, reach = neighbourhood_keys(points)
    network = saying({24: 0.5, 192: 0.5})
    probes = probe_balls(points, keys, reach, network, CALIBRATION, 50, 1, 1, lambda: None)
    np.testing.assert_allclose(np.median(result.errors), CALIBRATION.error_factor * np.median(probes.errors), rtol=0.1)


def test_too_few_points_for_the_smallest_ball_come_back() -> None:
    points = plane(20)
    result = filter_points(points, adaptive_pooled, calibration=CALIBRATION, patch_points=50)
    np.testing.assert_array_equal(result.points, points)
    assert np.isnan(result.radii).all()


def test_a_given_radius_is_every_point_s_ball() -> None:
    result = filter_points(plane(500), adaptive_pooled, calibration=CALIBRATION, patch_points=50, radius=0.2)
    np.testing.assert_array_equal(result.radii, 0.2)
    assert result.moved.any()


@given(seed=st.integers(0, 2**32), reach=st.floats(0.05, 1))
def test_a_point_s_patch_is_around_a_point_close_by(seed: int, reach: float) -> None:
    points = plane(400, seed)
    keys, _ = neighbourhood_keys(points)
    radii = np.random.default_rng(seed).uniform(0.05, 0.2, 400)
    rows = np.arange(400)
    owners = patch_centres(Grids(points), rows, radii, keys, reach, 1, lambda: None)
    distances = np.linalg.norm(points - points[owners], axis=1)
    assert (distances <= reach * np.minimum(radii, radii[owners]) + 1e-12).all()
    shared = owners != rows
    assert (keys[owners[shared]] < keys[rows[shared]]).all()


@pytest.mark.parametrize("reach", [0.0, 0.2, 0.4])
def test_a_patch_answers_for_points_within_its_reach_and_for_several(reach: float) -> None:
    distances: list[np.ndarray] = []
    patches_cut = 0

    def recorded(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        nonlocal patches_cut
        distances.append(np.linalg.norm(queries, axis=1))
        patches_cut += len(patches)
        return adaptive_pooled(patches, context, queries, owners)

    calibration = dataclasses.replace(CALIBRATION, query_reach=reach)
    filter_points(plane(2_000), recorded, calibration=calibration, patch_points=50, radius=0.1, iterations=1)
    asked = np.concatenate(distances)
    assert asked.max() <= reach + 1e-6
    if reach == 0:
        assert patches_cut == len(asked) == 2_000
    else:
        assert asked.max() > 0.8 * reach
        assert patches_cut < 0.7 * 2_000 < 2_000 < len(asked)


# --- the calibration itself ---


def test_a_calibration_survives_json() -> None:
    assert Calibration.from_dict(CALIBRATION.as_dict()) == CALIBRATION


@pytest.mark.parametrize(
    "change",
    [
        {"balls": []}, {"balls": [48, 24]}, {"balls": [2, 24]}, {"balls": [24.5]}, {"passes": 0}, {"passes": 1.5},
        {"query_reach": 1.5}, {"error_factor": 0.0}, {"preference": float("nan")}, {"other": 1},
        {"margin": float("nan")}, {"margin": float("inf")}, {"error_factor": float("inf")},
    ],
)  # fmt: skip
def test_a_calibration_out_of_range_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="calibration"):
        Calibration.from_dict({**CALIBRATION.as_dict(), **change})


def test_progress_counts_rows_and_not_places() -> None:
    calls: list[tuple[int, int]] = []
    points = np.repeat(plane(300), 3, axis=0)
    filter_points(
        points,
        adaptive_pooled,
        calibration=CALIBRATION,
        patch_points=50,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert {total for _, total in calls} == {CALIBRATION.passes * 900}
    assert calls[-1][0] == CALIBRATION.passes * 900


def test_no_error_is_expected_where_balls_hold_too_few_points() -> None:
    result = filter_points(plane(500), adaptive_pooled, calibration=CALIBRATION, patch_points=50, radius=0.01)
    assert np.isnan(result.errors).mean() > 0.9
    assert not result.moved[np.isnan(result.errors)].any()


@pytest.mark.parametrize("size", [1e-200, 1e-9, 1e-4])
def test_a_tight_clump_does_not_stop_the_filter(size: float) -> None:
    points = plane(20_000)
    clump = np.array([0.5, 0.5, 0.0]) if size > 1e-100 else np.zeros(3)
    points = np.vstack([points, clump + size * np.random.default_rng(1).normal(size=(30, 3))])
    result = filter_points(
        points, saying(dict.fromkeys(CALIBRATION.balls, -1.0)), calibration=CALIBRATION, patch_points=50, iterations=1,
        origin=np.zeros(3),
    )  # fmt: skip
    assert np.isfinite(result.points).all()
    assert result.moved[:20_000].mean() > 0.9
