from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from training.dataset import (
    Batch,
    CleanCloud,
    TrainingCloud,
    _queries,
    batches_ahead,
    clean_patches,
    cut_batch,
    load_author_clouds,
    make_clean,
    make_cloud,
    nearest_on_surface,
    validation_cloud,
)
from training.network import context
from training.pools import Pools
from training.settings import TrainingSettings


def same(a: Batch, b: Batch) -> bool:
    pairs = zip(vars(a).values(), vars(b).values(), strict=True)
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in pairs)


def test_a_batch_is_a_function_of_settings_and_step(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    first = cut_batch(clouds, tiny.data, 5)
    cut_batch(clouds, tiny.data, 6)
    assert same(first, cut_batch(clouds, tiny.data, 5))
    assert not same(first, cut_batch(clouds, tiny.data, 6))
    assert not same(first, cut_batch(clouds, dataclasses.replace(tiny.data, seed=1), 5))
    assert same(first, cut_batch(Pools(tiny.data)(0), tiny.data, 5))


def test_batches_come_in_order_wherever_one_begins(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    expected = [cut_batch(clouds, tiny.data, step) for step in range(3, 9)]
    found = list(batches_ahead(clouds, tiny.data, 3, 9, ahead=2))
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))
    early = list(itertools.islice(batches_ahead(clouds, tiny.data, 3, 10**9), 2))
    assert all(same(a, b) for a, b in zip(early, expected, strict=False))


def test_an_error_in_the_second_thread_reaches_the_first(tiny: TrainingSettings) -> None:
    with pytest.raises((ValueError, IndexError)):
        next(batches_ahead([], tiny.data, 0, 3))


