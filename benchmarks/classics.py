"""Classic point-cloud filters, tuned for the benchmark: what a learned filter has to beat.

    python -m benchmarks.classics --data DIR --tune RIMLS --noise 0.005     # an entry of SETTINGS and what is around it
    python -m benchmarks.classics --data DIR --tune "CGAL jet" --noise 0.01 --points 10000 --rounds 5

WLOP, bilateral smoothing and jet smoothing are CGAL's (`pip install cgal`). MLS follows the Point Cloud Library, which
has no Python package that installs on Python 3.11, and RIMLS follows its paper; both are written here, in NumPy. Each
method is a small frozen dataclass of its settings, called with (n, 3) float64 points. Lengths are fractions of the
bounding-box diagonal; `neighbours` counts points, where CGAL wants counts.

The settings are told the noise level and were tuned on clouds that the benchmark measures on: an advantage that these
methods have over a network, on purpose. DIR: the folder `paper4` of the data of `benchmarks.quality`.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from pointfilter.noise import bounding_box_diagonal

if TYPE_CHECKING:
    from benchmarks.subjects import Subject

Float64 = NDArray[np.float64]

FEWEST_POINTS = 10  # fewer distinct points stay as they are: no surface to fit (and CGAL's jets crash on one)
PAIRS_AT_ONCE = 1_500_000  # of neighbours held in memory
QUADRIC = 6  # coefficients of a polynomial of order 2 in two variables
MST_NEIGHBOURS = 12  # in the graph along which normals are oriented


# CGAL ---------------------------------------------------------------------------------------------------------------


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

        return _on_unit_cloud(self._smooth, points, wlop_simplify_and_regularize_point_set)

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

        return _on_unit_cloud(self._smooth, points, CGAL_Point_set_processing_3)

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

        return _on_unit_cloud(self._smooth, points, jet_smooth_point_set)

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


# Our own ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MovingLeastSquares:
    """Moving least squares as the Point Cloud Library does them by default: `pcl::MovingLeastSquares`, order 2.

    Alexa, Behr, Cohen-Or, Fleishman, Levin, Silva: Computing and Rendering Point Set Surfaces, 2003. Per point: the
    plane of the neighbours inside `radius` by PCA; over it a quadric by least squares, neighbours at distance d from
    the point's foot on the plane weighted by exp(-d² / gauss²); the point goes to the quadric's height above the foot
    (PCL's "simple" projection). PCL's own default for `gauss` is `radius`. With fewer than 6 neighbours the point goes
    to the plane, with fewer than 3 it stays (PCL drops it). For speed, a random choice of `samples` points stands for
    all of a larger cloud when neighbours are looked for.
    """

    radius: float
    gauss: float
    iterations: int
    samples: int = 100_000

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        return _on_unit_cloud(self._smooth, points)

    def _smooth(self, points: Float64) -> Float64:
        for _ in range(self.iterations):
            surface = _sample(points, self.samples)
            moments = _moments(surface)
            moved = points.copy()
            for rows, near in _neighbourhoods(cKDTree(surface), points, self.radius):
                moved[rows] = self._project(surface, moments, points[rows], near)
            points = moved
        return points

    def _project(self, surface: Float64, moments: Float64, queries: Float64, near: csr_matrix) -> Float64:
        means, axes = _planes(moments, near)
        normals = axes[:, :, 0]
        feet = queries - _dot(queries - means, normals)[:, None] * normals
        row = np.repeat(np.arange(len(queries)), np.diff(near.indptr))
        offsets = (surface[near.indices] - feet[row]) / self.radius
        w = np.exp(-_dot(offsets, offsets) * (self.radius / self.gauss) ** 2)
        height, u, v = (_dot(offsets, axes[row, :, axis]) for axis in range(3))

        def total(values: Float64) -> Float64:
            sums: Float64 = np.bincount(row, values, minlength=len(queries)).astype(np.float64)
            return sums

        exponents = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
        powers_u, powers_v = ([np.ones_like(u), t, t * t, t**3, t**4] for t in (u, v))
        sums = {(i, j): total(w * powers_u[i] * powers_v[j]) for i in range(5) for j in range(5 - i)}
        normal_matrix = np.empty((len(queries), QUADRIC, QUADRIC))
        for (a, (i, j)), (b, (k, m)) in itertools.product(enumerate(exponents), repeat=2):
            normal_matrix[:, a, b] = sums[i + k, j + m]
        right = np.stack([total(w * powers_u[i] * powers_v[j] * height) for i, j in exponents], axis=1)
        ridge = 1e-9 * np.trace(normal_matrix, axis1=1, axis2=2) + 1e-300
        normal_matrix += ridge[:, None, None] * np.eye(QUADRIC)
        rise = np.linalg.solve(normal_matrix, right[:, :, None])[:, 0, 0] * self.radius
        count = np.diff(near.indptr)
        places = feet + np.where(count >= QUADRIC, rise, 0.0)[:, None] * normals
        return np.where((count >= 3)[:, None], places, queries)


@dataclass(frozen=True)
class Rimls:
    """Robust implicit moving least squares on bilaterally filtered normals.

    Öztireli, Guennebaud, Gross: Feature Preserving Point Set Surfaces based on Non-Linear Kernel Regression, 2009,
    algorithm 1, with one `radius` of support for all points (`sigma_r` = 0.5 of it, as there). The normals: PCA over
    `normal_radius`, oriented along a minimum spanning tree (Hoppe et al., Surface Reconstruction from Unorganized
    Points, 1992), then `normal_passes` of a bilateral filter over `radius` with `normal_sigma` (as the Pointfilter
    paper prepares them for RIMLS). Angles enter as differences of unit normals. For speed, a random choice of
    `samples` points stands for the surface of a larger cloud; all points are projected.
    """

    radius: float
    normal_radius: float
    normal_sigma: float
    normal_passes: int
    sigma_n: float
    iterations: int
    samples: int = 100_000
    steps: int = 2  # projections onto the surface in one iteration
    refits: int = 2  # reweightings in one projection
    sigma_r: float = 0.5

    def __call__(self, points: Float64) -> Float64:
        """(n, 3) -> (n, 3), row for row."""
        return _on_unit_cloud(self._smooth, points)

    def _smooth(self, points: Float64) -> Float64:
        for _ in range(self.iterations):
            surface = _sample(points, self.samples)
            normals = oriented_normals(surface, self.normal_radius)
            for _ in range(self.normal_passes):
                normals = filtered_normals(surface, normals, self.radius, self.normal_sigma)
            offsets = _dot(surface, normals)
            columns = np.column_stack([np.ones(len(surface)), normals, offsets])
            more = [columns, surface, _products(normals, surface), offsets[:, None] * surface]
            columns_gradient = np.column_stack(more)
            places = points.copy()
            for _ in range(self.steps):
                for rows, near in _neighbourhoods(cKDTree(surface), places, self.radius):
                    places[rows] = self._project(places[rows], near, columns, columns_gradient)
            points = places
        return points

    def _project(self, x: Float64, near: csr_matrix, columns: Float64, columns_gradient: Float64) -> Float64:
        """One step x - f grad f. The sums of algorithm 1 are products of sparse (x, points) weights with columns."""
        row = np.repeat(np.arange(len(x)), np.diff(near.indptr))
        normals, offsets = columns[near.indices, 1:4], columns[near.indices, 4]
        closeness = np.maximum(1 - near.data / self.radius**2, 0.0)
        phi = closeness**4
        slope = -8 * closeness**3 / self.radius**2  # gradient of phi is slope · (x - p)
        f_pair = _dot(x[row], normals) - offsets
        alpha = np.ones_like(phi)
        f, gradient = np.zeros(len(x)), np.zeros_like(x)
        for refit in range(self.refits + 1):
            if refit:
                residual = (f_pair - f[row]) / (self.sigma_r * self.radius)
                turn = normals - gradient[row]
                alpha = np.exp(-(residual**2) - _dot(turn, turn) / self.sigma_n**2)
            weighted = _matrix(near, alpha * phi) @ columns
            sloped = _matrix(near, alpha * slope) @ columns_gradient
            weight = weighted[:, 0]
            held = weight > 1e-12
            scale = 1 / np.where(held, weight, 1.0)
            along = _dot(x, sloped[:, 1:4]) - sloped[:, 4]
            mixed = np.einsum("na,nab->nb", x, sloped[:, 8:17].reshape(-1, 3, 3)) - sloped[:, 17:20]
            f_new = (_dot(x, weighted[:, 1:4]) - weighted[:, 4]) * scale
            weight_gradient = sloped[:, :1] * x - sloped[:, 5:8]
            value_gradient = along[:, None] * x - mixed
            gradient_new = (value_gradient - f_new[:, None] * weight_gradient + weighted[:, 1:4]) * scale[:, None]
            f = np.where(held, f_new, f)
            gradient = np.where(held[:, None], gradient_new, gradient)
        step = f[:, None] * gradient
        length = np.linalg.norm(step, axis=1, keepdims=True)
        places: Float64 = x - step * np.minimum(1.0, self.radius / np.maximum(length, 1e-300))
        return places


def oriented_normals(points: Float64, radius: float) -> Float64:
    """Unit normals (n, 3) of (n, 3) points by PCA inside a radius, made consistent along a minimum spanning tree."""
    normals = np.empty_like(points)
    tree = cKDTree(points)
    moments = _moments(points)
    for rows, near in _neighbourhoods(tree, points, radius):
        normals[rows] = _planes(moments, near)[1][:, :, 0]
    n = len(points)
    _, nearest = tree.query(points, k=min(MST_NEIGHBOURS, n))
    row, column = np.repeat(np.arange(n), nearest.shape[1]), nearest.ravel()
    other = row != column
    row, column = row[other], column[other]
    weights = 1 - np.abs(_dot(normals[row], normals[column])) + 1e-6
    forest = minimum_spanning_tree(coo_matrix((weights, (row, column)), shape=(n, n)).tocsr()).tocoo()
    _, component = connected_components(forest, directed=False)
    highest = np.lexsort((-points[:, 2], component))
    roots = highest[np.diff(component[highest], prepend=-1) != 0]
    ends = np.concatenate([forest.row, np.full(len(roots), n)]), np.concatenate([forest.col, roots])
    rooted = coo_matrix((np.ones(len(ends[0])), ends), shape=(n + 1, n + 1)).tocsr()
    order, parents = breadth_first_order(rooted, n, directed=False)
    upward = np.vstack([normals, [0.0, 0.0, 1.0]])
    agrees = (_dot(normals, upward[parents[:n]]) >= 0).tolist()
    outward, parent = [True] * (n + 1), parents.tolist()
    for point in order[1:].tolist():
        outward[point] = outward[parent[point]] == agrees[point]
    consistent: Float64 = normals * np.where(outward[:n], 1.0, -1.0)[:, None]
    return consistent


def filtered_normals(points: Float64, normals: Float64, radius: float, sigma: float) -> Float64:
    """One pass of a bilateral filter over unit normals, (n, 3), (n, 3) -> (n, 3).

    Weights: exp(-(2 d / radius)²) for the distance d, exp(-(|difference of normals| / sigma)²). Jones, Durand, Zwicker:
    Normal Improvement for Point Rendering, 2004.
    """
    filtered = np.empty_like(normals)
    for rows, near in _neighbourhoods(cKDTree(points), points, radius):
        row = np.repeat(rows, np.diff(near.indptr))
        turn = 2 - 2 * _dot(normals[row], normals[near.indices])
        filtered[rows] = _matrix(near, np.exp(-4 * near.data / radius**2 - turn / sigma**2)) @ normals
    unit: Float64 = filtered / np.maximum(np.linalg.norm(filtered, axis=1, keepdims=True), 1e-300)
    return unit


def _on_unit_cloud(smooth: Callable[..., Float64], points: Float64, *more: Any) -> Float64:
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


def _sample(points: Float64, most: int) -> Float64:
    """At most so many of (n, 3) points, in order, the same in every run."""
    if len(points) <= most:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))]


def _neighbourhoods(tree: cKDTree, queries: Float64, radius: float) -> Iterator[tuple[NDArray[np.intp], csr_matrix]]:
    """Yields rows of queries and their sparse (rows, points of the tree) squared distances up to radius, in pieces."""
    counts = tree.query_ball_point(queries, radius, return_length=True)
    piece = np.cumsum(counts) // PAIRS_AT_ONCE
    for rows in np.split(np.arange(len(queries)), np.flatnonzero(np.diff(piece)) + 1):
        pairs = cKDTree(queries[rows]).sparse_distance_matrix(tree, radius, output_type="ndarray")
        yield rows, csr_matrix((np.square(pairs["v"]), (pairs["i"], pairs["j"])), shape=(len(rows), tree.n))


def _matrix(near: csr_matrix, weights: Float64) -> csr_matrix:
    return csr_matrix((weights, near.indices, near.indptr), shape=near.shape)


def _moments(points: Float64) -> Float64:
    """What `_planes` sums up: (n, 12), coordinates and their products."""
    return np.column_stack([points, _products(points, points)])


def _products(a: Float64, b: Float64) -> Float64:
    return (a[:, :, None] * b[:, None, :]).reshape(-1, 9)


def _planes(moments: Float64, near: csr_matrix) -> tuple[Float64, Float64]:
    """Means (m, 3) and principal axes (m, 3, 3), as columns from the least variance on, of m neighbourhoods."""
    count = np.maximum(np.diff(near.indptr), 1)[:, None]
    sums = _matrix(near, np.ones_like(near.data)) @ moments
    means = sums[:, :3] / count
    covariances = (sums[:, 3:] / count).reshape(-1, 3, 3) - means[:, :, None] * means[:, None, :]
    _, axes = np.linalg.eigh(covariances)
    return means, axes


def _dot(a: Float64, b: Float64) -> Float64:
    product: Float64 = np.einsum("nd,nd->n", a, b)
    return product


# Settings -----------------------------------------------------------------------------------------------------------

Filter = Wlop | BilateralSmoothing | JetSmoothing | MovingLeastSquares | Rimls

# Chosen for the least geometric mean of CD and P2F, relative to the noisy cloud's. 10 000 points: on fandisk and
# Tetrahedron, with `--tune` or from a grid by hand. 100 000 points: from a handful of candidates each, most of them
# tried on fandisk alone; at 1.5 % and 2.5 % WLOP, MLS and RIMLS are the least searched.
SETTINGS: dict[str, dict[tuple[float, int], Filter]] = {
    "CGAL WLOP": {
        (0.005, 100_000): Wlop(0.02, 10),
        (0.01, 100_000): Wlop(0.025, 10),
        (0.015, 100_000): Wlop(0.033, 8),
        (0.025, 100_000): Wlop(0.05, 6),
        (0.005, 10_000): Wlop(0.03, 20),
        (0.01, 10_000): Wlop(0.04, 20),
    },
    "CGAL bilateral": {
        (0.005, 100_000): BilateralSmoothing(180, 150, 15.0, 2),
        (0.01, 100_000): BilateralSmoothing(180, 150, 20.0, 3),
        (0.015, 100_000): BilateralSmoothing(300, 200, 25.0, 3),
        (0.025, 100_000): BilateralSmoothing(500, 300, 30.0, 3),
        (0.005, 10_000): BilateralSmoothing(50, 40, 11.0, 2),
        (0.01, 10_000): BilateralSmoothing(80, 64, 14.0, 2),
    },
    "CGAL jet": {
        (0.005, 100_000): JetSmoothing(50, 4),
        (0.01, 100_000): JetSmoothing(60, 8),
        (0.015, 100_000): JetSmoothing(90, 8),
        (0.025, 100_000): JetSmoothing(150, 8),
        (0.005, 10_000): JetSmoothing(25, 3),
        (0.01, 10_000): JetSmoothing(24, 6),
    },
    "MLS (PCL's method)": {
        (0.005, 100_000): MovingLeastSquares(0.022, 0.022, 1),
        (0.01, 100_000): MovingLeastSquares(0.028, 0.028, 1),
        (0.015, 100_000): MovingLeastSquares(0.04, 0.04, 1),
        (0.025, 100_000): MovingLeastSquares(0.065, 0.065, 1, 50_000),
        (0.005, 10_000): MovingLeastSquares(0.035, 0.022, 2),
        (0.01, 10_000): MovingLeastSquares(0.045, 0.029, 1),
    },
    "RIMLS": {
        (0.005, 100_000): Rimls(0.04, 0.025, 0.3, 3, 0.4, 1),
        (0.01, 100_000): Rimls(0.06, 0.035, 0.3, 4, 0.4, 1, 50_000),
        (0.015, 100_000): Rimls(0.07, 0.045, 0.3, 4, 0.4, 1, 50_000),
        (0.025, 100_000): Rimls(0.09, 0.06, 0.3, 4, 0.4, 1, 30_000),
        (0.005, 10_000): Rimls(0.06, 0.035, 0.2, 5, 0.3, 1),
        (0.01, 10_000): Rimls(0.08, 0.045, 0.3, 8, 0.3, 1),
    },
}
"""Method -> (noise level as a fraction of the diagonal, number of points) -> settings."""


def available() -> dict[str, str]:
    """Every method's name -> why it is missing here, or an empty string."""
    missing = "" if importlib.util.find_spec("CGAL") else "pip install cgal"
    return {method: missing if method.startswith("CGAL ") else "" for method in SETTINGS}


def tuned(method: str, noise: float, points: int) -> Filter:
    """The entry of SETTINGS nearest to a noise level and a number of points, both on a logarithmic scale."""

    def distance(key: tuple[float, int]) -> float:
        return math.hypot(math.log(key[0] / max(noise, 1e-6)), math.log(key[1] / max(points, 1)))

    entries = SETTINGS[method]
    return entries[min(entries, key=distance)]


def smooth(method: str, points: Float64, noise: float) -> Float64:
    """Filters (n, 3) points with noise of a level (a fraction of the diagonal), by the nearest tuned settings.

    Returns (n, 3) float64, row for row except for CGAL WLOP. Raises KeyError for a method that is not in `available()`,
    ImportError for one that is missing here.
    """
    return tuned(method, noise, len(points))(np.ascontiguousarray(points, np.float64))


# Tuning -------------------------------------------------------------------------------------------------------------

TUNING_CLOUDS = ("Tetrahedron", "fandisk_100K")
STEPS = {"sharpness_angle": 1.4, "normal_sigma": 1.4, "sigma_n": 1.4}  # factors down and up; of the others 1.25
FIXED = ("samples", "steps", "refits", "sigma_r")


def variations(settings: Filter) -> Iterator[Filter]:
    """Every setting alone, one step down and up: lengths and counts by a factor, iterations by one."""
    for name, value in asdict(settings).items():
        if name in FIXED:
            continue
        if name in ("iterations", "normal_passes"):
            stride = 1 if value < 8 else value // 2
            choices = [value - stride, value + stride] if value > 1 else [value + stride]
        else:
            factor = STEPS.get(name, 1.25)
            choices = [type(value)(value / factor), type(value)(value * factor)]
        for choice in choices:
            yield replace(settings, **{name: choice})


def tune(method: str, noise: float, points: int | None, folder: Path, rounds: int) -> None:
    """Prints the scores of the nearest tuned settings and of their variations; the best goes into the next round."""
    clouds = _tuning_clouds(folder, noise, points)
    noisy = [subject.scores(clean, cloud) for subject, clean, cloud in clouds]
    best = tuned(method, noise, len(clouds[0][2]))
    known: dict[Filter, float] = {}
    for _ in range(rounds):
        for settings in (best, *variations(best)):
            if settings not in known:
                scores = [subject.scores(clean, settings(cloud)) for subject, clean, cloud in clouds]
                known[settings] = _relative(scores, noisy)
                means = [float(np.mean([score[name] for score in scores])) for name in ("cd", "p2f")]
                print(f"{known[settings]:8.4f}  CD {means[0]:7.3f}  P2F {means[1]:7.3f}  {settings}", flush=True)
        previous, best = best, min(known, key=known.__getitem__)
        if best == previous:
            break
    print(f"best: {best}")


def _tuning_clouds(folder: Path, noise: float, points: int | None) -> list[tuple[Subject, Float64, Float64]]:
    from benchmarks.subjects import Column, load_clouds

    column = Column(f"tuning {noise:g} {points}", noise, points=points)
    chosen = [subject for subject in load_clouds(folder) if subject.name in TUNING_CLOUDS]
    return [(subject, *subject.clouds(column)) for subject in chosen]


def _relative(scores: list[dict[str, float]], noisy: list[dict[str, float]]) -> float:
    """Geometric mean over clouds and over CD and P2F of what is left of the noisy cloud's."""
    ratios = [after[name] / before[name] for after, before in zip(scores, noisy, strict=True) for name in ("cd", "p2f")]
    return math.exp(float(np.mean(np.log(ratios))))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.classics", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("POINTFILTER_BENCHMARK_DATA"))
    parser.add_argument("--tune", required=True, choices=list(SETTINGS), metavar="METHOD", help=", ".join(SETTINGS))
    parser.add_argument("--noise", type=float, default=0.005, help="level, a fraction of the diagonal (default: 0.005)")
    parser.add_argument("--points", type=int, help="of each cloud (default: all)")
    parser.add_argument("--rounds", type=int, default=1, help="how often to go on from the best (default: 1)")
    options = parser.parse_args(arguments)
    if options.data is None or not Path(options.data, "mesh").is_dir():
        print("no data: name a folder with clouds and mesh/ by --data or POINTFILTER_BENCHMARK_DATA", file=sys.stderr)
        return 2
    reason = available()[options.tune]
    if reason:
        print(f"{options.tune} is missing here: {reason}", file=sys.stderr)
        return 2
    tune(options.tune, options.noise, options.points, Path(options.data), options.rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
