"""Hostile files, each with a name and with the error that it must lead to (None: it must go through)."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pointfilter import errors
from tests.ply_files import header, ply_bytes

XYZ = ("property float x", "property float y", "property float z")
GIGABYTE = 1 << 30


@dataclass(frozen=True)
class Attack:
    name: str
    write: Callable[[Path], object]
    error: type[errors.InputError] | None


ATTACKS: list[Attack] = []


def attack(name: str, content: bytes | Callable[[Path], object], error: type[errors.InputError] | None) -> None:
    write = content if callable(content) else (lambda path: path.write_bytes(content))
    ATTACKS.append(Attack(name, write, error))


def sparse(start: bytes, size: int) -> Callable[[Path], object]:
    """A file that is large but for the disk."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(start)
            file.truncate(size)

    return write


Malformed, Unsupported, Limit = errors.MalformedFileError, errors.UnsupportedFormatError, errors.LimitExceededError
Missing, TooFew, Degenerate = errors.MissingCoordinatesError, errors.TooFewPointsError, errors.DegenerateCloudError

ROWS = [(float(k), float(k * k % 7), 0.5 * k) for k in range(12)]
GOOD = ply_bytes("binary_little_endian", ROWS)
GOOD_ASCII = ply_bytes("ascii", ROWS)

# --- no PLY at all ---

attack("empty", b"", Unsupported)
attack("text", b"x y z\n1 2 3\n" * 50, Unsupported)
attack("ply without a line break", b"ply", Malformed)
attack("ply and a blank", b"ply \nformat ascii 1.0\n", Unsupported)
attack("plyx", b"plyx\n", Unsupported)
attack("zeros", bytes(5000), Unsupported)
attack("a gigabyte of zeros", sparse(b"", GIGABYTE), Unsupported)
attack("utf-16", GOOD_ASCII.decode().encode("utf-16"), Unsupported)
attack("utf-8 with a byte order mark", b"\xef\xbb\xbf" + GOOD_ASCII, Unsupported)
attack("line breaks of the old Mac", GOOD_ASCII.replace(b"\n", b"\r"), Unsupported)
attack("gzip", gzip.compress(GOOD), Unsupported)
with io.BytesIO() as _buffer:
    with zipfile.ZipFile(_buffer, "w") as _archive:
        _archive.writestr("scan.ply", GOOD)
    attack("zip", _buffer.getvalue(), Unsupported)
attack("escape sequences", b"\x1b[2J\x1b]0;owned\x07\n", Unsupported)

# --- headers ---

attack("endless line", sparse(b"ply\nformat ascii 1.0\ncomment ", GIGABYTE), Limit)
attack("endless comments", sparse(b"ply\nformat ascii 1.0\n" + b"comment hello\n" * 100_000, GIGABYTE), Limit)
attack("endless empty lines", b"ply\nformat ascii 1.0\n" + b"\n" * 2_000_000, Limit)
attack("endless properties", header("element vertex 9", *(f"property char p{k}" for k in range(200_000))), Limit)
attack(
    "tens of thousands of properties",
    header("element vertex 9", *(f"property char p{k}" for k in range(40_000))),
    Missing,
)
attack("a thousand elements", header(*(f"element e{k} 0" for k in range(1_000))), Missing)
attack("tens of thousands of elements", header(*(f"element e{k} 0" for k in range(60_000))), Limit)
attack("no end", GOOD.split(b"end_header")[0], Malformed)
attack("an end without a line break", header(*("element vertex 0", *XYZ))[:-1], Malformed)
attack("no format", b"ply\nelement vertex 1\n", Malformed)
attack("no format and no element", b"ply\nend_header\n", Malformed)
attack("two formats", GOOD.replace(b"1.0\n", b"1.0\nformat ascii 1.0\n"), Malformed)
attack("unknown encoding", GOOD.replace(b"binary_little_endian", b"binary_middle_endian"), Malformed)
attack("version 2", GOOD.replace(b"1.0", b"2.0"), Malformed)
attack("element before format", b"ply\nelement vertex 1\nformat ascii 1.0\nend_header\n", Malformed)
attack("property before element", header("property float x", "element vertex 1", *XYZ), Malformed)
attack("unknown type", GOOD.replace(b"float x", b"float128 x"), Malformed)
attack("property without a name", GOOD.replace(b"float x", b"float"), Malformed)
attack("list without types", GOOD.replace(b"float x", b"list x"), Malformed)
attack("list of float length", header("element vertex 1", *XYZ, "property list float int views"), Malformed)
attack("unknown line", GOOD.replace(b"element vertex", b"script run\nelement vertex"), Malformed)
attack("zeros in the header", GOOD.replace(b"property float y", b"property fl\0at y"), Malformed)
attack("two of a property", GOOD.replace(b"float y", b"float x"), Malformed)
attack("two of an element", header("element vertex 1", *XYZ, "element vertex 1", *XYZ), Malformed)
attack("long property name", header("element vertex 1", "property float " + "x" * 1_000_000), Missing)
attack("long type name", header("element vertex 1", f"property {'f' * 900_000} x"), Malformed)
attack("escape sequence as a type", header("element vertex 1", "property \x1b[31mred x"), Malformed)
attack("bell as an element", header("element \x07 two"), Malformed)
attack("letters of many scripts", "ply\nformat ascii 1.0\nэлемент 点\n".encode(), Malformed)
attack("words cut at a strange blank", header("element\u00a0vertex 1"), Malformed)

