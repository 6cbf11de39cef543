"""Smooth shapes as level sets of distance fields, meshed with marching cubes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from skimage.measure import marching_cubes

from training.shapes.distributions import Rng
from training.shapes.mesh import Float64, Mesh, faceted_mesh, unit_normals

RESOLUTION = 112
AXIS = np.linspace(-1, 1, RESOLUTION)
GRID: Float64 = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1)


def _rotation(rng: Rng) -> Float64:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation: Float64 = q * np.sign(np.diag(r))
    return rotation


def level_set(field: Float64) -> Mesh | None:
    """The surface field = 0 (negative inside), with the field's gradient as normals."""
    for axis in range(3):  # closed at the border of the grid
        for side in (0, -1):
            np.moveaxis(field, axis, 0)[side] = np.maximum(np.moveaxis(field, axis, 0)[side], 0.05)
    if field.min() > -0.02:
        return None
    vertices, faces, normals, _ = marching_cubes(  # type: ignore[no-untyped-call]
        field, 0.0, spacing=(AXIS[1] - AXIS[0],) * 3, gradient_direction="ascent"
    )
    if len(faces) < 2000:
        return None
    flat = faceted_mesh(vertices.astype(np.float64), faces.astype(np.int64))
    return Mesh(flat.vertices, flat.faces, unit_normals(normals.astype(np.float64)[flat.faces], flat))


def smooth_minimum(a: Float64, b: Float64, width: float) -> Float64:
    blend = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    smooth: Float64 = b * (1 - blend) + a * blend - width * blend * (1 - blend)
    return smooth


def rounded_box(p: Float64, rng: Rng) -> Float64:
    half = rng.uniform(0.12, 0.55, 3)
    rounding = rng.uniform(0.03, 0.1)
    q = np.abs(p) - (half - rounding)
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
    field: Float64 = outside + np.minimum(q.max(axis=-1), 0) - rounding
    return field


def torus(p: Float64, rng: Rng) -> Float64:
    ring = np.hypot(np.hypot(p[..., 0], p[..., 1]) - rng.uniform(0.3, 0.5), p[..., 2])
    field: Float64 = ring - rng.uniform(0.06, 0.2)
    return field


def capsule(p: Float64, rng: Rng) -> Float64:
    height = rng.uniform(0.1, 0.5)
    z = p[..., 2] - np.clip(p[..., 2], -height, height)
    field: Float64 = np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + z**2) - rng.uniform(0.08, 0.3)
    return field


def ellipsoid(p: Float64, rng: Rng) -> Float64:
    axes = rng.uniform(0.2, 0.6, 3)
    field: Float64 = (np.linalg.norm(p / axes, axis=-1) - 1) * axes.min()
    return field


_PARTS: tuple[Callable[[Float64, Rng], Float64], ...] = (rounded_box, torus, capsule, ellipsoid)


def random_part(rng: Rng, kinds: tuple[Callable[[Float64, Rng], Float64], ...] = _PARTS) -> Float64:
    moved = (GRID - rng.uniform(-0.3, 0.3, 3)) @ _rotation(rng).T
    return kinds[int(rng.integers(len(kinds)))](moved, rng)


def rounded_solid(rng: Rng) -> Mesh | None:
    """Fillets: rounded parts, joined and cut with a smooth minimum."""
    field = random_part(rng, (rounded_box,))
    for _ in range(int(rng.integers(1, 5))):
        width = rng.uniform(0.04, 0.15)
        if rng.random() < 0.6:
            field = smooth_minimum(field, random_part(rng), width)
        else:
            field = -smooth_minimum(-field, random_part(rng), width)
    return level_set(field)


def smooth_body(rng: Rng) -> Mesh | None:
    """Organic bodies: blended ellipsoids and tubes, with waves on the surface."""
    field = random_part(rng, (ellipsoid, capsule))
    for _ in range(int(rng.integers(2, 7))):
        field = smooth_minimum(field, random_part(rng, (ellipsoid, capsule, torus)), rng.uniform(0.08, 0.3))
    for _ in range(int(rng.integers(0, 4))):
        frequency = rng.uniform(2, 14)
        wave = np.sin(frequency * (GRID @ _rotation(rng)) + rng.uniform(0, 6.28, 3)).prod(axis=-1)
        field = field + rng.uniform(0.2, 0.6) / frequency * wave * 0.6
    return level_set(field)
