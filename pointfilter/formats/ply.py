"""PLY in and out, byte for byte but for x, y and z and the columns that a cloud sets or drops.

The file is not taken apart and put together again: the coordinates are read from its bytes and, on the way out, written
into a copy of them. So other columns, lists, faces, comments, spelling and line endings cannot get lost, and what comes
after the vertices is checked but never held as objects. plyfile writes clouds that come from arrays;
docs/adr/0003-ply-by-splicing.md says why it does not do the rest.
"""

from __future__ import annotations

import mmap
import os
import re
import secrets
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import plyfile
from numpy.typing import NDArray

from pointfilter.cloud import PointCloud
from pointfilter.errors import LimitExceededError, MalformedFileError, ParameterError
from pointfilter.formats.ply_columns import NEW_TYPE, ColumnEdit
from pointfilter.formats.ply_convert import STRUCT_CODES, convert
from pointfilter.formats.ply_header import ENCODINGS, TYPES, ByteOrder, Element, Header, Property, read_header, shown
from pointfilter.limits import ReadLimits

Float64 = NDArray[np.float64]
AXES = ("x", "y", "z")
_ELEMENT_LINE = re.compile(rb"^[ \t]*element\b", re.MULTILINE)
MAX_LIST_ROW_BYTES = 1 << 20  # of ascii: a row is held as tokens, at 40 times its bytes


@dataclass(frozen=True)
class PlySource:
    """The file's bytes and where the vertices are in them."""

    header: Header
    data: mmap.mmap | bytes = field(repr=False)
    vertex_start: int
    vertex_stop: int
    offsets: NDArray[np.int64] | None = field(default=None, repr=False)
    """(n, 3) byte positions of x, y and z, for binary vertices that hold lists."""

    @property
    def single_precision(self) -> bool:
        return any(
            property.name in "xyz" and property.type in ("float", "float32")
            for property in self.header.vertex.properties
        )

    @property
    def column_types(self) -> dict[str, np.dtype[Any] | None]:
        return {
            property.name: None if property.length_type else property.dtype("=")
            for property in self.header.vertex.properties
        }

    def columns(self, names: Sequence[str]) -> Float64:
        properties = _properties(self.header.vertex, names)
        if self.header.encoding == "ascii":
            return _text_columns(self, properties)
        raw = np.frombuffer(self.data, np.uint8)
        found = np.empty((self.header.vertex.count, len(names)), dtype=np.float64)
        for number, (property, places) in enumerate(zip(properties, _places(self, names), strict=True)):
            with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
                found[:, number] = _column(self, raw, property, places)
        return found

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "format": "ply",
            "encoding": self.header.encoding,
            "elements": {
                element.name: {
                    "count": element.count,
                    "properties": [_spelled(property) for property in element.properties],
                }
                for element in self.header.elements
            },
            "comments": list(self.header.comments),
            "obj_info": list(self.header.obj_info),
        }