# --- counts ---

for _count in ("1000000000", "999999999999999999"):
    _error = Malformed if len(_count) < 11 else Limit
    for _encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        attack(f"{_count} points, {_encoding}", header(f"element vertex {_count}", *XYZ, encoding=_encoding), _error)
for _count in ("1000000000000000000", "9" * 5000, "-1", "+5", "1e3", "0x10", "1_0", "٣", "", "5 5", "2.0", "NaN"):
    attack(f"count {_count[:20]!a}", header(f"element vertex {_count}", *XYZ).replace(b"?", b""), Malformed) if (
        _count.isascii()
    ) else attack(f"count {_count!a}", f"ply\nformat ascii 1.0\nelement vertex {_count}\n".encode(), Malformed)
attack(
    "a billion cameras first",
    header("element camera 1000000000", "property int id", "element vertex 1", *XYZ),
    Malformed,
)
attack(
    "a billion lists",
    header(
        "element vertex 1", *XYZ, "element face 1000000000", "property list uchar int i", encoding="binary_big_endian"
    ),
    Malformed,
)
attack(
    "elements that cost nothing",
    header("element vertex 0", *XYZ, "element e 999999999", encoding="binary_big_endian"),
    Malformed,
)
attack("ascii elements that cost nothing", header("element vertex 0", *XYZ, "element e 999999999"), Malformed)
attack(
    "sparse points",
    sparse(header("element vertex 3000000000", *XYZ, encoding="binary_big_endian"), 40 * GIGABYTE),
    Limit,
)

# --- no coordinates ---

attack("no elements", header(), Missing)
attack("no vertices", header("element face 0", "property list uchar int vertex_indices"), Missing)
attack("vertices without properties", header("element vertex 3") + b"\n\n\n", Malformed)
attack("no z", ply_bytes("ascii", [(1.0, 2.0)], ["float x", "float y"]), Missing)
attack("capital letters", ply_bytes("ascii", [(1.0, 2.0, 3.0)], ["float X", "float Y", "float Z"]), Missing)
attack("integers", ply_bytes("ascii", [(1, 2, 3)], ["int x", "int y", "int z"]), Missing)
attack("lists", header("element vertex 1", "property list uchar float x", *XYZ[1:]) + b"1 1 1 1\n", Missing)

# --- rows ---

VERTEX_LISTS = ("element vertex 2", *XYZ, "property list {} uchar views")
for _type, _code, _lengths in (
    ("uchar", "B", [255]),
    ("int", "i", [2**31 - 1, -1, -(2**31)]),
    ("uint", "I", [2**32 - 1]),
):
    for _length in _lengths:
        for _order, _encoding in (("<", "binary_little_endian"), (">", "binary_big_endian")):
            _lines = [line.format(_type) for line in VERTEX_LISTS]
            _body = 2 * (struct.pack(_order + "3f" + _code, 1, 2, 3, _length) + b"ab")
            attack(f"vertex list of {_length}, {_encoding}", header(*_lines, encoding=_encoding) + _body, Malformed)
            _faces = ("element vertex 0", *XYZ, "element face 1", f"property list {_type} int vertex_indices")
            _body = struct.pack(_order + _code, _length) + bytes(400)
            attack(f"face of {_length}, {_encoding}", header(*_faces, encoding=_encoding) + _body, Malformed)
