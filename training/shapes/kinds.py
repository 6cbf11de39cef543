"""The kinds of shapes, their weights, and the shape of a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import manifold3d
import numpy as np

from training.shapes.csg import boolean_solid, mesh_of
from training.shapes.detailed_parts import detailed_part
from training.shapes.distributions import Rng
from training.shapes.level_sets import rounded_solid, smooth_body
from training.shapes.mesh import Mesh
from training.shapes.organic import organic_body, relief
from training.shapes.rods import rods
from training.shapes.scenes import scene
from training.shapes.sheets import open_sheet, parallel_sheets
from training.shapes.thin_solids import thin_solid

Build = Callable[[Rng], Mesh | None]  # None where an attempt gave no shape


@dataclass(frozen=True)
class Kind:
    """A kind of shape and its share of the seeds (the weights are normalised)."""

    weight: float
    build: Build


def _of_solid(build: Callable[[Rng], manifold3d.Manifold]) -> Build:
    def mesh(rng: Rng) -> Mesh | None:
        solid = build(rng)
        return None if solid.num_tri() < 12 else mesh_of(solid)

    return mesh


KINDS: dict[str, Kind] = {
    "solid": Kind(0.16, _of_solid(boolean_solid)),
    "thin solid": Kind(0.11, _of_solid(thin_solid)),
    "detailed part": Kind(0.18, _of_solid(detailed_part)),
    "rounded solid": Kind(0.07, rounded_solid),  # this one and the next two run marching cubes: about 0.5 s each
    "smooth body": Kind(0.06, smooth_body),
    "organic": Kind(0.10, organic_body),
    "relief": Kind(0.07, relief),
    "rods": Kind(0.05, _of_solid(rods)),
    "open sheet": Kind(0.03, open_sheet),
    "parallel sheets": Kind(0.05, parallel_sheets),
    "scene": Kind(0.12, scene),
}


def random_shape(seed: int, family: int = 0) -> Mesh:
    """The shape of this seed; its kind is drawn with the weights of KINDS.

    Families share no shape: one is for training, another for validation. Raises RuntimeError if no attempt succeeds.
    """
    rng = np.random.default_rng([seed, 0x5AFE, family])
    kinds = list(KINDS.values())
    weights = np.array([kind.weight for kind in kinds])
    build = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))].build
    for _ in range(20):
        mesh = build(rng)
        if mesh is not None and len(mesh.faces):
            return mesh
    raise RuntimeError(f"no shape for seed {seed}")  # pragma: no cover - 20 empty shapes in a row
