from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointfilter import _native
from pointfilter.network import LENGTH_STEP, by_length
from pointfilter.patches import NeighbourIndex, Patches
from tests.clouds import rotation


def cut(points: np.ndarray, radius: float, length: int, key: int = 0) -> Patches:
    return NeighbourIndex(points, radius).patches(np.arange(len(points)), np.full(len(points), radius), length, key)


def in_ball(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    return (points[np.linalg.norm(points - centre, axis=1) < radius] - centre) / radius


def assert_rotations(frames: np.ndarray) -> None:
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-12)


@given(seed=st.integers(0, 2**32), flatness=st.floats(1e-6, 1), radius=st.floats(0.2, 5))
def test_frames_are_rotations_onto_the_principal_axes(seed: int, flatness: float, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(120, 3)) * [1, 0.6, 0.3 * flatness]) @ rotation(rng).T
    patches = cut(points, radius, 200)
    assert_rotations(patches.frames)
    for centre, frame, count in zip(points, patches.frames, patches.counts, strict=True):
        ball = in_ball(points, centre, radius)
        assert len(ball) == count
        if count < 4:
            continue
        covariance = np.cov(ball.T, bias=True)
        values = np.linalg.eigvalsh(covariance)[::-1]
        # Rows: x the second axis, y the first, z the last; eigenvectors, so R C Rᵀ is diagonal.
        turned = frame @ covariance @ frame.T
        np.testing.assert_allclose(turned, np.diag(values[[1, 0, 2]]), atol=1e-10)


def test_rows_of_a_frame_are_numpys_eigenvectors() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3)) * [1, 0.5, 0.2]
    patches = cut(points, 10.0, 300)
    for centre, frame in zip(points, patches.frames, strict=True):
        _, vectors = np.linalg.eigh(np.cov(in_ball(points, centre, 10.0).T, bias=True))
        for row, vector in zip(frame[[1, 0, 2]], vectors.T[::-1], strict=True):
            assert abs(abs(row @ vector) - 1) < 1e-12


@given(seed=st.integers(0, 2**32))
def test_the_mean_of_the_neighbours_lies_towards_x_and_z(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(80, 3)) * [1, 0.5, 0.2]
    patches = cut(points, 0.9, 80)
    means = patches.points.astype(np.float64).sum(axis=1) / patches.counts[:, None]
    crowded = patches.counts >= 4
    assert crowded.any()
    assert (means[crowded][:, [0, 2]] >= -1e-6).all()


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0]],
        [[0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0.3, 0], [0.2, 0, 0.1]],
        [[0, 0, 0]] * 9,
        [[t, 2 * t, -t] for t in np.linspace(0, 0.4, 12)],
        [[t, 0, 0] for t in np.linspace(-0.4, 0.4, 13)],
        [[a, b, 0] for a in (-1, 0, 1) for b in (-1, 0, 1)],
        [[a, b, c] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)],
        [[1e-12 * k, 0, 1e-13 * k * k] for k in range(8)],
    ],
    ids=["one", "two", "three", "equal", "line", "axis", "symmetric sheet", "symmetric cube", "minute"],
)
@pytest.mark.parametrize("length", [1, 4, 40])
def test_degenerate_patches_have_frames_too(points: list[list[float]], length: int) -> None:
    patches = cut(np.array(points, dtype=np.float64), 2.0, length)
    assert_rotations(patches.frames)
    assert np.isfinite(patches.points).all()


def test_patches_are_centred_turned_scaled_and_padded() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(90, 3)) * [1, 0.6, 0.3] + 40
    radius = 0.8
    patches = cut(points, radius, 90)
    assert patches.points.dtype == np.float32
    for centre, frame, patch, count in zip(points, patches.frames, patches.points, patches.counts, strict=True):
        expected = in_ball(points, centre, radius) @ frame.T
        assert not patch[count:].any()
        order = np.lexsort(expected.round(5).T)
        found = patch[:count][np.lexsort(patch[:count].round(5).T)]
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected[order], axis=0), atol=1e-6)
        assert (np.linalg.norm(patch, axis=1) < 1 + 1e-6).all()
        assert (np.linalg.norm(patch, axis=1) == 0).any()  # the centre


def test_a_longer_patch_is_the_same_patch_with_more_padding() -> None:
    points = np.random.default_rng(2).normal(size=(90, 3))
    short = cut(points, 0.8, 90)
    long = cut(points, 0.8, 131)
    np.testing.assert_array_equal(short.points, long.points[:, :90])
    np.testing.assert_array_equal(short.frames, long.frames)
    assert not long.points[:, 90:].any()


def test_the_frame_sees_the_whole_ball_and_not_the_choice() -> None:
    points = np.random.default_rng(2).normal(size=(200, 3))
    whole = cut(points, 2.0, 200)
    chosen = cut(points, 2.0, 12)
    np.testing.assert_array_equal(whole.frames, chosen.frames)
    np.testing.assert_array_equal(whole.counts, chosen.counts)
    for patch, every in zip(chosen.points, whole.points, strict=True):
        assert set(map(tuple, patch.tolist())) <= set(map(tuple, every.tolist()))


@given(counts=st.lists(st.integers(0, 2000), max_size=80), longest=st.integers(1, 600))
def test_every_patch_is_evaluated_once_at_a_length_that_fits(counts: list[int], longest: int) -> None:
    numbers = np.array(counts, dtype=np.int64)
    seen: list[int] = []
    for length, positions in by_length(numbers, longest):
        assert length <= longest
        assert (np.minimum(numbers[positions], longest) <= length).all()
        assert (length - numbers[positions] <= LENGTH_STEP).all() or length == longest
        seen += positions.tolist()
    assert sorted(seen) == list(range(len(counts)))


# --- the compiled module checks its buffers ---


def test_buffers_that_do_not_fit_are_refused() -> None:
    points = np.random.default_rng(3).normal(size=(20, 3))
    arrays = NeighbourIndex(points, 1.0)._arrays
    rows, radii, owners = np.arange(20), np.ones(20), np.empty(20, np.int64)
    keys = np.arange(20, dtype=np.uint64)
    _native.smallest_key(arrays, rows, radii, keys, owners)
    with pytest.raises(ValueError, match="radii"):
        _native.smallest_key(arrays, rows, radii[:5], keys, owners)
    with pytest.raises(TypeError, match="radii"):
        _native.smallest_key(arrays, rows, radii.astype(np.float32), keys, owners)
    with pytest.raises(ValueError, match="beyond"):
        _native.smallest_key(arrays, rows + 1, radii, keys, owners)
    with pytest.raises(ValueError, match="keys"):
        _native.smallest_key(arrays, rows, radii, keys[:5].copy(), owners)
    with pytest.raises(ValueError, match="frames"):
        _native.build_patches(arrays, rows, radii, 0, np.empty((20, 4, 3), np.float32), np.empty((19, 3, 3)), owners)
    with pytest.raises(ValueError, match="radii"):
        _native.ball_radii(arrays, rows, radii, np.ones((20, 2), np.int64), np.empty((20, 3)))
    with pytest.raises(ValueError, match=r"cell_starts|index"):
        _native.smallest_key((arrays[0], arrays[1], arrays[2][:-1].copy(), *arrays[3:]), rows, radii, keys, owners)
    owners.setflags(write=False)
    with pytest.raises(ValueError, match="read-only"):
        _native.smallest_key(arrays, rows, radii, keys, owners)
