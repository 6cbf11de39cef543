"""How large a cloud is, whatever a few stray points say (docs/adr/0016-stray-points.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pointfilter.noise import bounding_box_diagonal
from pointfilter.patches import NeighbourIndex, sample_rows, stable_ids

Float64 = NDArray[np.float64]

OUTER_SHARE = 0.01  # of the points, at either end of each axis: between them lies the core
MARGIN = 0.05  # of the core's diagonal: a point so far outside the core may be a stray one
REACH = 0.1  # of the core's diagonal: so far away its neighbours are counted
LONELY = 0.05  # of the neighbours that points have in the median: a point with fewer is a stray one
COUNTED = 1_024  # points that the median is taken of
HARMLESS = 0.8  # of the bounding box's diagonal: stray points that stretch it by less are what noise does, too


def stray(points: Float64) -> NDArray[np.bool_]:
    """Which of the (n, 3) finite points lie far outside all others with hardly any around them: (n,) bool.

    They are at most 2 % of the points along each axis. The answer depends neither on row order nor on scale.
    """
    outer = int(np.ceil(OUTER_SHARE * len(points)))
    if 2 * outer >= len(points):
        return np.zeros(len(points), dtype=np.bool_)
    low, high = np.partition(points, [outer, len(points) - 1 - outer], axis=0)[[outer, len(points) - 1 - outer]]
    core = float(np.linalg.norm(high - low))
    outside: NDArray[np.bool_] = ((points < low - MARGIN * core) | (points > high + MARGIN * core)).any(axis=1)
    if not outside.any() or core == 0:
        return np.zeros(len(points), dtype=np.bool_)
    ids = stable_ids(points)
    index = NeighbourIndex(points, REACH * core, ids)
    few = LONELY * float(np.median(index.count(points[sample_rows(ids, COUNTED, seed=0)])))
    outside[outside] = index.count(points[outside], enough=int(few) + 1) < few
    return outside


def extent(points: Float64) -> float:
    """Diagonal of the bounding box of the (n, 3) points; without the stray ones where they stretch it much.

    inf beyond doubles.
    """
    diagonal = bounding_box_diagonal(points)
    if not (np.isfinite(diagonal) and diagonal > 0):
        return diagonal
    without = bounding_box_diagonal(points[~stray(points)])
    return without if without < HARMLESS * diagonal else diagonal
