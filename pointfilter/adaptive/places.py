"""The distinct places of a cloud: rows at one place share one patch and one answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.patches import UInt64, mixed

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

PLACEHOLDER_ROWS = 16  # at one place, and so many times as many as at its neighbours: no measurement, as 0 0 0 is
NEIGHBOURS = 24  # whose distances make a point's key, and whose number of rows is looked at
KEY_STEPS = 2**12  # of a squared distance relative to that of the farthest neighbour
ROWS_AT_ONCE = 65_536


@dataclass(frozen=True, eq=False)
class Places:
    """points: (p, 3) float64, the distinct places without placeholders. rows: (n,) int64, the place of each row of the
    cloud, -1 for a placeholder's rows."""

    points: Float64
    rows: Int64

    @property
    def placeholder_rows(self) -> int:
        return int((self.rows < 0).sum())


def distinct_places(points: Float64) -> Places:
    """The places of (n, 3) finite points. A place that holds many more rows than its surroundings is a placeholder."""
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0]))
    fresh = np.ones(len(points), dtype=bool)
    fresh[1:] = np.any(np.diff(points[order], axis=0) != 0, axis=1)
    rows = np.empty(len(points), dtype=np.int64)
    rows[order] = np.cumsum(fresh) - 1
    first = order[fresh]
    places, counts = points[first], np.diff(np.flatnonzero(np.append(fresh, True)))
    crowded = np.flatnonzero(counts >= PLACEHOLDER_ROWS)
    if len(crowded) and len(places) > 1:
        _, near = cKDTree(places).query(places[crowded], k=np.arange(2, min(NEIGHBOURS + 1, len(places)) + 1))
        usual = np.median(counts[near], axis=1)
        held = np.zeros(len(places), dtype=bool)
        held[crowded] = counts[crowded] >= PLACEHOLDER_ROWS * usual
        numbers = np.where(held, -1, np.cumsum(~held) - 1)
        places, rows = places[~held], numbers[rows]
    return Places(places, rows)


def neighbourhood_keys(points: Float64, threads: int = 1) -> tuple[UInt64, Float64]:
    """A random key (n,) uint64 for each point, and its distance (n,) to the farthest of NEIGHBOURS neighbours.

    The keys are hashes of the neighbours' relative distances: neither a motion nor a change of scale changes them. The
    distance is inf where the cloud has fewer neighbours.
    """
    tree = cKDTree(points)
    keys, reach = np.empty(len(points), dtype=np.uint64), np.empty(len(points))
    wanted = np.arange(2, NEIGHBOURS + 2)
    for start in range(0, len(points), ROWS_AT_ONCE):
        distances, _ = tree.query(points[start : start + ROWS_AT_ONCE], k=wanted, workers=threads)
        farthest = distances[:, -1]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            steps = np.square(distances[:, [0, 1, 3, 7, 15]] / farthest[:, None]) * KEY_STEPS
        key = np.zeros(len(distances), dtype=np.uint64)
        for column in np.nan_to_num(steps, nan=0.0, posinf=0.0).astype(np.uint64).T:
            key = mixed(key * np.uint64(0x9E3779B97F4A7C15) + column)
        keys[start : start + ROWS_AT_ONCE] = key
        reach[start : start + ROWS_AT_ONCE] = farthest
    return keys, reach
