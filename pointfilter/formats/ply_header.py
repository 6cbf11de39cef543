"""The header of a PLY file, checked against limits and against the size of the file before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, BinaryIO, Literal

import numpy as np

from pointfilter.errors import LimitExceededError, MalformedFileError, MissingCoordinatesError, UnsupportedFormatError
from pointfilter.limits import ReadLimits

ByteOrder = Literal["=", "<", ">"]

ENCODINGS: dict[str, ByteOrder] = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

MOST_ELEMENTS = 1_000


@dataclass(frozen=True)
class Property:
    """One column: its name, its type as the file spells it, and for a list the type of its length."""

    name: str
    type: str
    length_type: str | None = None

    def dtype(self, order: ByteOrder) -> np.dtype[Any]:
        return np.dtype(TYPES[self.type]).newbyteorder(order)


@dataclass(frozen=True)
class Element:
    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(property.length_type for property in self.properties)

    def smallest_row(self, ascii: bool) -> int:
        """Bytes that a row has at least: every list empty; in ascii a digit and a separator a field."""
        if ascii:
            return max(1, 2 * len(self.properties) - 1)
        return sum(np.dtype(TYPES[p.length_type or p.type]).itemsize for p in self.properties)


@dataclass(frozen=True)
class Header:
    """What the header says. `raw` holds its bytes up to and without the end_header line, `ending` the line ending."""

    encoding: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    obj_info: tuple[str, ...]
    raw: bytes
    ending: bytes
    size: int
    """Bytes from the start of the file to the first row."""

    @property
    def order(self) -> ByteOrder:
        return ENCODINGS[self.encoding]

    @property
    def vertex(self) -> Element:
        return next(element for element in self.elements if element.name == "vertex")


def read_header(file: BinaryIO, file_size: int, limits: ReadLimits) -> Header:
    """Reads and checks the header; leaves the file at the first row.

    Raises UnsupportedFormatError when this is no PLY at all, MalformedFileError (line named), MissingCoordinatesError,
    LimitExceededError.
    """
    first = file.readline(16)
    if first.rstrip(b"\r\n") != b"ply":
        raise UnsupportedFormatError(
            "this is not a PLY file: its first line is not 'ply'", hint="convert the scan to .ply first"
        )
    ending = first[3:]
    if ending not in (b"\n", b"\r\n"):
        raise MalformedFileError("line 1: 'ply' must be followed by a line break")
    parser = _Parser()
    lines = [first]
    left = limits.max_header_bytes - len(first)
    while True:
        line = file.readline(left + 1)
        number = len(lines) + 1
        if len(line) > left:
            raise LimitExceededError(
                f"the header is longer than {limits.max_header_bytes} bytes",
                limit=limits.max_header_bytes,
                hint="real headers are far shorter: is this a PLY file?",
            )
        if not line.endswith(b"\n"):
            raise MalformedFileError(f"line {number}: the file ends inside the header")
        text = line.strip()
        if text == b"end_header":
            break
        lines.append(line)
        left -= len(line)
        if text:
            parser.line(number, text)
    raw = b"".join(lines)
    header = parser.finish(raw, ending, raw_size=len(raw) + len(line))
    _check(header, file_size, limits)
    return header


class _Parser:
    def __init__(self) -> None:
        self.encoding = ""
        self.elements: dict[str, tuple[int, dict[str, Property]]] = {}
        self.properties: dict[str, Property] = {}  # of the last element
        self.comments: list[str] = []
        self.obj_info: list[str] = []

    def line(self, number: int, text: bytes) -> None:
        keyword, *others = text.split(None, 1)
        rest = others[0] if others else b""
        if keyword == b"comment":
            self.comments.append(decoded(rest))
        elif keyword == b"obj_info":
            self.obj_info.append(decoded(rest))
        elif keyword == b"format":
            self._format(number, _words(rest))
        elif keyword == b"element":
            self._element(number, _words(rest))
        elif keyword == b"property":
            self._property(number, _words(rest))
        else:
            raise MalformedFileError(f"line {number}: {shown(decoded(text))} is no PLY header line")

    def _format(self, number: int, words: list[str]) -> None:
        if self.encoding:
            raise MalformedFileError(f"line {number}: a second format line")
        if len(words) != 2 or words[0] not in ENCODINGS or words[1] != "1.0":
            raise MalformedFileError(
                f"line {number}: the format must be one of {', '.join(ENCODINGS)} with version 1.0, "
                f"not {shown(' '.join(words))}"
            )
        self.encoding = words[0]

    def _element(self, number: int, words: list[str]) -> None:
        if not self.encoding:
            raise MalformedFileError(f"line {number}: an element before the format line")
        if len(words) != 2 or not (words[1].isascii() and words[1].isdigit()) or len(words[1]) > 18:
            raise MalformedFileError(
                f"line {number}: an element needs a name and a count, not {shown(' '.join(words))}"
            )
        if words[0] in self.elements:
            raise MalformedFileError(f"line {number}: a second element {shown(words[0])}")
        if len(self.elements) >= MOST_ELEMENTS:
            raise LimitExceededError(
                f"line {number}: more than {MOST_ELEMENTS} elements",
                limit=MOST_ELEMENTS,
                actual=MOST_ELEMENTS + 1,
                hint="real files have a handful: is this a PLY file?",
            )
        self.properties = {}
        self.elements[words[0]] = (int(words[1]), self.properties)

    def _property(self, number: int, words: list[str]) -> None:
        if not self.elements:
            raise MalformedFileError(f"line {number}: a property before any element")
        is_list = words[:1] == ["list"]
        types = words[1:-1] if is_list else words[:-1]
        if len(types) != (2 if is_list else 1) or not all(type in TYPES for type in types):
            raise MalformedFileError(f"line {number}: {shown(' '.join(words))} is no property")
        if is_list and TYPES[types[0]].startswith("f"):
            raise MalformedFileError(f"line {number}: the length of a list must be an integer type, not {types[0]}")
        if words[-1] in self.properties:
            raise MalformedFileError(f"line {number}: a second property {shown(words[-1])} in one element")
        self.properties[words[-1]] = Property(words[-1], types[-1], types[0] if is_list else None)

    def finish(self, raw: bytes, ending: bytes, raw_size: int) -> Header:
        if not self.encoding:
            raise MalformedFileError("the header has no format line")
        elements = tuple(
            Element(name, count, tuple(properties.values())) for name, (count, properties) in self.elements.items()
        )
        return Header(self.encoding, elements, tuple(self.comments), tuple(self.obj_info), raw, ending, raw_size)


def _check(header: Header, file_size: int, limits: ReadLimits) -> None:
    for element in header.elements:
        if element.count and not element.properties:  # rows of nothing: any number of them would fit any file
            raise MalformedFileError(f"element {shown(element.name)} has {element.count} rows and no properties")
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        raise MissingCoordinatesError("the file has no vertex element")
    found = {property.name: property for property in vertex.properties}
    for name in ("x", "y", "z"):
        if name not in found:
            raise MissingCoordinatesError(f"the vertices have no property {name}")
        if found[name].length_type or not TYPES[found[name].type].startswith("f"):
            raise MissingCoordinatesError(f"property {name} must be float or double, not {found[name].type}")
    if vertex.count > limits.max_points:
        raise LimitExceededError(
            f"the file says {vertex.count} points, more than the limit of {limits.max_points}",
            limit=limits.max_points,
            actual=vertex.count,
            hint=f"raise {limits.max_points_knob} or split the cloud",
        )
    needed = sum(element.count * element.smallest_row(header.encoding == "ascii") for element in header.elements)
    if needed > file_size - header.size:
        raise MalformedFileError(
            f"the header promises at least {needed} bytes after byte {header.size}, "
            f"the file has {file_size - header.size}",
            hint="the file is truncated, or its header is wrong",
        )


def decoded(text: bytes) -> str:
    """Headers come in any encoding: UTF-8 where it is, else Latin-1, which never fails. `raw` keeps the bytes."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def _words(text: bytes) -> list[str]:
    return [decoded(word) for word in text.split()]  # of bytes: only ASCII knows which characters are blanks


def shown(text: str) -> str:
    """Text from outside, short and harmless enough for a message."""
    return ascii(text if len(text) <= 60 else text[:57] + "...")
