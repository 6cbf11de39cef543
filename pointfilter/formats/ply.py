"""PLY in and out, byte for byte but for x, y and z and the columns that a cloud sets or drops.

The file is not taken apart and put together again: the coordinates are read from its bytes and, on the way out, written
into a copy of them. So other columns, lists, faces, comments, spelling and line endings cannot get lost, and what comes
after the vertices is checked but never held as objects. plyfile writes clouds that come from arrays;
docs/adr/0003-ply-by-splicing.md says why it does not do the rest.
"""

from __future__ import annotations

import mmap
import os
import secrets
from pathlib import Path

from pointfilter.cloud import PointCloud
from pointfilter.errors import ParameterError
from pointfilter.formats.ply_convert import convert
from pointfilter.formats.ply_header import ENCODINGS, read_header
from pointfilter.formats.ply_read import read_ascii, read_binary
from pointfilter.formats.ply_source import PlySource
from pointfilter.formats.ply_write import write_new, write_spliced
from pointfilter.limits import ReadLimits


def read(path: Path, limits: ReadLimits) -> PointCloud:
    """Reads a PLY file from disk. Raises MalformedFileError (line or byte named), UnsupportedFormatError,
    MissingCoordinatesError, LimitExceededError, OSError."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        header = read_header(file, size, limits)
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return read_ascii(header, data) if header.encoding == "ascii" else read_binary(header, data)


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
                write_spliced(cloud, cloud.source, file, comment)
            else:
                write_new(cloud, file, comment)
        source_encoding = (
            cloud.source.header.encoding if isinstance(cloud.source, PlySource) else "binary_little_endian"
        )
        if encoding not in ("same", source_encoding):
            convert(partial, encoding)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
