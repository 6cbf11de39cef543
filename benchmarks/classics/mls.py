"""Moving least squares and their robust kin, written here in NumPy.

The Point Cloud Library, whose method the first follows, has no Python package that installs on Python 3.11.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from benchmarks.classics.unit import MST_NEIGHBOURS, Float64, on_unit_cloud

PAIRS_AT_ONCE = 1_500_000  # of neighbours held in memory
QUADRIC = 6  # coefficients of a polynomial of order 2 in two variables


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
        return on_unit_cloud(self._smooth, points)

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
        return on_unit_cloud(self._smooth, points)

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
