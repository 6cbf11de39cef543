from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pointfilter.errors import ParameterError
from pointfilter.grids import Grids
from pointfilter.patches import MAX_REACH, NeighbourIndex, mixed, sampling_key


def brute_counts(points: np.ndarray, radii: np.ndarray) -> np.ndarray:
    squared = np.square(points[:, None] - points[None]).sum(axis=2)
    return (squared < np.square(radii)[:, None]).sum(axis=1)


@given(seed=st.integers(0, 2**32), edge=st.floats(0.02, 5), spread=st.sampled_from([0.0, 1e-3, 1.0, 1e6]))
def test_balls_hold_what_a_search_over_all_points_finds(seed: int, edge: float, spread: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(150, 3)) * [1, 1, spread]
    points[:3] += 1e7  # far away: the gap is narrowed
    radii = rng.uniform(0.01, min(2.0, 0.9 * MAX_REACH * edge), 150)
    counts = NeighbourIndex(points, edge).patches(np.arange(150), radii, 1, 0).counts
    np.testing.assert_array_equal(counts, brute_counts(points, radii))


@given(seed=st.integers(0, 2**32), guess=st.floats(1e-3, 3))
def test_radii_of_balls_are_distances_to_neighbours(seed: int, guess: float) -> None:
    points = np.random.default_rng(seed).normal(size=(200, 3))
    sizes = np.tile([1, 5, 40, 199, 200, 500], (200, 1))
    radii = NeighbourIndex(points, 0.3).ball_radii(np.arange(200), sizes, np.full(200, guess))
    distances, _ = cKDTree(points).query(points, k=200)
    squares = np.square(distances)
    between = np.sqrt((squares[:, [0, 4, 39, 198]] + squares[:, [1, 5, 40, 199]]) / 2)
    np.testing.assert_allclose(radii[:, :4], between, rtol=1e-11)
    assert np.isinf(radii[:, 4:]).all()


def test_a_ball_of_this_radius_holds_so_many_points() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    index = NeighbourIndex(points, 0.2)
    radii = index.ball_radii(np.arange(300), np.full((300, 1), 24), np.full(300, 0.1))[:, 0]
    np.testing.assert_array_equal(index.patches(np.arange(300), radii, 1, 0).counts, 24)


def test_a_ball_beyond_the_grid_s_reach_is_empty() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    patches = NeighbourIndex(points, 0.01).patches(np.arange(50), np.full(50, 0.01 * (MAX_REACH + 1)), 8, 0)
    assert not patches.counts.any()
    assert not patches.points.any()
    np.testing.assert_array_equal(patches.frames, np.broadcast_to(np.eye(3), (50, 3, 3)))


@given(seed=st.integers(0, 2**32), radius=st.floats(0.05, 1.0))
def test_the_smallest_key_in_a_ball(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points, keys = rng.normal(size=(200, 3)), rng.integers(0, 2**63, 200).astype(np.uint64)
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < radius
    expected = np.where(near, keys[None].astype(object), 2**64).argmin(axis=1)
    rows = np.arange(200)
    index = NeighbourIndex(points, radius)
    found = index.smallest_key(rows, np.full(200, radius), keys[index.order])
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(Grids(points).smallest_key(rows, np.full(200, radius), keys, 2, lambda: None), found)


@pytest.mark.parametrize("edge", [0.0, -1.0, float("nan"), float("inf")])
def test_an_edge_that_is_none(edge: float) -> None:
    with pytest.raises(ParameterError, match="edge"):
        NeighbourIndex(np.zeros((3, 3)), edge)


def test_a_grid_with_too_many_cells_gets_larger_ones() -> None:
    points = np.zeros((2**15, 3))
    points[:, 0] = np.arange(2**15)
    index = NeighbourIndex(points, 1e-3)
    assert 1e-3 < index.edge < 1
    rows = np.arange(1, 200)
    counts = index.patches(rows, np.full(199, 1.5), 1, 0).counts
    np.testing.assert_array_equal(counts, 3)
    assert NeighbourIndex(points, 1e-140).edge < 1


def test_a_piece_of_a_cloud_is_sorted_as_the_whole() -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (500, 3))
    piece = points[:, 0] < 1
    whole = NeighbourIndex(points, 0.7).order
    np.testing.assert_array_equal(np.flatnonzero(piece)[NeighbourIndex(points[piece], 0.7).order], whole[piece[whole]])


def test_grids_of_powers_of_two() -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    radii = np.exp(np.random.default_rng(1).uniform(-3, 1, 100))
    seen: list[int] = []
    for chosen, index in Grids(points).by_radius(np.arange(100), radii):
        assert ((index.edge <= radii[chosen]) & (radii[chosen] < 2 * index.edge)).all()
        assert (np.diff(index.positions[chosen]) > 0).all()
        seen += chosen.tolist()
    assert sorted(seen) == list(range(100))


def test_which_neighbours_a_full_patch_keeps_depends_on_the_key_and_is_fair() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    index = NeighbourIndex(points, 1.0)
    kept = np.zeros(400)
    for key in range(300):
        patch = index.patches(np.array([0]), np.array([4.0]), 40, sampling_key(0, key))
        places = (patch.points[0].astype(np.float64) @ patch.frames[0]) * 4.0 + points[0]
        _, rows = cKDTree(points).query(places)
        assert len(set(rows)) == 40
        assert 0 in rows
        kept[rows] += 1
    assert abs(kept[1:].mean() - 300 * 39 / 399) < 1e-9
    assert kept[1:].std() < 2 * np.sqrt(300 * 0.1 * 0.9)


GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def test_mixing_is_the_finaliser_of_splitmix64() -> None:
    """Its first three numbers from seed 0, as published with the generator."""
    found = mixed(np.arange(1, 4, dtype=np.uint64) * GOLDEN)
    assert found.tolist() == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]


@given(seed=st.integers(0, 2**32), key=st.integers(0, 2**64 - 1))
def test_a_full_patch_keeps_the_smallest_hashes_of_the_distances(seed: int, key: int) -> None:
    """The native choice is this one, with the same mixing."""
    points = np.random.default_rng(seed).uniform(-1, 1, (300, 3))
    patch = NeighbourIndex(points, 1.0).patches(np.array([0]), np.array([4.0]), 40, key)
    steps = (np.square(points - points[0]).sum(axis=1) * (2**12 / 16.0)).astype(np.uint64)
    hashes = mixed(mixed(np.array([key], np.uint64)) + steps * GOLDEN)
    hashes[0] = 0
    squared = np.square(points - points[0]).sum(axis=1)
    expected = np.lexsort((squared, hashes))[:40]
    _, found = cKDTree(points).query(patch.points[0].astype(np.float64) @ patch.frames[0] * 4.0 + points[0])
    assert sorted(found) == sorted(expected)
