from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pointfilter.errors import ParameterError
from pointfilter.patches import NeighbourIndex, _mixed, sampling_key, stable_ids


def index_of(points: np.ndarray, radius: float) -> tuple[NeighbourIndex, np.ndarray]:
    ids = stable_ids(points)
    return NeighbourIndex(points, radius, ids), ids


def all_neighbours(points: np.ndarray, centres: np.ndarray, radius: float) -> list[list[int]]:
    """What the index finds, as sorted rows of `points`."""
    index, _ = index_of(points, radius)
    rows, counts = index.sample(centres, np.zeros(len(centres), np.uint64), max(1, len(points)), 0)
    np.testing.assert_array_equal(index.count(centres), counts)
    found = [sorted(row[row >= 0].tolist()) for row in rows]
    assert [len(row) for row in found] == counts.tolist()
    return found


def brute_force(points: np.ndarray, centres: np.ndarray, radius: float) -> list[list[int]]:
    offsets = points[None] - centres[:, None]
    with np.errstate(over="ignore"):
        squared = offsets[..., 0] ** 2 + offsets[..., 1] ** 2 + offsets[..., 2] ** 2
    return [np.flatnonzero(row < radius * radius).tolist() for row in squared]


def random_cloud(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "random":
        return rng.uniform(-1, 1, (300, 3))
    if kind == "clustered":
        return rng.normal(size=(6, 1, 3)).repeat(50, axis=1).reshape(-1, 3) + 0.02 * rng.normal(size=(300, 3))
    if kind == "sheet":
        return rng.uniform(-1, 1, (300, 3)) * [1, 1, 0]
    if kind == "line":
        return rng.uniform(-1, 1, (300, 1)) * [1, 2, 3]
    if kind == "duplicates":
        return rng.uniform(-1, 1, (60, 3)).repeat(5, axis=0)
    if kind == "utm":
        return rng.uniform(-1, 1, (300, 3)) + np.array([5e5, 5e6, 120.0])
    if kind == "stray":  # one point so far away that the grid ends before it
        return np.vstack([rng.uniform(-1, 1, (299, 3)), [[1e9, -1e9, 1e9]]])
    if kind == "strays":  # a few in one place, and one on either side of the others
        far = np.array([[1e9, -1e9, 1e9]] * 10 + [[-1e9, 0, 0], [0, 1e9, 0]])
        return np.vstack([rng.uniform(-1, 1, (288, 3)), far + 0.3 * rng.normal(size=far.shape)])
    if kind == "two places":  # so many points far away that the grid has to be coarser than the radius
        return rng.uniform(-1, 1, (300, 3)) + np.where(rng.random((300, 1)) < 0.5, 1e9, 0)
    assert kind == "grid"
    return np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)


