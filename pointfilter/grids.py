"""Neighbour indexes of one cloud for balls of different sizes: a grid for each power of two that is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from pointfilter.patches import SMALLEST_RADIUS, NeighbourIndex, UInt64
from pointfilter.ranges import over_ranges

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

ROWS_PER_TASK = 4_096


class Grids:
    """Indexes of (n, 3) points, made when they are first needed."""

    def __init__(self, points: Float64) -> None:
        self.points = points
        self._indexes: dict[int, NeighbourIndex] = {}

    def by_radius(self, rows: Int64, radii: Float64) -> Iterator[tuple[Int64, NeighbourIndex]]:
        """Splits the points `rows` (q,) by the power of two below their radii (q,): yields positions in `rows`, in the
        order of the index, and an index whose cells are one to two of them wide."""
        octaves = np.floor(np.log2(np.maximum(radii, SMALLEST_RADIUS))).astype(np.int64)
        for octave in np.unique(octaves):
            if octave not in self._indexes:
                self._indexes[octave] = NeighbourIndex(self.points, float(2.0**octave))
            index = self._indexes[octave]
            chosen = np.flatnonzero(octaves == octave)
            yield chosen[np.argsort(index.positions[rows[chosen]])], index

    def smallest_key(self, rows: Int64, radii: Float64, keys: UInt64, threads: int, check: Callable[[], None]) -> Int64:
        """For the points `rows` (q,): the row of the point with the smallest key within radii (q,). keys: (n,)."""
        owners = np.empty(len(rows), dtype=np.int64)
        for chosen, index in self.by_radius(rows, radii):
            ordered, index_rows, index_radii = keys[index.order], rows[chosen], radii[chosen]

            def find(
                first: int,
                last: int,
                index: NeighbourIndex = index,
                rows: Int64 = index_rows,
                radii: Float64 = index_radii,
                keys: UInt64 = ordered,
            ) -> Int64:
                return index.smallest_key(rows[first:last], radii[first:last], keys)

            owners[chosen] = np.concatenate(list(over_ranges(find, len(chosen), ROWS_PER_TASK, threads, check)))
        return owners
