"""A PLY file in another encoding: every number the same, in its own type; the header the same but for its format line.

Rows without lists are converted column by column, rows with lists one by one. For files that `ply.read` has checked.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import MalformedFileError
from pointfilter.formats.ply_header import ENCODINGS, TYPES, ByteOrder, Element, Header, read_header, shown
from pointfilter.limits import ReadLimits

STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
ROWS = 1 << 16  # rows held at once

Row = list[Any]
"""One value a property; a list for a list."""


def convert(path: Path, encoding: str) -> None:
    """Rewrites a file in another of ENCODINGS, in place and atomically.

    Raises MalformedFileError where a text is no number of its property's type, OSError.
    """
    partial = path.with_name(path.name + ".converted")
    try:
        with path.open("rb") as source, partial.open("xb") as target:
            header = read_header(source, os.fstat(source.fileno()).st_size, ReadLimits(max_header_bytes=2**31))
            format_line = b"format " + encoding.encode() + b" 1.0"
            raw, replaced = re.subn(rb"(?m)^[ \t]*format\b[^\r\n]*", format_line, header.raw, count=1)
            if not replaced:
                raise MalformedFileError("the format line starts with a character that is no blank")
            target.write(raw)
            target.write(b"end_header" + header.ending)
            for element in header.elements:
                try:
                    _convert_rows(source, target, element, header, encoding)
                except (ValueError, OverflowError, struct.error) as error:
                    name = shown(element.name)
                    raise MalformedFileError(f"element {name} cannot be converted to {encoding}: {error}") from error
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _convert_rows(source: BinaryIO, target: BinaryIO, element: Element, header: Header, encoding: str) -> None:
    order = ENCODINGS[encoding]
    ascii = encoding == "ascii"
    if element.has_lists:
        read = _rows_of_text(source, element) if header.encoding == "ascii" else _rows(source, element, header.order)
        for row in read:
            target.write(_text(element, row, header.ending) if ascii else _packed(element, row, order))
        return
    for table in _tables(source, element, header):
        if ascii:
            columns = [table[name].astype(str).tolist() for name in table.dtype.names or ()]
            ending = header.ending.decode()
            target.write("".join(" ".join(row) + ending for row in zip(*columns, strict=True)).encode())
        else:
            target.write(table.astype(_dtype(element, order)).tobytes())


def _dtype(element: Element, order: ByteOrder) -> np.dtype[Any]:
    return np.dtype([(f"{number}", property.dtype(order)) for number, property in enumerate(element.properties)])


def _tables(source: BinaryIO, element: Element, header: Header) -> Iterator[NDArray[Any]]:
    """The rows of an element without lists, as structured arrays of at most ROWS rows."""
    dtype = _dtype(element, header.order)
    for start in range(0, element.count, ROWS):
        count = min(ROWS, element.count - start)
        if header.encoding == "ascii":
            lines = (line.decode("ascii") for line in islice(source, count))
            with np.errstate(over="ignore"):  # text beyond its type is infinite, here as in ply.read
                yield np.loadtxt(lines, dtype=dtype, comments=None, ndmin=1)
        else:
            yield np.frombuffer(source.read(count * dtype.itemsize), dtype)


def _rows(source: BinaryIO, element: Element, order: ByteOrder) -> Iterator[Row]:
    mark = "<" if order == "<" else ">"

    def take(type: str, count: int = 1) -> tuple[Any, ...]:
        code = struct.Struct(f"{mark}{count}{STRUCT_CODES[TYPES[type]]}")
        return code.unpack(source.read(code.size))

    for _ in range(element.count):
        yield [
            list(take(property.type, take(property.length_type)[0])) if property.length_type else take(property.type)[0]
            for property in element.properties
        ]


def _rows_of_text(source: BinaryIO, element: Element) -> Iterator[Row]:
    for line in islice(source, element.count):
        tokens = iter(line.split())

        def number(type: str, tokens: Iterator[bytes] = tokens) -> int | float:
            text = next(tokens)
            return float(text) if TYPES[type].startswith("f") else int(text)

        yield [
            [number(property.type) for _ in range(int(number(property.length_type)))]
            if property.length_type
            else number(property.type)
            for property in element.properties
        ]


def _text(element: Element, row: Row, ending: bytes) -> bytes:
    words: list[str] = []
    for property, value in zip(element.properties, row, strict=True):
        kind = np.dtype(TYPES[property.type]).type
        if property.length_type:
            words.append(str(len(value)))
        words += [str(kind(item)) for item in (value if property.length_type else [value])]
    return " ".join(words).encode() + ending


def _packed(element: Element, row: Row, order: ByteOrder) -> bytes:
    mark = "<" if order == "<" else ">"
    packed = b""
    for property, value in zip(element.properties, row, strict=True):
        if property.length_type:
            packed += struct.pack(mark + STRUCT_CODES[TYPES[property.length_type]], len(value))
        items = value if property.length_type else [value]
        if TYPES[property.type] == "f4":  # struct refuses what a float can only hold as infinity
            with np.errstate(over="ignore"):
                packed += np.array(items, dtype=f"{mark}f4").tobytes()
        else:
            packed += struct.pack(f"{mark}{len(items)}{STRUCT_CODES[TYPES[property.type]]}", *items)
    return packed