KINDS = ["random", "clustered", "sheet", "line", "duplicates", "utm", "stray", "strays", "two places", "grid"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius", [1e-9, 0.01, 0.1731, 0.5, 3.7, 1e3])
def test_the_index_finds_what_a_kd_tree_finds(kind: str, radius: float) -> None:
    rng = np.random.default_rng(3)
    points = random_cloud(kind, rng)
    centres = np.vstack([points[::3], points.mean(axis=0) + rng.normal(size=(20, 3))])
    expected = [sorted(row) for row in cKDTree(points).query_ball_point(centres, radius)]
    assert all_neighbours(points, centres, radius) == expected


@given(
    kind=st.sampled_from(KINDS),
    seed=st.integers(0, 2**32),
    radius=st.floats(1e-4, 1e4),
    distance=st.sampled_from([0.0, 0.5, 3.0, 1e6]),
)
def test_the_index_finds_what_brute_force_finds(kind: str, seed: int, radius: float, distance: float) -> None:
    rng = np.random.default_rng(seed)
    points = random_cloud(kind, rng)
    centres = np.vstack([points[:40], points[:40] + distance * rng.normal(size=(40, 3))])
    assert all_neighbours(points, centres, radius) == brute_force(points, centres, radius)


def test_a_stray_point_does_not_make_the_cells_coarser() -> None:
    """Else all others would lie in a few cells, and a million points would cost a million times a million."""
    points = np.random.default_rng(0).uniform(size=(500, 3))
    without, _ = index_of(points, 0.1)
    stray, _ = index_of(np.vstack([points, [[-5e6, 2e5, 0]]]), 0.1)
    number_of_cells = len(without._arrays[2])
    assert number_of_cells > 400
    assert abs(len(stray._arrays[2]) - number_of_cells) < 40  # the grid has another origin


def test_the_ball_is_open_as_in_the_paper() -> None:
    points = random_cloud("grid", np.random.default_rng(0))
    (found,) = all_neighbours(points, np.array([[3.0, 3.0, 3.0]]), 1.0)
    assert points[found].tolist() == [[3.0, 3.0, 3.0]]  # the six at distance 1 exactly are outside


@pytest.mark.parametrize("radius", [1e-150, 1e-30, 1e30, 1e160, 1e300])
def test_extreme_radii_are_answered(radius: float) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    found = all_neighbours(points, points, radius)
    everyone = list(range(50))
    assert found == ([everyone] * 50 if radius > 1 else [[row] for row in everyone])


def test_centres_far_outside_the_box_have_no_neighbours() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    centres = np.array([[1e12, 0, 0], [-1e300, 1e300, 0], [0, 0, 3.0]])
    assert all_neighbours(points, centres, 0.5) == [[], [], []]


def test_a_centre_outside_still_sees_what_is_near() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 1]])
    assert all_neighbours(points, np.array([[-0.3, -0.3, 0.0], [1.2, 1.2, 1.2]]), 0.5) == [[0], [2]]


def test_a_cloud_of_one_point() -> None:
    points = np.array([[3.0, 4.0, 5.0]])
    assert all_neighbours(points, np.array([[3.0, 4.0, 5.0], [3.0, 4.0, 6.0]]), 0.5) == [[0], []]


def test_an_empty_cloud_has_no_neighbours() -> None:
    index, _ = index_of(np.empty((0, 3)), 1.0)
    np.testing.assert_array_equal(index.count(np.zeros((2, 3))), [0, 0])
    patches = index.patches(np.zeros((2, 3)), np.zeros(2, np.uint64), 4, 0)
    assert not patches.points.any()


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_that_is_none_is_refused(radius: float) -> None:
    with pytest.raises(ParameterError, match="radius"):
        index_of(np.zeros((3, 3)), radius)


def test_counting_stops_where_it_is_told_to() -> None:
    points = random_cloud("random", np.random.default_rng(0))
    index, _ = index_of(points, 0.6)
    counts = index.count(points)
    assert counts.min() < 12 < counts.max()
    np.testing.assert_array_equal(index.count(points, 12), np.minimum(counts, 12))


# --- dense clouds ---

ENOUGH = 1024  # what _native.cpp calls kEnough


def looked_at(points: np.ndarray, ids: np.ndarray, centre: np.ndarray, radius: float, enough: int) -> np.ndarray:
    """By definition: the points of the highest level that has enough of them in the ball, as sorted rows."""
    mixed = [int(value) for value in _mixed(ids)]
    zeros = np.array([64 - value.bit_length() for value in mixed])
    (ball,) = np.nonzero(np.linalg.norm(points - centre, axis=1) < radius)
    level = max((k for k in range(1, 41) if (zeros[ball] >= k).sum() >= enough), default=0)
    return ball[zeros[ball] >= level]


