from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pointfilter.noise import NOISE_KINDS
from training.dataset import (
    Batch,
    TrainingCloud,
    batches_ahead,
    cloud_from_mesh,
    cut_batch,
    load_author_clouds,
    training_clouds,
    validation_cloud,
)
from training.shapes import Mesh, load_meshes, random_shape
from training.train import TrainingSettings


def same(a: Batch, b: Batch) -> bool:
    return all(torch.equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


def test_a_batch_is_a_function_of_settings_and_step(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    first = cut_batch(clouds, tiny.data, 5)
    assert same(first, cut_batch(clouds, tiny.data, 5))
    assert not same(first, cut_batch(clouds, tiny.data, 6))
    assert not same(first, cut_batch(clouds, dataclasses.replace(tiny.data, seed=1), 5))
    assert same(first, cut_batch(list(training_clouds(tiny.data)), tiny.data, 5))


def test_batches_come_in_order_wherever_one_begins(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    expected = [cut_batch(clouds, tiny.data, step) for step in range(3, 9)]
    found = list(batches_ahead(clouds, tiny.data, 3, 9, ahead=2))
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))
    early = list(itertools.islice(batches_ahead(clouds, tiny.data, 3, 10**9), 2))
    assert all(same(a, b) for a, b in zip(early, expected, strict=False))


def test_an_error_in_the_second_thread_reaches_the_first(tiny: TrainingSettings) -> None:
    with pytest.raises((ValueError, IndexError)):
        next(batches_ahead([], tiny.data, 0, 3))


def test_a_share_of_the_clouds_is_filtered_before(
    clouds: list[TrainingCloud], tiny: TrainingSettings, bundle_folder: Path
) -> None:
    settings = dataclasses.replace(
        tiny.data, filtered_share=1.0, filtered_by=str(bundle_folder), filtered_points=500, noise_low=0.02
    )
    noisy = list(training_clouds(dataclasses.replace(settings, filtered_share=0.0)))
    for cloud, before, again in zip(training_clouds(settings), noisy, training_clouds(settings), strict=True):
        assert len(cloud.points) == min(500, len(before.points))
        stayed = np.isin(cloud.points, before.points).all(axis=1)
        assert stayed.mean() < 0.1  # those with too few neighbours
        np.testing.assert_array_equal(cloud.points, again.points)
        np.testing.assert_array_equal(cloud.clean, before.clean)
        reach = cKDTree(before.points).query(cloud.points)[0]
        assert reach.max() < 3 * cloud.index.radius
    assert len(noisy) == len(clouds)


def test_the_ball_of_a_sparse_noisy_cloud_is_the_filter_s(tiny: TrainingSettings) -> None:
    for noise, grows in ((0.02, True), (0.0, False)):
        fixed = dataclasses.replace(
            tiny.data, clouds=2, fewest_points=1000, most_points=1000, noise_low=noise, noise_high=noise
        )
        growing = training_clouds(dataclasses.replace(fixed, radius_grows=True))
        for before, cloud in zip(training_clouds(fixed), growing, strict=True):
            np.testing.assert_array_equal(cloud.points, before.points)
            assert (cloud.index.radius > before.index.radius) == grows
            assert cloud.clean_index.radius == cloud.index.radius


def test_shapes_of_a_batch(clouds: list[TrainingCloud], tiny: TrainingSettings) -> None:
    batch = cut_batch(clouds, tiny.data, 0)
    assert batch.patches.shape == (16, 32, 3)
    assert batch.clean.shape == batch.normals.shape == (16, 48, 3)
    assert batch.present.shape == (16, 48)
    assert {tensor.dtype for tensor in (batch.patches, batch.clean, batch.normals)} == {torch.float32}
    assert batch.clean.norm(dim=2).max() < 1 + 1e-5
    lengths = batch.normals.norm(dim=2)
    assert torch.allclose(lengths[batch.present], torch.ones(()), atol=1e-5)
    assert not batch.clean[~batch.present].any()
    assert not batch.normals[~batch.present].any()


def test_the_clean_patch_lies_in_the_frame_of_the_noisy_one(tiny: TrainingSettings) -> None:
    """Without noise and with room for all neighbours, both patches hold the same points where the clouds do."""
    rng = np.random.default_rng(0)
    from training.dataset import make_cloud

    points = rng.normal(size=(300, 3)) * [1, 0.6, 0.2]
    normals = np.tile([[0.0, 0, 1]], (300, 1))
    cloud = make_cloud(points, points, normals, 0.5)
    data = dataclasses.replace(tiny.data, patch_points=300, clean_patch_points=300)
    batch = cut_batch([cloud], data, 0)
    for patch, clean, present in zip(batch.patches, batch.clean, batch.present, strict=True):
        count = int(present.sum())
        np.testing.assert_allclose(
            np.sort(patch[:count].numpy(), axis=0), np.sort(clean[present].numpy(), axis=0), atol=1e-5
        )


def test_noise_kinds_are_an_option(tiny: TrainingSettings) -> None:
    mesh = random_shape(0)
    data = dataclasses.replace(tiny.data, noise_low=0.01, noise_high=0.01, open_share=0.0, uneven_share=0.0)
    found = {}
    for kind in NOISE_KINDS:
        found[kind] = cloud_from_mesh(mesh, dataclasses.replace(data, noise_kinds=(kind,)), 0).points
    assert all(len(points) == len(found["gaussian"]) for points in found.values())
    pairs = itertools.combinations(found.values(), 2)
    assert all((a != b).any() for a, b in pairs)
    mixed = dataclasses.replace(data, noise_kinds=("gaussian", "impulsive"))
    still = [
        np.mean(distance_to_faces(mesh, cloud_from_mesh(mesh, mixed, seed).points[:200]) < 1e-9) for seed in range(8)
    ]
    assert {share > 0.5 for share in still} == {True, False}  # impulsive noise leaves nine points in ten on the surface


def test_clouds_may_be_open_and_uneven(tiny: TrainingSettings) -> None:
    mesh = random_shape(0)
    whole = dataclasses.replace(tiny.data, open_share=0.0, uneven_share=0.0, noise_high=0.0)
    closed = cloud_from_mesh(mesh, whole, 3)
    opened = cloud_from_mesh(mesh, dataclasses.replace(whole, open_share=1.0), 3)
    assert len(opened.points) < len(closed.points)
    assert len(opened.clean) < len(closed.clean)
    uneven = cloud_from_mesh(mesh, dataclasses.replace(whole, uneven_share=1.0), 3)
    assert (uneven.points[:50] != closed.points[:50]).any()
    assert len(closed.normals) == len(closed.clean)


# --- shapes ---


def distance_to_faces(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    from pointfilter.metrics import point_to_surface

    return point_to_surface(points, mesh.vertices, mesh.faces)


@pytest.mark.parametrize("seed", range(4))
def test_a_shape_is_decided_by_its_seed(seed: int) -> None:
    mesh, again = random_shape(seed), random_shape(seed)
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    np.testing.assert_array_equal(mesh.faces, again.faces)
    assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(1, abs=1e-6)
    points, normals = mesh.sample(300, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert distance_to_faces(mesh, points).max() < 1e-9
    other = random_shape(seed + 100)
    assert other.vertices.shape != mesh.vertices.shape or (other.vertices != mesh.vertices).any()


def test_samples_spread_evenly_over_the_area() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [8, 5, 5], [5, 8, 5]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]]), np.tile([0.0, 0, 1], (2, 3, 1)))
    points, normals = mesh.sample(20_000, np.random.default_rng(0))
    small = points[:, 2] < 1
    assert small.mean() == pytest.approx(0.1, abs=0.01)
    np.testing.assert_allclose(points[small].mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.02)
    np.testing.assert_array_equal(normals[0], [0, 0, 1])


