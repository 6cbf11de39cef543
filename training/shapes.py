"""Procedural training shapes, each from one seed: CAD parts, organic bodies, reliefs, thin sheets, rods and scenes.

`KINDS` lists the kinds and their weights. None of the shapes imitates a known test model: all dimensions are random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

Float64 = NDArray[np.float64]
Rng = np.random.Generator
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


def random_shape(seed: int, family: int = 0) -> Mesh:
    """The shape of this seed; its kind is drawn with the weights of KINDS.

    Families share no shape: one is for training, another for validation. Raises RuntimeError if no attempt succeeds.
    """
    rng = np.random.default_rng([seed, 0x5AFE, family])
    kinds = list(KINDS.values())
    weights = np.array([kind.weight for kind in kinds])
    build = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))].build
    for _ in range(20):
        mesh = build(rng)
        if mesh is not None and len(mesh.faces):
            return mesh
    raise RuntimeError(f"no shape for seed {seed}")  # pragma: no cover - 20 empty shapes in a row


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
        mesh = _faceted(np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64))
        if len(mesh.faces) == 0:
            raise ValueError(f"{path} holds no triangle that has an area")
        meshes.append(mesh)
    return meshes


def _unit(vertices: Float64) -> Float64:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit: Float64 = (vertices - (low + high) / 2) / np.linalg.norm(high - low)
    return unit


def _faceted(vertices: Float64, faces: NDArray[np.int64]) -> Mesh:
    vertices = _unit(vertices)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    solid = lengths > 1e-14
    normals = normals[solid] / lengths[solid, None]
    return Mesh(vertices, faces[solid], np.repeat(normals[:, None, :], 3, axis=1))


def _smooth(vertices: Float64, faces: NDArray[np.int64]) -> Mesh:
    """A mesh with area-weighted vertex normals, for surfaces without creases."""
    flat = _faceted(vertices, faces)
    corners = flat.vertices[flat.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(flat.vertices)
    for corner in range(3):
        np.add.at(normals, flat.faces[:, corner], cross)
    return Mesh(flat.vertices, flat.faces, _unit_normals(normals[flat.faces], flat))


def _unit_normals(normals: Float64, flat: Mesh) -> Float64:
    """(f, 3, 3) corner normals scaled to length 1; a corner without a usable normal takes the one of its face."""
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    usable = np.isfinite(lengths) & (lengths > 1e-12)
    unit: Float64 = np.where(usable, normals / np.where(usable, lengths, 1.0), flat.corner_normals)
    return unit


def _joined(parts: list[Surface]) -> Surface:
    """Several (vertices, faces) pairs as one."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _compact(surface: Surface) -> Surface:
    """Drops the vertices that no face uses."""
    vertices, faces = surface
    used, kept = np.unique(faces.ravel(), return_inverse=True)
    return vertices[used], kept.reshape(-1, 3).astype(np.int64)


def _surface_of(solid: manifold3d.Manifold) -> Surface:
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)


def _solid_of(mesh: Mesh) -> manifold3d.Manifold:
    """The manifold3d solid of a closed mesh; empty if the mesh is not closed."""
    faces = mesh.faces.astype(np.uint32)
    first, second, third = mesh.vertices[faces].transpose(1, 0, 2)
    volume = np.einsum("fd,fd->", first, np.cross(second, third))
    if volume < 0:
        faces = faces[:, ::-1]
    raw = manifold3d.Mesh(mesh.vertices.astype(np.float32), np.ascontiguousarray(faces))
    return manifold3d.Manifold(raw)


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """The faceted mesh of a manifold3d solid, with a diagonal of 1."""
    return _faceted(*_surface_of(solid))


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# --- CAD solids: booleans of primitives -------------------------------------------------------------------------


