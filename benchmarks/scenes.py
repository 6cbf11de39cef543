"""Procedural scenes with known surfaces and fixed seeds: clouds that hold several objects of different size.

room              4 × 4 × 3 m with a table, 150 000 points drawn by area, 3 mm Gaussian noise
street            façades, poles, trees and ground around a scanner: density falls with the distance from it and with
                  the angle to the ray; 300 000 points, 20 mm noise along the ray. Faces that look away from the scanner
                  hold no points; parts do not hide each other
object on floor   a turned part on a round floor ten times as wide; noise on the part only
two objects       a turned part and a ball with bumps, 10 000 diagonals apart, both with noise

Every point belongs to one part, and a part's truth is its own triangle mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from pointfilter.metrics import point_to_surface
from pointfilter.noise import bounding_box_diagonal

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Unit = Literal["mm", "% of size"]

ROOM_POINTS, ROOM_NOISE = 150_000, 0.003  # metres
STREET_POINTS, STREET_NOISE = 300_000, 0.02
STREET_CANDIDATES = 10  # points drawn by area for each one that the scanner sees
SCANNER = np.array([0.0, 0.0, 2.0])
OBJECT_POINTS, FLOOR_POINTS = 30_000, 120_000
OBJECT_NOISE = 0.005  # of the object's diagonal
APART = 1e4  # diagonals between the two objects


@dataclass(frozen=True)
class Part:
    """One labelled surface. vertices (v, 3), faces (f, 3). noisy: its points carry noise."""

    name: str
    vertices: Float64
    faces: Int64
    noisy: bool = True

    @cached_property
    def size(self) -> float:
        """Diagonal of its bounding box."""
        return bounding_box_diagonal(self.vertices)

    def distances(self, points: Float64) -> Float64:
        """(n, 3) -> (n,), each point's distance to this surface."""
        return point_to_surface(points, self.vertices, self.faces)


@dataclass(frozen=True)
class Scene:
    """clean and noisy (n, 3), row for row; labels (n,): the part that a point was drawn from."""

    name: str
    unit: Unit
    parts: tuple[Part, ...]
    clean: Float64
    noisy: Float64
    labels: Int64

    def rms(self, points: Float64) -> list[float]:
        """Root mean square distance of the points of each part to the part's surface, in the scene's unit.

        points (n, 3): row i is what became of row i of `noisy`.
        """
        found = []
        for label, part in enumerate(self.parts):
            distances = part.distances(points[self.labels == label])
            found.append(self.scale(part) * float(np.sqrt(np.square(distances).mean())))
        return found

    def scale(self, part: Part) -> float:
        """What turns a distance at a part into the scene's unit."""
        return 1e3 if self.unit == "mm" else 100 / part.size


def room() -> Scene:
    """A room of 4 × 4 × 3 m; its table has a top 3 cm thick and four square legs of 6 cm."""
    x0, x1, y0, y1 = 1.0, 2.6, 1.4, 2.3  # the table top
    under, top, leg = 0.72, 0.75, 0.06
    corners = [(x, y) for x in (x0, x1 - leg) for y in (y0, y1 - leg)]
    feet = [(np.array([x, y]), np.array([x + leg, y + leg])) for x, y in corners]
    parts = (
        _part("floor", [_plate((0, 4), (0, 4), 0.0, feet)]),
        _part("ceiling", [_plate((0, 4), (0, 4), 3.0)]),
        _part("walls", _sides((0, 4), (0, 4), (0, 3))),
        _part("table top", [_plate((x0, x1), (y0, y1), top)]),
        _part("underside", [_plate((x0, x1), (y0, y1), under, feet)]),
        _part("table edge", _sides((x0, x1), (y0, y1), (under, top))),
        _part("legs", [quad for x, y in corners for quad in _sides((x, x + leg), (y, y + leg), (0, under))]),
    )
    rng = np.random.default_rng(1)
    clean, labels, _ = _drawn_by_area(parts, ROOM_POINTS, rng)
    return Scene("room", "mm", parts, clean, clean + rng.normal(scale=ROOM_NOISE, size=clean.shape), labels)