OBJ = "v 0 0 0\nv 2 0 0\nv 0 2 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_meshes_of_one_s_own(tmp_path: Path, tiny: TrainingSettings) -> None:
    (tmp_path / "b.obj").write_text(OBJ)
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    (tmp_path / "notes.txt").write_text("no mesh")
    flat, solid = load_meshes(tmp_path)
    assert (len(flat.faces), len(solid.faces)) == (1, 4)
    for mesh in (flat, solid):
        assert np.linalg.norm(np.ptp(mesh.vertices, axis=0)) == pytest.approx(1)
        points, normals = mesh.sample(100, np.random.default_rng(0))
        assert distance_to_faces(mesh, points).max() < 1e-9
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    data = dataclasses.replace(tiny.data, clouds=3)
    assert len(list(training_clouds(data, meshes=tmp_path))) == 3


def test_folders_without_meshes(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_meshes(tmp_path / "missing")
    with pytest.raises(FileNotFoundError, match=r"\.ply"):
        load_meshes(tmp_path)


@pytest.mark.parametrize("faces", ["", "f 1 2 2\nf 3 3 3\n"], ids=["no faces", "no area"])
def test_a_mesh_without_a_surface(faces: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ.split("f ")[0] + faces)
    with pytest.raises(ValueError, match=r"a\.obj"):
        load_meshes(tmp_path)


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
    assert [float(np.abs(cloud.points - cloud.clean).max().round(4)) for cloud in clouds] == [0.0, 0.005, 0.01]
    for cloud in clouds:
        assert cloud.index.radius == pytest.approx(0.05 * np.linalg.norm(np.ptp(cloud.clean, axis=0)))
    assert len(list(training_clouds(tiny.data, clouds=layout))) == len(clouds)
    batch = cut_batch(clouds, dataclasses.replace(tiny.data, radius=0.05), 0)
    assert batch.present.any()


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
    other = dataclasses.replace(tiny.data, seed=9, noise_skew=3.0, noise_high=0.1, most_points=5_000, thin_share=1.0)
    first, second = (validation_cloud(3, data) for data in (tiny.data, other))
    np.testing.assert_array_equal(first.points, second.points)
    assert (first.points != validation_cloud(4, other).points).any()
