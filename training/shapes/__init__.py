"""Procedural training shapes, each from one seed: CAD parts, organic bodies, reliefs, thin sheets, rods and scenes.

`KINDS` lists the kinds and their weights. None of the shapes imitates a known test model: all dimensions are random.
"""

from training.shapes.csg import mesh_of
from training.shapes.kinds import KINDS, random_shape
from training.shapes.mesh import Mesh, load_meshes

__all__ = ["KINDS", "Mesh", "load_meshes", "mesh_of", "random_shape"]
