"""Rows of a PLY element: byte positions in binary rows with lists, token numbers in ascii rows, each checked."""

from __future__ import annotations

import mmap
import struct
from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import MalformedFileError
from pointfilter.formats.ply_convert import STRUCT_CODES
from pointfilter.formats.ply_header import TYPES, ByteOrder, Element, shown


def walk_rows(
    element: Element, order: ByteOrder, data: mmap.mmap | bytes, position: int, wanted: Sequence[str]
) -> tuple[int, NDArray[np.int64]]:
    """Steps over rows with lists, checking every length against the file: (end, offsets (n, k) of wanted columns)."""
    size = len(data)
    steps = row_steps(element, order)
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


def row_steps(element: Element, order: ByteOrder) -> list[tuple[str, struct.Struct | None, int]]:
    prefix = "<" if order == "<" else ">"
    return [
        (
            property.name,
            struct.Struct(prefix + STRUCT_CODES[TYPES[property.length_type]]) if property.length_type else None,
            property.dtype(order).itemsize,
        )
        for property in element.properties
    ]


def parse_number(text: bytes) -> float:
    if b"_" in text:
        raise ValueError("1_000 is a number in Python only")
    return float(text)


def fixed_token_numbers(element: Element, names: Sequence[str]) -> list[int] | None:
    """Numbers of the values of these columns where no list comes into it; None where rows must be walked."""
    if element.has_lists:
        return None
    known = [property.name for property in element.properties]
    return [known.index(name) if name in known else 0 for name in names]


def token_numbers(
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
