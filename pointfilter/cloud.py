"""A point cloud as it came in: coordinates to work on, and everything else to give back untouched."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import ParameterError
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

    @property
    def column_types(self) -> dict[str, np.dtype[Any] | None]:
        """Types of the columns of the points, x, y and z too, in file order; None for a column of lists."""
        ...

    def columns(self, names: Sequence[str]) -> Float64:
        """The values (n, k) float64 of k columns of numbers. Raises MalformedFileError, KeyError."""
        ...


@dataclass(frozen=True)
class PointCloud:
    """Points in file order.

    xyz: (n, 3) float64, read-only; rows may hold NaN or Inf, which are kept and never filtered.
    source: everything else in the file (other columns, faces, comments, encoding), or None for a cloud made of arrays.
    columns: values (n,) float64 by name that a written file gets in place of the source's; a column that the source
    does not have is added as float. Where the source has the column, rows with NaN or Inf keep what they have.
    dropped: columns of the source that a written file does not get.
    """

    xyz: Float64
    source: Source | None = None
    columns: Mapping[str, Float64] = field(default_factory=lambda: MappingProxyType({}))
    dropped: frozenset[str] = frozenset()

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

    @property
    def column_types(self) -> dict[str, np.dtype[Any] | None]:
        """Types of the columns that a written file gets, x, y and z too where there is a source; None for lists."""
        types = {} if self.source is None else self.source.column_types
        added = {name: np.dtype(float) for name in self.columns if name not in types}
        return {**{name: kind for name, kind in types.items() if name not in self.dropped}, **added}

    def column_values(self, names: Sequence[str]) -> Float64:
        """The values (n, k) float64 of k columns of numbers. Raises KeyError, MalformedFileError."""
        found = np.full((len(self), len(names)), np.nan)
        kept = [name for name in names if self.source is not None and name in self.source.column_types]
        if kept and self.source is not None:
            found[:, [names.index(name) for name in kept]] = self.source.columns(kept)
        for number, name in enumerate(names):
            if name in self.dropped or not (name in kept or name in self.columns):
                raise KeyError(name)
            values = self.columns.get(name)
            if values is not None:
                found[:, number] = np.where(np.isfinite(values) | (name not in kept), values, found[:, number])
        return found

    def with_columns(self, columns: Mapping[str, Float64]) -> PointCloud:
        """The same cloud with other values (n,) float64 of these columns, or with new columns.

        Raises ParameterError where the source has a column of the name that is neither float nor double.
        """
        known = {} if self.source is None else self.source.column_types
        for name, values in columns.items():
            if not (name.isascii() and name.isidentifier()):
                raise ValueError(f"the name of a column must be one ASCII word, got {name!r}")
            if np.shape(values) != (len(self),):
                raise ValueError(f"column {name!r} must have shape ({len(self)},), got {np.shape(values)}")
            kind = known.get(name, np.dtype(float))
            if kind is None or kind.kind != "f":
                raise ParameterError(
                    f"column {name!r} of the file is {'a list' if kind is None else kind.name}, not float or double, "
                    "and cannot take other values",
                    actual=name,
                )
        return dataclasses.replace(
            self, columns=MappingProxyType({**self.columns, **columns}), dropped=self.dropped - columns.keys()
        )

    def without_columns(self, names: Iterable[str]) -> PointCloud:
        """The same cloud without these columns; names that it does not have are ignored."""
        names = frozenset(names)
        if names & {"x", "y", "z"}:
            raise ValueError("x, y and z cannot be dropped")
        columns = {name: values for name, values in self.columns.items() if name not in names}
        return dataclasses.replace(self, columns=MappingProxyType(columns), dropped=self.dropped | names)

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
