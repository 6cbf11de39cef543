"""Scenes: objects on a floor, rooms and streets."""

from __future__ import annotations

import manifold3d
import numpy as np
from numpy.typing import NDArray

from training.shapes.csg import boolean_solid, difference, randomly_rotated, solid_of, surface_of, union
from training.shapes.detailed_parts import detailed_part
from training.shapes.distributions import Rng, log_uniform
from training.shapes.level_sets import rounded_solid, smooth_body
from training.shapes.mesh import Float64, Mesh, Surface, compact, faceted_mesh, joined
from training.shapes.organic import organic_body
from training.shapes.rods import above, rod, rods
from training.shapes.thin_solids import thin_solid


def _object(rng: Rng, size: float) -> manifold3d.Manifold:
    """A solid of any closed kind with a diagonal of `size`, standing on z = 0 around the z axis, or an empty one."""
    pick = rng.random()
    if pick < 0.2:
        mesh = (organic_body, smooth_body, rounded_solid)[int(rng.integers(3))](rng)
        solid = manifold3d.Manifold() if mesh is None else solid_of(mesh)
    else:
        build = (boolean_solid, thin_solid, detailed_part, detailed_part, rods)[int(rng.integers(5))]
        solid = build(rng)
    if solid.is_empty():
        return solid
    if rng.random() < 0.3:
        solid = randomly_rotated(solid, rng)
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
    return compact((vertices, faces[inside[faces].all(axis=1)]))


def _standing(rng: Rng) -> Mesh | None:
    """An object on a floor 2 to 10 times as wide, or two or three objects of different size, some without a floor."""
    count = int(rng.choice([1, 1, 2, 3]))
    parts: list[manifold3d.Manifold] = []
    for _ in range(count):
        thing = _object(rng, 1.0 if not parts else log_uniform(rng, 0.1, 1.0))
        if thing.is_empty():
            return None
        parts.append(thing.translate([*(rng.uniform(-1.5, 1.5, 2) * (count > 1)).tolist(), 0.0]))
    if count == 1 or rng.random() < 0.6:
        half = log_uniform(rng, 2, 10) / 2
        parts.append(_block((-half, -half, -0.2), (half, half, rng.uniform(0.0, 0.02))))
    surface = surface_of(union(parts))
    return _trimmed(surface, [-np.inf, -np.inf, -0.1], [np.inf] * 3)


def _trimmed(surface: Surface, low: list[float], high: list[float], more: list[Surface] | None = None) -> Mesh | None:
    kept = _within(surface, np.array(low), np.array(high))
    return faceted_mesh(*joined([kept, *(more or [])])) if len(kept[1]) > 10 else None


def _table(rng: Rng) -> manifold3d.Manifold:
    """A table on z = 0 around the z axis, with a thin top, legs and often an object on it."""
    x, y, height = rng.uniform(0.3, 0.9), rng.uniform(0.25, 0.5), rng.uniform(0.4, 1.0)
    top = rng.uniform(0.015, 0.06)
    leg = rng.uniform(0.015, 0.05)
    parts = [_block((-x, -y, height - top), (x, y, height))]
    for sx in (-1, 1):
        for sy in (-1, 1):
            foot = np.array([sx * (x - 2 * leg), sy * (y - 2 * leg), 0.0])
            parts.append(rod(foot, above(foot, height - top / 2), leg, int(rng.choice([4, 24]))))
    if rng.random() < 0.7:
        parts.append(_object(rng, rng.uniform(0.15, 0.6)).translate([0, 0, height]))
    return union(parts)


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
    return union(parts)


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
    parts = [difference(shell, hollow)]
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
        parts.append(rod(foot, above(foot, height - 0.6), rng.uniform(0.01, 0.06)))
    reach = 0.25
    roof = height + reach if top > 0 else np.inf
    return _trimmed(surface_of(union(parts)), [-reach] * 3, [x + reach, y + reach, roof])


def _tree(rng: Rng) -> tuple[manifold3d.Manifold, Surface]:
    """Trunk and branches on z = 0 around the z axis, and the leaves: small open quads in an ellipsoid."""
    height, crown = rng.uniform(1.5, 4), rng.uniform(0.5, 1.4, 3)
    middle = np.array([0, 0, height + 0.6 * crown[2]])
    trunk = manifold3d.Manifold.cylinder(height, rng.uniform(0.06, 0.25), 0.06, 24)
    tips = middle + rng.normal(size=(int(rng.integers(4, 12)), 3)) * crown * 0.4
    fork = np.array([0, 0, height * 0.9])
    branches = [rod(fork, tip, rng.uniform(0.01, 0.04), 8) for tip in tips]
    count = int(log_uniform(rng, 150, 2500))
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
    return union([trunk, *branches]), (corners.reshape(-1, 3), faces.reshape(-1, 3))


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
        parts.append(difference(_block((0, 0, -0.5), (length, 1.0, height)), windows))
        parts += frames
    leaves: list[Surface] = []
    for _ in range(int(rng.integers(1, 5))):
        foot = np.array([rng.uniform(0.5, length - 0.5), rng.uniform(-0.8 * depth, -0.5), 0.0])
        kind = rng.random()
        if kind < 0.55:
            parts.append(rod(foot, above(foot, rng.uniform(1, 6)), log_uniform(rng, 0.01, 0.12)))
        elif kind < 0.85:
            wood, (vertices, faces) = _tree(rng)
            parts.append(wood.translate(foot.tolist()))
            leaves.append((vertices + foot, faces))
        else:
            parts.append(_object(rng, rng.uniform(0.5, 2)).translate(foot.tolist()))
    return _trimmed(
        surface_of(union(parts)), [-np.inf, -np.inf, -0.4], [np.inf, 0.45 if facade else np.inf, np.inf], leaves
    )


def scene(rng: Rng) -> Mesh | None:
    return (_standing, _standing, _room, _street)[int(rng.integers(4))](rng)
