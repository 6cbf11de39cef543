from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pointfilter import PointCloud
from pointfilter.errors import ParameterError, UnsupportedFormatError
from tests.ply_files import ORDERS, Column, Table, ply_bytes, write_ply

ENCODINGS = ["ascii", *ORDERS]


def test_coordinates_are_read_only_and_have_a_shape() -> None:
    cloud = PointCloud(np.zeros((4, 3)))
    assert len(cloud) == 4
    with pytest.raises(ValueError, match="read-only"):
        cloud.xyz[0, 0] = 1
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        PointCloud(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"\(4, 3\)"):
        cloud.with_xyz(np.zeros((5, 3)))


def test_the_caller_s_array_stays_the_caller_s() -> None:
    mine = np.zeros((4, 3))
    cloud = PointCloud(mine)
    mine[0, 0] = 1
    assert mine.flags.writeable
    assert not cloud.xyz.flags.writeable
    assert PointCloud(mine.astype(np.float32)).xyz.dtype == np.float64


def test_finite_rows() -> None:
    cloud = PointCloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]))
    assert cloud.finite.tolist() == [True, False, False, False]


@pytest.mark.parametrize("encoding", ["same", *ENCODINGS])
def test_a_cloud_of_arrays_can_be_written(encoding: str, tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(size=(20, 3)) + np.array([5e5, 5e6, 0])
    path = tmp_path / "new.ply"
    PointCloud(xyz).write(path, encoding, comment="made in a test")
    again = PointCloud.read(path)
    np.testing.assert_array_equal(again.xyz, xyz)
    assert again.source is not None
    assert again.source.summary["encoding"] == ("binary_little_endian" if encoding == "same" else encoding)
    assert again.source.summary["comments"] == ["made in a test"]


@pytest.mark.parametrize("before", ENCODINGS)
@pytest.mark.parametrize("after", ENCODINGS)
@pytest.mark.parametrize("lists", [False, True], ids=["numbers", "numbers and lists"])
def test_every_value_survives_a_change_of_encoding(lists: bool, before: str, after: str, tmp_path: Path) -> None:
    layout = [
        Column("x", "double"),
        Column("red", "uchar"),
        Column("y", "float"),
        Column("z", "double"),
        Column("w", "short"),
    ]
    rows: list[list[object]] = [[0.1 + k, k, 0.25 * k, 1e-7 * k, -k] for k in range(9)]
    if lists:
        layout.insert(2, Column("views", "short", "uchar"))
        rows = [[*row[:2], [-k] * (k % 3), *row[2:]] for k, row in enumerate(rows)]
    faces = [[[0, 1, 2]], [[3, 4, 5, 6]]]
    tables = [Table("vertex", layout, rows), Table("face", [Column("vertex_indices", "int", "uchar")], faces)]
    source, target, back = tmp_path / "in.ply", tmp_path / "out.ply", tmp_path / "back.ply"
    source.write_bytes(write_ply(before, tables, remarks={0: [b"comment kept", b"obj_info kept too"]}).data)
    PointCloud.read(source).write(target, after)
    PointCloud.read(target).write(back, before)
    cloud, converted = PointCloud.read(source), PointCloud.read(target)
    np.testing.assert_array_equal(converted.xyz, cloud.xyz)
    assert converted.source is not None
    assert cloud.source is not None
    assert converted.source.summary == {**cloud.source.summary, "encoding": after}
    expected = write_ply(after, tables).data
    if after != "ascii":
        body = expected.index(b"end_header\n")
        assert target.read_bytes().endswith(expected[body:])
    if before != "ascii":
        assert back.read_bytes().endswith(source.read_bytes()[source.read_bytes().index(b"end_header\n") :])


@pytest.mark.parametrize("encoding", ["pcd", "", "binary"])
def test_an_unknown_encoding(encoding: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="binary_little_endian"):
        PointCloud(np.zeros((4, 3))).write(tmp_path / "a.ply", encoding)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("comment", ["two\nlines", "caf\u00e9", "bell\a"])
def test_a_comment_must_not_break_the_header(comment: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="comment"):
        PointCloud(np.zeros((4, 3))).write(tmp_path / "a.ply", comment=comment)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_behind_when_writing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(before := ply_bytes("ascii", [(1.0, 2.0, 3.0)]))
    cloud = PointCloud.read(path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        cloud.write(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scan.ply"]
    assert path.read_bytes() == before


def test_a_file_may_be_overwritten_with_its_own_result(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(ply_bytes("binary_little_endian", [(float(k), 0.0, 0.0) for k in range(5000)]))
    cloud = PointCloud.read(path)
    cloud.with_xyz(cloud.xyz + 1).write(path)
    np.testing.assert_array_equal(PointCloud.read(path).xyz, cloud.xyz + 1)


def test_the_result_is_an_ordinary_file(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        PointCloud(np.zeros((4, 3))).write(tmp_path / "a.ply")
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
    assert (tmp_path / "a.ply").stat().st_mode & 0o777 == 0o640


def test_a_format_that_we_do_not_write(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedFormatError, match="xyz"):
        PointCloud(np.zeros((4, 3))).write(tmp_path / "a.xyz")


def test_suffixes_in_capitals_are_suffixes(tmp_path: Path) -> None:
    path = tmp_path / "SCAN.PLY"
    PointCloud(np.zeros((4, 3))).write(path)
    assert len(PointCloud.read(path)) == 4
