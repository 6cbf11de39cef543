"""Formats: one module each, with the same two functions.

read(path: Path, limits: ReadLimits) -> PointCloud
write(cloud: PointCloud, path: Path, encoding: str, comment: str | None) -> None
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from pointfilter.errors import UnsupportedFormatError
from pointfilter.formats import ply
from pointfilter.limits import ReadLimits

FORMATS: dict[str, ModuleType] = {".ply": ply}

__all__ = ["FORMATS", "ReadLimits", "format_of", "ply"]


def format_of(path: Path) -> ModuleType:
    """The module for a path's suffix. Raises UnsupportedFormatError."""
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise UnsupportedFormatError(
            f"no format for the suffix {path.suffix!r}", hint=f"known: {', '.join(FORMATS)}"
        ) from None
