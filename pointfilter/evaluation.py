"""The paper's metrics of one cloud against another, as `pointfilter evaluate` and the benchmarks print them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.cloud import PointCloud
from pointfilter.errors import DegenerateCloudError, InputError, MalformedFileError
from pointfilter.metrics import (
    chamfer_distance,
    mean_neighbour_distance,
    mean_square_error,
    normalised,
    point_to_surface,
)
from pointfilter.noise import bounding_box_diagonal

Float64 = NDArray[np.float64]

PLANE_NEIGHBOURS = 16  # clean points that a plane is fitted to where there is no mesh


def evaluate(cloud: PointCloud, clean: PointCloud, mesh: Path | None = None) -> dict[str, float]:
    """CD ×1e5, both readings of MSE (docs/formats.md) and P2F ×1e3, for a clean cloud scaled to a diagonal of 1.

    P2F is exact against `mesh`; without one it is the distance to planes fitted to the clean cloud, named `P2F* x1e3`.
    Rows without finite coordinates do not count. Raises InputError, OSError.
    """
    for name, one in (("clean", clean), ("filtered", cloud)):
        if one.finite.sum() < PLANE_NEIGHBOURS:
            raise InputError(f"the {name} cloud has fewer than {PLANE_NEIGHBOURS} finite points")
    if not 0 < bounding_box_diagonal(clean.xyz[clean.finite]) < np.inf:
        raise DegenerateCloudError("the clean cloud has no extent, or none within double precision, to scale by")
    vertices, faces = read_mesh(mesh) if mesh is not None else (np.empty((0, 3)), None)
    clean_points, points, vertices = normalised(clean.xyz[clean.finite], cloud.xyz[cloud.finite], vertices)
    if faces is not None:
        to_surface = {"P2F x1e3": 1e3 * float(point_to_surface(points, vertices, faces).mean())}
    else:
        to_surface = {"P2F* x1e3": 1e3 * float(point_to_planes(points, clean_points).mean())}
    return {
        "CD x1e5": 1e5 * chamfer_distance(clean_points, points),
        "MSE x1e5": 1e5 * mean_square_error(clean_points, points),
        "paper's MSE x1e3": 1e3 * mean_neighbour_distance(clean_points, points),
        **to_surface,
    }


def point_to_planes(points: Float64, clean: Float64, neighbours: int = PLANE_NEIGHBOURS) -> Float64:
    """Distance of each of the (n, 3) points to the plane through the clean points around its nearest clean point: (n,).

    An estimate of the distance to the surface: it rounds sharp edges off, so it is a little too large there.
    """
    tree = cKDTree(clean)
    _, nearest = tree.query(points, workers=-1)
    used, inverse = np.unique(nearest, return_inverse=True)
    _, around = tree.query(clean[used], k=neighbours, workers=-1)
    patch = clean[around]
    centre = patch.mean(axis=1)
    spread = patch - centre[:, None, :]
    _, vectors = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread)
    offsets = points - centre[inverse]
    distances: Float64 = np.abs(np.einsum("nd,nd->n", offsets, vectors[inverse, :, 0]))
    return distances


def read_mesh(path: Path) -> tuple[Float64, NDArray[np.int64]]:
    """Vertices (v, 3) float64 and triangles (f, 3) int64 of a PLY mesh; polygons are cut into fans.

    For files of one's own: unlike PointCloud.read it builds every face. Raises MalformedFileError, OSError.
    """
    cloud = PointCloud.read(path)  # checks every length in the file first
    try:
        face = plyfile.PlyData.read(str(path), mmap=False)["face"]
        lists = face[next(name for name in ("vertex_indices", "vertex_index") if name in face)]
        faces = [(row[0], row[k], row[k + 1]) for row in lists for k in range(1, len(row) - 1)]
        triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
    except (KeyError, StopIteration, TypeError, plyfile.PlyParseError, ValueError, OverflowError) as error:
        raise MalformedFileError(f"{path} has no readable faces: {error}") from error
    if not cloud.finite.all():
        raise MalformedFileError(f"{path} has corners that are not finite")
    if len(triangles) == 0 or triangles.min() < 0 or triangles.max() >= len(cloud):
        raise MalformedFileError(f"{path} has no faces, or faces of vertices that it does not have")
    return cloud.xyz, triangles
