"""Error-coloured pictures: noisy and filtered cloud side by side, points coloured by distance to the surface.

python -m benchmarks.pictures NOISY.ply MESH.ply OUT.png [--iterations 2] [--model NAME]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")
from matplotlib import pyplot as plt

from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.evaluation import read_mesh
from pointfilter.metrics import point_to_surface
from pointfilter.models import open_model
from pointfilter.noise import bounding_box_diagonal
from pointfilter.pipeline import filter_cloud

Float64 = NDArray[np.float64]
VIEW = np.array([0.62, 0.60, 0.50])  # from where the camera looks


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pictures", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("noisy", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--model")
    options = parser.parse_args(arguments)
    noisy = PointCloud.read(options.noisy)
    filtered, _ = filter_cloud(noisy, Engine(open_model(options.model)), iterations=options.iterations)
    vertices, faces = read_mesh(options.mesh)
    diagonal = bounding_box_diagonal(vertices)
    errors = [100 * point_to_surface(cloud.xyz, vertices, faces) / diagonal for cloud in (noisy, filtered)]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for axis, cloud, error, name in zip(axes, (noisy, filtered), errors, ("noisy", "filtered"), strict=True):
        x, y, order = _projected(cloud.xyz)
        drawn = axis.scatter(x, y, c=error[order], s=1.2, cmap="turbo", vmin=0, vmax=errors[0].mean() * 2, lw=0)
        axis.set_title(f"{name}\nmean distance to the surface {error.mean():.3f} % of the diagonal", fontsize=10)
        axis.set_aspect("equal")
        axis.axis("off")
    figure.colorbar(drawn, ax=axes, shrink=0.7, label="distance to the surface, % of the diagonal")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)
    return 0


def _projected(points: Float64) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """Picture coordinates of (n, 3) points, far ones first, and the order they are in."""
    depth = VIEW / np.linalg.norm(VIEW)
    right = np.cross([0.0, 0.0, 1.0], depth)
    right /= np.linalg.norm(right)
    order = np.argsort(points @ depth)
    return points[order] @ right, points[order] @ np.cross(depth, right), order


if __name__ == "__main__":
    sys.exit(main())
