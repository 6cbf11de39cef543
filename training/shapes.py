"""Procedural shapes, so that training needs no download: CAD solids and smooth bodies, each from one seed.

None of them is one of the benchmark's shapes: every solid is a boolean of at least three random parts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes

Float64 = NDArray[np.float64]
Rng = np.random.Generator

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


def random_shape(seed: int, family: int = 0, thin_share: float = 0.0) -> Mesh:
    """The shape of this seed: six in ten are CAD solids, two rounded solids, two smooth bodies.

    Families share no shape: one is for training, another for validation. thin_share: of the seeds that give a thin
    solid instead.
    """
    # Family 0 leaves its number out: that is how the shapes of the first bundle were drawn.
    rng = np.random.default_rng([seed, 0x5AFE, family] if family else [seed, 0x5AFE])
    if thin_share and np.random.default_rng([seed, 0x7415, family]).random() < thin_share:
        build = _thin_solid
    else:
        pick = rng.random()
        build = _solid if pick < 0.6 else _rounded_solid if pick < 0.8 else _smooth_body
    for _ in range(20):
        mesh = build(rng)
        if mesh is not None:
            return mesh
    raise RuntimeError(f"no shape for seed {seed}")  # pragma: no cover - 20 empty booleans in a row


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


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """The faceted mesh of a manifold3d solid, with a diagonal of 1."""
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    return _faceted(vertices, np.asarray(mesh.tri_verts, dtype=np.int64))


# --- CAD solids: booleans of primitives -------------------------------------------------------------------------


def _polygon(rng: Rng) -> Float64:
    """A star-shaped polygon: anything from a triangle to a cog, convex or not."""
    corners = int(rng.integers(3, 11))
    angles = (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners
    radii = rng.uniform(0.35, 1.0, corners) if rng.random() < 0.6 else np.ones(corners)
    polygon: Float64 = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return polygon


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


def _solid(rng: Rng) -> Mesh | None:
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
    return None if solid.num_tri() < 12 else mesh_of(solid)


# --- Thin solids: two surfaces within one patch ------------------------------------------------------------------


def _thin_solid(rng: Rng) -> Mesh | None:
    """Sheets, folds, tubes, bowls, ribs, slots and wires, with holes drilled through some of them."""
    thickness = float(np.exp(rng.uniform(np.log(0.012), np.log(0.08))))
    build = _THIN[int(rng.integers(len(_THIN)))]
    solid = build(rng, thickness)
    for _ in range(int(rng.integers(0, 4))):
        hole = manifold3d.Manifold.cylinder(4, rng.uniform(0.02, 0.12), -1.0, 96, True)
        solid = solid - _placed(hole, rng, 0.35)
    return None if solid.num_tri() < 12 else mesh_of(solid)


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


def _wires(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """Rods from one point to the next."""
    points = rng.uniform(-0.5, 0.5, (int(rng.integers(4, 9)), 3))
    wires = manifold3d.Manifold()
    for start, end in pairwise(points):
        along = end - start
        length = float(np.linalg.norm(along))
        rod = manifold3d.Manifold.cylinder(length, thickness, -1.0, 48)
        tilt = float(np.degrees(np.arccos(along[2] / length)))
        rod = rod.rotate([0.0, tilt, float(np.degrees(np.arctan2(along[1], along[0])))])
        wires = wires + rod.translate(start.tolist())
    return wires


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
    faces = faces.astype(np.int64)
    return Mesh(_unit(vertices.astype(np.float64)), faces, normals.astype(np.float64)[faces])


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
