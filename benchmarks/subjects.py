"""What the quality benchmark measures on: clean clouds with their surfaces, and the noisy clouds made of them.

Four sets, each in a folder of its own:

paper     paper4/: NAME.npy (clean), NAME_0.005.npy (noisy, row for row) and mesh/*.ply (surfaces; the one that fits a
          cloud is found by distance)
meshes    meshes/*.ply, sampled
shapes    shapes/*.ply, sampled
printed   printed/: NAME_scan.ply, a real scan, and NAME_truth.ply, the mesh that was scanned, in the same place

A noisy cloud that is not on disk is made from the clean one with a seed of its own, the same in every run.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.cloud import PointCloud
from pointfilter.evaluation import read_mesh
from pointfilter.metrics import chamfer_distance, normalised, point_to_surface
from pointfilter.noise import NoiseKind, add_noise

Float64 = NDArray[np.float64]

SHARP_DEGREES = 30  # an edge of the mesh is sharp where its faces' normals differ by more
EDGE_REACH = 0.01  # of the diagonal: a point counts for `edge` when the clean point nearest to it is this close to one
EDGE_SPACING = 0.0005  # of the diagonal: how densely sharp edges are sampled to find them
THINNEST = 0.1  # of the density of the dense side, on the thin side of an uneven cloud

MESH_POINTS = 400_000  # of the clean cloud of a mesh
SHAPE_POINTS = 400_000
PRINTED_POINTS = 200_000  # of the surface that was scanned

Set = Literal["paper", "meshes", "shapes", "printed"]
SAMPLED: tuple[Set, ...] = ("meshes", "shapes")  # meshes that any number of points is drawn from


@dataclass(frozen=True)
class Column:
    """One column of the table: which clouds, how dense, how noisy."""

    name: str
    level: float
    kind: NoiseKind = "gaussian"
    points: int | None = None
    """A random choice of this many points of the clean cloud; None: all."""
    uneven: bool = False
    """Density falls to a tenth from one side to the other."""
    subjects: Set = "paper"
    only: tuple[str, ...] = ()
    """Of these clouds; none: of all in the set."""


def _sampled(subjects: Set, levels: Iterable[float], points: int) -> list[Column]:
    """Columns of a set of meshes with Gaussian noise; the number of points is in the name unless it is 100 000."""
    density = "" if points == 100_000 else f" {points / 1000:g} k"
    return [
        Column(
            f"{subjects}{density} {f'{100 * level:g} %' if level else 'clean'}", level, points=points, subjects=subjects
        )
        for level in levels
    ]


COLUMNS = (
    Column("clean", 0.0),
    Column("0.25 %", 0.0025),
    Column("0.5 %", 0.005),
    Column("1 %", 0.01),
    Column("1.5 %", 0.015),
    Column("2.5 %", 0.025),
    Column("impulsive 0.5 %", 0.005, kind="impulsive"),
    Column("uniform 0.5 %", 0.005, kind="uniform"),
    Column("10 k", 0.005, points=10_000),
    Column("30 k", 0.005, points=30_000),
    Column("50 k", 0.005, points=50_000),
    Column("uneven", 0.005, uneven=True),
    *_sampled("meshes", (0.0, 0.0025, 0.005, 0.01, 0.025), 100_000),
    *_sampled("meshes", (0.005, 0.01, 0.02), 10_000),
    *_sampled("shapes", (0.0, 0.0025, 0.005, 0.01, 0.025), 100_000),
    *_sampled("shapes", (0.005, 0.01, 0.02), 10_000),
    Column("shapes 400 k 0.5 %", 0.005, subjects="shapes", only=("busted", "screwdriver", "lion", "springer")),
    Column("shapes impulsive 0.5 %", 0.005, kind="impulsive", points=100_000, subjects="shapes"),
    Column("shapes outliers 0.5 %", 0.005, kind="outliers", points=100_000, subjects="shapes"),
    Column("shapes uneven", 0.005, points=100_000, uneven=True, subjects="shapes"),
    Column("printed", 0.001, subjects="printed"),  # the level is for the classics: the noise is the scanner's
)


def at_points(columns: Iterable[Column], points: int) -> list[Column]:
    """The columns of meshes with Gaussian noise, once a level, with other points; named as those in COLUMNS are."""
    levels: dict[Set, list[float]] = {}
    for column in columns:
        if column.subjects in SAMPLED and column.kind == "gaussian" and not column.uneven and not column.only:
            levels.setdefault(column.subjects, []).append(column.level)
    return [column for name, found in levels.items() for column in _sampled(name, sorted(set(found)), points)]


@dataclass(frozen=True)
class Subject:
    """One clean cloud with its surface. clean (n, 3), vertices (v, 3) float64, faces (f, 3) int64."""

    name: str
    clean: Float64
    vertices: Float64
    faces: NDArray[np.int64]
    noisy_files: dict[float, Path] = field(default_factory=dict)
    """Noisy copies of the clean cloud on disk, by level."""
    scan: Float64 | None = None
    """A real scan (k, 3) of the surface: the noisy cloud of every column."""

    @cached_property
    def sharp_edges(self) -> Float64:
        """Points (m, 3) on the mesh's sharp edges, closer together than anything that is measured there."""
        mesh = trimesh.Trimesh(self.vertices, self.faces, process=True)
        sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > np.radians(SHARP_DEGREES)]
        starts, ends = mesh.vertices[sharp].transpose(1, 0, 2)
        spacing = EDGE_SPACING * np.linalg.norm(np.ptp(self.vertices, axis=0))
        counts = np.maximum(2, np.ceil(np.linalg.norm(ends - starts, axis=1) / spacing)).astype(int)
        edges = [
            start + np.linspace(0, 1, count)[:, None] * (end - start)
            for start, end, count in zip(starts, ends, counts, strict=True)
        ]
        return np.concatenate([np.empty((0, 3)), *edges])

    def clouds(self, column: Column) -> tuple[Float64, Float64]:
        """The clean and the noisy cloud of a column, row for row unless the noisy one is a real scan."""
        if self.scan is not None:
            return self.clean, self.scan
        if (
            column.kind == "gaussian"
            and column.points is None
            and not column.uneven
            and column.level in self.noisy_files
        ):
            return self.clean, np.load(self.noisy_files[column.level], allow_pickle=False).astype(np.float64)
        rng = np.random.default_rng(zlib.crc32(f"{self.name} {column.name}".encode()))
        clean = self.clean
        if column.uneven:
            slope = clean @ rng.normal(size=3)
            kept = THINNEST + (1 - THINNEST) * (slope - slope.min()) / np.ptp(slope)
            clean = clean[rng.random(len(clean)) < kept]
        if column.points is not None:
            clean = clean[np.sort(rng.choice(len(clean), min(column.points, len(clean)), replace=False))]
        return clean, add_noise(clean, column.level, rng, column.kind) if column.level else clean.copy()

    def distances(self, clean: Float64, points: Float64) -> Float64:
        """Distances (n,) of the points to the surface, for a diagonal of 1 of the clean cloud of the column."""
        _, points, vertices = normalised(clean, points, self.vertices)
        return point_to_surface(points, vertices, self.faces)

    def scores(self, clean: Float64, points: Float64, distances: Float64 | None = None) -> dict[str, float]:
        """CD ×1e5, P2F ×1e3 and `edge`, the P2F ×1e3 of the points close to a sharp edge, all for a diagonal of 1.

        clean: the clean cloud of the column. distances: of the points to the surface, where they are known. edge is NaN
        where the surface has no sharp edge.
        """
        if distances is None:
            distances = self.distances(clean, points)
        clean, points, edges = normalised(clean, points, self.sharp_edges)
        close = np.zeros(len(points), dtype=bool)
        if len(edges):
            to_edge, _ = cKDTree(edges).query(clean, distance_upper_bound=EDGE_REACH, workers=-1)
            close = np.isfinite(to_edge)[cKDTree(clean).query(points, workers=-1)[1]]
        return {
            "cd": 1e5 * chamfer_distance(clean, points),
            "p2f": 1e3 * float(distances.mean()),
            "edge": 1e3 * float(distances[close].mean()) if close.any() else float("nan"),
        }


