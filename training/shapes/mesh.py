"""Triangle meshes: corner normals, sampling, joining, loading from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from training.shapes.distributions import Rng

Float64 = NDArray[np.float64]
Surface = tuple[Float64, NDArray[np.int64]]  # vertices (v, 3), faces (f, 3)

MESH_SUFFIXES = (".ply", ".obj", ".off", ".stl")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with a bounding-box diagonal of 1.

    vertices: (v, 3) float64. faces: (f, 3) int64. corner_normals: (f, 3, 3) float64, the normal at each corner of each
    face; the three are equal where the surface is flat or faceted.
    """

    vertices: Float64
    faces: NDArray[np.int64]
    corner_normals: Float64

    def sample(self, count: int, rng: Rng) -> tuple[Float64, Float64]:
        """Points spread evenly over the surface and their unit normals: two (count, 3) float64 arrays."""
        corners = self.vertices[self.faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        face = rng.choice(len(areas), size=count, p=areas / areas.sum())
        u, v = rng.random((2, count))
        root = np.sqrt(u)
        weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
        points = np.einsum("nk,nkd->nd", weights, corners[face])
        normals = np.einsum("nk,nkd->nd", weights, self.corner_normals[face])
        return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def load_meshes(folder: Path) -> list[Mesh]:
    """The user's own meshes: every ply, obj, off and stl file in a folder, in the order of their names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise FileNotFoundError(f"no {', '.join(MESH_SUFFIXES)} file in {folder}")
    meshes = []
    for path in files:
        loaded = trimesh.load(path, force="mesh", process=False)
        if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
            raise ValueError(f"{path} holds no triangles")
        mesh = faceted_mesh(np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64))
        if len(mesh.faces) == 0:
            raise ValueError(f"{path} holds no triangle that has an area")
        meshes.append(mesh)
    return meshes


def _unit(vertices: Float64) -> Float64:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit: Float64 = (vertices - (low + high) / 2) / np.linalg.norm(high - low)
    return unit


def faceted_mesh(vertices: Float64, faces: NDArray[np.int64]) -> Mesh:
    vertices = _unit(vertices)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    solid = lengths > 1e-14
    normals = normals[solid] / lengths[solid, None]
    return Mesh(vertices, faces[solid], np.repeat(normals[:, None, :], 3, axis=1))


def smooth_mesh(vertices: Float64, faces: NDArray[np.int64]) -> Mesh:
    """A mesh with area-weighted vertex normals, for surfaces without creases."""
    flat = faceted_mesh(vertices, faces)
    corners = flat.vertices[flat.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(flat.vertices)
    for corner in range(3):
        np.add.at(normals, flat.faces[:, corner], cross)
    return Mesh(flat.vertices, flat.faces, unit_normals(normals[flat.faces], flat))


def unit_normals(normals: Float64, flat: Mesh) -> Float64:
    """(f, 3, 3) corner normals scaled to length 1; a corner without a usable normal takes the one of its face."""
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    usable = np.isfinite(lengths) & (lengths > 1e-12)
    unit: Float64 = np.where(usable, normals / np.where(usable, lengths, 1.0), flat.corner_normals)
    return unit


def joined(parts: list[Surface]) -> Surface:
    """Several (vertices, faces) pairs as one."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def compact(surface: Surface) -> Surface:
    """Drops the vertices that no face uses."""
    vertices, faces = surface
    used, kept = np.unique(faces.ravel(), return_inverse=True)
    return vertices[used], kept.reshape(-1, 3).astype(np.int64)


def parameter_grid(rows: int, columns: int) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """Parameters u, v in [-1, 1] of a grid of rows × columns vertices (flat arrays) and its faces."""
    u, v = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return u.ravel(), v.ravel(), faces
