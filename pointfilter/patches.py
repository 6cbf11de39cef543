"""Patches: neighbourhoods, PCA frames, padding and keyed downsampling (paper §3.2, Eq. 2).

The one copy of this code: the service, the command line and the training all cut their patches here. The work itself is
compiled (`_native.cpp`, docs/adr/0002-compiled-patches.md); this module prepares the index and says what the arrays
mean.

Four properties hold and are tested:

* the patch turns, moves and scales with the cloud, because the frame's signs come from the patch itself and the random
  choice is keyed to `stable_ids`, which know nothing of orientation, origin, scale or row order;
* nothing depends on batches, threads or the order of the input rows;
* where a ball holds thousands of points, patch and frame are made from a share of them that is the same for all its
  neighbours (at least 1024, at least four times the patch's length): what a point costs does not grow with the density;
* a patch of n points may be written at any length >= n: the rest is padded with the origin, which is the centre point.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pointfilter import _native
from pointfilter.errors import ParameterError

CELLS_PER_RADIUS = 2  # measured: 1 visits twice the candidates, 3 looks up twice the rows of cells
MAX_CELLS_PER_AXIS = 2**20  # three of them fit the 63 bits of a cell's key

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
UInt64 = NDArray[np.uint64]


@dataclass(frozen=True)
class Patches:
    """A batch of patches in their own frames, in units of the radius.

    points: (B, N, 3) float32, centred, rotated, divided by r, padded with zeros.
    frames: (B, 3, 3) float64, the rotations R; the rows are the x, y and z axis of the patch.
    counts: (B,) int64, neighbours that the points were chosen from, the centre included.
    """

    points: Float32
    frames: Float64
    counts: Int64


class NeighbourIndex:
    """A grid over a cloud that answers "who is closer than r" for one fixed r.

    points: (n, 3) float64, finite. radius: r > 0, same unit. ids: (n,) uint64, one a point (`stable_ids`).

    The points are kept sorted by (cell, mixed id); `order[k]` is the row in `points` of the k-th one. Centres that come
    in this order are answered fastest.
    """

    def __init__(self, points: Float64, radius: float, ids: UInt64) -> None:
        if not (np.isfinite(radius) and radius > 0):
            raise ParameterError(f"radius must be a finite number above 0, got {radius!r}")
        self.radius = float(radius)
        low = points.min(axis=0) if len(points) else np.zeros(3)
        extent = float(np.max(points.max(axis=0) - low)) if len(points) else 0.0
        edge = self.radius / CELLS_PER_RADIUS
        if extent > edge * (MAX_CELLS_PER_AXIS - 1):
            low, edge = _huge_grid(points, low, extent, edge)
        cells = np.clip(np.floor((points - low) / edge), 0, MAX_CELLS_PER_AXIS - 1).astype(np.int64)
        shape = (cells.max(axis=0) + 1) if len(points) else np.ones(3, dtype=np.int64)
        keys = (cells[:, 2] * shape[1] + cells[:, 1]) * shape[0] + cells[:, 0]
        self.order: Int64 = np.lexsort((_mixed(ids), keys)).astype(np.int64)
        cell_keys, cell_starts = np.unique(keys[self.order], return_index=True)
        self._arrays = (
            np.ascontiguousarray(points[self.order].T),
            np.ascontiguousarray(ids[self.order]),
            cell_keys.astype(np.int64),
            np.append(cell_starts, len(points)).astype(np.int64),
            np.array([*low, edge], dtype=np.float64),
            shape.astype(np.int64),
        )

    def count(self, centres: Float64, enough: int = sys.maxsize) -> Int64:
        """How many points lie closer than r to each of the (q, 3) float64 centres: (q,) int64, none above `enough`."""
        counts = np.empty(len(centres), dtype=np.int64)
        _native.count_neighbours(self._arrays, np.ascontiguousarray(centres), self.radius, enough, counts)
        return counts

    def sample(self, centres: Float64, centre_ids: UInt64, length: int, key: int) -> tuple[Int64, Int64]:
        """Rows of at most `length` neighbours of each centre, chosen by key where there are more.

        Returns (rows (q, length) int64, filled with -1; counts (q,) int64 of the neighbours to choose from).
        """
        positions = np.empty((len(centres), length), dtype=np.int64)
        counts = np.empty(len(centres), dtype=np.int64)
        _native.sample_neighbours(
            self._arrays, np.ascontiguousarray(centres), centre_ids, self.radius, key, positions, counts
        )
        return np.where(positions >= 0, self.order[positions], -1), counts

    def patches(self, centres: Float64, centre_ids: UInt64, length: int, key: int) -> Patches:
        """The patches of (q, 3) float64 centres, each `length` points long (Eq. 2; frames see all neighbours).

        A patch with more neighbours keeps a random choice of them, the centre always among them; the choice depends on
        `key` and on the ids of centre and neighbour, and on nothing else.
        """
        points = np.empty((len(centres), length, 3), dtype=np.float32)
        frames = np.empty((len(centres), 3, 3), dtype=np.float64)
        counts = np.empty(len(centres), dtype=np.int64)
        _native.build_patches(
            self._arrays, np.ascontiguousarray(centres), centre_ids, self.radius, key, points, frames, counts
        )
        return Patches(points, frames, counts)

    def averages(self, vectors: Float64, first: int, last: int, enough: int) -> tuple[Float64, Float64, Int64]:
        """Means over the balls around the points at the positions first to last (exclusive) of `order`.

        vectors: (n, 3) float64, one a point, C-contiguous and in the order of `order`. Of a ball that holds many more
        than `enough` points a share is looked at, as for a patch.
        Returns the mean vector (q, 3) and the mean of the squared lengths (q,), float64, and how many points it was of
        (q,), int64.
        """
        count = last - first
        means, squares, counts = np.empty((count, 3)), np.empty(count), np.empty(count, dtype=np.int64)
        _native.mean_vectors(self._arrays, vectors, first, self.radius, enough, means, squares, counts)
        return means, squares, counts


def _huge_grid(points: Float64, low: Float64, extent: float, edge: float) -> tuple[Float64, float]:
    """Origin and edge of a grid over a cloud that more cells of this edge would span than there may be.

    Cells around the median, where few points lie beyond them: those share the outermost cells, and as many of them as
    the root of all do not cost more than the others. Else coarser cells.
    """
    around = np.median(points, axis=0) - edge * (MAX_CELLS_PER_AXIS / 2)
    beyond = ((points < around) | (points >= around + edge * MAX_CELLS_PER_AXIS)).any(axis=1).sum()
    return (around, edge) if beyond**2 <= len(points) else (low, extent / (MAX_CELLS_PER_AXIS - 1))


def _mixed(ids: UInt64) -> UInt64:
    """The native code's mix(id): Stafford's variant 13 of the MurmurHash3 finaliser."""
    values: UInt64 = ids ^ (ids >> np.uint64(30))
    values *= np.uint64(0xBF58476D1CE4E5B9)
    values ^= values >> np.uint64(27)
    values *= np.uint64(0x94D049BB133111EB)
    values ^= values >> np.uint64(31)
    return values


def stable_ids(points: Float64) -> UInt64:
    """Ids of (n, 3) float64 points that survive shuffling, rotation, translation and scaling: (n,) uint64.

    The rank of the point by its distance from the centroid, ties by coordinates; points at the same place share an id.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.uint64)
    centroid = np.sort(points, axis=0).sum(axis=0) / len(points)  # sorted: the sum must not depend on the row order
    distances = np.square(points - centroid).sum(axis=1)
    order = np.argsort(distances, kind="stable")
    if np.any(np.diff(distances[order]) == 0):
        order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], distances))
    fresh = np.any(np.diff(points[order], axis=0) != 0, axis=1)
    ids = np.empty(len(points), dtype=np.uint64)
    ids[order] = np.concatenate([[0], np.cumsum(fresh)]).astype(np.uint64)
    return ids


def sample_rows(ids: UInt64, count: int, seed: int) -> Int64:
    """Rows of at most `count` points, drawn by their (n,) ids, so that neither row order nor pose has a say."""
    return np.random.default_rng(seed).choice(np.argsort(ids, kind="stable"), min(count, len(ids)), replace=False)


def sampling_key(seed: int, iteration: int) -> int:
    """The 64-bit key of one iteration's downsampling."""
    return int(np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint64)[0])


def length_buckets(counts: Int64, longest: int, step: int = 32) -> Iterator[tuple[int, Int64]]:
    """Groups patches by the length they need: yields (length, positions) with lengths rounded up to `step`.

    Evaluating a patch at its own length is exact (the padding is the centre point once more) and saves the rest.
    """
    lengths = np.minimum(-(-counts // step) * step, longest)
    for length in np.unique(lengths):
        yield int(length), np.flatnonzero(lengths == length)
