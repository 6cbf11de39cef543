"""Wires, poles and bars, alone or in rows, lattices and bundles."""

from __future__ import annotations

from itertools import pairwise

import manifold3d
import numpy as np

from training.shapes.csg import union
from training.shapes.distributions import Rng, log_uniform
from training.shapes.mesh import Float64


def rod(start: Float64, end: Float64, radius: float, sides: int = 32) -> manifold3d.Manifold:
    """A cylinder (or, with few sides, a bar) from one point to another."""
    along = end - start
    length = max(float(np.linalg.norm(along)), 1e-6)
    rod = manifold3d.Manifold.cylinder(length, radius, -1.0, sides)
    tilt = float(np.degrees(np.arccos(np.clip(along[2] / length, -1, 1))))
    rod = rod.rotate([0.0, tilt, float(np.degrees(np.arctan2(along[1], along[0])))])
    return rod.translate(start.tolist())


def above(place: Float64, height: float) -> Float64:
    above: Float64 = place + np.array([0.0, 0.0, height])
    return above


def rods(rng: Rng) -> manifold3d.Manifold:
    """Wires, poles and bars of all thicknesses: loose, in a row, as a lattice or as a bundle."""
    radius = log_uniform(rng, 0.001, 0.06)
    kind = str(rng.choice(["loose", "row", "lattice", "bundle"]))
    sides = int(rng.choice([4, 8, 32]))
    if kind == "loose":
        points = rng.uniform(-0.5, 0.5, (int(rng.integers(2, 12)), 3))
        pairs = list(pairwise(points))
    elif kind == "row":
        count = int(rng.integers(2, 16))
        spacing = max(1 / count, 3 * radius)
        feet = [np.array([k * spacing, 0.0, 0.0]) for k in range(count)]
        pairs = [(foot, above(foot, rng.uniform(0.5, 0.8))) for foot in feet]
        pairs += [(above(feet[0], z), above(feet[-1], z)) for z in rng.uniform(0.05, 0.5, int(rng.integers(0, 4)))]
    elif kind == "lattice":
        steps = int(rng.integers(1, 3))
        nodes = np.stack(np.meshgrid(*[np.arange(steps + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        pairs = [(a, a + axis) for a in nodes for axis in np.eye(3) if (a + axis <= steps).all()]
        size = rng.uniform(0.3, 1.0, 3) / steps
        pairs = [(a * size, b * size) for a, b in pairs]
    else:
        gap = 2 * radius + log_uniform(rng, 0.003, 0.06)
        offsets = gap * np.argwhere(np.ones((3, 3)))[rng.permutation(9)[: int(rng.integers(2, 8))]]
        pairs = [(np.array([x, y, 0.0]), np.array([x, y, rng.uniform(0.6, 1.0)])) for x, y in offsets]
    equal = rng.random() < 0.6
    return union([rod(a, b, radius if equal else radius * log_uniform(rng, 0.4, 1.5), sides) for a, b in pairs])
