"""Which patches answer for which points, and what a point takes of their answers (docs/adr/0020)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.grids import Grids
from pointfilter.patches import UInt64, mixed

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

ANSWERS = 4  # of patches, that a point takes the mean of: more cost time and change little


@dataclass(frozen=True, eq=False)
class Queries:
    """What is asked of the patches of one pass. centres: (c,), the points in their middles, ascending. rows: (m,), the
    points that they answer for, patch after patch. sizes: (c,), how many of them each. own: (n,), for each point the
    centre of the patch that answers for it in any case, -1 for a point that is not asked about."""

    centres: Int64
    rows: Int64
    sizes: Int64
    own: Int64

    @classmethod
    def one_each(cls, rows: Int64, count: int) -> Queries:
        """Each of the points `rows` (q,), ascending, of `count` in all has a patch of its own."""
        own = np.full(count, -1)
        own[rows] = rows
        return cls(rows, rows, np.ones(len(rows), dtype=np.int64), own)

    @classmethod
    def shared(
        cls,
        grids: Grids,
        rows: Int64,
        radii: Float64,
        keys: UInt64,
        pass_key: int,
        reach: float,
        threads: int,
        check: Callable[[], None],
    ) -> Queries:
        """A patch answers for the points within `reach` of its radius, a point asks its own and about ANSWERS of those
        that reach it. keys: (n,), of the points; pass_key: mixed with them, so that each pass has other patches."""
        own = np.full(len(grids.points), -1)
        own[rows] = patch_centres(grids, rows, radii, mixed(keys ^ np.uint64(pass_key)), reach, threads, check)
        centres = np.unique(own[rows])
        asked, sizes = reached(grids.points, rows, centres, radii, reach, threads)
        asked, sizes = thinned(asked, centres, sizes, own, keys)
        return cls(centres, asked, sizes, own)


class Means:
    """Means of the answers for each of n points: of steps, and of logarithms of errors where there are any.

    Sums are whole numbers of 2⁻⁴⁰ of the point's radius, which float64 adds exactly: their order does not matter.
    """

    def __init__(self, radii: Float64) -> None:
        self._units = np.where(np.isfinite(radii), radii, 1.0) * 2.0**-40
        self._sums = np.zeros((len(radii), 5))
        self._counts = np.zeros(len(radii), dtype=np.int64)
        self._log_errors = False
        self._lock = threading.Lock()

    def add(self, rows: Int64, steps: Float64, log_errors: Float64 | None) -> None:
        """Takes (m, 3) steps and (m, 2) logarithms of errors, in the unit of the radii, for the points `rows` (m,)."""
        values = np.zeros((len(rows), 5))
        values[:, :3] = np.round(steps / self._units[rows, None])
        if log_errors is not None:
            values[:, 3:] = np.round(log_errors * 2.0**40)
        with self._lock:
            np.add.at(self._sums, rows, values)
            np.add.at(self._counts, rows, 1)
            self._log_errors |= log_errors is not None

    def of(self, rows: Int64) -> tuple[Float64, Float64 | None]:
        """The means (m, 3) and (m, 2); NaN for a point without answers."""
        with np.errstate(invalid="ignore"):
            means = self._sums[rows] / self._counts[rows, None]
        return means[:, :3] * self._units[rows, None], means[:, 3:] * 2.0**-40 if self._log_errors else None


def patch_centres(
    grids: Grids,
    rows: Int64,
    radii: Float64,
    keys: UInt64,
    reach: float,
    threads: int,
    check: Callable[[], None],
) -> Int64:
    """For the points `rows` (q,): the row of a point whose patch answers for it, itself or one close by.

    It is the point with the smallest key in a ball of `reach` times the point's own radius; where that lies beyond
    `reach` of the centre's radius, the point is its own centre.
    """
    owners = grids.smallest_key(rows, reach * radii[rows], keys, threads, check)
    distances = np.linalg.norm(grids.points[rows] - grids.points[owners], axis=1)
    return np.where(distances <= reach * radii[owners], owners, rows)


def reached(
    points: Float64, rows: Int64, centres: Int64, radii: Float64, reach: float, threads: int
) -> tuple[Int64, Int64]:
    """Which of the points `rows` (q,) lie within `reach` of the radius of each of the points `centres` (c,).

    Returns their rows, centre after centre, and how many each centre has: (c,).
    """
    tree = cKDTree(points[rows])
    far = reach * radii[centres]
    lists = tree.query_ball_point(points[centres], far * (1 + 1e-9), workers=threads)  # which checks boxes of points
    sizes = np.fromiter(map(len, lists), np.int64, len(lists))
    found = rows[np.fromiter(chain.from_iterable(lists), np.int64, int(sizes.sum()))]
    centre = np.repeat(np.arange(len(centres)), sizes)
    near = np.linalg.norm(points[found] - points[centres[centre]], axis=1) <= far[centre]
    return found[near], np.bincount(centre[near], minlength=len(centres))


def thinned(rows: Int64, centres: Int64, sizes: Int64, nearest: Int64, keys: UInt64) -> tuple[Int64, Int64]:
    """Leaves about ANSWERS of the patches that each point asks, always the one in `nearest` (n,).

    rows: (m,), the points that the patches around `centres` (c,) answer for, `sizes` (c,) of them each; the same is
    returned. Whether a pair of point and centre stays depends on their keys (n,) alone.
    """
    centre = np.repeat(centres, sizes)
    wanted = ANSWERS / np.bincount(rows, minlength=len(keys))[rows]
    stays = (mixed(keys[rows] ^ mixed(keys[centre])) <= wanted * 2.0**64) | (centre == nearest[rows])
    return rows[stays], np.add.reduceat(stays.astype(np.int64), np.cumsum(sizes) - sizes)
