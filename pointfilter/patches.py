"""Patches: neighbourhoods, PCA frames, padding and keyed downsampling (paper §3.2, Eq. 2).

The one copy of this code: the service, the command line and the training all cut their patches here. The work itself is
compiled (`_native.cpp`, docs/adr/0002-compiled-patches.md); this module prepares the index and says what the arrays
mean.

Four properties hold and are tested:

* a patch turns, moves and scales with the cloud: the frame's signs come from the patch itself, and which neighbours a
  full patch keeps depends on their distances;
* nothing depends on batches, threads or the order of the input rows;
* a patch depends on the points in its ball and on nothing else in the cloud;
* a patch of n points may be written at any length >= n: the rest is padded with the origin, which is the centre point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pointfilter import _native
from pointfilter.errors import ParameterError

EMPTY_CELLS = 64  # a wider gap between cells along an axis is narrowed to this many; more than a ball may reach
SMALLEST_RADIUS = 1e-150  # its square is still a number
MAX_REACH = 63  # edges of a cell: no ball may be larger (kMaxReach in the native code)
MAX_CELLS_PER_AXIS = 2**20  # three of them fit the 63 bits of a cell's key
LARGEST_CELL = 2.0**50  # number of a cell before gaps are narrowed: exact in double precision

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
UInt64 = NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Patches:
    """A batch of patches in their own frames, in units of their radii.

    points: (B, N, 3) float32, centred, rotated, divided by r, padded with zeros.
    frames: (B, 3, 3) float64, the rotations R; the rows are the x, y and z axis of the patch.
    counts: (B,) int64, points in the ball, the centre included; the patch holds at most N of them.
    radii: (B,) float64, r in the unit of the cloud.
    """

    points: Float32
    frames: Float64
    counts: Int64
    radii: Float64


class NeighbourIndex:
    """A grid over a cloud that answers which points lie within a given distance of one of them.

    points: (n, 3) float64, finite. edge: of a cell, in the same unit, larger where the cloud would have too many cells;
    balls of one to four edges are answered fastest, those of more than MAX_REACH edges not at all.

    The points are kept sorted by cell, then by coordinates; `order[k]` is the row in `points` of the k-th one,
    `positions` the inverse, and centres that come in this order are answered fastest. Cells are anchored at the origin
    of the coordinates, so that a piece of a cloud is sorted as the whole.
    """

    def __init__(self, points: Float64, edge: float) -> None:
        if not (np.isfinite(edge) and edge > 0):
            raise ParameterError(f"the edge of a cell must be a finite number above 0, got {edge!r}")
        self.edge, cells = _cells(points, float(edge))
        shape = (cells.max(axis=0) + 1) if len(points) else np.ones(3, dtype=np.int64)
        keys = (cells[:, 2] * shape[1] + cells[:, 1]) * shape[0] + cells[:, 0]
        self.order: Int64 = np.lexsort((points[:, 2], points[:, 1], points[:, 0], keys)).astype(np.int64)
        self.positions: Int64 = np.empty(len(points), dtype=np.int64)
        self.positions[self.order] = np.arange(len(points))
        cell_keys, cell_starts = np.unique(keys[self.order], return_index=True)
        self._arrays = (
            np.ascontiguousarray(points[self.order].T),
            cell_keys.astype(np.int64),
            np.append(cell_starts, len(points)).astype(np.int64),
            np.array([self.edge]),
            shape.astype(np.int64),
        )

    def patches(self, rows: Int64, radii: Float64, length: int, key: int) -> Patches:
        """The patches around the points `rows` (q,) with radii (q,), each `length` points long (Eq. 2).

        Frames see all neighbours. A patch with more of them keeps a random choice, the centre always among them; the
        choice depends on `key` (64 bits) and on the distances of the neighbours, and on nothing else.
        """
        points = np.empty((len(rows), length, 3), dtype=np.float32)
        frames = np.empty((len(rows), 3, 3), dtype=np.float64)
        counts = np.empty(len(rows), dtype=np.int64)
        radii = np.ascontiguousarray(radii, dtype=np.float64)
        _native.build_patches(self._arrays, self.positions[rows], radii, key, points, frames, counts)
        return Patches(points, frames, counts, radii)

    def ball_radii(self, rows: Int64, sizes: Int64, guesses: Float64) -> Float64:
        """Radii (q, L) of the balls around the points `rows` (q,) that hold `sizes` (q, L) points each.

        Such a ball ends midway (of the squares) between its last point and the next one; where these are equally far
        away, it holds both. inf where the cloud has no more points than that, or where the ball would be larger than
        the grid answers. guesses: (q,) radii to start with.
        """
        radii = np.empty(sizes.shape)
        guesses = np.ascontiguousarray(guesses, dtype=np.float64)
        _native.ball_radii(self._arrays, self.positions[rows], guesses, np.ascontiguousarray(sizes), radii)
        return radii

    def smallest_key(self, rows: Int64, radii: Float64, keys: UInt64) -> Int64:
        """For the points `rows` (q,): the row of the point with the smallest key within radii (q,). keys: (n,), in
        the order of `order`."""
        owners = np.empty(len(rows), dtype=np.int64)
        radii = np.ascontiguousarray(radii, dtype=np.float64)
        _native.smallest_key(self._arrays, self.positions[rows], radii, keys, owners)
        return self.order[owners]


def _cells(points: Float64, edge: float) -> tuple[float, Int64]:
    """The edge, and the cells (n, 3) of the points along each axis from 0 on.

    The edge is doubled until there are at most MAX_CELLS_PER_AXIS: a few points that lie far closer together than all
    others must not make the grid large.
    """
    largest = float(np.abs(points).max(initial=0.0))
    while edge * LARGEST_CELL < largest:
        edge *= 2
    while True:
        cells = np.stack([_narrowed(np.floor(points[:, axis] / edge)) for axis in range(3)], axis=1)
        if cells.max(initial=0) < MAX_CELLS_PER_AXIS:
            return edge, cells
        edge *= 2


def _narrowed(cells: Float64) -> Int64:
    """Cell numbers along one axis from 0 on, with gaps wider than EMPTY_CELLS narrowed: a few points far away must not
    make the grid large."""
    names, inverse = np.unique(cells, return_inverse=True)
    steps = np.minimum(np.diff(names, prepend=names[:1]), EMPTY_CELLS)
    narrowed: Int64 = np.cumsum(steps).astype(np.int64)[inverse]
    return narrowed


def sampling_key(seed: int, iteration: int) -> int:
    """The 64-bit key of one iteration's downsampling."""
    return int(np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint64)[0])


def mixed(values: UInt64) -> UInt64:
    """Stafford's variant 13 of the MurmurHash3 finaliser, as in the native code: (n,) uint64 to (n,) uint64."""
    values = values ^ (values >> np.uint64(30))
    values *= np.uint64(0xBF58476D1CE4E5B9)
    values ^= values >> np.uint64(27)
    values *= np.uint64(0x94D049BB133111EB)
    values ^= values >> np.uint64(31)
    return values
