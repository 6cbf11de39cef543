"""Thin solids, where one patch holds two surfaces: sheets, folds, tubes, bowls, ribs, slots and wires."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import manifold3d
import numpy as np

from training.shapes.csg import circle, primitive, randomly_placed, randomly_rotated, star_polygon, union
from training.shapes.distributions import Rng, log_uniform
from training.shapes.rods import rod


def thin_solid(rng: Rng) -> manifold3d.Manifold:
    """Sheets, folds, tubes, bowls, ribs, slots and wires, with holes drilled through some of them."""
    thickness = log_uniform(rng, 0.004, 0.08)
    build = _THIN[int(rng.integers(len(_THIN)))]
    solid = build(rng, thickness)
    for _ in range(int(rng.integers(0, 4))):
        hole = manifold3d.Manifold.cylinder(4, rng.uniform(0.02, 0.12), -1.0, 96, True)
        solid = solid - randomly_placed(hole, rng, 0.35)
    return solid


def _sheet(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """A flat piece of any outline."""
    if rng.random() < 0.5:
        return manifold3d.Manifold.cube([*rng.uniform(0.4, 1.0, 2).tolist(), thickness], True)
    outline = star_polygon(rng) if rng.random() < 0.6 else circle(rng.uniform(0.5, 1.0))
    return manifold3d.Manifold.extrude(manifold3d.CrossSection([outline * 0.6]), thickness)


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
    outline = circle(rng.uniform(0.08, 0.5)) if rng.random() < 0.7 else 0.5 * star_polygon(rng)
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
    return outer.scale(size.tolist()) - inner - randomly_rotated(cut, rng)


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
    solid = primitive(rng, str(rng.choice(["box", "cylinder", "prism"])))
    for _ in range(int(rng.integers(1, 5))):
        gap = manifold3d.Manifold.cube([2.0, thickness, rng.uniform(0.3, 1.0)], True)
        solid = solid - randomly_rotated(gap.translate([0, rng.uniform(-0.25, 0.25), rng.uniform(0.1, 0.5)]), rng)
    return solid


def _wires(rng: Rng, thickness: float) -> manifold3d.Manifold:
    """Rods from one point to the next."""
    points = rng.uniform(-0.5, 0.5, (int(rng.integers(4, 9)), 3))
    return union([rod(start, end, thickness, 48) for start, end in pairwise(points)])


_THIN: tuple[Callable[[Rng, float], manifold3d.Manifold], ...] = (
    _sheet, _sheet, _fold, _tube, _bowl, _ribs, _slots, _wires,
)  # fmt: skip
