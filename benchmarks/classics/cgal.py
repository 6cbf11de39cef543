"""The classic filters of CGAL, by its Python package (`pip install cgal`). It is imported when one is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.classics.unit import MST_NEIGHBOURS, Float64, on_unit_cloud


@dataclass(frozen=True)
class Wlop:
    """CGAL's `wlop_simplify_and_regularize_point_set` with all points retained.

    Huang, Li, Zhang, Ascher, Cohen-Or: Consolidation of Unorganized Point Clouds for Surface Reconstruction, 2009.
    The points come back in an order of CGAL's own: row i is not row i of the input.
    """

    radius: float
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3)."""
        from CGAL.CGAL_Point_set_processing_3 import wlop_simplify_and_regularize_point_set

        return on_unit_cloud(self._smooth, points, wlop_simplify_and_regularize_point_set)

    def _smooth(self, points: Float64, wlop: Callable[..., None]) -> Float64:
        output = _point_set(points[:0])
        wlop(_point_set(points), output, 100.0, self.radius, self.iterations, False)
        return _points_of(output)


@dataclass(frozen=True)
class BilateralSmoothing:
    """CGAL's `bilateral_smooth_point_set` on PCA normals oriented along a minimum spanning tree.

    Huang, Wu, Gong, Cohen-Or, Ascher, Zhang: Edge-Aware Point Set Resampling, 2013, section 4. CGAL moves points and
    normals; the normals are estimated once, with `normal_neighbours`, and carried through the iterations.
    """

    neighbours: int
    normal_neighbours: int
    sharpness_angle: float  # degrees
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        from CGAL import CGAL_Point_set_processing_3

        return on_unit_cloud(self._smooth, points, CGAL_Point_set_processing_3)

    def _smooth(self, points: Float64, cgal: Any) -> Float64:
        most = len(points) - 1
        cloud = _point_set(points)
        cgal.pca_estimate_normals(cloud, min(self.normal_neighbours, most))
        cgal.mst_orient_normals(cloud, min(MST_NEIGHBOURS, most))
        cloud.cancel_removals()  # of the points that the tree did not reach
        for _ in range(self.iterations):
            cgal.bilateral_smooth_point_set(cloud, min(self.neighbours, most), 0.0, self.sharpness_angle)
        return _points_of(cloud)


@dataclass(frozen=True)
class JetSmoothing:
    """CGAL's `jet_smooth_point_set`, fitting quadrics.

    Cazals, Pouget: Estimating differential quantities using polynomial fitting of osculating jets, 2005.
    """

    neighbours: int
    iterations: int

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        from CGAL.CGAL_Point_set_processing_3 import jet_smooth_point_set

        return on_unit_cloud(self._smooth, points, jet_smooth_point_set)

    def _smooth(self, points: Float64, jet_smooth: Callable[..., None]) -> Float64:
        cloud = _point_set(points)
        for _ in range(self.iterations):
            jet_smooth(cloud, min(self.neighbours, len(points) - 1))
        return _points_of(cloud)


def _point_set(points: Float64) -> Any:
    """A CGAL Point_set_3 of (n, 3) points. Its binding has no destructor and says so at exit, unless disowned."""
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3

    cloud = Point_set_3()
    cloud.thisown = False
    for x, y, z in points.tolist():
        cloud.insert(Point_3(x, y, z))
    return cloud


def _points_of(cloud: Any) -> Float64:
    """(n, 3), in order of insertion: `cloud.points()` is in the order that orienting normals leaves."""
    rows = ((point.x(), point.y(), point.z()) for point in map(cloud.point, range(cloud.size())))
    return np.array(list(rows), np.float64).reshape(-1, 3)
