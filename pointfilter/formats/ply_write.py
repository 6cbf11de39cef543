"""Writing PLY: a copy of the source's bytes with new vertex values, or a new file for a cloud made of arrays."""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from itertools import islice
from typing import BinaryIO

import numpy as np
import plyfile

from pointfilter.cloud import PointCloud
from pointfilter.formats.ply_columns import NEW_TYPE, ColumnEdit
from pointfilter.formats.ply_header import TYPES
from pointfilter.formats.ply_rows import fixed_token_numbers, row_steps, token_numbers
from pointfilter.formats.ply_source import (
    AXES,
    Float64,
    PlySource,
    binary_column,
    byte_positions,
    cast,
    properties_named,
    vertex_lines,
)

_ELEMENT_LINE = re.compile(rb"^[ \t]*element\b", re.MULTILINE)


def write_spliced(cloud: PointCloud, source: PlySource, file: BinaryIO, comment: str | None) -> None:
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
    places_of = dict(zip(AXES, byte_positions(source, AXES), strict=True))
    places_of.update(zip(edit.replaced, byte_positions(source, list(edit.replaced)), strict=True))
    for property in properties_named(vertex, list(replaced)):
        dtype, places = property.dtype(order), places_of[property.name]
        old = binary_column(source, raw, property, places)
        values = cast(replaced[property.name], dtype)
        changed = (values != old) & np.isfinite(values)
        if places is None:
            binary_column(local, rows, property, None)[changed] = values[changed]
        else:
            bytes_of = places[changed, None] - source.vertex_start + np.arange(dtype.itemsize)
            rows[bytes_of] = values[changed].astype(dtype).view(np.uint8).reshape(-1, dtype.itemsize)
    if not edit.changes_layout:
        yield rows.data
    elif vertex.has_lists:
        yield from edit.rows_with_lists(rows.data, row_steps(vertex, order), order)
    else:
        yield edit.rows(rows, vertex, order).data


def _spliced_ascii(cloud: PointCloud, source: PlySource, edit: ColumnEdit, step: int = 4096) -> Iterator[bytes]:
    """The vertex lines with new values, each as the shortest text that reads back as the same number in the property's
    own type; a value that did not change keeps its text."""
    vertex = source.header.vertex
    replaced = _replaced(cloud, edit)
    names = list(replaced)
    fields = fixed_token_numbers(vertex, names)
    text = vertex_lines(source)
    for first in range(0, vertex.count, step):
        part = slice(first, min(first + step, vertex.count))
        lines = [_split_keeping_spaces(line) for line in islice(text, step)]
        places = [
            [2 * column + 1 for column in token_numbers(pieces[1::2], vertex, names, fields, first + row)]
            for row, pieces in enumerate(lines)
        ]
        for number, property in enumerate(properties_named(vertex, names)):
            dtype = np.dtype(TYPES[property.type])
            values = cast(replaced[property.name][part], dtype)
            texts = [pieces[place[number]] for pieces, place in zip(lines, places, strict=True)]
            old = cast(np.array(list(map(float, texts))), dtype)
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


def write_new(cloud: PointCloud, file: BinaryIO, comment: str | None) -> None:
    layout = [*((name, "<f8") for name in AXES), *((name, f"<{NEW_TYPE}") for name in cloud.columns)]
    vertices = np.empty(len(cloud), dtype=layout)
    for axis, name in enumerate(AXES):
        vertices[name] = cloud.xyz[:, axis]
    for name, values in cloud.columns.items():
        vertices[name] = cast(values, np.dtype(NEW_TYPE))
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element], byte_order="<", comments=[comment] if comment else []).write(file)