def street() -> Scene:
    """A street of 40 m between façades 16 m apart, seen from SCANNER."""
    rng = np.random.default_rng(2)
    poles = [(x, y) for x in (-15.0, -5.0, 9.0) for y in (-5.5, 5.5)]
    trees = [(x, y) for x in (-10.0, 4.0) for y in (-5.5, 5.5)]
    crowns = [_ball_with_bumps(1.6, rng, centre=(x, y, 4.6)) for x, y in trees]
    feet = [_footprint(x, y, 0.08) for x, y in poles] + [_footprint(x, y, 0.18) for x, y in trees]
    parts = (
        _part("ground", _ground(feet)),
        _part("façades", [quad for y, inwards in ((-8.0, 1), (8.0, -1)) for quad in _facade(y, inwards)]),
        _part("poles", [_turned([(0.08, 0.12), (0.08, 5.0), (0.0, 5.0)], at=at) for at in poles]),
        _part("trunks", [_turned([(0.18, 0.12), (0.12, 2.6), (0.0, 2.6)], at=at) for at in trees]),
        _part("branches", [branch for at in trees for branch in _branches(at, rng)]),
        _part("crowns", crowns),
    )
    places, labels, normals = _drawn_by_area(parts, STREET_CANDIDATES * STREET_POINTS, rng)
    rays = places - SCANNER
    distances = np.linalg.norm(rays, axis=1)
    rays /= distances[:, None]
    seen = np.maximum(-np.einsum("ij,ij->i", rays, normals), 0) / distances**2  # the solid angle of a piece of surface
    chosen = np.sort(rng.choice(len(places), STREET_POINTS, replace=False, p=seen / seen.sum()))
    clean = places[chosen]
    noisy = clean + rays[chosen] * rng.normal(scale=STREET_NOISE, size=(len(clean), 1))
    return Scene("street", "mm", parts, clean, noisy, labels[chosen])


def object_on_floor() -> Scene:
    """A turned part 90 wide with noise on a floor 900 wide without."""
    rings = [(radius, 0.0) for radius in np.geomspace(450.0, 30.0, 20)]  # triangles of the size of what is around them
    parts = (_part("object", [_turned(_profile(90.0))]), _part("floor", [_turned(rings)], noisy=False))
    rng = np.random.default_rng(3)
    drawn = [_drawn_by_area(parts[i : i + 1], n, rng)[0] for i, n in enumerate((OBJECT_POINTS, FLOOR_POINTS))]
    clean = np.concatenate(drawn)
    labels = np.repeat(np.arange(2), [len(points) for points in drawn])
    noise = rng.normal(scale=OBJECT_NOISE * parts[0].size, size=clean.shape)
    return Scene("object on floor", "% of size", parts, clean, clean + noise * (labels == 0)[:, None], labels)


def two_objects() -> Scene:
    """Two objects APART diagonals from each other."""
    rng = np.random.default_rng(4)
    turned = _turned(_profile(1.0))
    diagonal = bounding_box_diagonal(turned.vertices)
    away = APART * diagonal * np.array([1.0, 2.0, 2.0]) / 3
    parts = (_part("turned part", [turned]), _part("ball with bumps", [_ball_with_bumps(0.5, rng, centre=away)]))
    drawn = [_drawn_by_area((part,), OBJECT_POINTS, rng)[0] for part in parts]
    noisy = [
        points + rng.normal(scale=OBJECT_NOISE * part.size, size=points.shape)
        for part, points in zip(parts, drawn, strict=True)
    ]
    labels = np.repeat(np.arange(2), OBJECT_POINTS)
    return Scene("two objects", "% of size", parts, np.concatenate(drawn), np.concatenate(noisy), labels)


SCENES: dict[str, Callable[[], Scene]] = {
    "room": room,
    "street": street,
    "object on floor": object_on_floor,
    "two objects": two_objects,
}
"""Name -> what makes the scene, the same points in every run."""


def _part(name: str, meshes: Iterable[trimesh.Trimesh], noisy: bool = True) -> Part:
    joined = _joined(meshes)
    return Part(name, np.asarray(joined.vertices, np.float64), np.asarray(joined.faces, np.int64), noisy)


