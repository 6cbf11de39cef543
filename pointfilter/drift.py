"""What a filter takes away on average, given back.

Noise has no preferred direction: what the passes took from the points of a small region must cancel out over it. What
does not cancel is the surface itself, pulled in at bends and together where it is thin, and is given back. The same
idea as in HC smoothing of meshes (Vollmer, Mencl, Müller, 1999), with a test in place of its two factors: only as much
is given back as the scatter in the region cannot explain (a shrinkage estimate: James and Stein, 1961).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pointfilter.patches import NeighbourIndex
from pointfilter.ranges import over_ranges

Float64 = NDArray[np.float64]

WINDOWS = (1.2, 0.8)  # radii of the regions, in units of the patch radius, one after the other
SIGNIFICANT = 8.0  # a squared mean below so many times its own variance is taken for chance
FEWEST = 12  # points of a region, fewer tell no scatter
ENOUGH = 2_048  # points of a region that are looked at, at least
POINTS_PER_TASK = 4_096


def without_drift(
    moved: Float64,
    original: Float64,
    ids: NDArray[np.uint64],
    radius: float,
    threads: int = 1,
    check: Callable[[], None] = lambda: None,
) -> Float64:
    """The filtered points with the drift of their regions taken back: (n, 3) float64, a new array.

    moved: (n, 3) float64, where the passes left the points. original: where they were before, row for row. ids: (n,)
    uint64, their stable_ids. radius: of the patches. A point that no pass moved stays where it is. check() is called
    between tasks, from this thread. The result depends neither on threads nor on the order of the rows.
    """
    movable = np.any(moved != original, axis=1)
    for window in WINDOWS:
        index = NeighbourIndex(moved, window * radius, ids)
        lost = np.ascontiguousarray((original - moved)[index.order])

        def drift(first: int, last: int, index: NeighbourIndex = index, lost: Float64 = lost) -> Float64:
            return _significant(*index.averages(lost, first, last, ENOUGH))

        back = np.empty_like(moved)
        back[index.order] = np.concatenate(over_ranges(drift, len(moved), POINTS_PER_TASK, threads, check))
        moved = np.where(movable[:, None], moved + back, moved)
    return moved


def _significant(means: Float64, squares: Float64, counts: NDArray[np.int64]) -> Float64:
    """The means (q, 3) shortened by what chance may have added to them."""
    lengths = np.square(means).sum(axis=1)  # squared
    variances = np.maximum(squares - lengths, 0) / np.maximum(counts - 1, 1)  # of the means
    sure = (counts >= FEWEST) & (lengths > SIGNIFICANT * variances)
    shares = np.zeros(len(means))
    shares[sure] = 1 - SIGNIFICANT * variances[sure] / lengths[sure]
    return shares[:, None] * means