@pytest.mark.parametrize("length", [16, 300])
def test_a_dense_ball_is_thinned_to_the_highest_level_that_is_enough(length: int) -> None:
    rng = np.random.default_rng(0)
    points = np.vstack([rng.uniform(-1, 1, (20_000, 3)) * [1, 1, 0.1], rng.uniform(1, 3, (3_000, 3)) * [1, 1, 0.1]])
    index, ids = index_of(points, 0.7)
    centres = np.concatenate([np.flatnonzero(points[:, 0] < 1)[:30], np.flatnonzero(points[:, 0] > 1)[:30]])
    rng.shuffle(centres)
    chosen, counts = index.sample(points[centres], ids[centres], length, 5)
    patches = index.patches(points[centres], ids[centres], length, 5)
    thinned = 0
    for row, centre in enumerate(centres):
        rows = looked_at(points, ids, points[centre], 0.7, max(ENOUGH, 4 * length))
        assert counts[row] == len(rows)
        assert set(chosen[row][chosen[row] >= 0]) <= set(rows)
        with_centre = np.union1d(rows, [centre])
        assert patches.counts[row] == len(with_centre)
        axes = np.linalg.eigh(np.cov((points[with_centre] - points[centre]).T))[1]
        np.testing.assert_allclose(np.abs(patches.frames[row] @ axes)[[2, 0, 1], [0, 1, 2]], 1, atol=1e-6)
        thinned += len(rows) < (np.linalg.norm(points - points[centre], axis=1) < 0.7).sum()
    assert 20 < thinned < 60


def test_a_thinned_patch_holds_its_centre() -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (9_000, 3))
    index, ids = index_of(points, 1.2)
    patches = index.patches(points[:200], ids[:200], 32, 0)
    assert patches.counts.max() < 3_000
    assert (np.abs(patches.points).max(axis=2) == 0).any(axis=1).all()


def test_how_a_ball_is_thinned_does_not_depend_on_who_is_asked_before() -> None:
    rng = np.random.default_rng(2)
    points = np.vstack([rng.normal(size=(6_000, 3)) * 0.2, rng.uniform(-2, 2, (2_000, 3))])
    index, ids = index_of(points, 0.5)
    order = rng.permutation(len(points))[:300]
    forwards, counts = index.sample(points[order], ids[order], 20, 1)
    backwards, _ = index.sample(points[order[::-1]], ids[order[::-1]], 20, 1)
    assert counts.min() < ENOUGH < counts.max()
    np.testing.assert_array_equal(forwards, backwards[::-1])
    alone = np.vstack([index.sample(points[[row]], ids[[row]], 20, 1)[0] for row in order])
    np.testing.assert_array_equal(forwards, alone)


# --- downsampling ---


@given(seed=st.integers(0, 2**32), wanted=st.integers(1, 60), key=st.integers(0, 2**64 - 1))
def test_downsampling_keeps_exactly_so_many_without_replacement(seed: int, wanted: int, key: int) -> None:
    points = random_cloud(KINDS[seed % len(KINDS)], np.random.default_rng(seed))
    index, ids = index_of(points, 0.6)
    whole, counts = index.sample(points, ids, len(points), key)
    chosen, same_counts = index.sample(points, ids, wanted, key)
    np.testing.assert_array_equal(counts, same_counts)
    for row, every in zip(chosen, whole, strict=True):
        kept = row[row >= 0]
        assert len(kept) == min(wanted, (every >= 0).sum())
        assert len(set(kept.tolist())) == len(kept)
        assert set(kept.tolist()) <= set(every.tolist())


@given(seed=st.integers(0, 2**32), wanted=st.integers(1, 20))
def test_downsampling_keeps_the_centre(seed: int, wanted: int) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, (200, 3))
    index, ids = index_of(points, 1.0)
    chosen, _ = index.sample(points, ids, wanted, seed)
    assert (chosen == np.arange(200)[:, None]).any(axis=1).all()


def test_a_pile_of_equal_points_is_downsampled_too() -> None:
    points = np.vstack([np.zeros((30, 3)), [[0.1, 0, 0]]])
    index, ids = index_of(points, 1.0)
    chosen, counts = index.sample(points, ids, 7, 0)
    assert (counts == 31).all()
    assert all(len(set(row.tolist())) == 7 for row in chosen)


def test_every_neighbour_is_chosen_about_as_often() -> None:
    """Chi-squared over many keys: 40 neighbours, 10 places of which the centre holds one."""
    points = np.random.default_rng(5).uniform(-0.1, 0.1, (40, 3))
    index, ids = index_of(points, 1.0)
    trials = 3000
    times = np.zeros(40)
    for trial in range(trials):
        chosen, _ = index.sample(points[:1], ids[:1], 10, sampling_key(trial, 0))
        times[chosen[0]] += 1
    assert times[0] == trials
    expected = trials * 9 / 39
    statistic = (((times[1:] - expected) ** 2) / expected).sum() / (1 - 9 / 39)
    assert statistic < 72.1  # 38 degrees of freedom: exceeded by chance once in a thousand


