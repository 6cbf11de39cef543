"""Constructive solid geometry with manifold3d: primitives, booleans, random placement, and random CAD solids."""

from __future__ import annotations

import manifold3d
import numpy as np

from training.shapes.distributions import Rng
from training.shapes.mesh import Float64, Mesh, Surface, faceted_mesh


def surface_of(solid: manifold3d.Manifold) -> Surface:
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)


def solid_of(mesh: Mesh) -> manifold3d.Manifold:
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
    return faceted_mesh(*surface_of(solid))


def union(parts: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)


def difference(solid: manifold3d.Manifold, parts: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean([solid, *parts], manifold3d.OpType.Subtract)


def star_polygon(rng: Rng) -> Float64:
    """A star-shaped polygon: anything from a triangle to a cog, convex or not."""
    corners = int(rng.integers(3, 11))
    angles = (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners
    radii = rng.uniform(0.35, 1.0, corners) if rng.random() < 0.6 else np.ones(corners)
    polygon: Float64 = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return polygon


def circle(radius: float, corners: int = 160) -> Float64:
    angles = np.arange(corners) * 2 * np.pi / corners
    circle: Float64 = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return circle


def primitive(rng: Rng, kind: str | None = None) -> manifold3d.Manifold:
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
    profile = manifold3d.CrossSection([star_polygon(rng) * size[0] / 2])
    twist = float(rng.uniform(-60, 60)) if rng.random() < 0.3 else 0.0
    top = float(rng.uniform(0.3, 1.0)) if rng.random() < 0.4 else 1.0
    solid = manifold3d.Manifold.extrude(profile, size[1], 24 if twist else 0, twist, (top, top))
    return solid.translate([0, 0, -size[1] / 2])


def randomly_placed(solid: manifold3d.Manifold, rng: Rng, spread: float) -> manifold3d.Manifold:
    angles = rng.uniform(-180, 180, 3) if rng.random() < 0.6 else 90.0 * rng.integers(0, 4, 3)
    return solid.rotate(angles.tolist()).translate(rng.uniform(-spread, spread, 3).tolist())


def randomly_rotated(solid: manifold3d.Manifold, rng: Rng) -> manifold3d.Manifold:
    return solid.rotate(
        (90.0 * rng.integers(0, 4, 3)).tolist() if rng.random() < 0.4 else rng.uniform(0, 360, 3).tolist()
    )


def boolean_solid(rng: Rng) -> manifold3d.Manifold:
    """A boolean of three to seven random parts."""
    solid = primitive(rng).scale([1.3, 1.3, 1.3])
    for _ in range(int(rng.integers(2, 7))):
        operation = rng.random()
        if operation < 0.5:
            solid = solid - randomly_placed(primitive(rng).scale([0.6, 0.6, 0.6]), rng, 0.5)
        elif operation < 0.65:  # a hole through everything
            hole = manifold3d.Manifold.cylinder(4, rng.uniform(0.04, 0.2), -1.0, 96, True)
            solid = solid - randomly_placed(hole, rng, 0.35)
        elif operation < 0.95:
            solid = solid + randomly_placed(primitive(rng).scale([0.8, 0.8, 0.8]), rng, 0.4)
        else:
            solid = solid ^ randomly_placed(primitive(rng).scale([1.6, 1.6, 1.6]), rng, 0.2)
    return solid
