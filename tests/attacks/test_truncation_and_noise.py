"""Whatever is cut off or changed in a file: it is read, or it is refused with an error of ours."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointfilter import PointCloud, ReadLimits
from pointfilter.errors import InputError, LimitExceededError, ParameterError, UnsupportedFormatError
from tests.ply_files import ORDERS, Column, Table, write_ply

ENCODINGS = ["ascii", *ORDERS]


def scan(encoding: str, lists: bool = False) -> bytes:
    layout = [Column("x", "float"), Column("y", "double"), Column("z", "float"), Column("red", "uchar")]
    layout += [Column("views", "short", "uchar")] if lists else []
    rows = [[0.5 * k, 10.0 + k, -1.25, 7 * k, *([[1] * (k % 3)] if lists else [])] for k in range(5)]
    faces = Table("face", [Column("vertex_indices", "int", "uchar"), Column("flag", "uchar")], [[[0, 1, 2], 17]] * 3)
    remarks = {3: [b"comment between \xe9"]}
    return write_ply(encoding, [Table("vertex", layout, rows), faces], remarks=remarks).data


SAMPLES = {f"{encoding}{', lists' * lists}": scan(encoding, lists) for encoding in ENCODINGS for lists in (False, True)}


@pytest.mark.parametrize("name", SAMPLES)
def test_a_file_cut_off_anywhere_is_refused(name: str, tmp_path: Path) -> None:
    whole = SAMPLES[name]
    path = tmp_path / "cut.ply"
    # What is left of the last number of a text may still be a number.
    last = len(whole) - (len(b"7\n") if name.startswith("ascii") else 0)
    for stop in range(last):
        path.write_bytes(whole[:stop])
        with pytest.raises(InputError):
            PointCloud.read(path)
    path.write_bytes(whole)
    assert len(PointCloud.read(path)) == 5


def read_and_write(data: bytes, folder: Path) -> None:
    """Through every door there is; errors of ours are fine, any other one is not."""
    path, target = folder / "in.ply", folder / "out.ply"
    path.write_bytes(data)
    try:
        cloud = PointCloud.read(path)
    except InputError as error:
        refusal = str(error)
    else:
        refusal = ""
    assert refusal.isascii()
    assert refusal == "" or refusal.isprintable()
    if refusal:
        return
    with np.errstate(all="ignore"):
        moved = cloud.with_xyz(cloud.xyz + 0.5)
    for encoding in ("same", *ENCODINGS):
        try:
            moved.write(target, encoding, comment="ours")
        except (InputError, ParameterError):
            if encoding == "same":
                raise
        else:
            assert len(PointCloud.read(target)) == len(cloud)
            target.unlink()
        assert sorted(entry.name for entry in folder.iterdir()) == ["in.ply"]


@settings(max_examples=150)
@given(
    name=st.sampled_from(sorted(SAMPLES)),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4),
)
def test_changed_bytes(name: str, changes: list[tuple[float, int]], tmp_path_factory: pytest.TempPathFactory) -> None:
    data = bytearray(SAMPLES[name])
    for place, value in changes:
        data[int(place * len(data))] = value
    read_and_write(bytes(data), tmp_path_factory.mktemp("changed"))


LINES = [
    "comment",
    "obj_info x",
    "element vertex 2",
    "element face 1",
    "element e 3",
    "element e 0",
    "property float x",
    "property double y",
    "property float32 z",
    "property uchar red",
    "property list uchar int vertex_indices",
    "property list int double q",
    "property list char float z",
    "format ascii 1.0",
    "",
    "property short s",
]


@settings(max_examples=150)
@given(
    encoding=st.sampled_from(ENCODINGS),
    lines=st.lists(st.sampled_from(LINES), max_size=8),
    body=st.one_of(
        st.binary(max_size=80),
        st.lists(st.sampled_from(["0", "1", "2", "-3", "1.5", "300", "nan", "x", "\n", "\n"]), max_size=40).map(
            lambda words: " ".join(words).encode()
        ),
    ),
)
def test_headers_of_all_sorts(
    encoding: str, lines: list[str], body: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    vertex = ["element vertex 2", "property float x", "property float y", "property float z"]
    data = "\n".join(["ply", f"format {encoding} 1.0", *vertex, *lines, "end_header", ""]).encode() + body
    read_and_write(data, tmp_path_factory.mktemp("header"))


@pytest.mark.parametrize(
    "row",
    [
        "1 2 3 300 0",
        "1 2 3 -1 0",
        "1 2 3 1.5 0",
        "1 2 3 x 0",
        "1 2 3 1e999 0",
        "1 2 3 0 2 300 1",
        "1 2 3 0 1 -1",
        "1 2 3 0 1 nan",
        "1 2 3 nan 0",
        "1 2 3 99999999999999999999999 0",
    ],
)
@pytest.mark.parametrize("encoding", sorted(ORDERS))
def test_text_that_its_type_cannot_hold_is_no_traceback_when_converted(row: str, encoding: str, tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty list uchar uchar views\nend_header\n"
    )
    read_and_write(f"{header}{row}\n".encode(), tmp_path)


# --- limits ---


def test_the_limit_of_points_names_value_limit_and_knob(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(SAMPLES["binary_little_endian"])
    assert len(PointCloud.read(path, ReadLimits(max_points=5))) == 5
    with pytest.raises(LimitExceededError, match=r"5 points.*limit of 4.*raise POINTFILTER_POINTS") as caught:
        PointCloud.read(path, ReadLimits(max_points=4, max_points_knob="POINTFILTER_POINTS"))
    assert (caught.value.limit, caught.value.actual) == (4, 5)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_limit_of_the_header_is_exact(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    data = SAMPLES[encoding]
    path.write_bytes(data)
    size = data.index(b"end_header") + len(b"end_header\n")
    assert len(PointCloud.read(path, ReadLimits(max_header_bytes=size))) == 5
    with pytest.raises(LimitExceededError, match=f"{size - 1} bytes") as caught:
        PointCloud.read(path, ReadLimits(max_header_bytes=size - 1))
    assert caught.value.limit == size - 1


@pytest.mark.parametrize("lie", [100, 10**9, 2**31 - 1])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_count_beyond_the_file_is_noticed_before_any_row_is_read(encoding: str, lie: int, tmp_path: Path) -> None:
    path = tmp_path / "lie.ply"
    path.write_bytes(SAMPLES[encoding].replace(b"element vertex 5", f"element vertex {lie}".encode()))
    with pytest.raises(InputError):
        PointCloud.read(path)


@pytest.mark.parametrize("order", sorted(ORDERS))
def test_a_list_that_reaches_over_the_end_by_one_byte(order: str, tmp_path: Path) -> None:
    path = tmp_path / "list.ply"
    start = (
        f"ply\nformat {order} 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    body = struct.pack(ORDERS[order] + "3fB3i", 1, 2, 3, 3, 0, 0, 0)
    path.write_bytes(start + body)
    assert len(PointCloud.read(path)) == 1
    path.write_bytes(start + body[:-1])
    with pytest.raises(InputError, match="3 items"):
        PointCloud.read(path)


# --- what is no file ---


def test_directories_and_missing_files_are_the_system_s_errors(tmp_path: Path) -> None:
    folder = tmp_path / "folder.ply"
    folder.mkdir()
    with pytest.raises(IsADirectoryError):
        PointCloud.read(folder)
    with pytest.raises(FileNotFoundError):
        PointCloud.read(tmp_path / "missing.ply")


@pytest.mark.parametrize("name", ["scan.las", "scan", "scan.ply.gz", ".ply"])
def test_suffixes_that_we_do_not_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(SAMPLES["ascii"])
    with pytest.raises(UnsupportedFormatError, match=r"known: \.ply"):
        PointCloud.read(path)