def test_two_centres_choose_independently() -> None:
    """The share of neighbours that two centres of the same ball have in common is what chance gives."""
    points = np.random.default_rng(6).uniform(-0.1, 0.1, (400, 3))
    index, ids = index_of(points, 1.0)
    chosen, _ = index.sample(points, ids, 100, 1)
    common = [len(set(a) & set(b)) for a, b in zip(chosen[:-1].tolist(), chosen[1:].tolist(), strict=True)]
    assert abs(np.mean(common) - 25) < 1


def test_the_choice_depends_on_the_key() -> None:
    points = np.random.default_rng(5).uniform(-1, 1, (200, 3))
    index, ids = index_of(points, 1.0)
    first, _ = index.sample(points, ids, 10, sampling_key(0, 0))
    for other in (sampling_key(0, 1), sampling_key(1, 0)):
        assert (first != index.sample(points, ids, 10, other)[0]).any(axis=1).mean() > 0.9


def test_the_choice_does_not_depend_on_who_is_asked_with_whom() -> None:
    points = np.random.default_rng(5).uniform(-1, 1, (200, 3))
    index, ids = index_of(points, 1.0)
    together, _ = index.sample(points, ids, 10, 3)
    alone = np.vstack([index.sample(points[k : k + 1], ids[k : k + 1], 10, 3)[0] for k in range(200)])
    backwards, _ = index.sample(points[::-1], ids[::-1].copy(), 10, 3)
    np.testing.assert_array_equal(together, alone)
    np.testing.assert_array_equal(together, backwards[::-1])


def test_the_choice_does_not_depend_on_the_order_of_the_cloud() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (200, 3))
    shuffle = rng.permutation(200)
    index, ids = index_of(points, 1.0)
    shuffled, shuffled_ids = index_of(points[shuffle], 1.0)
    chosen, _ = index.sample(points, ids, 10, 3)
    other, _ = shuffled.sample(points, shuffled_ids[np.argsort(shuffle)], 10, 3)
    np.testing.assert_array_equal(chosen, shuffle[other])


def test_sampling_keys_differ_and_are_64_bits() -> None:
    keys = {sampling_key(seed, iteration) for seed in range(50) for iteration in range(10)}
    assert len(keys) == 500
    assert all(0 <= key < 2**64 for key in keys)
    assert sampling_key(2**63 - 1, 99) not in keys


# --- stable ids ---


def test_ids_are_ranks_and_equal_points_share_one() -> None:
    points = np.array([[0.0, 0, 0], [3, 0, 0], [0, 0, 0], [-3.5, 0.1, 0]])
    ids = stable_ids(points)
    assert ids[0] == ids[2]
    assert sorted(set(ids.tolist())) == [0, 1, 2]
    assert stable_ids(np.empty((0, 3))).shape == (0,)


@given(seed=st.integers(0, 2**32), scale=st.floats(1e-3, 1e3))
def test_ids_survive_shuffling_and_similarity(seed: int, scale: float) -> None:
    from tests.clouds import rotation

    rng = np.random.default_rng(seed)
    points = rng.normal(size=(150, 3))
    points[20:30] = points[:10]
    ids = stable_ids(points)
    shuffle = rng.permutation(150)
    np.testing.assert_array_equal(stable_ids(points[shuffle]), ids[shuffle])
    # The copies are left out: after a rotation they are still equal, so they still share an id.
    np.testing.assert_array_equal(stable_ids(scale * points @ rotation(rng).T + rng.normal(size=3)), ids)


def test_points_at_one_distance_are_told_apart_by_their_coordinates() -> None:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    shuffle = np.array([3, 1, 5, 0, 2, 4])
    ids = stable_ids(points)
    assert sorted(ids.tolist()) == list(range(6))
    np.testing.assert_array_equal(stable_ids(points[shuffle]), ids[shuffle])
