"""Everything in a PLY file but x, y and z comes out byte for byte."""

from __future__ import annotations

import math
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointfilter import Engine, PointCloud, Radius, filter_cloud
from tests.ply_files import AXES, CODES, ORDERS, Column, Table, Written, ply_bytes, write_ply

ENCODINGS = ["ascii", *ORDERS]
OURS = "filtered by pointfilter"

INTEGERS = [name for name, code in CODES.items() if code in "bBhHiI"]
RANGES = {"b": (-128, 127), "B": (0, 255), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1), "i": (-(2**31), 2**31 - 1),
          "I": (0, 2**32 - 1)}  # fmt: skip


def number(type_: str) -> st.SearchStrategy[object]:
    code = CODES[type_]
    if code in RANGES:
        return st.integers(*RANGES[code])
    return st.floats(width=32 if code == "f" else 64)


coordinate_text = st.sampled_from(
    ["0", "-0.0", "1.50", "+2", "1e-3", "00012.5000", "3.", ".25", "7E2", "nan", "-inf", "1e-400"]
)
names = st.text(
    st.characters(codec="ascii", categories=["Ll", "Lu", "Nd"], include_characters="_"), min_size=1, max_size=12
)
remark = st.builds(
    lambda word, text: word + b" " + text,
    st.sampled_from([b"comment", b"obj_info"]),
    st.one_of(
        st.text(st.characters(exclude_characters="\r\n", codec="utf-8"), max_size=20).map(str.encode),
        st.text(st.characters(exclude_characters="\r\n", codec="latin-1"), max_size=20).map(
            lambda t: t.encode("latin-1")
        ),
    ),
)


@st.composite
def columns(draw: st.DrawFn, least: int, taken: tuple[str, ...] = ()) -> list[Column]:
    found = draw(st.lists(names, min_size=least, max_size=4, unique=True))
    return [
        Column(
            name,
            draw(st.sampled_from(sorted(CODES))),
            draw(st.sampled_from([None, None, None, *INTEGERS])),
        )
        for name in found
        if name not in taken
    ]


@st.composite
def entries(draw: st.DrawFn, column: Column, ascii_: bool) -> object:
    if column.length_type:
        return draw(st.lists(number(column.type), max_size=4))
    if ascii_ and column.name in AXES and draw(st.booleans()):
        return draw(coordinate_text)
    return draw(number(column.type))


@st.composite
def tables(draw: st.DrawFn, name: str, layout: list[Column], ascii_: bool) -> Table:
    count = draw(st.integers(0, 6))
    return Table(name, layout, [[draw(entries(column, ascii_)) for column in layout] for _ in range(count)])


@dataclass
class Sample:
    encoding: str
    newline: bytes
    types: dict[str, str]
    written: Written


@st.composite
def ply_files(draw: st.DrawFn) -> Sample:
    encoding = draw(st.sampled_from(ENCODINGS))
    ascii_ = encoding == "ascii"
    axes = [Column(name, draw(st.sampled_from(["float", "float32", "double", "float64"]))) for name in AXES]
    layout = draw(st.permutations([*axes, *draw(columns(0, AXES))]))
    vertex = draw(tables("vertex", layout, ascii_))
    others = draw(st.lists(names.filter(lambda name: name != "vertex"), max_size=3, unique=True))
    elements = [draw(tables(name, draw(columns(1)), ascii_)) for name in others]
    elements.insert(draw(st.integers(0, len(elements))), vertex)
    lines = 1 + sum(1 + len(table.columns) for table in elements)
    remarks = draw(st.dictionaries(st.integers(0, lines), st.lists(remark, min_size=1, max_size=2), max_size=3))
    newline = draw(st.sampled_from([b"\n", b"\r\n"]))
    separators = (
        draw(st.lists(st.sampled_from([b" ", b"  ", b"\t", b" \t "]), min_size=1, max_size=3)) if ascii_ else [b" "]
    )
    final = draw(st.booleans())
    trailing = draw(st.sampled_from([b"", b"\n", b"rest of\x00 the file", b"\r\n\r\n"])) if final else b""
    written = write_ply(
        encoding,
        elements,
        newline=newline,
        separators=separators,
        remarks=remarks,
        final_newline=final,
        trailing=trailing,
    )
    return Sample(encoding, newline, {column.name: column.type for column in axes}, written)


