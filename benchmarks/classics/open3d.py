"""The smoothing filters of Open3D, from version 0.20 (`pip install open3d-cpu`). It is imported when one is called."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks.classics.unit import Float64, on_unit_cloud


class _Smoothing:
    """One of Open3D's filters, called `iterations` times with the nearest `neighbours` points inside `radius`."""

    radius: float
    neighbours: int
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        return on_unit_cloud(self._smooth, points, import_module("open3d"))

    def _smooth(self, points: Float64, open3d: Any) -> Float64:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        search = open3d.geometry.KDTreeSearchParamHybrid(self.radius, self.neighbours)
        for _ in range(self.iterations):
            cloud = self._once(cloud, search)
        return np.array(cloud.points, np.float64)

    def _once(self, cloud: Any, search: Any) -> Any:
        raise NotImplementedError


@dataclass(frozen=True)
class Open3dMls(_Smoothing):
    """`PointCloud.smooth_mls`: every point goes to the weighted plane of its neighbours, again and again.

    The neighbours are weighted by exp(-d² / radius²).
    """

    radius: float
    neighbours: int
    iterations: int

    def _once(self, cloud: Any, search: Any) -> Any:
        return cloud.smooth_mls(search)


@dataclass(frozen=True)
class Open3dBilateral(_Smoothing):
    """`PointCloud.smooth_bilateral`: the mean of the neighbours, weighted by distance and by height over the plane.

    The normals are PCA's over the same neighbours.
    """

    radius: float
    neighbours: int
    spatial_sigma: float
    range_sigma: float
    iterations: int

    def _once(self, cloud: Any, search: Any) -> Any:
        cloud.estimate_normals(search)
        return cloud.smooth_bilateral(search, self.spatial_sigma, self.range_sigma)
