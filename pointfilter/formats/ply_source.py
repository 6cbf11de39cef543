"""What a cloud keeps of its PLY file: the bytes, where the vertices are in them, and the columns read from there."""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import MalformedFileError
from pointfilter.formats.ply_header import TYPES, Element, Header, Property, shown
from pointfilter.formats.ply_rows import fixed_token_numbers, parse_number, token_numbers, walk_rows

Float64 = NDArray[np.float64]
AXES = ("x", "y", "z")


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
        properties = properties_named(self.header.vertex, names)
        if self.header.encoding == "ascii":
            return _text_columns(self, properties)
        raw = np.frombuffer(self.data, np.uint8)
        found = np.empty((self.header.vertex.count, len(names)), dtype=np.float64)
        for number, (property, places) in enumerate(zip(properties, byte_positions(self, names), strict=True)):
            with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
                found[:, number] = binary_column(self, raw, property, places)
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


def properties_named(vertex: Element, names: Sequence[str]) -> list[Property]:
    found = {property.name: property for property in vertex.properties}
    return [found[name] for name in names]


def byte_positions(source: PlySource, names: Sequence[str]) -> list[NDArray[np.int64] | None]:
    """Byte positions (n,) of each of these columns, None where rows have no lists: there they follow from the row."""
    if source.offsets is None:
        return [None] * len(names)
    offsets = source.offsets
    if tuple(names) != AXES:
        vertex, order = source.header.vertex, source.header.order
        offsets = walk_rows(vertex, order, source.data, source.vertex_start, names)[1]
    return list(offsets.T)


def binary_column(
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


def _text_columns(source: PlySource, properties: list[Property]) -> Float64:
    """The values (n, k) of columns of a file that `read` has checked. Raises MalformedFileError."""
    vertex = source.header.vertex
    names = [property.name for property in properties]
    fields = fixed_token_numbers(vertex, names)
    found = np.empty((vertex.count, len(names)), dtype=np.float64)
    for row, line in enumerate(vertex_lines(source)):
        tokens = line.split()
        try:
            found[row] = [parse_number(tokens[column]) for column in token_numbers(tokens, vertex, names, fields, row)]
        except ValueError:
            raise MalformedFileError(f"vertex {row}: {', '.join(map(shown, names))} must be numbers") from None
    return in_their_types(found, properties)


def vertex_lines(source: PlySource) -> Iterator[bytes]:
    """The lines of the vertices, with their endings."""
    position = source.vertex_start
    for _ in range(source.header.vertex.count):
        end = source.data.find(b"\n", position, source.vertex_stop)
        end = source.vertex_stop if end < 0 else end + 1
        yield source.data[position:end]
        position = end


def in_their_types(values: Float64, properties: list[Property]) -> Float64:
    """A float property holds floats, however many digits its text has."""
    for number, property in enumerate(properties):
        values[:, number] = cast(values[:, number], np.dtype(TYPES[property.type]))
    return values


def cast(values: Float64, dtype: np.dtype[Any]) -> NDArray[Any]:
    with np.errstate(over="ignore"):
        return values.astype(dtype)


def _spelled(property: Property) -> str:
    kind = f"list {property.length_type} {property.type}" if property.length_type else property.type
    return f"{kind} {property.name}"