def load_clouds(folder: Path) -> list[Subject]:
    """Every NAME.npy of a folder that is no noisy copy, with the mesh that lies closest to it."""
    meshes = [read_mesh(path) for path in sorted((folder / "mesh").glob("*.ply"))]
    subjects = []
    for path in sorted(folder.glob("*.npy")):
        if re.search(r"_0\.\d+$", path.stem):
            continue
        clean = np.load(path, allow_pickle=False).astype(np.float64)
        probe = clean[:: max(1, len(clean) // 500)]
        distances = [point_to_surface(probe, *mesh).mean() for mesh in meshes]
        vertices, faces = meshes[int(np.argmin(distances))]
        noisy = {float(file.stem.rpartition("_")[2]): file for file in folder.glob(f"{path.stem}_0.*.npy")}
        subjects.append(Subject(path.stem, clean, vertices, faces, noisy))
    return subjects


def load_meshes(folder: Path, points: int = MESH_POINTS) -> list[Subject]:
    """Every .ply mesh of a folder, with clean points spread evenly over it."""
    return [sample_mesh(path.stem, *read_mesh(path), points) for path in sorted(folder.glob("*.ply"))]


def load_shapes(folder: Path) -> list[Subject]:
    """The same, with SHAPE_POINTS points each."""
    return load_meshes(folder, SHAPE_POINTS)


def load_printed(folder: Path) -> list[Subject]:
    """Every NAME_scan.ply of a folder with its NAME_truth.ply."""
    subjects = []
    for path in sorted(folder.glob("*_scan.ply")):
        name = path.stem.removesuffix("_scan")
        truth = sample_mesh(name, *read_mesh(folder / f"{name}_truth.ply"), PRINTED_POINTS)
        subjects.append(replace(truth, scan=PointCloud.read(path).xyz))
    return subjects


SETS: dict[Set, tuple[str, Callable[[Path], list[Subject]]]] = {
    "paper": ("paper4", load_clouds),
    "meshes": ("meshes", load_meshes),
    "shapes": ("shapes", load_shapes),
    "printed": ("printed", load_printed),
}
"""Set -> its folder and what reads it."""


def sample_mesh(name: str, vertices: Float64, faces: NDArray[np.int64], points: int) -> Subject:
    """A mesh with so many clean points spread evenly over it, the same in every run."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    clean, _ = trimesh.sample.sample_surface(mesh, points, seed=zlib.crc32(name.encode()))
    return Subject(name, np.asarray(clean, dtype=np.float64), vertices, faces)
