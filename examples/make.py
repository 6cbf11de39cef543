"""Makes the example scan: a bracket as a CAD program would draw it, and as a noisy scanner would see it.

    make examples        # or: python -m examples.make

writes bracket_noisy.ply (what a user has: float coordinates, colours, an intensity), bracket_clean.ply (the same points
without noise, row for row) and bracket_mesh.ply (the surface itself, for an exact point-to-surface error).
"""

from __future__ import annotations

from pathlib import Path

import manifold3d
import numpy as np
import plyfile

from pointfilter.noise import add_noise
from training.shapes import Mesh, mesh_of

POINTS = 40_000
NOISE = 0.01  # of the bounding-box diagonal
SIZE = 120.0  # the bracket's diagonal in millimetres
SEED = 7


def bracket() -> manifold3d.Manifold:
    """A base plate and an upright plate, a rib between them, four holes."""
    base = manifold3d.Manifold.cube([60, 40, 8])
    upright = manifold3d.Manifold.cube([8, 40, 50])
    rib = manifold3d.Manifold.extrude(manifold3d.CrossSection([[[0, 0], [34, 0], [0, 34]]]), 6)
    rib = rib.rotate([90, 0, 0]).translate([7, 23, 7])
    solid = base + upright + rib
    for x, y in ((48, 10), (48, 30)):
        solid = solid - manifold3d.Manifold.cylinder(20, 4.5, 4.5, 96).translate([x, y, -5])
    hole = manifold3d.Manifold.cylinder(20, 7, 7, 96).rotate([0, 90, 0])
    return solid - hole.translate([-5, 10, 36]) - hole.translate([-5, 30, 36])


def main() -> None:
    """Writes the three files beside this one."""
    folder = Path(__file__).parent
    mesh = mesh_of(bracket())
    rng = np.random.default_rng(SEED)
    clean, normals = mesh.sample(POINTS, rng)
    noisy = add_noise(clean, NOISE, rng, diagonal=1.0)
    shade = np.clip(110 + 100 * normals @ np.array([0.3, 0.4, 0.85]), 0, 255)
    intensity = rng.gamma(4.0, 0.1, POINTS)
    for name, points in (("noisy", noisy), ("clean", clean)):
        vertices = np.empty(
            POINTS,
            dtype=[(axis, "<f4") for axis in "xyz"]
            + [(colour, "u1") for colour in ("red", "green", "blue")]
            + [("scalar_intensity", "<f4")],
        )
        for axis, column in zip("xyz", (points * SIZE).T, strict=True):
            vertices[axis] = column
        for colour, tint in (("red", 0.75), ("green", 0.85), ("blue", 1.0)):
            vertices[colour] = shade * tint
        vertices["scalar_intensity"] = intensity
        element = plyfile.PlyElement.describe(vertices, "vertex")
        _write(folder / f"bracket_{name}.ply", [element], f"bracket, {name}, mm")
    _write(folder / "bracket_mesh.ply", _mesh_elements(mesh), "bracket, surface, mm")


def _mesh_elements(mesh: Mesh) -> list[plyfile.PlyElement]:
    vertices = np.array([tuple(row) for row in mesh.vertices * SIZE], dtype=[(axis, "<f8") for axis in "xyz"])
    faces = np.empty(len(mesh.faces), dtype=[("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    return [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(faces, "face")]


def _write(path: Path, elements: list[plyfile.PlyElement], comment: str) -> None:
    plyfile.PlyData(elements, byte_order="<", comments=[comment]).write(str(path))


if __name__ == "__main__":
    main()