def test_shapes_of_a_batch(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    batch = cut_batch(clouds, tiny.data, 0)
    asked = len(batch.queries)
    assert batch.patches.shape == (16, 32, 3)
    assert batch.context.shape == (16, 2)
    assert 16 < asked <= 16 * tiny.data.queries
    assert batch.queries.shape == (asked, 3)
    assert batch.owners.shape == batch.still.shape == (asked,)
    assert {tensor.dtype for tensor in (batch.patches, batch.context, batch.queries, batch.still)} == {torch.float32}
    assert batch.owners.dtype == torch.int64
    assert batch.patches.norm(dim=2).max() < 1 + 1e-5
    assert (batch.centres.shape, batch.frames.shape, batch.radii.shape) == ((16, 3), (16, 3, 3), (16,))
    for row, number in enumerate(batch.clouds):
        assert (clouds[number].points == batch.centres[row]).all(axis=1).any()


def test_balls_are_thinned_to_between_two_numbers_of_points(tiny: TrainingSettings) -> None:
    points = np.random.default_rng(0).normal(size=(400, 3))
    cloud = make_cloud(points, make_clean(points, np.tile([0.0, 0, 1], (400, 1))))
    data = dataclasses.replace(
        tiny.data, smallest_ball=50, patch_points=40, fewest_patch_points=10, batch=256, clouds_per_batch=128
    )
    batch = cut_batch([cloud], data, 0)
    counts = batch.counts.numpy()
    assert (counts.min(), counts.max()) == (10, 40)
    assert 20 < counts.mean() < 30
    written = batch.patches.numpy().any(axis=2)
    for row, count in enumerate(counts):
        assert not written[row, count:].any()
        assert written[row].sum() == count - 1  # all but the centre, which is the origin
    fixed = cut_batch([cloud], dataclasses.replace(data, fewest_patch_points=40), 0)
    assert (fixed.counts == 40).all()


def test_the_context_of_a_patch_is_what_its_ball_holds(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    batch = cut_batch(clouds, tiny.data, 1)
    held = 2 ** (6 * (batch.context[:, 0].numpy() + 1))
    for row, number in enumerate(batch.clouds):
        distances = np.linalg.norm(clouds[number].points - batch.centres[row], axis=1) / batch.radii[row]
        least, most = (distances < 1 - 1e-9).sum(), (distances < 1 + 1e-9).sum()  # points may lie on the ball's edge
        assert least - 0.01 < held[row] < most + 0.01
        assert tiny.data.smallest_ball <= most
        assert least <= tiny.data.largest_ball
    assert not batch.context[:, 1].any()


def test_balls_hold_as_many_points_as_a_small_cloud_has(tiny: TrainingSettings) -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    cloud = make_cloud(points, make_clean(points, np.tile([0.0, 0, 1], (30, 1))))
    batch = cut_batch([cloud], dataclasses.replace(tiny.data, smallest_ball=100, largest_ball=4_000), 0)
    held = [(np.linalg.norm(points - c, axis=1) < r).sum() for c, r in zip(batch.centres, batch.radii, strict=True)]
    assert np.isfinite(batch.radii).all()
    assert min(held) >= 20


def test_a_radius_of_the_settings_is_that_of_every_patch(tiny_paper: TrainingSettings) -> None:
    data = dataclasses.replace(tiny_paper.data, radius=0.07)
    clouds = Pools(data)(0)
    batch = cut_batch(clouds, data, 0)
    for number, radius in zip(batch.clouds, batch.radii, strict=True):
        clean = clouds[number].clean.points
        assert radius == pytest.approx(0.07 * np.linalg.norm(np.ptp(clean, axis=0)))
    assert len(batch.queries) == len(batch.patches)


# --- queries ---


def test_queries_are_the_centre_and_points_within_reach(tiny: TrainingSettings) -> None:
    rng = np.random.default_rng(0)
    patches = rng.uniform(-0.6, 0.6, (5, 40, 3)).astype(np.float32)
    patches[:, 0] = 0
    counts = np.array([40, 12, 1, 40, 25])
    for row, count in enumerate(counts):
        patches[row, count:] = 0
    data = dataclasses.replace(tiny.data, queries=6, query_reach=0.45)
    queries, owners = _queries(patches, counts, data, rng)
    assert queries.dtype == np.float32
    assert not queries[:5].any()
    np.testing.assert_array_equal(owners[:5], range(5))
    for row, count in enumerate(counts):
        own = queries[5:][owners[5:] == row]
        near = patches[row, :count][np.linalg.norm(patches[row, :count], axis=1) < 0.45]
        assert len(own) == min(5, len(near))
        assert len({tuple(query) for query in own}) == len(own)
        assert {tuple(query) for query in own} <= {tuple(point) for point in near}


def test_queries_are_drawn_from_all_the_points_within_reach(tiny: TrainingSettings) -> None:
    rng = np.random.default_rng(0)
    patches = np.repeat(rng.uniform(-0.2, 0.2, (1, 20, 3)).astype(np.float32), 200, axis=0)
    data = dataclasses.replace(tiny.data, queries=3)
    queries, _ = _queries(patches, np.full(200, 20), data, rng)
    times = [(queries[200:] == point).all(axis=1).sum() for point in patches[0]]
    assert sum(times) == 400
    assert min(times) >= 5  # of 20 on average


def test_queries_lie_on_points_of_the_cloud(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    batch = cut_batch(clouds, tiny.data, 2)
    for query, owner in zip(batch.queries.numpy(), batch.owners.numpy(), strict=True):
        place = query @ batch.frames[owner] * batch.radii[owner] + batch.centres[owner]
        distances = np.linalg.norm(clouds[batch.clouds[owner]].points - place, axis=1)
        assert distances.min() < 1e-5 * batch.radii[owner]


# --- the surface ---


def plane(half: float = 2.0, step: float = 0.02) -> CleanCloud:
    """The square [-half, half]² at z = 0."""
    x, y = np.meshgrid(*[np.arange(-half, half + step / 2, step)] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return make_clean(points, np.tile([0.0, 0, 1], (len(points), 1)))


def above(height: float, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (count, 3))
    points[:, 2] = height * rng.choice([-1, 1], count)
    return points


def test_nearest_on_the_surface_of_a_plane(tiny: TrainingSettings) -> None:
    height = 0.05
    cloud = make_cloud(above(height), plane())
    assert cloud.clean.spacing == pytest.approx(2 * 0.02)
    batch = cut_batch([cloud], tiny.data, 0)
    nearest, normals, spacing = nearest_on_surface(batch, [cloud], batch.queries)
    owners = batch.owners.numpy()
    frames, radii, centres = batch.frames[owners], batch.radii[owners], batch.centres[owners]
    places = np.einsum("mi,mij->mj", nearest.numpy(), frames) * radii[:, None] + centres
    queries = np.einsum("mi,mij->mj", batch.queries.numpy(), frames) * radii[:, None] + centres
    np.testing.assert_allclose(places[:, 2], 0, atol=1e-5)
    assert np.abs(places - queries)[:, :2].max() <= 0.01 + 1e-5
    np.testing.assert_allclose(np.einsum("mi,mij->mj", normals.numpy(), frames), [[0, 0, 1]] * len(places), atol=1e-5)
    np.testing.assert_allclose(spacing.numpy(), 0.04 / radii, rtol=1e-5)
    np.testing.assert_allclose(batch.still.numpy(), height / radii, rtol=1e-3)


def test_the_clean_patch_lies_in_the_frame_of_the_noisy_one(tiny_paper: TrainingSettings) -> None:
    """Without noise and with room for all neighbours, both patches hold the same points."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3)) * [1, 0.6, 0.2]
    cloud = make_cloud(points, make_clean(points, np.tile([[0.0, 0, 1]], (300, 1))), 0.5)
    data = dataclasses.replace(tiny_paper.data, patch_points=300, clean_patch_points=300)
    batch = cut_batch([cloud], data, 0)
    for patch, clean, normals, present in zip(batch.patches, *clean_patches(batch, [cloud], data, 0), strict=True):
        count = int(present.sum())
        np.testing.assert_allclose(
            np.sort(patch[:count].numpy(), axis=0), np.sort(clean[present].numpy(), axis=0), atol=1e-5
        )
        np.testing.assert_allclose(normals[present].norm(dim=1), 1, atol=1e-5)
        assert not clean[~present].any()
        assert not normals[~present].any()


def test_a_full_clean_patch_is_a_choice_of_the_step(clouds: list[TrainingCloud], tiny_paper: TrainingSettings) -> None:
    data = dataclasses.replace(tiny_paper.data, clean_patch_points=8)
    batch = cut_batch(clouds, data, 0)
    first, again, other = (clean_patches(batch, clouds, data, step) for step in (0, 0, 1))
    assert first[0].shape == first[1].shape == (16, 8, 3)
    assert first[2].any(dim=1).all()
    assert torch.equal(first[0], again[0])
    assert not torch.equal(first[0], other[0])


# --- clouds that the network has filtered ---


def test_a_share_of_the_patches_comes_from_later_clouds(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    later = make_cloud(clouds[0].points[:500], clouds[0].clean, later=True)
    data = dataclasses.replace(tiny.data, own_share=0.35, batch=16 * 200, clouds_per_batch=200)
    batch = cut_batch([*clouds, later], data, 0)
    own = batch.clouds == len(clouds)
    assert 0.2 < own.mean() < 0.5
    np.testing.assert_array_equal(batch.context[:, 1].numpy(), own)
    none = cut_batch([*clouds, later], dataclasses.replace(data, own_share=0.0), 0)
    assert not (none.clouds == len(clouds)).any()


def test_the_context_of_training_is_the_filter_s() -> None:
    from pointfilter import network

    counts = np.array([1, 20, 4_000])
    for later in (False, True):
        told = context(torch.from_numpy(counts), torch.full((3,), later))
        np.testing.assert_allclose(told.numpy(), network.context(counts, later), atol=1e-6)


# --- the user's own meshes ---

OBJ = "v 0 0 0\nv 2 0 0\nv 0 2 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_meshes_of_one_s_own(tmp_path: Path, tiny: TrainingSettings) -> None:
    (tmp_path / "b.obj").write_text(OBJ)
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    data = dataclasses.replace(tiny.data, clouds=3, clean_share=1.0, plain_share=1.0)
    flat, solid, again = Pools(data, meshes=tmp_path)(0)
    assert not np.ptp(flat.points[:, 2])
    assert not np.ptp(again.points[:, 2])
    assert np.ptp(solid.points, axis=0).min() > 0.3
    assert (flat.points[:10] != again.points[:10]).any()


# --- the authors' layout ---


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for name, levels in (("cube", ("0.005", "0.01")), ("cube_2", ())):
        points = rng.uniform(size=(200, 3)).astype(np.float32)
        np.save(tmp_path / f"{name}.npy", points)
        np.save(tmp_path / f"{name}_normal.npy", np.tile(np.float32([0, 0, 1]), (200, 1)))
        for level in levels:
            np.save(tmp_path / f"{name}_{level}.npy", points + np.float32(level))
    return tmp_path


def test_the_authors_layout(layout: Path, tiny: TrainingSettings) -> None:
    clouds = load_author_clouds(layout, 0.05)
    moves = [float(np.abs(cloud.points - cloud.clean.points).max().round(4)) for cloud in clouds]
    assert moves == [0.0, 0.0, 0.005, 0.01]  # cube_2 and cube: the clean clouds are training clouds too
    for cloud in clouds:
        assert cloud.radius == pytest.approx(0.05 * np.linalg.norm(np.ptp(cloud.clean.points, axis=0)))
        assert not cloud.later
    assert len(Pools(tiny.data, clouds=layout)(0)) == len(clouds)
    batch = cut_batch(clouds, tiny.data, 0)
    assert set(batch.radii) <= {cloud.radius for cloud in clouds}
    assert {cloud.radius for cloud in load_author_clouds(layout, 0.0)} == {0.0}


@pytest.mark.parametrize("name", ["cube", "cube_normal", "cube_0.01"])
def test_values_that_are_not_finite_are_refused(name: str, layout: Path) -> None:
    values = np.load(layout / f"{name}.npy")
    values[7] = np.nan
    np.save(layout / f"{name}.npy", values)
    with pytest.raises(ValueError, match=rf"{name}\.npy.*finite"):
        load_author_clouds(layout, 0.05)


def test_a_noisy_cloud_of_another_shape_is_refused(layout: Path) -> None:
    np.save(layout / "cube_0.01.npy", np.zeros((200, 4)))
    with pytest.raises(ValueError, match=r"cube_0\.01\.npy \(200, 4\)"):
        load_author_clouds(layout, 0.05)


def test_a_folder_that_is_not_the_authors_layout(layout: Path) -> None:
    with pytest.raises(FileNotFoundError, match="_normal"):
        load_author_clouds(layout / "missing", 0.05)
    np.save(layout / "cube_normal.npy", np.zeros((7, 3)))
    with pytest.raises(ValueError, match="cube_normal"):
        load_author_clouds(layout, 0.05)
    (layout / "cube_normal.npy").write_bytes(b"garbage")
    with pytest.raises(ValueError, match=r"pickle|magic|format"):
        load_author_clouds(layout, 0.05)
    (layout / "cube.npy").unlink()
    with pytest.raises(FileNotFoundError, match="cube"):
        load_author_clouds(layout, 0.05)


def test_validation_clouds_are_the_same_for_every_run(tiny: TrainingSettings) -> None:
    other = dataclasses.replace(tiny.data, seed=9, clean_share=1.0, noise_high=0.1, most_points=5_000, plain_share=0.0)
    first, second = (validation_cloud(3, data) for data in (tiny.data, other))
    np.testing.assert_array_equal(first.points, second.points)
    assert (first.points != validation_cloud(4, other).points).any()
