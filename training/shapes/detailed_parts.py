"""Detailed CAD parts: gears, threads, knobs and plates with arrays of small features."""

from __future__ import annotations

import manifold3d
import numpy as np

from training.shapes.csg import circle, primitive, union
from training.shapes.distributions import Rng, log_uniform
from training.shapes.mesh import Float64


def _profile(rng: Rng, size: float = 1.0) -> manifold3d.CrossSection:
    """A convex outline about `size` wide: rectangle, rounded rectangle, slot, disc or regular polygon."""
    kind = str(rng.choice(["rectangle", "rounded", "slot", "disc", "polygon"]))
    width = size * rng.uniform(0.3, 1.0)
    if kind == "disc":
        return manifold3d.CrossSection([circle(size / 2)])
    if kind == "polygon":
        return manifold3d.CrossSection([circle(size / 2, int(rng.integers(3, 9)))])
    if kind == "slot":
        ends = [circle(width / 4) + np.array([side * (size / 2 - width / 4), 0]) for side in (-1, 1)]
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
        return circle(radius, int(np.clip(2 * np.pi * radius / spacing, 3, 60)))
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
    size = min(log_uniform(rng, 0.004, 0.1), 0.45 * min(width, depth))
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
    array = union(parts).translate([middle[0], middle[1], float(lift)])
    whole = turned - array if cut else turned + array
    # The turns are about one axis each: the opposite angles undo them.
    return whole.rotate([-angle for angle in turn])


def detailed_part(rng: Rng) -> manifold3d.Manifold:
    """A plate, block or turned part with small features, 0.4 % to 10 % of the part in size."""
    pick = rng.random()
    if pick < 0.3:
        build = (_gear, _threaded, _knurled)[int(rng.integers(3))]
        solid = build(rng, log_uniform(rng, 0.02, 0.12))
    else:
        height = log_uniform(rng, 0.03, 0.8)
        bevel = min(log_uniform(rng, 0.004, 0.1), 0.25 * height, 0.06)
        steps = int(rng.choice([1, 8]))
        solid = _beveled(_profile(rng), height, bevel, steps) if rng.random() < 0.7 else primitive(rng)
    for _ in range(int(rng.integers(1, 5) if pick >= 0.3 else rng.integers(0, 2))):
        solid = _with_features(solid, rng)
    return solid
