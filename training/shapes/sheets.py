"""Open surfaces without thickness: one sheet, bent or folded, or several parallel ones."""

from __future__ import annotations

import numpy as np

from training.shapes.distributions import Rng, log_uniform
from training.shapes.mesh import Mesh, Surface, compact, faceted_mesh, joined, parameter_grid, smooth_mesh


def _bent(rng: Rng) -> Surface:
    """A smooth open surface: a piece of a cylinder, cone, ball, saddle, wave, helix or roll."""
    kind = str(rng.choice(["cylinder", "cone", "cap", "saddle", "wave", "helix", "roll"]))
    u, v, faces = parameter_grid(96, 96)
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
        radius = 0.3 + log_uniform(rng, 0.02, 0.2) * angle / (2 * np.pi)
        place = [radius * np.cos(angle), radius * np.sin(angle), length * v]
    return np.stack(place, axis=1), faces


def open_sheet(rng: Rng) -> Mesh | None:
    """One surface without thickness: bent smoothly, or folded along straight lines."""
    if rng.random() < 0.65:
        return smooth_mesh(*_bent(rng))
    heading, path = 0.0, [np.zeros(2)]
    for _ in range(int(rng.integers(2, 7))):
        path.append(path[-1] + rng.uniform(0.15, 0.6) * np.array([np.cos(heading), np.sin(heading)]))
        heading += rng.uniform(0.2, 2.0) * rng.choice([-1, 1])
    _, v, faces = parameter_grid(len(path), 2)
    return faceted_mesh(np.column_stack([np.repeat(path, 2, axis=0), v * rng.uniform(0.1, 0.8)]), faces)


def parallel_sheets(rng: Rng) -> Mesh | None:
    """Two to four bent surfaces one behind the other; the gap is 0.3 % to 6 % of the size."""
    vertices, faces = _bent(rng)
    first = smooth_mesh(vertices, faces)
    normals = np.zeros_like(vertices)
    normals[first.faces] = first.corner_normals
    gap = log_uniform(rng, 0.003, 0.06)
    parts = [(first.vertices, first.faces)]
    flipped = rng.random() < 0.5
    u, v, _ = parameter_grid(96, 96)
    for layer in range(1, int(rng.choice([2, 2, 2, 3, 4]))):
        kept = first.faces
        if rng.random() < 0.4:  # a piece only, so that the sheet below has a free part
            border = rng.uniform(-0.5, 0.5)
            kept = kept[((u if rng.random() < 0.5 else v)[kept] > border).all(axis=1)]
        turned = kept[:, ::-1] if flipped and layer % 2 else kept
        parts.append((first.vertices + layer * gap * normals, turned))
    return smooth_mesh(*compact(joined(parts)))