def _joined(meshes: Iterable[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of all the faces, in their order."""
    meshes = list(meshes)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def _drawn_by_area(parts: tuple[Part, ...], count: int, rng: np.random.Generator) -> tuple[Float64, Int64, Float64]:
    """Points (count, 3) spread evenly over all parts, the part of each (count,) and the normal there (count, 3)."""
    mesh = _joined(trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    part_of_face = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    return np.asarray(points, np.float64), part_of_face[faces], np.asarray(mesh.face_normals[faces], np.float64)


def _quad(corner: Iterable[float], u: Iterable[float], v: Iterable[float]) -> trimesh.Trimesh:
    """A parallelogram; its normal is u × v."""
    start, along, across = (np.array(list(vector), np.float64) for vector in (corner, u, v))
    corners = [start, start + along, start + along + across, start + across]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


Box = tuple[Float64, Float64]  # lowest and highest corner in a plane


def _plate(x: tuple[float, float], y: tuple[float, float], z: float, holes: Iterable[Box] = ()) -> trimesh.Trimesh:
    """A horizontal rectangle, facing up, with rectangular holes."""
    holes = list(holes)
    xs = np.unique([*x, *(edge[0] for hole in holes for edge in hole)])
    ys = np.unique([*y, *(edge[1] for hole in holes for edge in hole)])
    cells = []
    for left, right in pairwise(xs):
        for low, high in pairwise(ys):
            middle = np.array([left + right, low + high]) / 2
            if not any((a < middle).all() and (middle < b).all() for a, b in holes):
                cells.append(_quad((left, low, z), (right - left, 0, 0), (0, high - low, 0)))
    return _joined(cells)


def _sides(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> list[trimesh.Trimesh]:
    """The four upright faces of a box, facing out."""
    up = (0, 0, z[1] - z[0])
    along, across = (x[1] - x[0], 0, 0), (0, y[1] - y[0], 0)
    return [
        _quad((x[0], y[0], z[0]), along, up),
        _quad((x[1], y[0], z[0]), across, up),
        _quad((x[1], y[1], z[0]), np.negative(along), up),
        _quad((x[0], y[1], z[0]), np.negative(across), up),
    ]


def _turned(profile: list[tuple[float, float]], at: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    """The surface that a profile of (distance from the axis, height) makes around an upright axis; bottom first."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=128)
    mesh.apply_translation((*at, 0.0))
    return mesh


def _profile(width: float) -> list[tuple[float, float]]:
    """Of a turned part with steps, a groove, a chamfer and a rounded head, from its foot up."""
    angles = np.linspace(-0.5, 0.5, 24) * np.pi
    head = [(0.25 * np.cos(angle), 1.25 + 0.25 * np.sin(angle)) for angle in angles[4:]]
    steps = [(1 / 3, 0.0), (0.5, 0.08), (0.5, 0.25), (0.35, 0.25), (0.35, 0.45), (0.31, 0.47), (0.31, 0.53)]
    steps += [(0.35, 0.55), (0.35, 0.75), (0.3, 0.8), (0.18, 0.8), (0.12, 1.0)]
    return [(width * radius, width * height) for radius, height in steps + head[:-1]] + [(0.0, width * 1.5)]


def _ball_with_bumps(radius: float, rng: np.random.Generator, centre: Iterable[float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=5)
    waves = rng.normal(scale=4.0, size=(8, 3))
    bumps = np.sin(mesh.vertices @ waves.T + rng.uniform(0, 2 * np.pi, 8)).mean(axis=1)
    return trimesh.Trimesh(
        mesh.vertices * radius * (1 + 0.3 * bumps[:, None]) + list(centre), mesh.faces, process=False
    )


def _footprint(x: float, y: float, radius: float) -> Box:
    """The square inside a round foot."""
    reach = radius / np.sqrt(2)
    return np.array([x - reach, y - reach]), np.array([x + reach, y + reach])


def _ground(feet: list[Box]) -> list[trimesh.Trimesh]:
    """A road between two pavements 12 cm above it."""
    length, kerb, height, end = 20.0, 4.0, 0.12, 8.0
    pavements = [
        _plate((-length, length), y, height, [foot for foot in feet if y[0] < foot[0][1] < y[1]])
        for y in ((-end, -kerb), (kerb, end))
    ]
    kerbs = [
        _quad((length, -kerb, 0), (-2 * length, 0, 0), (0, 0, height)),
        _quad((-length, kerb, 0), (2 * length, 0, 0), (0, 0, height)),
    ]
    return [_plate((-length, length), (-kerb, kerb), 0.0), *pavements, *kerbs]


def _facade(y: float, inwards: int) -> list[trimesh.Trimesh]:
    """A wall of 40 × 10 m in the plane y, facing the street, its windows 15 cm deep."""
    width, height, depth = 1.2, 1.6, 0.15
    windows = [(x, z) for x in np.arange(-18.0, 18.0, 3.0) for z in (1.2, 4.2, 7.2)]
    holes = [(np.array([x, z]), np.array([x + width, z + height])) for x, z in windows]
    wall = _plate((-20, 20), (0.12, 10), 0.0, holes)
    panes = [_quad((x, z, -depth), (width, 0, 0), (0, height, 0)) for x, z in windows]
    reveals = [side for x, z in windows for side in _sides((x, x + width), (z, z + height), (-depth, 0.0))]
    for side in reveals:
        side.invert()  # seen from inside
    turned = []
    for mesh in (wall, *panes, *reveals):
        # The plane (x, z) with its height above the wall: stood up so that it faces the street.
        flat = mesh.vertices
        upright = np.column_stack([flat[:, 0], y + inwards * flat[:, 2], flat[:, 1]])
        faces = mesh.faces if inwards < 0 else mesh.faces[:, ::-1]
        turned.append(trimesh.Trimesh(upright, faces, process=False))
    return turned


def _branches(at: tuple[float, float], rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Five branches from the upper trunk outwards and up, each with a thinner one at its end."""
    found = []
    for turn in np.arange(5) * 2 * np.pi / 5 + rng.uniform(0, 1):
        start = np.array([*at, rng.uniform(1.9, 2.4)])
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        fork = start + 0.9 * out + [0, 0, 0.5]
        for first, last, radius in ((start + 0.12 * out, fork, 0.05), (fork, fork + 0.5 * out + [0, 0, 0.6], 0.03)):
            found.append(trimesh.creation.cylinder(radius, segment=[first, last], sections=24, cap=False))
    return found