def through(data: bytes, move: np.ndarray | float = 0.0, **options: object) -> tuple[PointCloud, bytes]:
    """A file read, moved and written: the cloud that went out, and the bytes."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.ply"), Path(folder, "out.ply")
        source.write_bytes(data)
        cloud = PointCloud.read(source)
        with np.errstate(over="ignore"):
            cloud = cloud.with_xyz(cloud.xyz + move)
        cloud.write(target, **options)
        return cloud, target.read_bytes()


def stored(sample: Sample, axis: str, piece: bytes) -> float:
    """The value of one coordinate's bytes, in the precision of its type."""
    code = CODES[sample.types[axis]]
    if sample.encoding != "ascii":
        return float(struct.unpack(ORDERS[sample.encoding] + code, piece)[0])
    return in_type(float(piece), code)


def in_type(value: float, code: str) -> float:
    with np.errstate(over="ignore"):
        return float(np.float64(value).astype(code))


def same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))


@settings(max_examples=200)
@given(sample=ply_files())
def test_coordinates_are_read_as_they_stand(sample: Sample) -> None:
    cloud, _ = through(sample.written.data)
    assert len(cloud) == len(sample.written.places)
    for row, places in zip(cloud.xyz, sample.written.places, strict=True):
        for value, axis in zip(row, AXES, strict=True):
            start, stop = places[axis]
            assert same(float(value), stored(sample, axis, sample.written.data[start:stop]))


@settings(max_examples=200)
@given(sample=ply_files())
def test_a_file_that_nobody_changed_is_the_same_file(sample: Sample) -> None:
    _, data = through(sample.written.data)
    assert data == sample.written.data


