"""Accuracy of a model on clouds with known surfaces: one command, one table, everything in it measured in this run.

    python -m benchmarks.quality --data DIR                 # the default model, one and two iterations
    python -m benchmarks.quality --data DIR --model NAME --iterations 1 2 4 --noise 0.005 0.01 --json scores.json

DIR is laid out like the paper's test clouds: NAME.npy (clean), NAME_0.005.npy (noisy, row for row) and mesh/*.ply
(surfaces; the one that fits a cloud is found by distance). The data is not part of this repository: --data or
POINTFILTER_BENCHMARK_DATA says where it lies. CD ×1e5, P2F ×1e3, clean model scaled to a diagonal of 1 (§4.3). "limit"
is the exact projection of the noisy points onto the surface.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.evaluation import read_mesh
from pointfilter.metrics import chamfer_distance, closest_on_surface, normalised, point_to_surface
from pointfilter.models import open_model
from pointfilter.pipeline import filter_cloud

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Subject:
    """One clean cloud with its surface; the noisy clouds are beside it on disk."""

    name: str
    clean: Float64
    vertices: Float64
    faces: NDArray[np.int64]

    def scores(self, points: Float64) -> dict[str, float]:
        """CD ×1e5 and P2F ×1e3 of points in the units of the files."""
        clean, scaled, vertices = normalised(self.clean, points, self.vertices)
        return {
            "cd": 1e5 * chamfer_distance(clean, scaled),
            "p2f": 1e3 * float(point_to_surface(scaled, vertices, self.faces).mean()),
        }


def load_subjects(folder: Path) -> list[Subject]:
    """Every NAME.npy of a folder that is no noisy copy, with the mesh that lies closest to it."""
    meshes = [read_mesh(path) for path in sorted((folder / "mesh").glob("*.ply"))]
    subjects = []
    for path in sorted(folder.glob("*.npy")):
        if re.search(r"_0\.\d+$", path.stem):
            continue
        clean = np.load(path, allow_pickle=False).astype(np.float64)
        probe = clean[:: max(1, len(clean) // 500)]
        distances = [point_to_surface(probe, *mesh).mean() for mesh in meshes]
        vertices, faces = meshes[int(np.argmin(distances))]
        subjects.append(Subject(path.stem, clean, vertices, faces))
    return subjects


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("POINTFILTER_BENCHMARK_DATA"))
    parser.add_argument("--model", help="a bundle's name or folder (default: the package's default)")
    parser.add_argument("--iterations", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--noise", nargs="+", default=["0.005"], help="levels as in the file names (default: 0.005)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the table there as well")
    options = parser.parse_args(arguments)
    if options.data is None or not Path(options.data, "mesh").is_dir():
        print(
            "no benchmark data: name a folder with clouds and mesh/ by --data or POINTFILTER_BENCHMARK_DATA",
            file=sys.stderr,
        )
        return 2
    engine = Engine(open_model(options.model))
    subjects = load_subjects(Path(options.data))
    table = []
    for level in options.noise:
        for subject in subjects:
            noisy_path = Path(options.data) / f"{subject.name}_{level}.npy"
            if noisy_path.is_file():
                table += _rows(subject, level, np.load(noisy_path).astype(np.float64), engine, options)
    if not table:
        print(f"no cloud with noise {', '.join(options.noise)} in {options.data}", file=sys.stderr)
        return 2
    _print(table)
    if options.json:
        scores = {"model": engine.bundle.name, "sha256": engine.bundle.sha256, "means": _means(table), "rows": table}
        options.json.write_text(json.dumps(scores, indent=1) + "\n")
    return 0


Row = dict[str, str | float]


def _rows(subject: Subject, level: str, noisy: Float64, engine: Engine, options: argparse.Namespace) -> list[Row]:
    def row(method: str, points: Float64, seconds: float) -> Row:
        found: Row = {
            "noise": level,
            "cloud": subject.name,
            "method": method,
            **subject.scores(points),
            "seconds": seconds,
        }
        print(f"  {level} {subject.name}: {method}", file=sys.stderr)
        return found

    rows = [
        row("noisy", noisy, 0.0),
        row("limit", closest_on_surface(noisy, subject.vertices, subject.faces), 0.0),
    ]
    for iterations in options.iterations:
        started = time.perf_counter()
        filtered, _ = filter_cloud(PointCloud(noisy.copy()), engine, iterations=iterations, seed=options.seed)
        rows.append(row(f"{engine.bundle.name} ×{iterations}", filtered.xyz, time.perf_counter() - started))
    return rows


def _means(table: list[Row]) -> list[Row]:
    means: list[Row] = []
    for noise, method in dict.fromkeys((row["noise"], row["method"]) for row in table):
        chosen = [row for row in table if (row["noise"], row["method"]) == (noise, method)]
        values = {name: float(np.mean([float(row[name]) for row in chosen])) for name in ("cd", "p2f", "seconds")}
        means.append({"noise": noise, "cloud": f"mean of {len(chosen)}", "method": method, **values})
    return means


def _print(table: list[Row]) -> None:
    print(f"{'noise':8}{'cloud':24}{'method':28}{'CD x1e5':>10}{'P2F x1e3':>10}{'seconds':>10}")
    for row in [*table, *_means(table)]:
        figures = "".join(f"{float(row[name]):10.3f}" for name in ("cd", "p2f"))
        print(f"{row['noise']:8}{row['cloud']:24}{row['method']:28}{figures}{float(row['seconds']):10.1f}")


if __name__ == "__main__":
    sys.exit(main())