for _row in (
    b"1 2 3 -1",
    b"1 2 3 9999999999",
    b"1 2 3 99999999999999",
    b"1 2 3 2 1",
    b"1 2 3 1 1 1",
    b"1 2 3",
    b"1 2 3 x",
    b"1 2 3 1.0 5",
    b"1 2 3 " + b"9" * 100_000,
):
    attack(
        f"ascii list {_row[:24].decode()}",
        header(*[s.format("uchar") for s in VERTEX_LISTS]) + 2 * (_row + b"\n"),
        Malformed,
    )
for _row in (
    b"1 2",
    b"1 2 3 4",
    b"",
    b"1 2 z",
    b"1,2,3",
    b"1 2 3\x004",
    b"1 2 0x10",
    b"1 2 1_000",
    b"1 2 3f",
    b"1 2 \xff",
    b"1 2 \xd9\xa3",
    b"1 2 --3",
):
    attack(f"ascii row {_row.decode('latin-1')!a}", GOOD_ASCII.replace(b"0.0 0.0 0.0", _row), Malformed)
attack(
    "rows of nothing",
    ply_bytes("binary_little_endian", [(1.0, 2.0, 3.0)] * 5).replace(
        b"end_header", b"element nothing 100000000000000000\nend_header"
    ),
    Malformed,
)
attack(
    "a list of a million values",
    header("element vertex 1", *XYZ, "property list uint uchar views") + b"1 2 3 1000000" + b" 0" * 1_000_000 + b"\n",
    Limit,
)
attack("a million values in a row", GOOD_ASCII.replace(b"0.0 0.0 0.0", b"1 " * 10_000_000), Malformed)
attack("rows without an end", sparse(header("element vertex 9", *XYZ), GIGABYTE // 8), Malformed)
attack("too few rows", GOOD_ASCII[: GOOD_ASCII.rindex(b"\n", 0, -1) + 1], Malformed)
attack(
    "a list that ends with the file",
    header("element vertex 1", *XYZ, "property list int int views", encoding="binary_little_endian")
    + struct.pack("<3f", 1, 2, 3)
    + b"\1",
    Malformed,
)
attack("1e999", GOOD_ASCII.replace(b"0.0 0.0 0.0", b"1e999 -1e999 1e39"), None)
attack("a number of a thousand digits", GOOD_ASCII.replace(b"0.0 0.0 0.0", b"0." + b"3" * 1000 + b" 1 1"), None)
attack("rows after the last", GOOD_ASCII + b"rm -rf\n" * 9, None)

# --- clouds ---

nan, large = float("nan"), 1e308
attack("zero points", ply_bytes("ascii", []), TooFew)
attack("zero points, binary", ply_bytes("binary_big_endian", []), TooFew)
attack("one point", ply_bytes("ascii", [(1.0, 2.0, 3.0)]), TooFew)
attack("nowhere", ply_bytes("binary_little_endian", [(nan, nan, nan)] * 100), TooFew)
attack("almost nowhere", ply_bytes("binary_little_endian", [(nan, 1.0, 1.0)] * 100 + [(1.0, 2.0, 3.0)]), TooFew)
attack("a thousand equal points", ply_bytes("binary_little_endian", [(1.0, 2.0, 3.0)] * 1000), Degenerate)
_doubles = ["double x", "double y", "double z"]
attack(
    "as far apart as can be",
    ply_bytes("binary_little_endian", [(large, -large, 0.0), (-large, large, 0.0)] * 50, _doubles),
    Degenerate,
)
attack("as far out as can be", ply_bytes("ascii", [(1.79e308, 1.79e308, 1.79e308)] * 50, _doubles), Degenerate)
attack(
    "far apart and far out", ply_bytes("ascii", [(k * 1e306, large, large) for k in range(50)], _doubles), Degenerate
)
attack("as near as can be", ply_bytes("ascii", [(k * 5e-324, 0.0, 0.0) for k in range(50)], _doubles), Degenerate)
attack("one stray point", ply_bytes("ascii", [*ROWS, (1e30, 1e30, 1e30)]), None)
attack("all in a line", ply_bytes("ascii", [(float(k), 0.0, 0.0) for k in range(100)]), None)
attack("two piles", ply_bytes("ascii", [(0.0, 0.0, 0.0)] * 500 + [(1.0, 1.0, 1.0)] * 500), None)
