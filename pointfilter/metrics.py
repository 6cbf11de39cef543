"""Metrics of §4.3: Chamfer distance, MSE, point-to-surface.

All are reported for a clean model scaled to a bounding-box diagonal of 1: `normalised` does that to both clouds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.noise import bounding_box_centre, bounding_box_diagonal

Float64 = NDArray[np.float64]

MSE_NEIGHBOURS = 10  # M in Eq. 9
FIRST_TRIANGLES = 4  # of a size, asked for at each point; then GROWTH times as many
GROWTH = 3
PAIRS_AT_ONCE = 1_000_000  # of point and triangle, held in memory


def normalised(clean: Float64, *others: Float64) -> tuple[Float64, ...]:
    """All clouds, (n, 3) each, moved and scaled by the one transformation that gives `clean` a diagonal of 1."""
    centre, diagonal = bounding_box_centre(clean), bounding_box_diagonal(clean)
    return tuple((points - centre) / diagonal for points in (clean, *others))


def chamfer_distance(clean: Float64, filtered: Float64) -> float:
    """Mean squared distance to the nearest point, clean -> filtered plus filtered -> clean (Eq. 10). Unit²."""
    forward, _ = cKDTree(filtered).query(clean, workers=-1)
    backward, _ = cKDTree(clean).query(filtered, workers=-1)
    return float(np.square(forward).mean() + np.square(backward).mean())


def mean_square_error(clean: Float64, filtered: Float64, neighbours: int = MSE_NEIGHBOURS) -> float:
    """Eq. 9 as written: for every clean point, the mean squared distance to its M nearest filtered points. Unit²."""
    distances, _ = cKDTree(filtered).query(clean, k=neighbours, workers=-1)
    return float(np.square(distances).mean())


def mean_neighbour_distance(clean: Float64, filtered: Float64, neighbours: int = MSE_NEIGHBOURS) -> float:
    """What the paper's MSE table holds: for every filtered point, the mean distance to its M nearest clean points."""
    distances, _ = cKDTree(clean).query(filtered, k=neighbours, workers=-1)
    return float(distances.mean())


def point_to_surface(points: Float64, vertices: Float64, faces: NDArray[np.int64]) -> Float64:
    """Exact distance of each point to a triangle mesh: (n, 3), (v, 3), (f, 3) -> (n,) float64."""
    distances: Float64 = np.linalg.norm(points - closest_on_surface(points, vertices, faces), axis=1)
    return distances


def closest_on_surface(points: Float64, vertices: Float64, faces: NDArray[np.int64]) -> Float64:
    """The nearest place on a triangle mesh to each point: (n, 3), (v, 3), (f, 3) -> (n, 3) float64.

    Candidates come from trees over the triangles' centres, one tree a size of triangle, so that a few large triangles
    do not widen the search among the small ones; the nearest place itself is exact.
    """
    corners = vertices[faces]
    centres = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centres[:, None, :], axis=2).max(axis=1)
    best = np.full(len(points), np.inf)
    closest = np.zeros_like(points)
    far = np.zeros(len(points))  # distance of the farthest centre that was asked for

    def offer(rows: NDArray[np.int64], triangles: NDArray[np.int64]) -> None:
        """Takes over what these triangles (one a row, rows may repeat) have nearer than what is known."""
        places = closest_on_triangle(points[rows], corners[triangles])
        distances = np.linalg.norm(points[rows] - places, axis=1)
        order = np.lexsort((distances, rows))
        first = order[np.diff(rows[order], prepend=-1) != 0]
        better = first[distances[first] < best[rows[first]]]
        best[rows[better]] = distances[better]
        closest[rows[better]] = places[better]

    sizes = np.ceil(np.log2(np.maximum(reach, reach.max() * 1e-6 + 1e-300)))
    names, counts = np.unique(sizes, return_counts=True)
    for size in names[
        np.argsort(-counts)
    ]:  # where most of the surface is, most points end; then little is left to look at
        group = np.flatnonzero(sizes == size)
        tree = cKDTree(centres[group])
        largest = reach[group].max()
        rows, asked = np.arange(len(points)), 0
        while len(rows) and asked < len(group):  # more and more of the nearest centres, where they can still matter
            wanted = min(max(FIRST_TRIANGLES, GROWTH * asked), len(group))
            for part in np.array_split(rows, -(-len(rows) * wanted // PAIRS_AT_ONCE)):
                distances, found = tree.query(points[part], k=np.arange(asked + 1, wanted + 1), workers=-1)
                row, column = np.nonzero(distances - reach[group[found]] < best[part, None])
                offer(part[row], group[found[row, column]])
                far[part] = distances[:, -1]
            rows, asked = rows[far[rows] - largest < best[rows]], wanted
    return closest


def closest_on_triangle(points: Float64, corners: Float64) -> Float64:
    """The nearest place on triangle k to point k: (n, 3), (n, 3, 3) -> (n, 3). A degenerate triangle is its edges."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normals = np.cross(b - a, c - a)
    squared = _dot(normals, normals)
    inside = squared > 0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= _dot(np.cross(q - p, points - p), normals) >= 0
    height = _dot(points - a, normals) / np.where(inside, squared, 1.0)
    places = points - height[:, None] * normals
    best = np.where(inside, 0.0, np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        on_edge = _closest_on_segment(points, p, q)
        distance = _dot(points - on_edge, points - on_edge)
        nearer = distance < best
        places[nearer], best[nearer] = on_edge[nearer], distance[nearer]
    return places


def _dot(a: Float64, b: Float64) -> Float64:
    product: Float64 = np.einsum("nd,nd->n", a, b)
    return product


def _closest_on_segment(points: Float64, start: Float64, end: Float64) -> Float64:
    along = end - start
    length = _dot(along, along)
    t = _dot(points - start, along) / np.where(length > 0, length, 1.0)
    place: Float64 = start + np.clip(t, 0, 1)[:, None] * along
    return place