def read(path: Path, limits: ReadLimits) -> PointCloud:
    """Reads a PLY file from disk. Raises MalformedFileError (line or byte named), UnsupportedFormatError,
    MissingCoordinatesError, LimitExceededError, OSError."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        header = read_header(file, size, limits)
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return _read_ascii(header, data) if header.encoding == "ascii" else _read_binary(header, data)


def write(cloud: PointCloud, path: Path, encoding: str = "same", comment: str | None = None) -> None:
    """Writes a cloud to disk, atomically: the file is there whole or not at all.

    encoding: "same" as the source (a cloud without one becomes binary_little_endian), or one of ENCODINGS. comment: a
    line to add to the header.
    """
    if encoding != "same" and encoding not in ENCODINGS:
        raise ParameterError(f"format must be one of same, {', '.join(ENCODINGS)}, got {encoding!r}", actual=encoding)
    if comment is not None and not (comment.isascii() and comment.isprintable()):
        raise ValueError("a comment must be one line of printable ASCII")
    partial = path.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        with partial.open("xb") as file:  # not a private file of tempfile's: the result is the user's ordinary one
            if isinstance(cloud.source, PlySource):
                _write_spliced(cloud, cloud.source, file, comment)
            else:
                _write_new(cloud, file, comment)
        source_encoding = (
            cloud.source.header.encoding if isinstance(cloud.source, PlySource) else "binary_little_endian"
        )
        if encoding not in ("same", source_encoding):
            convert(partial, encoding)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


# --- binary ---------------------------------------------------------------------------------------------------------


def _read_binary(header: Header, data: mmap.mmap) -> PointCloud:
    position = header.size
    start = stop = position
    offsets = None
    for element in header.elements:
        begin = position
        wanted = element.name == "vertex"
        if element.has_lists:
            position, found = _walk(element, header.order, data, position, AXES if wanted else ())
            offsets = found if wanted else offsets
        else:
            position += element.count * element.smallest_row(ascii=False)
        if position > len(data):
            raise MalformedFileError(
                f"the file ends at byte {len(data)}, inside element {shown(element.name)}, which needs byte {position}",
                hint="the file is truncated",
            )
        if wanted:
            start, stop = begin, position
    source = PlySource(header, data, start, stop, offsets)
    return PointCloud(source.columns(AXES), source)


def _properties(vertex: Element, names: Sequence[str]) -> list[Property]:
    found = {property.name: property for property in vertex.properties}
    return [found[name] for name in names]


def _places(source: PlySource, names: Sequence[str]) -> list[NDArray[np.int64] | None]:
    """Byte positions (n,) of each of these columns, None where rows have no lists: there they follow from the row."""
    if source.offsets is None:
        return [None] * len(names)
    offsets = source.offsets
    if tuple(names) != AXES:
        vertex, order = source.header.vertex, source.header.order
        offsets = _walk(vertex, order, source.data, source.vertex_start, names)[1]
    return list(offsets.T)


def _column(
    source: PlySource, raw: NDArray[np.uint8], property: Property, places: NDArray[np.int64] | None
) -> NDArray[Any]:
    """The values of one column: a view on the bytes, or a gathered copy where rows have lists."""
    dtype = property.dtype(source.header.order)
    if places is not None:
        rows = places[:, None] + np.arange(dtype.itemsize)
        return raw[rows].view(dtype)[:, 0] if len(rows) else np.empty(0, dtype)
    vertex = source.header.vertex
    if vertex.count == 0:
        return np.empty(0, dtype)
    before = sum(p.dtype("=").itemsize for p in vertex.properties[: vertex.properties.index(property)])
    return np.ndarray(
        (vertex.count,), dtype, raw.data, source.vertex_start + before, (vertex.smallest_row(ascii=False),)
    )


def _walk(
    element: Element, order: ByteOrder, data: mmap.mmap | bytes, position: int, wanted: Sequence[str]
) -> tuple[int, NDArray[np.int64]]:
    """Steps over rows with lists, checking every length against the file: (end, offsets (n, k) of wanted columns)."""
    size = len(data)
    steps = _steps(element, order)
    found = array("q")
    for row in range(element.count):
        for name, length, item in steps:
            if name in wanted:
                found.append(position)
            if length is None:
                position += item
                continue
            count = length.unpack_from(data, position)[0] if position + length.size <= size else 0
            if count < 0 or position + length.size + count * item > size:
                raise MalformedFileError(
                    f"byte {position}: row {row} of element {shown(element.name)} has a list {shown(name)} of {count} "
                    f"items, which the file of {size} bytes does not hold"
                )
            position += length.size + count * item
        if position > size or (row + 1 < element.count and position == size):
            raise MalformedFileError(
                f"the file ends at byte {size}, in row {row} of element {shown(element.name)}",
                hint="the file is truncated",
            )
    in_order = [property.name for property in element.properties if property.name in wanted]
    offsets = np.frombuffer(found, np.int64).reshape(-1 if wanted else 0, len(wanted))
    return position, offsets[:, [in_order.index(name) for name in wanted]]


def _steps(element: Element, order: ByteOrder) -> list[tuple[str, struct.Struct | None, int]]:
    prefix = "<" if order == "<" else ">"
    return [
        (
            property.name,
            struct.Struct(prefix + STRUCT_CODES[TYPES[property.length_type]]) if property.length_type else None,
            property.dtype(order).itemsize,
        )
        for property in element.properties
    ]


# --- ascii ----------------------------------------------------------------------------------------------------------


def _read_ascii(header: Header, data: mmap.mmap) -> PointCloud:
    number = header.raw.count(b"\n") + 1  # lines of the header
    position = header.size
    start = stop = position
    coordinates = array("d")
    for element in header.elements:
        begin = position
        wanted = element.name == "vertex"
        fields = _fields(element, AXES)
        for _ in range(element.count):
            end = data.find(b"\n", position)
            end = len(data) if end < 0 else end
            if fields is None and end - position > MAX_LIST_ROW_BYTES:
                raise LimitExceededError(
                    f"line {number + 1}: a row with lists has {end - position} bytes, more than {MAX_LIST_ROW_BYTES}",
                    limit=MAX_LIST_ROW_BYTES,
                    actual=end - position,
                    hint="write the file in a binary encoding",
                )
            # A row without lists is never taken further apart than it may be: tokens cost 40 times their bytes.
            tokens = data[position:end].split(None, -1 if fields is None else len(element.properties))
            number += 1
            if position >= len(data):
                raise MalformedFileError(f"line {number}: the file ends inside element {shown(element.name)}")
            columns = _columns(tokens, element, AXES, fields, number)
            if wanted:
                try:
                    coordinates.extend([_number(tokens[columns[axis]]) for axis in range(3)])
                except ValueError:
                    raise MalformedFileError(f"line {number}: x, y and z must be numbers") from None
            position = end + 1
        if wanted:
            start, stop = begin, min(position, len(data))
    xyz = np.frombuffer(coordinates, np.float64).reshape(-1, 3).copy()
    return PointCloud(_in_their_types(xyz, _properties(header.vertex, AXES)), PlySource(header, data, start, stop))


def _in_their_types(values: Float64, properties: list[Property]) -> Float64:
    """A float property holds floats, however many digits its text has."""
    for number, property in enumerate(properties):
        values[:, number] = _cast(values[:, number], np.dtype(TYPES[property.type]))
    return values


def _text_columns(source: PlySource, properties: list[Property]) -> Float64:
    """The values (n, k) of columns of a file that `read` has checked. Raises MalformedFileError."""
    vertex = source.header.vertex
    names = [property.name for property in properties]
    fields = _fields(vertex, names)
    found = np.empty((vertex.count, len(names)), dtype=np.float64)
    for row, line in enumerate(_lines(source)):
        tokens = line.split()
        try:
            found[row] = [_number(tokens[column]) for column in _columns(tokens, vertex, names, fields, row)]
        except ValueError:
            raise MalformedFileError(f"vertex {row}: {', '.join(map(shown, names))} must be numbers") from None
    return _in_their_types(found, properties)


def _lines(source: PlySource) -> Iterator[bytes]:
    """The lines of the vertices, with their endings."""
    position = source.vertex_start
    for _ in range(source.header.vertex.count):
        end = source.data.find(b"\n", position, source.vertex_stop)
        end = source.vertex_stop if end < 0 else end + 1
        yield source.data[position:end]
        position = end


def _number(text: bytes) -> float:
    if b"_" in text:
        raise ValueError("1_000 is a number in Python only")
    return float(text)


def _fields(element: Element, names: Sequence[str]) -> list[int] | None:
    """Numbers of the values of these columns where no list comes into it; None where rows must be walked."""
    if element.has_lists:
        return None
    known = [property.name for property in element.properties]
    return [known.index(name) if name in known else 0 for name in names]


def _columns(
    tokens: list[bytes], element: Element, names: Sequence[str], fields: list[int] | None, number: int
) -> list[int]:
    """Numbers of the values of these columns in this row; checks that the row has the values that its element says."""
    if fields is not None:
        if len(tokens) != len(element.properties):
            found = "more" if len(tokens) > len(element.properties) else f"{len(tokens)}"
            raise MalformedFileError(
                f"line {number}: {found} values for the {len(element.properties)} properties of {shown(element.name)}"
            )
        return fields
    places = {}
    column = 0
    for property in element.properties:
        places[property.name] = column
        if property.length_type:
            length = tokens[column] if column < len(tokens) else b""
            if not length.isdigit() or len(length) > 10:
                raise MalformedFileError(f"line {number}: list {shown(property.name)} has no length")
            column += int(length)
        column += 1
    if column != len(tokens):
        raise MalformedFileError(f"line {number}: {len(tokens)} values, the row's lists and properties need {column}")
    return [places.get(name, 0) for name in names]


# --- writing --------------------------------------------------------------------------------------------------------


def _write_spliced(cloud: PointCloud, source: PlySource, file: BinaryIO, comment: str | None) -> None:
    header = source.header
    edit = ColumnEdit.of(header.vertex, cloud.columns, cloud.dropped)
    raw = edit.header(header.raw, header.ending)
    # Before the first element, where readers look for the comments on the whole file.
    first = _ELEMENT_LINE.search(raw)
    place = first.start() if first else len(raw)
    file.write(raw[:place])
    if comment is not None:
        file.write(b"comment " + comment.encode() + header.ending)
    file.write(raw[place:])
    file.write(source.data[len(header.raw) : source.vertex_start])  # from the end_header line on
    splice = _spliced_ascii if header.encoding == "ascii" else _spliced_binary
    for part in splice(cloud, source, edit):
        file.write(part)
    _copy(source.data, source.vertex_stop, file)


def _copy(data: mmap.mmap | bytes, start: int, file: BinaryIO, step: int = 1 << 24) -> None:
    for position in range(start, len(data), step):
        file.write(data[position : position + step])


def _replaced(cloud: PointCloud, edit: ColumnEdit) -> dict[str, Float64]:
    """New values (n,) of columns that the file has: x, y and z first."""
    return {**dict(zip(AXES, cloud.xyz.T, strict=True)), **edit.replaced}


def _spliced_binary(cloud: PointCloud, source: PlySource, edit: ColumnEdit) -> Iterator[bytes | memoryview]:
    """The vertex bytes with new values; values that did not change keep their bytes, NaN payloads too."""
    raw = np.frombuffer(source.data, np.uint8)
    rows = np.array(raw[source.vertex_start : source.vertex_stop])
    vertex, order = source.header.vertex, source.header.order
    local = PlySource(source.header, b"", 0, 0)
    replaced = _replaced(cloud, edit)
    places_of = dict(zip(AXES, _places(source, AXES), strict=True))
    places_of.update(zip(edit.replaced, _places(source, list(edit.replaced)), strict=True))
    for property in _properties(vertex, list(replaced)):
        dtype, places = property.dtype(order), places_of[property.name]
        old = _column(source, raw, property, places)
        values = _cast(replaced[property.name], dtype)
        changed = (values != old) & np.isfinite(values)
        if places is None:
            _column(local, rows, property, None)[changed] = values[changed]
        else:
            bytes_of = places[changed, None] - source.vertex_start + np.arange(dtype.itemsize)
            rows[bytes_of] = values[changed].astype(dtype).view(np.uint8).reshape(-1, dtype.itemsize)
    if not edit.changes_layout:
        yield rows.data
    elif vertex.has_lists:
        yield from edit.rows_with_lists(rows.data, _steps(vertex, order), order)
    else:
        yield edit.rows(rows, vertex, order).data


def _cast(values: Float64, dtype: np.dtype[Any]) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        return values.astype(dtype)


def _spliced_ascii(cloud: PointCloud, source: PlySource, edit: ColumnEdit, step: int = 4096) -> Iterator[bytes]:
    """The vertex lines with new values, each as the shortest text that reads back as the same number in the property's
    own type; a value that did not change keeps its text."""
    vertex = source.header.vertex
    replaced = _replaced(cloud, edit)
    names = list(replaced)
    fields = _fields(vertex, names)
    text = _lines(source)
    for first in range(0, vertex.count, step):
        part = slice(first, min(first + step, vertex.count))
        lines = [_split_keeping_spaces(line) for line in islice(text, step)]
        places = [
            [2 * column + 1 for column in _columns(pieces[1::2], vertex, names, fields, first + row)]
            for row, pieces in enumerate(lines)
        ]
        for number, property in enumerate(_properties(vertex, names)):
            dtype = np.dtype(TYPES[property.type])
            values = _cast(replaced[property.name][part], dtype)
            texts = [pieces[place[number]] for pieces, place in zip(lines, places, strict=True)]
            old = _cast(np.array(list(map(float, texts))), dtype)
            changed = np.flatnonzero((values != old) & np.isfinite(values))
            for row, new in zip(changed.tolist(), values[changed].astype(str).tolist(), strict=True):
                lines[row][places[row][number]] = new.encode()
        if edit.changes_layout:
            lines = edit.lines(lines, vertex, part)
        yield b"".join(piece for pieces in lines for piece in pieces)


def _split_keeping_spaces(line: bytes) -> list[bytes]:
    """[space, token, space, token, ..., space]; the first and the last may be empty."""
    pieces = []
    position = 0
    for token in line.split():
        start = line.index(token, position)
        pieces += [line[position:start], token]
        position = start + len(token)
    return [*pieces, line[position:]]


def _write_new(cloud: PointCloud, file: BinaryIO, comment: str | None) -> None:
    layout = [*((name, "<f8") for name in AXES), *((name, f"<{NEW_TYPE}") for name in cloud.columns)]
    vertices = np.empty(len(cloud), dtype=layout)
    for axis, name in enumerate(AXES):
        vertices[name] = cloud.xyz[:, axis]
    for name, values in cloud.columns.items():
        vertices[name] = _cast(values, np.dtype(NEW_TYPE))
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element], byte_order="<", comments=[comment] if comment else []).write(file)


def _spelled(property: Property) -> str:
    kind = f"list {property.length_type} {property.type}" if property.length_type else property.type
    return f"{kind} {property.name}"
