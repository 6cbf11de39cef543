"""Organic bodies and reliefs, with detail at several frequencies from random Fourier modes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from training.shapes.distributions import Rng, log_uniform
from training.shapes.level_sets import (
    AXIS,
    GRID,
    capsule,
    ellipsoid,
    level_set,
    random_part,
    rounded_box,
    smooth_minimum,
    torus,
)
from training.shapes.mesh import Float64, Mesh, Surface, parameter_grid, smooth_mesh

MODES = 12  # plane waves per octave
Evaluate = Callable[[Float64, Float64], Float64]  # wave vectors (m, 3), phases (m,) -> sum of the cosines


def _waves_at(points: Float64) -> Evaluate:
    """Evaluates sums of plane waves at (n, 3) points."""

    def evaluate(vectors: Float64, phases: Float64) -> Float64:
        total: Float64 = np.cos(points @ vectors.T + phases).sum(axis=1)
        return total

    return evaluate


def _waves_on_grid(vectors: Float64, phases: Float64) -> Float64:
    """Evaluates a sum of plane waves on GRID; cos(a + b) = cos a cos b - sin a sin b makes it one matrix product."""
    plane = GRID[:, :, 0, :2].reshape(-1, 2) @ vectors[:, :2].T + phases
    depth = np.outer(vectors[:, 2], AXIS)
    waves = np.hstack([np.cos(plane), -np.sin(plane)]) @ np.vstack([np.cos(depth), np.sin(depth)])
    total: Float64 = waves.reshape(GRID.shape[:3])
    return total


def _detail(rng: Rng, evaluate: Evaluate, lowest: float, highest: float) -> Float64:
    """Noise in octaves from one wave number to another: rolling, ridged or folded. Slopes are about 0.1 to 0.6."""
    style = str(rng.choice(["rolling", "ridges", "folds"]))
    slope = rng.uniform(0.15, 0.6)
    stretch = np.where(rng.random(3) < 0.25, 0.25, 1.0)  # grain along an axis
    total: Float64 = np.zeros(())
    for _ in range(4):
        directions = rng.normal(size=(MODES, 3))
        directions *= stretch / np.linalg.norm(directions, axis=1, keepdims=True)
        vectors = directions * lowest * rng.uniform(0.7, 1.3, (MODES, 1))
        values = evaluate(vectors, rng.uniform(0, 2 * np.pi, MODES)) * np.sqrt(2 / MODES)
        if style == "ridges":
            values = 1 - np.abs(values)
        elif style == "folds":
            values = np.abs(values)
        total = total + slope / lowest * values
        slope *= rng.uniform(0.6, 1.1)
        lowest *= 2
        if lowest > highest:
            break
    return total


def _scales(rng: Rng, points: Float64) -> Float64:
    """Convex cells: scales, pebbles or cobbles, higher in their middle."""
    centres = points[rng.choice(len(points), size=int(log_uniform(rng, 30, 1500)))]
    distances = cKDTree(centres).query(points, k=2)[0]
    width = np.median(distances[:, 0]) * 2
    edge = np.clip((distances[:, 1] - distances[:, 0]) / width, 0, 1)
    scales: Float64 = width * rng.uniform(0.1, 0.6) * np.sqrt(edge)
    return scales


def organic_body(rng: Rng) -> Mesh | None:
    """Blended bodies with detail over three or four octaves."""
    field = random_part(rng, (ellipsoid, capsule, rounded_box))
    for _ in range(int(rng.integers(1, 5))):
        field = smooth_minimum(field, random_part(rng, (ellipsoid, capsule, torus)), rng.uniform(0.05, 0.25))
    return level_set(field + _detail(rng, _waves_on_grid, rng.uniform(4, 12), 90) * rng.uniform(0.5, 1.0))


@lru_cache(maxsize=1)
def _icosphere() -> Surface:
    sphere = trimesh.creation.icosphere(subdivisions=6)
    return np.asarray(sphere.vertices, np.float64), np.asarray(sphere.faces, np.int64)


def relief(rng: Rng) -> Mesh | None:
    """A displaced sphere, an open patch of terrain or an open displaced tube."""
    kind = str(rng.choice(["sphere", "terrain", "tube"]))
    if kind == "sphere":
        directions, faces = _icosphere()
        base = directions * rng.uniform(0.4, 1.0, 3)
        normals = directions
    else:
        u, v, faces = parameter_grid(200, 200)
        if kind == "terrain":
            base = np.stack([u, v * rng.uniform(0.4, 1.0), np.zeros_like(u)], axis=1)
            normals = np.tile([0.0, 0.0, 1.0], (len(u), 1))
        else:
            angle = u * np.pi * rng.uniform(0.4, 1.0)
            normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(u)], axis=1)
            base = normals * log_uniform(rng, 0.1, 0.8) + np.outer(v, [0.0, 0.0, 1.0])
    height = np.zeros(len(base))
    if rng.random() < 0.8:
        height = height + _detail(rng, _waves_at(base), rng.uniform(2, 10), 100)
    if rng.random() < 0.3 or not height.any():
        height = height + _scales(rng, base)
    return smooth_mesh(base + normals * height[:, None], faces)