def _polygon(rng: Rng) -> Float64:
    """A star-shaped polygon: anything from a triangle to a cog, convex or not."""
    corners = int(rng.integers(3, 11))
    angles = (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners
    radii = rng.uniform(0.35, 1.0, corners) if rng.random() < 0.6 else np.ones(corners)
    polygon: Float64 = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return polygon


def _union(parts: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)


def _difference(solid: manifold3d.Manifold, parts: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean([solid, *parts], manifold3d.OpType.Subtract)


def _primitive(rng: Rng, kind: str | None = None) -> manifold3d.Manifold:
    kind = kind or str(rng.choice(["box", "plate", "cylinder", "cone", "prism", "extrusion", "sphere", "wedge"]))
    size = rng.uniform(0.3, 1.0, 3)
    if kind == "box":
        return manifold3d.Manifold.cube(size.tolist(), True)
    if kind == "plate":
        return manifold3d.Manifold.cube([size[0], size[1], float(rng.uniform(0.03, 0.12))], True)
    if kind == "cylinder":
        return manifold3d.Manifold.cylinder(size[0], size[1] / 2, size[1] / 2, 160, True)
    if kind == "cone":
        return manifold3d.Manifold.cylinder(size[0], size[1] / 2, size[1] / 2 * rng.uniform(0.05, 0.8), 160, True)
    if kind == "sphere":
        ball = manifold3d.Manifold.sphere(0.5, 160)
        return ball.scale(size.tolist())
    if kind == "wedge":  # a crease of any angle
        angle = rng.uniform(0.2, 2.6)
        corners = np.array([[0, 0], [size[0], 0], [size[0] * np.cos(angle), size[0] * np.sin(angle)]])
        profile = manifold3d.CrossSection([corners - corners.mean(axis=0)])
        return manifold3d.Manifold.extrude(profile, size[1]).translate([0, 0, -size[1] / 2])
    if kind == "prism":
        sides = int(rng.integers(3, 9))
        return manifold3d.Manifold.cylinder(size[0], size[1] / 2, size[1] / 2 * rng.uniform(0.4, 1.0), sides, True)
    profile = manifold3d.CrossSection([_polygon(rng) * size[0] / 2])
    twist = float(rng.uniform(-60, 60)) if rng.random() < 0.3 else 0.0
    top = float(rng.uniform(0.3, 1.0)) if rng.random() < 0.4 else 1.0
    solid = manifold3d.Manifold.extrude(profile, size[1], 24 if twist else 0, twist, (top, top))
    return solid.translate([0, 0, -size[1] / 2])


def _placed(solid: manifold3d.Manifold, rng: Rng, spread: float) -> manifold3d.Manifold:
    angles = rng.uniform(-180, 180, 3) if rng.random() < 0.6 else 90.0 * rng.integers(0, 4, 3)
    return solid.rotate(angles.tolist()).translate(rng.uniform(-spread, spread, 3).tolist())


def _solid(rng: Rng) -> manifold3d.Manifold:
    """A boolean of three to seven random parts."""
    solid = _primitive(rng).scale([1.3, 1.3, 1.3])
    for _ in range(int(rng.integers(2, 7))):
        operation = rng.random()
        if operation < 0.5:
            solid = solid - _placed(_primitive(rng).scale([0.6, 0.6, 0.6]), rng, 0.5)
        elif operation < 0.65:  # a hole through everything
            hole = manifold3d.Manifold.cylinder(4, rng.uniform(0.04, 0.2), -1.0, 96, True)
            solid = solid - _placed(hole, rng, 0.35)
        elif operation < 0.95:
            solid = solid + _placed(_primitive(rng).scale([0.8, 0.8, 0.8]), rng, 0.4)
        else:
            solid = solid ^ _placed(_primitive(rng).scale([1.6, 1.6, 1.6]), rng, 0.2)
    return solid


# --- Thin solids: two surfaces within one patch ------------------------------------------------------------------


def _thin_solid(rng: Rng) -> manifold3d.Manifold:
    """Sheets, folds, tubes, bowls, ribs, slots and wires, with holes drilled through some of them."""
    thickness = _log_uniform(rng, 0.004, 0.08)
    build = _THIN[int(rng.integers(len(_THIN)))]
    solid = build(rng, thickness)
    for _ in range(int(rng.integers(0, 4))):
        hole = manifold3d.Manifold.cylinder(4, rng.uniform(0.02, 0.12), -1.0, 96, True)
        solid = solid - _placed(hole, rng, 0.35)
    return solid


def _sheet(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A flat piece of any outline."""
    if rng.random() < 0.5:
        return manifold3d.Manifold.cube([*rng.uniform(0.4, 1.0, 2).tolist(), thickness], True)
    outline = _polygon(rng) if rng.random() < 0.6 else _circle(rng.uniform(0.5, 1.0))
    return manifold3d.Manifold.extrude(manifold3d.CrossSection([outline * 0.6]), thickness)


def _circle(radius: float, corners: int = 160) -> Float64:
    angles = np.arange(corners) * 2 * np.pi / corners
    circle: Float64 = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return circle


def _fold(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A strip bent once to four times: angles, channels, zigzags, cut from sheet of one thickness."""
    heading, place, path = 0.0, np.zeros(2), [np.zeros(2)]
    for _ in range(int(rng.integers(2, 6))):
        place = place + rng.uniform(0.2, 0.6) * np.array([np.cos(heading), np.sin(heading)])
        path.append(place)
        heading += rng.uniform(0.3, 2.4) * rng.choice([-1, 1])
    width = rng.uniform(0.3, 1.0)
    strip = manifold3d.Manifold()
    for start, end in pairwise(path):
        along = end - start
        length = float(np.linalg.norm(along))
        piece = manifold3d.Manifold.cube([length + thickness, thickness, width], False)
        turned = piece.translate([-thickness / 2, -thickness / 2, 0]).rotate(
            [0.0, 0.0, float(np.degrees(np.arctan2(along[1], along[0])))]
        )
        strip = strip + turned.translate([*start.tolist(), 0.0])
    return strip


def _tube(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A pipe, round or not, of any length, often cut open along its side."""
    outline = _circle(rng.uniform(0.08, 0.5)) if rng.random() < 0.7 else 0.5 * _polygon(rng)
    section = manifold3d.CrossSection([outline])
    length = rng.uniform(0.2, 1.2)
    tube = manifold3d.Manifold.extrude(section - section.offset(-thickness), length)
    if rng.random() < 0.5:
        tube = tube - manifold3d.Manifold.cube([2.0, 2.0, 2.0], False).translate([rng.uniform(-0.2, 0.2), -1.0, -0.5])
    return tube.translate([0, 0, -length / 2])


def _bowl(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A piece of a hollow ball or ellipsoid."""
    size = rng.uniform(0.5, 1.0, 3)
    outer = manifold3d.Manifold.sphere(0.5, 160)
    inner = outer.scale(np.maximum(size - 2 * thickness, 0.1).tolist())
    cut = manifold3d.Manifold.cube([2.0, 2.0, 2.0], True).translate([0, 0, 1 + rng.uniform(-0.25, 0.3)])
    return outer.scale(size.tolist()) - inner - _turned(cut, rng)


def _ribs(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A block with thin walls on it, all the way or crossing each other."""
    size = rng.uniform(0.4, 0.9, 3)
    block = manifold3d.Manifold.cube([float(size[0]), float(size[1]), float(0.3 * size[2])], True)
    for _ in range(int(rng.integers(1, 6))):
        wall = manifold3d.Manifold.cube([float(size[0]), thickness, float(size[2])], True)
        turned = wall.rotate([0.0, 0.0, float(rng.choice([0, 90]) if rng.random() < 0.7 else rng.uniform(0, 180))])
        block = block + turned.translate([*rng.uniform(-0.3, 0.3, 2).tolist(), float(0.4 * size[2])])
    return block


def _slots(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A solid with narrow gaps cut into it."""
    solid = _primitive(rng, str(rng.choice(["box", "cylinder", "prism"])))
    for _ in range(int(rng.integers(1, 5))):
        gap = manifold3d.Manifold.cube([2.0, thickness, rng.uniform(0.3, 1.0)], True)
        solid = solid - _turned(gap.translate([0, rng.uniform(-0.25, 0.25), rng.uniform(0.1, 0.5)]), rng)
    return solid


def _rod(start: Float64, end: Float64, radius: float, sides: int = 32) -> manifold3d.Manifold:
    """A cylinder (or, with few sides, a bar) from one point to another."""
    along = end - start
    length = max(float(np.linalg.norm(along)), 1e-6)
    rod = manifold3d.Manifold.cylinder(length, radius, -1.0, sides)
    tilt = float(np.degrees(np.arccos(np.clip(along[2] / length, -1, 1))))
    rod = rod.rotate([0.0, tilt, float(np.degrees(np.arctan2(along[1], along[0])))])
    return rod.translate(start.tolist())


def _wires(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """Rods from one point to the next."""
    points = rng.uniform(-0.5, 0.5, (int(rng.integers(4, 9)), 3))
    return _union([_rod(start, end, thickness, 48) for start, end in pairwise(points)])


def _turned(solid: manifold3d.Manifold, rng: Rng) -> manifold3d.Manifold:
    return solid.rotate(
        (90.0 * rng.integers(0, 4, 3)).tolist() if rng.random() < 0.4 else rng.uniform(0, 360, 3).tolist()
    )


_THIN: tuple[Callable[[Rng, float], manifold3d.Manifold], ...] = (
    _sheet, _sheet, _fold, _tube, _bowl, _ribs, _slots, _wires,
)  # fmt: skip


# --- Smooth shapes: level sets through marching cubes -----------------------------------------------------------

RESOLUTION = 112
_AXIS = np.linspace(-1, 1, RESOLUTION)
_GRID: Float64 = np.stack(np.meshgrid(_AXIS, _AXIS, _AXIS, indexing="ij"), axis=-1)


def _rotation(rng: Rng) -> Float64:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation: Float64 = q * np.sign(np.diag(r))
    return rotation


def _level_set(field: Float64) -> Mesh | None:
    """The surface field = 0 (negative inside), with the field's gradient as normals."""
    for axis in range(3):  # closed at the border of the grid
        for side in (0, -1):
            np.moveaxis(field, axis, 0)[side] = np.maximum(np.moveaxis(field, axis, 0)[side], 0.05)
    if field.min() > -0.02:
        return None
    vertices, faces, normals, _ = marching_cubes(  # type: ignore[no-untyped-call]
        field, 0.0, spacing=(_AXIS[1] - _AXIS[0],) * 3, gradient_direction="ascent"
    )
    if len(faces) < 2000:
        return None
    flat = _faceted(vertices.astype(np.float64), faces.astype(np.int64))
    return Mesh(flat.vertices, flat.faces, _unit_normals(normals.astype(np.float64)[flat.faces], flat))


def _smooth_minimum(a: Float64, b: Float64, width: float) -> Float64:
    blend = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    smooth: Float64 = b * (1 - blend) + a * blend - width * blend * (1 - blend)
    return smooth


def _rounded_box(p: Float64, rng: Rng) -> Float64:
    half = rng.uniform(0.12, 0.55, 3)
    rounding = rng.uniform(0.03, 0.1)
    q = np.abs(p) - (half - rounding)
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
    field: Float64 = outside + np.minimum(q.max(axis=-1), 0) - rounding
    return field


def _torus(p: Float64, rng: Rng) -> Float64:
    ring = np.hypot(np.hypot(p[..., 0], p[..., 1]) - rng.uniform(0.3, 0.5), p[..., 2])
    field: Float64 = ring - rng.uniform(0.06, 0.2)
    return field


def _capsule(p: Float64, rng: Rng) -> Float64:
    height = rng.uniform(0.1, 0.5)
    z = p[..., 2] - np.clip(p[..., 2], -height, height)
    field: Float64 = np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + z**2) - rng.uniform(0.08, 0.3)
    return field


def _ellipsoid(p: Float64, rng: Rng) -> Float64:
    axes = rng.uniform(0.2, 0.6, 3)
    field: Float64 = (np.linalg.norm(p / axes, axis=-1) - 1) * axes.min()
    return field


_PARTS: tuple[Callable[[Float64, Rng], Float64], ...] = (_rounded_box, _torus, _capsule, _ellipsoid)


def _part(rng: Rng, kinds: tuple[Callable[[Float64, Rng], Float64], ...] = _PARTS) -> Float64:
    moved = (_GRID - rng.uniform(-0.3, 0.3, 3)) @ _rotation(rng).T
    return kinds[int(rng.integers(len(kinds)))](moved, rng)


def _rounded_solid(rng: Rng) -> Mesh | None:
    """Fillets: rounded parts, joined and cut with a smooth minimum."""
    field = _part(rng, (_rounded_box,))
    for _ in range(int(rng.integers(1, 5))):
        width = rng.uniform(0.04, 0.15)
        if rng.random() < 0.6:
            field = _smooth_minimum(field, _part(rng), width)
        else:
            field = -_smooth_minimum(-field, _part(rng), width)
    return _level_set(field)


def _smooth_body(rng: Rng) -> Mesh | None:
    """Organic bodies: blended ellipsoids and tubes, with waves on the surface."""
    field = _part(rng, (_ellipsoid, _capsule))
    for _ in range(int(rng.integers(2, 7))):
        field = _smooth_minimum(field, _part(rng, (_ellipsoid, _capsule, _torus)), rng.uniform(0.08, 0.3))
    for _ in range(int(rng.integers(0, 4))):
        frequency = rng.uniform(2, 14)
        wave = np.sin(frequency * (_GRID @ _rotation(rng)) + rng.uniform(0, 6.28, 3)).prod(axis=-1)
        field = field + rng.uniform(0.2, 0.6) / frequency * wave * 0.6
    return _level_set(field)


# --- Detail at several frequencies: random Fourier modes ---------------------------------------------------------

MODES = 12  # plane waves per octave
Evaluate = Callable[[Float64, Float64], Float64]  # wave vectors (m, 3), phases (m,) -> sum of the cosines


def _waves_at(points: Float64) -> Evaluate:
    """Evaluates sums of plane waves at (n, 3) points."""

    def evaluate(vectors: Float64, phases: Float64) -> Float64:
        total: Float64 = np.cos(points @ vectors.T + phases).sum(axis=1)
        return total

    return evaluate


def _waves_on_grid(vectors: Float64, phases: Float64) -> Float64:
    """Evaluates a sum of plane waves on _GRID; cos(a + b) = cos a cos b - sin a sin b makes it one matrix product."""
    plane = _GRID[:, :, 0, :2].reshape(-1, 2) @ vectors[:, :2].T + phases
    depth = np.outer(vectors[:, 2], _AXIS)
    waves = np.hstack([np.cos(plane), -np.sin(plane)]) @ np.vstack([np.cos(depth), np.sin(depth)])
    total: Float64 = waves.reshape(_GRID.shape[:3])
    return total


def _detail(rng: Rng, evaluate: Evaluate, lowest: float, highest: float) -> Float64:
    """Noise in octaves from one wave number to another: rolling, ridged or folded. Slopes are about 0.1 to 0.6."""
    style = str(rng.choice(["rolling", "ridges", "folds"]))
    slope = rng.uniform(0.15, 0.6)
    stretch = np.where(rng.random(3) < 0.25, 0.25, 1.0)  # grain along an axis
    total: Float64 = np.zeros(())
    for _ in range(4):
        directions = rng.normal(size=(MODES, 3))
        directions *= stretch / np.linalg.norm(directions, axis=1, keepdims=True)
        vectors = directions * lowest * rng.uniform(0.7, 1.3, (MODES, 1))
        values = evaluate(vectors, rng.uniform(0, 2 * np.pi, MODES)) * np.sqrt(2 / MODES)
        if style == "ridges":
            values = 1 - np.abs(values)
        elif style == "folds":
            values = np.abs(values)
        total = total + slope / lowest * values
        slope *= rng.uniform(0.6, 1.1)
        lowest *= 2
        if lowest > highest:
            break
    return total


def _scales(rng: Rng, points: Float64) -> Float64:
    """Convex cells: scales, pebbles or cobbles, higher in their middle."""
    centres = points[rng.choice(len(points), size=int(_log_uniform(rng, 30, 1500)))]
    distances = cKDTree(centres).query(points, k=2)[0]
    width = np.median(distances[:, 0]) * 2
    edge = np.clip((distances[:, 1] - distances[:, 0]) / width, 0, 1)
    scales: Float64 = width * rng.uniform(0.1, 0.6) * np.sqrt(edge)
    return scales


def _organic(rng: Rng) -> Mesh | None:
    """Blended bodies with detail over three or four octaves."""
    field = _part(rng, (_ellipsoid, _capsule, _rounded_box))
    for _ in range(int(rng.integers(1, 5))):
        field = _smooth_minimum(field, _part(rng, (_ellipsoid, _capsule, _torus)), rng.uniform(0.05, 0.25))
    return _level_set(field + _detail(rng, _waves_on_grid, rng.uniform(4, 12), 90) * rng.uniform(0.5, 1.0))


@lru_cache(maxsize=1)
def _icosphere() -> Surface:
    sphere = trimesh.creation.icosphere(subdivisions=6)
    return np.asarray(sphere.vertices, np.float64), np.asarray(sphere.faces, np.int64)


def _grid(rows: int, columns: int) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """Parameters u, v in [-1, 1] of a grid of rows × columns vertices (flat arrays) and its faces."""
    u, v = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return u.ravel(), v.ravel(), faces


def _relief(rng: Rng) -> Mesh | None:
    """A displaced sphere, an open patch of terrain or an open displaced tube."""
    kind = str(rng.choice(["sphere", "terrain", "tube"]))
    if kind == "sphere":
        directions, faces = _icosphere()
        base = directions * rng.uniform(0.4, 1.0, 3)
        normals = directions
    else:
        u, v, faces = _grid(200, 200)
        if kind == "terrain":
            base = np.stack([u, v * rng.uniform(0.4, 1.0), np.zeros_like(u)], axis=1)
            normals = np.tile([0.0, 0.0, 1.0], (len(u), 1))
        else:
            angle = u * np.pi * rng.uniform(0.4, 1.0)
            normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(u)], axis=1)
            base = normals * _log_uniform(rng, 0.1, 0.8) + np.outer(v, [0.0, 0.0, 1.0])
    height = np.zeros(len(base))
    if rng.random() < 0.8:
        height = height + _detail(rng, _waves_at(base), rng.uniform(2, 10), 100)
    if rng.random() < 0.3 or not height.any():
        height = height + _scales(rng, base)
    return _smooth(base + normals * height[:, None], faces)


# --- Detailed CAD parts: arrays of small features -----------------------------------------------------------------


def _profile(rng: Rng, size: float = 1.0) -> manifold3d.CrossSection:
    """A convex outline about `size` wide: rectangle, rounded rectangle, slot, disc or regular polygon."""
    kind = str(rng.choice(["rectangle", "rounded", "slot", "disc", "polygon"]))
    width = size * rng.uniform(0.3, 1.0)
    if kind == "disc":
        return manifold3d.CrossSection([_circle(size / 2)])
    if kind == "polygon":
        return manifold3d.CrossSection([_circle(size / 2, int(rng.integers(3, 9)))])
    if kind == "slot":
        ends = [_circle(width / 4) + np.array([side * (size / 2 - width / 4), 0]) for side in (-1, 1)]
        return manifold3d.CrossSection.hull_points(np.concatenate(ends))
    rounding = rng.uniform(0.05, 0.4) * width if kind == "rounded" else 0.0
    core = manifold3d.CrossSection.square([size - rounding, width - rounding], True)
    return core.offset(rounding / 2, manifold3d.JoinType.Round, 2.0, 64) if rounding else core


def _beveled(profile: manifold3d.CrossSection, height: float, bevel: float, steps: int) -> manifold3d.Manifold:
    """A convex profile extruded around z = 0, with chamfered (steps = 1) or filleted edges above and below."""
    points = []
    for angle in np.linspace(0, np.pi / 2, steps + 1):
        inset, level = bevel * (1 - np.cos(angle)), height / 2 - bevel * (1 - np.sin(angle))
        for polygon in profile.offset(-inset, manifold3d.JoinType.Miter).to_polygons():
            points += [np.column_stack([polygon, np.full(len(polygon), side * level)]) for side in (-1, 1)]
    return manifold3d.Manifold.hull_points(np.concatenate(points))


def _cog(teeth: int, root: float, tip: float, fill: float = 0.5) -> Float64:
    """The outline of a cog with straight-sided teeth; `fill` is a tooth's share of the pitch."""
    pitch = 2 * np.pi / teeth
    within = np.array([0.0, 0.5 - 0.4 * fill, 0.5 - 0.2 * fill, 0.5 + 0.2 * fill, 0.5 + 0.4 * fill])
    angles = (pitch * (np.arange(teeth)[:, None] + within)).ravel()
    radii = np.tile([root, root, tip, tip, root], teeth)
    outline: Float64 = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return outline


def _gear(rng: Rng, size: float) -> manifold3d.Manifold:
    """A gear with straight or helical teeth, with a bore, often with a hub."""
    tip = 0.5
    teeth = int(np.clip(np.pi * tip / size, 6, 90))
    profile = manifold3d.CrossSection([_cog(teeth, tip - min(size, 0.12), tip, rng.uniform(0.6, 1.1))])
    height = rng.uniform(0.05, 0.6)
    twist = float(rng.uniform(-40, 40)) if rng.random() < 0.5 else 0.0
    gear = manifold3d.Manifold.extrude(profile, height, 12 if twist else 0, twist)
    bore = rng.uniform(0.05, 0.2)
    if rng.random() < 0.5:
        hub = manifold3d.Manifold.cylinder(height * rng.uniform(1.1, 2.0), bore + rng.uniform(0.02, 0.1), -1.0, 96)
        gear = gear + hub
    return gear - manifold3d.Manifold.cylinder(4, bore, -1.0, 96, True)


def _threaded(rng: Rng, size: float) -> manifold3d.Manifold:
    """A shaft with a helical groove of pitch `size`, often with a head."""
    length, radius = rng.uniform(0.5, 1.0), rng.uniform(0.08, 0.3)
    turns = float(np.clip(length / size, 2, 24))
    depth = min(size * rng.uniform(0.3, 0.8), 0.6 * radius)
    starts = int(rng.integers(1, 4)) if rng.random() < 0.4 else 1
    angles = np.arange(48) * 2 * np.pi / 48
    saw = np.abs((angles * starts / np.pi) % 2 - 1)
    radii = radius - depth * np.clip(saw * rng.uniform(1.0, 1.6), 0, 1)
    profile = manifold3d.CrossSection([np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)])
    twist = 360 * turns / starts * float(rng.choice([-1, 1]))
    shaft = manifold3d.Manifold.extrude(profile, length, int(turns / starts * 24), twist)
    if rng.random() < 0.6:
        head = radius * rng.uniform(1.3, 2.2)
        sides = int(rng.choice([4, 6, 8, 96]))
        shaft = shaft + manifold3d.Manifold.cylinder(rng.uniform(0.05, 0.3), head, -1.0, sides, True)
    if rng.random() < 0.5:
        shank = manifold3d.Manifold.cylinder(length * rng.uniform(0.1, 0.6), radius, -1.0, 96)
        shaft = shaft + shank
    return shaft


def _knurled(rng: Rng, size: float) -> manifold3d.Manifold:
    """A knob with crossed helical grooves on its side, or straight flutes."""
    radius, height = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.8)
    teeth = int(np.clip(2 * np.pi * radius / size, 5, 36))
    profile = manifold3d.CrossSection([_cog(teeth, radius - 0.4 * min(size, 0.5 * radius), radius, 1.0)])
    twist = float(np.degrees(height / radius)) * rng.uniform(0.4, 1.2) if rng.random() < 0.7 else 0.0
    knob = manifold3d.Manifold.extrude(profile, height, 16 if twist else 0, twist)
    if twist:
        knob = knob ^ manifold3d.Manifold.extrude(profile, height, 16, -twist)
    shaft = manifold3d.Manifold.cylinder(height * rng.uniform(1.2, 2.0), radius * rng.uniform(0.3, 0.9), -1.0, 96)
    return knob + shaft.translate([0, 0, -0.3 * height])


def _places(rng: Rng, width: float, depth: float, size: float) -> Float64:
    """(n, 2) places of equal features about `size` wide in a field: rows, a ring or scattered; at most 120."""
    spacing = size * rng.uniform(1.3, 4.0)
    style = rng.random()
    if style < 0.55:
        columns = int(np.clip(width * rng.uniform(0.3, 0.9) / spacing, 1, 12))
        rows = int(np.clip(depth * rng.uniform(0.3, 0.9) / spacing, 1, 10))
        x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
        grid: Float64 = spacing * np.stack([x.ravel(), y.ravel()], axis=1)
        free = np.maximum(np.array([width, depth]) * 0.9 - np.ptp(grid, axis=0) - size, 0) / 2
        grid += rng.uniform(-free, free)
        return grid
    if style < 0.8:
        radius = rng.uniform(0.15, 0.45) * min(width, depth)
        return _circle(radius, int(np.clip(2 * np.pi * radius / spacing, 3, 60)))
    half = 0.45 * np.array([width, depth])
    return rng.uniform(-half, half, (int(rng.integers(3, 50)), 2))


def _stud(rng: Rng, size: float, height: float) -> manifold3d.Manifold:
    """One small feature centred at the origin: pin, cone, block, hexagon or dome."""
    kind = str(rng.choice(["pin", "pin", "cone", "block", "hexagon", "dome"]))
    sides = int(np.clip(600 * size, 16, 64))
    if kind == "block":
        return manifold3d.Manifold.cube([size, size * rng.uniform(0.4, 1.0), 2 * height], True)
    if kind == "dome":
        return manifold3d.Manifold.sphere(size / 2, min(sides, 24))
    if kind == "cone":
        shrink = rng.uniform(0.4, 0.9)
        return manifold3d.Manifold.cylinder(2 * height, size / 2, size / 2 * shrink, sides, True)
    return manifold3d.Manifold.cylinder(2 * height, size / 2, -1.0, 6 if kind == "hexagon" else sides, True)


def _glyphs(rng: Rng, width: float, size: float) -> list[manifold3d.Manifold]:
    """A line of characters made of random 3 × 5 pixels of edge `size`."""
    count = int(np.clip(0.9 * width / (4 * size), 1, 10))
    pixel = manifold3d.Manifold.cube([1.02 * size, 1.02 * size, 2 * size * rng.uniform(0.3, 1.0)], True)
    parts = []
    for character in range(count):
        for x, y in np.argwhere(rng.random((3, 5)) < 0.6):
            parts.append(pixel.translate([size * (4 * (character - count / 2) + x), size * (y - 2.0), 0.0]))
    return parts


def _with_features(solid: manifold3d.Manifold, rng: Rng) -> manifold3d.Manifold:
    """Adds or cuts one array of small features on the face that a random quarter turn brings to the top."""
    turn = ([0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [0.0, 90.0, 0.0], [180.0, 0.0, 0.0])[
        int(rng.choice(4, p=[0.5, 0.15, 0.15, 0.2]))
    ]
    turned = solid.rotate(turn)
    low, high = np.reshape(turned.bounding_box(), (2, 3))
    width, depth, thickness = (high - low).tolist()
    size = min(_log_uniform(rng, 0.004, 0.1), 0.45 * min(width, depth))
    height = size * rng.uniform(0.2, 2.0)
    kind = str(rng.choice(["studs", "holes", "blind holes", "ribs", "grooves", "glyphs"]))
    if kind == "glyphs":
        parts = _glyphs(rng, width, size)
    elif kind in ("ribs", "grooves"):
        spacing = size * rng.uniform(1.4, 5.0)
        count = int(np.clip(0.9 * width / spacing, 1, 40))
        if kind == "grooves" and rng.random() < 0.4:  # V-shaped
            bar = manifold3d.Manifold.cube([size, depth * 1.1, size], True).rotate([0.0, 45.0, 0.0])
        else:
            bar = manifold3d.Manifold.cube([size, depth * (1.1 if kind == "grooves" else 0.9), 2 * height], True)
        parts = [bar.translate([spacing * (k - (count - 1) / 2), 0.0, 0.0]) for k in range(count)]
    else:
        through = 1.1 * thickness if kind == "holes" else height
        stud = _stud(rng, size, through)
        parts = [stud.translate([*place, 0.0]) for place in _places(rng, width, depth, size).tolist()]
    middle = ((low + high) / 2).tolist()
    cut = kind in ("holes", "blind holes", "grooves") or (kind == "glyphs" and rng.random() < 0.5)
    lift = high[2] if cut else high[2] - 0.02 * height
    array = _union(parts).translate([middle[0], middle[1], float(lift)])
    whole = turned - array if cut else turned + array
    # The turns are about one axis each: the opposite angles undo them.
    return whole.rotate([-angle for angle in turn])


def _detailed_part(rng: Rng) -> manifold3d.Manifold:
    """A plate, block or turned part with small features, 0.4 % to 10 % of the part in size."""
    pick = rng.random()
    if pick < 0.3:
        build = (_gear, _threaded, _knurled)[int(rng.integers(3))]
        solid = build(rng, _log_uniform(rng, 0.02, 0.12))
    else:
        height = _log_uniform(rng, 0.03, 0.8)
        bevel = min(_log_uniform(rng, 0.004, 0.1), 0.25 * height, 0.06)
        steps = int(rng.choice([1, 8]))
        solid = _beveled(_profile(rng), height, bevel, steps) if rng.random() < 0.7 else _primitive(rng)
    for _ in range(int(rng.integers(1, 5) if pick >= 0.3 else rng.integers(0, 2))):
        solid = _with_features(solid, rng)
    return solid


# --- Rods and open sheets -----------------------------------------------------------------------------------------


def _above(place: Float64, height: float) -> Float64:
    above: Float64 = place + np.array([0.0, 0.0, height])
    return above


def _rods(rng: Rng) -> manifold3d.Manifold:
    """Wires, poles and bars of all thicknesses: loose, in a row, as a lattice or as a bundle."""
    radius = _log_uniform(rng, 0.001, 0.06)
    kind = str(rng.choice(["loose", "row", "lattice", "bundle"]))
    sides = int(rng.choice([4, 8, 32]))
    if kind == "loose":
        points = rng.uniform(-0.5, 0.5, (int(rng.integers(2, 12)), 3))
        pairs = list(pairwise(points))
    elif kind == "row":
        count = int(rng.integers(2, 16))
        spacing = max(1 / count, 3 * radius)
        feet = [np.array([k * spacing, 0.0, 0.0]) for k in range(count)]
        pairs = [(foot, _above(foot, rng.uniform(0.5, 0.8))) for foot in feet]
        pairs += [(_above(feet[0], z), _above(feet[-1], z)) for z in rng.uniform(0.05, 0.5, int(rng.integers(0, 4)))]
    elif kind == "lattice":
        steps = int(rng.integers(1, 3))
        nodes = np.stack(np.meshgrid(*[np.arange(steps + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        pairs = [(a, a + axis) for a in nodes for axis in np.eye(3) if (a + axis <= steps).all()]
        size = rng.uniform(0.3, 1.0, 3) / steps
        pairs = [(a * size, b * size) for a, b in pairs]
    else:
        gap = 2 * radius + _log_uniform(rng, 0.003, 0.06)
        offsets = gap * np.argwhere(np.ones((3, 3)))[rng.permutation(9)[: int(rng.integers(2, 8))]]
        pairs = [(np.array([x, y, 0.0]), np.array([x, y, rng.uniform(0.6, 1.0)])) for x, y in offsets]
    equal = rng.random() < 0.6
    return _union([_rod(a, b, radius if equal else radius * _log_uniform(rng, 0.4, 1.5), sides) for a, b in pairs])


def _bent(rng: Rng) -> Surface:
    """A smooth open surface: a piece of a cylinder, cone, ball, saddle, wave, helix or roll."""
    kind = str(rng.choice(["cylinder", "cone", "cap", "saddle", "wave", "helix", "roll"]))
    u, v, faces = _grid(96, 96)
    length = rng.uniform(0.3, 1.5)
    if kind in ("cylinder", "cone"):
        angle = u * rng.uniform(0.2, 3.0)
        radius = 1 - v * (rng.uniform(0.2, 0.9) if kind == "cone" else 0.0)
        place = [radius * np.cos(angle), radius * np.sin(angle), length * v]
    elif kind == "cap":
        angle, lift = u * rng.uniform(0.3, 3.0), v * rng.uniform(0.2, 1.4)
        place = [np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)]
    elif kind == "saddle":
        a, b, c = rng.uniform(-0.7, 0.7, 3)
        place = [u, length * v, a * u**2 + b * v**2 + c * u * v]
    elif kind == "wave":
        frequency = rng.uniform(1, 9)
        place = [u, length * v, rng.uniform(0.2, 1.0) / frequency * np.sin(frequency * u + rng.uniform(-1, 1) * v)]
    elif kind == "helix":
        turn = u * rng.uniform(0.5, 4.0)
        place = [(v + 1.2) * np.cos(turn), (v + 1.2) * np.sin(turn), u * rng.uniform(0.3, 1.5)]
    else:
        angle = (u + 1) * rng.uniform(3, 9)
        radius = 0.3 + _log_uniform(rng, 0.02, 0.2) * angle / (2 * np.pi)
        place = [radius * np.cos(angle), radius * np.sin(angle), length * v]
    return np.stack(place, axis=1), faces


def _open_sheet(rng: Rng) -> Mesh | None:
    """One surface without thickness: bent smoothly, or folded along straight lines."""
    if rng.random() < 0.65:
        return _smooth(*_bent(rng))
    heading, path = 0.0, [np.zeros(2)]
    for _ in range(int(rng.integers(2, 7))):
        path.append(path[-1] + rng.uniform(0.15, 0.6) * np.array([np.cos(heading), np.sin(heading)]))
        heading += rng.uniform(0.2, 2.0) * rng.choice([-1, 1])
    _, v, faces = _grid(len(path), 2)
    return _faceted(np.column_stack([np.repeat(path, 2, axis=0), v * rng.uniform(0.1, 0.8)]), faces)


def _parallel_sheets(rng: Rng) -> Mesh | None:
    """Two to four bent surfaces one behind the other; the gap is 0.3 % to 6 % of the size."""
    vertices, faces = _bent(rng)
    first = _smooth(vertices, faces)
    normals = np.zeros_like(vertices)
    normals[first.faces] = first.corner_normals
    gap = _log_uniform(rng, 0.003, 0.06)
    parts = [(first.vertices, first.faces)]
    flipped = rng.random() < 0.5
    u, v, _ = _grid(96, 96)
    for layer in range(1, int(rng.choice([2, 2, 2, 3, 4]))):
        kept = first.faces
        if rng.random() < 0.4:  # a piece only, so that the sheet below has a free part
            border = rng.uniform(-0.5, 0.5)
            kept = kept[((u if rng.random() < 0.5 else v)[kept] > border).all(axis=1)]
        turned = kept[:, ::-1] if flipped and layer % 2 else kept
        parts.append((first.vertices + layer * gap * normals, turned))
    return _smooth(*_compact(_joined(parts)))


# --- Scenes -------------------------------------------------------------------------------------------------------


def _object(rng: Rng, size: float) -> manifold3d.Manifold:
    """A solid of any closed kind with a diagonal of `size`, standing on z = 0 around the z axis, or an empty one."""
    pick = rng.random()
    if pick < 0.2:
        mesh = (_organic, _smooth_body, _rounded_solid)[int(rng.integers(3))](rng)
        solid = manifold3d.Manifold() if mesh is None else _solid_of(mesh)
    else:
        build = (_solid, _thin_solid, _detailed_part, _detailed_part, _rods)[int(rng.integers(5))]
        solid = build(rng)
    if solid.is_empty():
        return solid
    if rng.random() < 0.3:
        solid = _turned(solid, rng)
    low, high = np.reshape(solid.bounding_box(), (2, 3))
    middle = (low + high) / 2
    scale = size / float(np.linalg.norm(high - low))
    return solid.translate([-middle[0], -middle[1], -low[2]]).scale([scale, scale, scale])


def _block(low: tuple[float, float, float], high: tuple[float, float, float]) -> manifold3d.Manifold:
    size = [float(b - a) for a, b in zip(low, high, strict=True)]
    return manifold3d.Manifold.cube(size).translate([float(a) for a in low])


def _within(surface: Surface, low: Float64, high: Float64) -> Surface:
    """The faces with all corners in a box: removes the outer sides of floors and walls, which no scanner sees."""
    vertices, faces = surface
    inside: NDArray[np.bool_] = np.all((vertices >= low) & (vertices <= high), axis=1)
    return _compact((vertices, faces[inside[faces].all(axis=1)]))


def _standing(rng: Rng) -> Mesh | None:
    """An object on a floor 2 to 10 times as wide, or two or three objects of different size, some without a floor."""
    count = int(rng.choice([1, 1, 2, 3]))
    parts: list[manifold3d.Manifold] = []
    for _ in range(count):
        thing = _object(rng, 1.0 if not parts else _log_uniform(rng, 0.1, 1.0))
        if thing.is_empty():
            return None
        parts.append(thing.translate([*(rng.uniform(-1.5, 1.5, 2) * (count > 1)).tolist(), 0.0]))
    if count == 1 or rng.random() < 0.6:
        half = _log_uniform(rng, 2, 10) / 2
        parts.append(_block((-half, -half, -0.2), (half, half, rng.uniform(0.0, 0.02))))
    surface = _surface_of(_union(parts))
    return _trimmed(surface, [-np.inf, -np.inf, -0.1], [np.inf] * 3)


def _trimmed(surface: Surface, low: list[float], high: list[float], more: list[Surface] | None = None) -> Mesh | None:
    kept = _within(surface, np.array(low), np.array(high))
    return _faceted(*_joined([kept, *(more or [])])) if len(kept[1]) > 10 else None


def _table(rng: Rng) -> manifold3d.Manifold:
    """A table on z = 0 around the z axis, with a thin top, legs and often an object on it."""
    x, y, height = rng.uniform(0.3, 0.9), rng.uniform(0.25, 0.5), rng.uniform(0.4, 1.0)
    top = rng.uniform(0.015, 0.06)
    leg = rng.uniform(0.015, 0.05)
    parts = [_block((-x, -y, height - top), (x, y, height))]
    for sx in (-1, 1):
        for sy in (-1, 1):
            foot = np.array([sx * (x - 2 * leg), sy * (y - 2 * leg), 0.0])
            parts.append(_rod(foot, _above(foot, height - top / 2), leg, int(rng.choice([4, 24]))))
    if rng.random() < 0.7:
        parts.append(_object(rng, rng.uniform(0.15, 0.6)).translate([0, 0, height]))
    return _union(parts)


def _shelf(rng: Rng) -> manifold3d.Manifold:
    """A shelf on z = 0 with thin boards and boxes on them; its back is at y = 0."""
    width, depth, height = rng.uniform(0.6, 1.6), rng.uniform(0.2, 0.45), rng.uniform(0.8, 2.2)
    board = rng.uniform(0.015, 0.04)
    parts = [_block((x, 0, 0), (x + board, depth, height)) for x in (0.0, width - board)]
    levels = np.linspace(0.05, height - board, int(rng.integers(3, 7)))
    for level in levels:
        parts.append(_block((0, 0, level), (width, depth, level + board)))
        x = board + 0.02
        while x < width - 0.3 and level < levels[-1] and rng.random() < 0.8:
            wide = rng.uniform(0.02, 0.25)
            tall = (levels[1] - levels[0]) * rng.uniform(0.3, 0.8)
            parts.append(_block((x, 0.02, level), (x + wide, depth * rng.uniform(0.5, 0.95), level + board + tall)))
            x += wide + rng.uniform(0.0, 0.2)
    return _union(parts)


def _room(rng: Rng) -> Mesh | None:
    """The inside of a room, with or without ceiling: furniture, boxes, recessed windows and a door."""
    x, y, height = rng.uniform(2.5, 7), rng.uniform(2.5, 6), rng.uniform(2.3, 3.2)
    wall, top = 0.3, (0.3 if rng.random() < 0.5 else -0.5)
    shell = _block((-wall, -wall, -wall), (x + wall, y + wall, height + top))
    hollow = [_block((0, 0, 0), (x, y, height + (0.0 if top > 0 else 1.0)))]
    for _ in range(int(rng.integers(1, 5))):  # windows, doors and niches
        place, wide = rng.uniform(0.1, 0.6), rng.uniform(0.5, 1.2)
        low = float(rng.choice([0.0, 0.8]))
        depth = rng.uniform(0.02, 0.2)
        if rng.random() < 0.5:
            hollow.append(_block((place * x, -depth, low), (place * x + wide, 0.1, 1.8)))
        else:
            hollow.append(_block((-depth, place * y, low), (0.1, place * y + wide, 1.8)))
    parts = [_difference(shell, hollow)]
    for _ in range(int(rng.integers(1, 4))):
        kind = rng.random()
        if kind < 0.4:
            thing = _table(rng).rotate([0.0, 0.0, float(rng.uniform(0, 180))])
            thing = thing.translate([float(rng.uniform(1, x - 1)), float(rng.uniform(1, y - 1)), 0.0])
        elif kind < 0.7:
            thing = _shelf(rng).translate([float(rng.uniform(0, x - 1)), float(rng.choice([0.0, 0.05])), 0.0])
        else:
            size = rng.uniform(0.1, 0.8, 3)
            box = _block((0, 0, 0), (size[0], size[1], size[2])).rotate([0.0, 0.0, float(rng.uniform(0, 90))])
            thing = box.translate([float(rng.uniform(0.6, x - 0.9)), float(rng.uniform(0.6, y - 0.9)), 0.0])
        parts.append(thing)
    if rng.random() < 0.5:
        foot = np.array([0.1, y - 0.1, 0.0])
        parts.append(_rod(foot, _above(foot, height - 0.6), rng.uniform(0.01, 0.06)))
    reach = 0.25
    roof = height + reach if top > 0 else np.inf
    return _trimmed(_surface_of(_union(parts)), [-reach] * 3, [x + reach, y + reach, roof])


def _tree(rng: Rng) -> tuple[manifold3d.Manifold, Surface]:
    """Trunk and branches on z = 0 around the z axis, and the leaves: small open quads in an ellipsoid."""
    height, crown = rng.uniform(1.5, 4), rng.uniform(0.5, 1.4, 3)
    middle = np.array([0, 0, height + 0.6 * crown[2]])
    trunk = manifold3d.Manifold.cylinder(height, rng.uniform(0.06, 0.25), 0.06, 24)
    tips = middle + rng.normal(size=(int(rng.integers(4, 12)), 3)) * crown * 0.4
    fork = np.array([0, 0, height * 0.9])
    branches = [_rod(fork, tip, rng.uniform(0.01, 0.04), 8) for tip in tips]
    count = int(_log_uniform(rng, 150, 2500))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centres = middle + direction * crown * rng.uniform(0.3, 1, (count, 1)) ** 0.5
    first, second = rng.normal(size=(2, count, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(first, second)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    size = rng.uniform(0.02, 0.12) * rng.uniform(0.6, 1.4, (count, 1))
    first, second = first * size, second * size * rng.uniform(0.4, 1.0)
    corners = np.stack([centres - first, centres - second, centres + first, centres + second], axis=1)
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return _union([trunk, *branches]), (corners.reshape(-1, 3), faces.reshape(-1, 3))


def _street(rng: Rng) -> Mesh | None:
    """A piece of a street: façade with recessed windows, pavement with a curb, poles, a tree, an object."""
    length, depth, height = rng.uniform(5, 15), rng.uniform(3, 7), rng.uniform(3, 9)
    curb = rng.uniform(0.08, 0.2)
    parts = [
        _block((0, -depth, -1), (length, 0.5, 0)),
        _block((0, -depth * rng.uniform(0.3, 0.7), -0.5), (length, 0.5, curb)),
    ]
    facade = rng.random() < 0.85
    if facade:
        pitch, wide, recess = rng.uniform(1.2, 3), rng.uniform(0.5, 1.1), rng.uniform(0.03, 0.35)
        floor, tall = rng.uniform(2.4, 3.5), rng.uniform(0.8, 2.0)
        windows, frames = [], []
        bar = rng.uniform(0.02, 0.08)
        for x in np.arange(0.4, length - wide - 0.1, pitch):
            for z in np.arange(0.8, height - tall - 0.1, floor):
                windows.append(_block((x, -0.1, z), (x + wide, recess, z + tall)))
                frames.append(
                    _block((x + wide / 2 - bar / 2, recess * 0.6, z), (x + wide / 2 + bar / 2, recess + 0.1, z + tall))
                )
                if rng.random() < 0.5:
                    frames.append(_block((x - 0.1, -rng.uniform(0.03, 0.3), z - 0.08), (x + wide + 0.1, 0.1, z)))
        parts.append(_difference(_block((0, 0, -0.5), (length, 1.0, height)), windows))
        parts += frames
    leaves: list[Surface] = []
    for _ in range(int(rng.integers(1, 5))):
        foot = np.array([rng.uniform(0.5, length - 0.5), rng.uniform(-0.8 * depth, -0.5), 0.0])
        kind = rng.random()
        if kind < 0.55:
            parts.append(_rod(foot, _above(foot, rng.uniform(1, 6)), _log_uniform(rng, 0.01, 0.12)))
        elif kind < 0.85:
            wood, (vertices, faces) = _tree(rng)
            parts.append(wood.translate(foot.tolist()))
            leaves.append((vertices + foot, faces))
        else:
            parts.append(_object(rng, rng.uniform(0.5, 2)).translate(foot.tolist()))
    return _trimmed(
        _surface_of(_union(parts)), [-np.inf, -np.inf, -0.4], [np.inf, 0.45 if facade else np.inf, np.inf], leaves
    )


def _scene(rng: Rng) -> Mesh | None:
    return (_standing, _standing, _room, _street)[int(rng.integers(4))](rng)


# --- The kinds and their weights ----------------------------------------------------------------------------------

Build = Callable[[Rng], Mesh | None]  # None where an attempt gave no shape


@dataclass(frozen=True)
class Kind:
    """A kind of shape and its share of the seeds (the weights are normalised)."""

    weight: float
    build: Build


def _of_solid(build: Callable[[Rng], manifold3d.Manifold]) -> Build:
    def mesh(rng: Rng) -> Mesh | None:
        solid = build(rng)
        return None if solid.num_tri() < 12 else mesh_of(solid)

    return mesh


KINDS: dict[str, Kind] = {
    "solid": Kind(0.16, _of_solid(_solid)),
    "thin solid": Kind(0.11, _of_solid(_thin_solid)),
    "detailed part": Kind(0.18, _of_solid(_detailed_part)),
    "rounded solid": Kind(0.07, _rounded_solid),  # this one and the next two run marching cubes: about 0.5 s each
    "smooth body": Kind(0.06, _smooth_body),
    "organic": Kind(0.10, _organic),
    "relief": Kind(0.07, _relief),
    "rods": Kind(0.05, _of_solid(_rods)),
    "open sheet": Kind(0.03, _open_sheet),
    "parallel sheets": Kind(0.05, _parallel_sheets),
    "scene": Kind(0.12, _scene),
}
