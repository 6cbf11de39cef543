"""The smoothing filters of Open3D, from version 0.20 (`pip install open3d-cpu`). It is imported when one is called."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks.classics.unit import Float64, on_unit_cloud


@dataclass(frozen=True)
class Open3dMls:
    """`PointCloud.smooth_mls`: every point goes to the weighted plane of its neighbours, again and again.

    The neighbours are the nearest `neighbours` points inside `radius`, weighted by exp(-d² / radius²).
    """

    radius: float
    neighbours: int
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        return on_unit_cloud(self._smooth, points, import_module("open3d"))

    def _smooth(self, points: Float64, open3d: Any) -> Float64:
        cloud = _cloud(points, open3d)
        search = open3d.geometry.KDTreeSearchParamHybrid(self.radius, self.neighbours)
        for _ in range(self.iterations):
            cloud = cloud.smooth_mls(search)
        return np.array(cloud.points, np.float64)


@dataclass(frozen=True)
class Open3dBilateral:
    """`PointCloud.smooth_bilateral`: the mean of the neighbours, weighted by distance and by height over the plane.

    The neighbours are the nearest `neighbours` points inside `radius`; the normals are PCA's over the same ones.
    """

    radius: float
    neighbours: int
    spatial_sigma: float
    range_sigma: float
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        return on_unit_cloud(self._smooth, points, import_module("open3d"))

    def _smooth(self, points: Float64, open3d: Any) -> Float64:
        cloud = _cloud(points, open3d)
        search = open3d.geometry.KDTreeSearchParamHybrid(self.radius, self.neighbours)
        for _ in range(self.iterations):
            cloud.estimate_normals(search)
            cloud = cloud.smooth_bilateral(search, self.spatial_sigma, self.range_sigma)
        return np.array(cloud.points, np.float64)


def _cloud(points: Float64, open3d: Any) -> Any:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
