"""What the classic filters share: points of any place and size come to them on a unit diagonal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.noise import bounding_box_diagonal

Float64 = NDArray[np.float64]

FEWEST_POINTS = 10  # fewer distinct points stay as they are: no surface to fit (and CGAL's jets crash on one)
MST_NEIGHBOURS = 12  # in the graph along which normals are oriented


def on_unit_cloud(smooth: Callable[..., Float64], points: Float64, *more: Any) -> Float64:
    """Calls smooth with the distinct points, moved and scaled to a diagonal of 1, and undoes all that.

    What smooth leaves non-finite, and clouds of fewer than FEWEST_POINTS distinct points, stay as they are.
    """
    diagonal = bounding_box_diagonal(points)
    if not (0 < diagonal < np.inf):
        return points.copy()
    low = points.min(axis=0)
    distinct, back = np.unique((points - low) / diagonal, axis=0, return_inverse=True)
    if len(distinct) < FEWEST_POINTS:
        return points.copy()
    order = cKDTree(distinct).indices  # neighbours in space become neighbours in memory
    moved = np.empty_like(distinct)
    moved[order] = smooth(distinct[order], *more)
    moved = np.where(np.isfinite(moved).all(axis=1, keepdims=True), moved, distinct)
    result: Float64 = moved[back.reshape(-1)] * diagonal + low
    return result