@settings(max_examples=200)
@given(sample=ply_files(), seed=st.integers(0, 2**32))
def test_only_x_y_z_and_our_comment_differ(sample: Sample, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = sample.written
    move = rng.normal(size=(len(before.places), 3)) * (rng.random((len(before.places), 3)) < 0.7)
    cloud, after = through(before.data, move, comment=OURS)
    ours = b"comment " + OURS.encode() + sample.newline
    lines = before.data.splitlines(keepends=True)
    first_element = next(k for k, line in enumerate(lines) if line.split()[:1] == [b"element"])
    place = len(b"".join(lines[:first_element]))  # readers take what stands before it for comments on the whole file
    assert after[:place] == before.data[:place]
    assert after[place:].startswith(ours)
    after = after[:place] + after[place + len(ours) :]

    old = new = 0  # both files, walked from one coordinate to the next
    for row, places in zip(cloud.xyz, before.places, strict=True):
        for axis, (start, stop) in sorted(places.items(), key=lambda item: item[1]):
            assert after[new : new + start - old] == before.data[old:start]
            new += start - old
            length = stop - start if sample.encoding != "ascii" else len(after[new:].split(None, 1)[0])
            piece = after[new : new + length]
            was, now = (
                stored(sample, axis, before.data[start:stop]),
                in_type(row[AXES.index(axis)], CODES[sample.types[axis]]),
            )
            if same(was, now) or not math.isfinite(now):
                assert piece == before.data[start:stop]
            else:
                assert stored(sample, axis, piece) == now
            old, new = stop, new + length
    assert after[new:] == before.data[old:]


@settings(max_examples=200)
@given(sample=ply_files())
def test_a_column_that_is_added_and_dropped_leaves_the_same_file(sample: Sample) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source, more, back, less = (Path(folder, f"{name}.ply") for name in ("in", "more", "back", "less"))
        source.write_bytes(sample.written.data)
        cloud = PointCloud.read(source)
        values = np.arange(len(cloud)) / 8
        cloud.with_columns({"scalar_of_ours": values}).write(more)
        added = PointCloud.read(more)
        np.testing.assert_array_equal(added.xyz, cloud.xyz)
        np.testing.assert_array_equal(added.column_values(["scalar_of_ours"])[:, 0], values)
        added.without_columns(["scalar_of_ours"]).write(back)
        assert back.read_bytes() == sample.written.data
        others = [name for name in cloud.column_types if name not in AXES]
        cloud.without_columns(others[:2]).write(less)
        left = PointCloud.read(less)
        np.testing.assert_array_equal(left.xyz, cloud.xyz)
        assert list(left.column_types) == [name for name in cloud.column_types if name not in others[:2]]


@settings(max_examples=100)
@given(sample=ply_files())
def test_the_summary_says_what_is_in_the_file(sample: Sample) -> None:
    cloud, _ = through(sample.written.data)
    assert cloud.source is not None
    summary = cloud.source.summary
    assert summary["format"] == "ply"
    assert summary["encoding"] == sample.encoding
    assert summary["elements"]["vertex"]["count"] == len(sample.written.places)
    spelled = summary["elements"]["vertex"]["properties"]
    assert {f"{type_} {name}" for name, type_ in sample.types.items()} <= set(spelled)
    body = sample.written.data[: sample.written.end_header]
    lines = body.split(b"\n")
    assert len(summary["comments"]) == sum(line.startswith(b"comment") for line in lines)
    assert len(summary["obj_info"]) == sum(line.startswith(b"obj_info") for line in lines)


# --- after the filter ---


def scan(encoding: str, rng: np.random.Generator) -> Written:
    """A scan with all that scans have: colours, normals, scalars, a list, faces, another element in front."""
    layout = [
        Column("x", "double"), Column("red", "uchar"), Column("y", "float"), Column("nx", "float"),
        Column("z", "double"), Column("views", "int", "uchar"), Column("scalar_gps_time", "double"),
    ]  # fmt: skip
    rows = [
        [
            498_765.0 + x,
            int(rng.integers(256)),
            float(np.float32(y)),
            float(np.float32(nx)),
            z,
            [1, 2, 3][: k % 4],
            1e9 * t,
        ]
        for k, (x, y, z, nx, t) in enumerate(rng.uniform(size=(200, 5)))
    ]
    for row in rows[::10]:
        row[4] = float("nan")
    rows[5][0], rows[6][2] = float("inf"), float("-inf")
    faces = [[[int(corner) for corner in rng.integers(200, size=3)]] for _ in range(20)]
    return write_ply(
        encoding,
        [
            Table("camera", [Column("view", "float")], [[0.5]]),
            Table("vertex", layout, rows),
            Table("face", [Column("vertex_indices", "int", "uchar")], faces),
        ],
        remarks={0: [b"comment Aufma\xdf", "comment château".encode()], 4: [b"obj_info num_cols 20"]},
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_filtered_scan_differs_in_coordinates_only(encoding: str, engine: Engine, tmp_path: Path) -> None:
    before = scan(encoding, np.random.default_rng(0))
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    source.write_bytes(before.data)
    cloud = PointCloud.read(source)
    filtered, report = filter_cloud(cloud, engine, radius=Radius(0.1, relative=True))
    filtered.write(target, comment=report.comment)
    assert source.read_bytes() == before.data

    again = PointCloud.read(target)
    assert report.skipped == (~cloud.finite).sum() > 20
    np.testing.assert_array_equal(again.finite, cloud.finite)
    moved = (filtered.xyz != cloud.xyz) & cloud.finite[:, None]
    assert moved.any(axis=1).sum() > 100
    ours = b"comment " + report.comment.encode() + b"\n"
    after = target.read_bytes().replace(ours, b"", 1)
    if encoding == "ascii":
        old, new = before.data.split(b"\n"), after.split(b"\n")
        assert len(old) == len(new)
        changed = [k for k in range(len(old)) if old[k] != new[k]]
        for k in changed:
            a, b = old[k].split(), new[k].split()
            assert [a[1], a[3], *a[5:]] == [b[1], b[3], *b[5:]]
        assert len(changed) == moved.any(axis=1).sum()
    else:
        allowed = np.zeros(len(before.data), bool)
        for row, places in enumerate(before.places):
            for start, stop in places.values():
                allowed[start:stop] = cloud.finite[row]
        differs = np.frombuffer(after, np.uint8) != np.frombuffer(before.data, np.uint8)
        assert differs.any()
        assert not (differs & ~allowed).any()


NANS = [b"\x01\x00\xa0\x7f", b"\xff\xff\xff\xff", b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\x00\x00\x80\xff"]


@pytest.mark.parametrize("payload", NANS, ids=["signalling", "negative", "quiet", "inf", "-inf"])
@pytest.mark.parametrize("encoding", sorted(ORDERS))
@pytest.mark.parametrize("lists", [False, True])
def test_rows_without_a_place_keep_every_bit(encoding: str, payload: bytes, lists: bool) -> None:
    layout = [Column("x", "float"), Column("y", "float"), Column("z", "float")]
    layout += [Column("views", "uchar", "uchar")] if lists else []
    rows = [[float(k), 0.0, 1.0, *([[k]] if lists else [])] for k in range(6)]
    written = write_ply(encoding, [Table("vertex", layout, rows)])
    data = bytearray(written.data)
    start, stop = written.places[2]["x"]
    data[start:stop] = payload if encoding == "binary_little_endian" else payload[::-1]
    _, after = through(bytes(data), np.where(np.arange(6)[:, None] == 2, 0.0, 1.0))
    first, last = min(written.places[2].values())[0], max(written.places[2].values())[1]
    assert after[first:last] == bytes(data[first:last])
    assert after != bytes(data)


def test_a_coordinate_that_does_not_fit_its_type_stays() -> None:
    data = ply_bytes("binary_little_endian", [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    _, after = through(data, np.array([[1e300, 0, 0], [0, 1.0, 0]]))
    assert np.frombuffer(after[-24:], "<f4").tolist() == [0, 0, 0, 1, 2, 1]


@pytest.mark.parametrize("text", ["1e39", "1e400", "-1e39"])
def test_text_beyond_its_type_is_infinite_and_stays(text: str) -> None:
    data = write_ply(
        "ascii", [Table("vertex", [Column(axis, "float") for axis in AXES], [[text, "0", "0"], ["1", "2", "3"]])]
    ).data
    cloud, after = through(data, np.array([[0, 0, 0], [1.0, 0, 0]]))
    assert cloud.finite.tolist() == [False, True]
    assert after == data.replace(b"\n1 2 3", b"\n2.0 2 3")


@pytest.mark.parametrize("type_", ["float", "double"])
def test_new_text_is_the_shortest_that_reads_back(type_: str) -> None:
    rows = [["0", "0", "0"]] * 3
    data = write_ply("ascii", [Table("vertex", [Column(axis, type_) for axis in AXES], rows)]).data
    _, after = through(data, np.array([[0.1, 1 / 3, 1e-12], [498765.123456789, -2.5, 0], [1e20, 0, 0]]))
    lines = after.split(b"end_header\n")[1].decode().splitlines()
    found = [token for line in lines for token in line.split()]
    kind = np.float32 if type_ == "float" else np.float64
    expected = [0.1, 1 / 3, 1e-12, 498765.123456789, -2.5, 0, 1e20, 0, 0]
    for text, value in zip(found, expected, strict=True):
        assert kind(text) == kind(value)
        assert text == "0" or len(text) <= len(str(kind(value)))


def test_a_line_ending_of_end_header_s_own_is_kept() -> None:
    data = ply_bytes("binary_little_endian", [[1.0, 2.0, 3.0]]).replace(b"end_header\n", b"end_header \r\n")
    assert through(data)[1] == data


def test_tabs_in_the_header_separate_words() -> None:
    data = ply_bytes("ascii", [[1.0, 2.0, 3.0]])
    for line in (b"property float y", b"element vertex 1", b"format ascii 1.0"):
        data = data.replace(line, line.replace(b" ", b" \t"))
    data = data.replace(b"end_header", b"comment\twith a tab\n\tcomment indented\nend_header")
    cloud, after = through(data)
    assert after == data
    assert cloud.source is not None
    assert cloud.source.summary["comments"] == ["with a tab", "indented"]


def test_comments_are_shown_in_the_encoding_they_are_in() -> None:
    data = ply_bytes("ascii", [[1.0, 2.0, 3.0]]).replace(
        b"end_header", "comment château".encode() + b"\ncomment Aufma\xdf\nend_header"
    )
    cloud, _ = through(data)
    assert cloud.source is not None
    assert cloud.source.summary["comments"] == ["château", "Aufmaß"]
