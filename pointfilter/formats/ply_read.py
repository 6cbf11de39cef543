"""Reading PLY: finds the vertices in the bytes of a file and checks every other element on the way."""

from __future__ import annotations

import mmap
from array import array

import numpy as np

from pointfilter.cloud import PointCloud
from pointfilter.errors import LimitExceededError, MalformedFileError
from pointfilter.formats.ply_header import Header, shown
from pointfilter.formats.ply_rows import fixed_token_numbers, parse_number, token_numbers, walk_rows
from pointfilter.formats.ply_source import AXES, PlySource, in_their_types, properties_named

MAX_LIST_ROW_BYTES = 1 << 20  # of ascii: a row is held as tokens, at 40 times its bytes


def read_binary(header: Header, data: mmap.mmap) -> PointCloud:
    position = header.size
    start = stop = position
    offsets = None
    for element in header.elements:
        begin = position
        wanted = element.name == "vertex"
        if element.has_lists:
            position, found = walk_rows(element, header.order, data, position, AXES if wanted else ())
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


def read_ascii(header: Header, data: mmap.mmap) -> PointCloud:
    number = header.raw.count(b"\n") + 1  # lines of the header
    position = header.size
    start = stop = position
    coordinates = array("d")
    for element in header.elements:
        begin = position
        wanted = element.name == "vertex"
        fields = fixed_token_numbers(element, AXES)
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
            columns = token_numbers(tokens, element, AXES, fields, number)
            if wanted:
                try:
                    coordinates.extend([parse_number(tokens[columns[axis]]) for axis in range(3)])
                except ValueError:
                    raise MalformedFileError(f"line {number}: x, y and z must be numbers") from None
            position = end + 1
        if wanted:
            start, stop = begin, min(position, len(data))
    xyz = np.frombuffer(coordinates, np.float64).reshape(-1, 3).copy()
    return PointCloud(in_their_types(xyz, properties_named(header.vertex, AXES)), PlySource(header, data, start, stop))
