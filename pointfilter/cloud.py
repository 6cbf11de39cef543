"""A point cloud as it came in: coordinates to work on, and everything else to give back untouched."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pointfilter.limits import ReadLimits

Float64 = NDArray[np.float64]


class Source(Protocol):
    """What a format keeps of the file that a cloud came from."""

    @property
    def summary(self) -> dict[str, Any]: ...

    @property
    def single_precision(self) -> bool:
        """Whether the file keeps coordinates as float32."""
        ...


@dataclass(frozen=True)
class PointCloud:
    """Points in file order.

    xyz: (n, 3) float64, read-only; rows may hold NaN or Inf, which are kept and never filtered.
    source: everything else in the file (other columns, faces, comments, encoding), or None for a cloud made of arrays.
    """

    xyz: Float64
    source: Source | None = None

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz, dtype=np.float64).view()  # a view: the caller may go on writing to the array itself
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ValueError(f"xyz must have shape (n, 3), got {xyz.shape}")
        xyz.setflags(write=False)
        object.__setattr__(self, "xyz", xyz)

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def finite(self) -> NDArray[np.bool_]:
        """(n,) bool: the rows that have a place in space."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def with_xyz(self, xyz: Float64) -> PointCloud:
        """The same cloud with other coordinates, (n, 3) float64, row for row."""
        if xyz.shape != self.xyz.shape:
            raise ValueError(f"expected coordinates of shape {self.xyz.shape}, got {xyz.shape}")
        return dataclasses.replace(self, xyz=np.asarray(xyz, dtype=np.float64))

    @classmethod
    def read(cls, path: str | Path, limits: ReadLimits | None = None) -> PointCloud:
        """Reads a file; the suffix names the format. Raises InputError and its children, OSError."""
        from pointfilter.formats import format_of

        path = Path(path)
        cloud: PointCloud = format_of(path).read(path, limits or ReadLimits())
        return cloud

    def write(self, path: str | Path, encoding: str = "same", comment: str | None = None) -> None:
        """Writes a file, whole or not at all. encoding: "same" as the source, or a name the format knows."""
        from pointfilter.formats import format_of

        path = Path(path)
        format_of(path).write(self, path, encoding, comment)
