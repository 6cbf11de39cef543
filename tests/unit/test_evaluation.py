from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pointfilter import PointCloud
from pointfilter.errors import InputError, MalformedFileError
from pointfilter.evaluation import PLANE_NEIGHBOURS, evaluate, point_to_planes, read_mesh
from tests.ply_files import ORDERS, Column, Table, ply_bytes, write_ply

SQUARE = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)]


@pytest.fixture
def square(tmp_path: Path) -> Path:
    path = tmp_path / "square.ply"
    path.write_bytes(ply_bytes("ascii", SQUARE, faces=[(0, 1, 2, 3)]))
    return path


@pytest.fixture
def clean() -> PointCloud:
    points = np.random.default_rng(0).uniform(size=(800, 2))
    return PointCloud(np.column_stack([np.vstack([points, [[0, 0], [1, 1]]]), np.zeros(802)]))


def lifted(cloud: PointCloud, height: float) -> PointCloud:
    return cloud.with_xyz(cloud.xyz + np.array([0, 0, height]))


def test_against_a_mesh_and_against_planes(clean: PointCloud, square: Path) -> None:
    """A sheet 0.01 above the surface, on a square whose diagonal is the root of 2."""
    against_mesh = evaluate(lifted(clean, 0.01), clean, square)
    against_planes = evaluate(lifted(clean, 0.01), clean)
    assert list(against_mesh) == ["CD x1e5", "MSE x1e5", "paper's MSE x1e3", "P2F x1e3"]
    assert list(against_planes) == ["CD x1e5", "MSE x1e5", "paper's MSE x1e3", "P2F* x1e3"]
    assert against_mesh["P2F x1e3"] == pytest.approx(1e3 * 0.01 / 2**0.5)
    assert against_planes["P2F* x1e3"] == pytest.approx(1e3 * 0.01 / 2**0.5)
    assert against_mesh["CD x1e5"] <= 1e5 * 2 * 0.01**2 / 2 + 1e-9


def test_the_unit_of_the_files_does_not_matter(clean: PointCloud) -> None:
    in_millimetres = clean.with_xyz(1000 * clean.xyz + 5e6)
    one = evaluate(lifted(clean, 0.01), clean)
    other = evaluate(lifted(in_millimetres, 10.0), in_millimetres)
    assert other == pytest.approx(one, rel=1e-5)


def test_a_clean_cloud_has_no_error(clean: PointCloud) -> None:
    row = evaluate(clean, clean)
    assert row["CD x1e5"] == 0
    assert row["P2F* x1e3"] == pytest.approx(0, abs=1e-9)


def test_rows_without_a_place_do_not_count(clean: PointCloud) -> None:
    holes = PointCloud(np.vstack([clean.xyz, np.full((9, 3), np.nan)]))
    assert evaluate(holes, clean) == evaluate(clean, clean)


def test_planes_follow_the_slope() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(size=(500, 2))
    clean = np.column_stack([xy, xy @ [0.5, -0.25]])
    normal = np.array([-0.5, 0.25, 1]) / np.linalg.norm([-0.5, 0.25, 1])
    np.testing.assert_allclose(point_to_planes(clean + 0.02 * normal, clean), 0.02, atol=1e-9)


def test_too_few_points_to_compare(clean: PointCloud) -> None:
    few = PointCloud(np.random.default_rng(0).normal(size=(PLANE_NEIGHBOURS - 1, 3)))
    with pytest.raises(InputError, match=f"filtered.*{PLANE_NEIGHBOURS}"):
        evaluate(few, clean)
    with pytest.raises(InputError, match="clean"):
        evaluate(clean, few)


@pytest.mark.parametrize("scale", [0.0, 1.7e308])
def test_a_clean_cloud_without_an_extent_to_scale_by(scale: float, clean: PointCloud) -> None:
    signs = np.where(np.arange(60).reshape(20, 3) % 2, 1.0, -1.0)
    with pytest.raises(InputError, match="clean"):
        evaluate(clean, PointCloud(scale * signs))


@pytest.mark.parametrize("encoding", ["ascii", *ORDERS])
@pytest.mark.parametrize("name", ["vertex_indices", "vertex_index"])
def test_polygons_are_cut_into_fans(encoding: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    tables = [
        Table("vertex", [Column(axis, "float") for axis in "xyz"], SQUARE),
        Table("face", [Column(name, "int", "uchar")], [[[0, 1, 2, 3]], [[2, 1, 0]]]),
    ]
    path.write_bytes(write_ply(encoding, tables).data)
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, SQUARE)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 1, 0]]


@pytest.mark.parametrize(
    ("lines", "rows"),
    [
        ([], ""),
        (["element face 0", "property list uchar int vertex_indices"], ""),
        (["element face 1", "property list uchar int corners"], "3 0 1 2"),
        (["element face 1", "property list uchar int vertex_indices"], "2 0 1"),
        (["element face 1", "property list uchar int vertex_indices"], "3 0 1 4"),
        (["element face 1", "property list uchar int vertex_indices"], "3 0 1 -1"),
        (["element face 1", "property list uchar int vertex_indices"], "3 0 1 x"),
        (["element face 1", "property list uchar uchar vertex_indices"], "3 0 1 300"),
        (["element face 1", "property int vertex_indices"], "3"),
    ],
)
def test_a_mesh_that_is_none(lines: list[str], rows: str, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    vertices = "\n".join("{} {} {}".format(*row) for row in SQUARE)
    names = ["element vertex 4", "property float x", "property float y", "property float z", *lines]
    path.write_text("\n".join(["ply", "format ascii 1.0", *names, "end_header", vertices, rows, ""]))
    with pytest.raises(MalformedFileError, match=r"mesh\.ply"):
        read_mesh(path)


def test_a_mesh_with_a_corner_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply_bytes("ascii", [(float("nan"), 0.0, 0.0), *SQUARE[1:]], faces=[(0, 1, 2)]))
    with pytest.raises(MalformedFileError, match="finite"):
        read_mesh(path)


def test_a_missing_mesh_is_the_system_s_error(clean: PointCloud, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        evaluate(clean, clean, tmp_path / "missing.ply")
