"""A PLY writer of the tests' own: it knows where every coordinate went, and it can write what no sane writer would."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

CODES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B",
    "short": "h", "int16": "h", "ushort": "H", "uint16": "H",
    "int": "i", "int32": "i", "uint": "I", "uint32": "I",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Column:
    name: str
    type: str
    length_type: str | None = None

    @property
    def line(self) -> str:
        kind = f"list {self.length_type} {self.type}" if self.length_type else self.type
        return f"property {kind} {self.name}"


@dataclass(frozen=True)
class Table:
    """An element. rows: one sequence a row, one entry a column; an entry of a list column is a sequence.

    An ascii entry may be a string: it is written as it stands.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[object]]


@dataclass
class Written:
    """A file's bytes and the places (start, stop) of x, y and z of each vertex in them."""

    data: bytes
    end_header: int
    body: int
    places: list[dict[str, tuple[int, int]]] = field(default_factory=list)


def write_ply(
    encoding: str,
    tables: Sequence[Table],
    *,
    newline: bytes = b"\n",
    separators: Sequence[bytes] = (b" ",),
    remarks: dict[int, Sequence[bytes]] | None = None,
    final_newline: bool = True,
    trailing: bytes = b"",
) -> Written:
    """remarks: lines (comment, obj_info) to put before the header's line of that number; 0 is the one after `ply`."""
    lines = [f"format {encoding} 1.0"]
    for table in tables:
        lines.append(f"element {table.name} {len(table.rows)}")
        lines += [column.line for column in table.columns]
    remarks = remarks or {}
    header = [b"ply"]
    for number, line in enumerate([*lines, ""]):
        header += remarks.get(number, ())
        if line:
            header.append(line.encode())
    data = bytearray(newline.join(header) + newline)
    end_header = len(data)
    data += b"end_header" + newline
    written = Written(b"", end_header, len(data))
    for table in tables:
        for row in table.rows:
            places = _row(data, encoding, table, row, newline, separators)
            if table.name == "vertex":
                written.places.append(places)
    if encoding == "ascii" and not final_newline and len(data) > written.body:
        del data[-len(newline) :]
    written.data = bytes(data) + trailing
    return written


def _row(
    data: bytearray,
    encoding: str,
    table: Table,
    row: Sequence[object],
    newline: bytes,
    separators: Sequence[bytes],
) -> dict[str, tuple[int, int]]:
    places = {}
    number = 0
    for column, value in zip(table.columns, row, strict=True):
        entries = (
            [("length", len(value)), *(("item", item) for item in value)] if column.length_type else [("item", value)]
        )
        for kind, entry in entries:
            if encoding == "ascii":
                if number:
                    data += separators[number % len(separators)]
                text = entry if isinstance(entry, str) else _text(entry)
                piece = text.encode()
            else:
                type_ = column.length_type if kind == "length" else column.type
                piece = struct.pack(ORDERS[encoding] + CODES[type_], entry)
            number += 1
            if table.name == "vertex" and column.name in AXES:
                places[column.name] = (len(data), len(data) + len(piece))
            data += piece
    if encoding == "ascii":
        data += newline
    return places


def _text(value: object) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def ply_bytes(
    encoding: str,
    rows: Sequence[Sequence[object]],
    properties: Sequence[str] = ("float x", "float y", "float z"),
    faces: Sequence[Sequence[int]] | None = None,
) -> bytes:
    """The common file: vertices with plain properties ("float x"), perhaps faces."""
    columns = [Column(name, type_) for type_, name in (line.split() for line in properties)]
    tables = [Table("vertex", columns, rows)]
    if faces is not None:
        tables.append(Table("face", [Column("vertex_indices", "int", "uchar")], [(face,) for face in faces]))
    return write_ply(encoding, tables).data


def header(*lines: str, encoding: str = "ascii") -> bytes:
    """A header with these lines in it, as they stand."""
    return "\n".join(["ply", f"format {encoding} 1.0", *lines, "end_header", ""]).encode("latin-1")
