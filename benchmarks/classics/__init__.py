"""Classic point-cloud filters, tuned for the benchmark: what a learned filter has to beat.

    python -m benchmarks.classics --data DIR --tune RIMLS --noise 0.005     # an entry of SETTINGS and what is around it

WLOP, bilateral smoothing and jet smoothing are CGAL's (`cgal`), two more are Open3D's (`open3d`), MLS and RIMLS are
written here (`mls`). Each method is a small frozen dataclass of its settings, called with (n, 3) float64 points.
Lengths are fractions of the bounding-box diagonal; `neighbours` counts points, where the library wants counts.

The settings are told the noise level and were tuned (`tuning`) on clouds that the benchmark measures on: an advantage
that these methods have over a network, on purpose.
"""

from __future__ import annotations

import importlib.util
import math
from importlib.metadata import packages_distributions, version

import numpy as np

from benchmarks.classics.cgal import BilateralSmoothing, JetSmoothing, Wlop
from benchmarks.classics.mls import MovingLeastSquares, Rimls
from benchmarks.classics.open3d import Open3dBilateral, Open3dMls
from benchmarks.classics.unit import Float64

Filter = Wlop | BilateralSmoothing | JetSmoothing | Open3dMls | Open3dBilateral | MovingLeastSquares | Rimls

# Chosen for the least geometric mean of CD and P2F, relative to the noisy cloud's. 10 000 points: on fandisk and
# Tetrahedron, with `--tune` or from a grid by hand. 100 000 points: from a handful of candidates each, most of them
# tried on fandisk alone; at 1.5 % and 2.5 % WLOP, MLS and RIMLS are the least searched. Open3D: from a handful of
# candidates each on fandisk; with 100 000 points at 1.5 % and 2.5 % carried on from 1 %, not searched.
SETTINGS: dict[str, dict[tuple[float, int], Filter]] = {
    "CGAL WLOP": {
        (0.005, 100_000): Wlop(0.02, 10),
        (0.01, 100_000): Wlop(0.025, 10),
        (0.015, 100_000): Wlop(0.033, 8),
        (0.025, 100_000): Wlop(0.05, 6),
        (0.005, 10_000): Wlop(0.03, 20),
        (0.01, 10_000): Wlop(0.04, 20),
    },
    "CGAL bilateral": {
        (0.005, 100_000): BilateralSmoothing(180, 150, 15.0, 2),
        (0.01, 100_000): BilateralSmoothing(180, 150, 20.0, 3),
        (0.015, 100_000): BilateralSmoothing(300, 200, 25.0, 3),
        (0.025, 100_000): BilateralSmoothing(500, 300, 30.0, 3),
        (0.005, 10_000): BilateralSmoothing(50, 40, 11.0, 2),
        (0.01, 10_000): BilateralSmoothing(80, 64, 14.0, 2),
    },
    "CGAL jet": {
        (0.005, 100_000): JetSmoothing(50, 4),
        (0.01, 100_000): JetSmoothing(60, 8),
        (0.015, 100_000): JetSmoothing(90, 8),
        (0.025, 100_000): JetSmoothing(150, 8),
        (0.005, 10_000): JetSmoothing(25, 3),
        (0.01, 10_000): JetSmoothing(24, 6),
    },
    "Open3D MLS": {
        (0.005, 100_000): Open3dMls(0.015, 100, 2),
        (0.01, 100_000): Open3dMls(0.025, 250, 2),
        (0.015, 100_000): Open3dMls(0.035, 500, 2),
        (0.025, 100_000): Open3dMls(0.06, 1000, 2),
        (0.005, 10_000): Open3dMls(0.03, 20, 1),
        (0.01, 10_000): Open3dMls(0.05, 25, 2),
        (0.02, 10_000): Open3dMls(0.08, 40, 2),
    },
    "Open3D bilateral": {
        (0.005, 100_000): Open3dBilateral(0.015, 100, 0.01, 0.01, 2),
        (0.01, 100_000): Open3dBilateral(0.025, 250, 0.015, 0.02, 2),
        (0.015, 100_000): Open3dBilateral(0.035, 500, 0.02, 0.03, 2),
        (0.025, 100_000): Open3dBilateral(0.06, 1000, 0.04, 0.05, 2),
        (0.005, 10_000): Open3dBilateral(0.03, 20, 0.02, 0.02, 1),
        (0.01, 10_000): Open3dBilateral(0.05, 40, 0.025, 0.03, 1),
        (0.02, 10_000): Open3dBilateral(0.08, 60, 0.04, 0.06, 2),
    },
    "MLS (PCL's method)": {
        (0.005, 100_000): MovingLeastSquares(0.022, 0.022, 1),
        (0.01, 100_000): MovingLeastSquares(0.028, 0.028, 1),
        (0.015, 100_000): MovingLeastSquares(0.04, 0.04, 1),
        (0.025, 100_000): MovingLeastSquares(0.065, 0.065, 1, 50_000),
        (0.005, 10_000): MovingLeastSquares(0.035, 0.022, 2),
        (0.01, 10_000): MovingLeastSquares(0.045, 0.029, 1),
    },
    "RIMLS": {
        (0.005, 100_000): Rimls(0.04, 0.025, 0.3, 3, 0.4, 1),
        (0.01, 100_000): Rimls(0.06, 0.035, 0.3, 4, 0.4, 1, 50_000),
        (0.015, 100_000): Rimls(0.07, 0.045, 0.3, 4, 0.4, 1, 50_000),
        (0.025, 100_000): Rimls(0.09, 0.06, 0.3, 4, 0.4, 1, 30_000),
        (0.005, 10_000): Rimls(0.06, 0.035, 0.2, 5, 0.3, 1),
        (0.01, 10_000): Rimls(0.08, 0.045, 0.3, 8, 0.3, 1),
    },
}
"""Method -> (noise level as a fraction of the diagonal, number of points) -> settings."""


def available() -> dict[str, str]:
    """Every method's name -> why it is missing here, or an empty string."""
    missing = {
        "CGAL": "" if importlib.util.find_spec("CGAL") else "pip install cgal",
        "Open3D": _open3d_missing(),
    }
    return {method: missing.get(method.partition(" ")[0], "") for method in SETTINGS}


def _open3d_missing() -> str:
    """Why Open3D cannot be used, or an empty string; it is not imported, that takes seconds."""
    wanted = "pip install 'open3d-cpu>=0.20' (and the system's libusb 1.0)"
    if importlib.util.find_spec("open3d") is None:
        return wanted
    installed = version(packages_distributions()["open3d"][0])
    major, minor = (int(number) for number in installed.split(".")[:2])
    return "" if (major, minor) >= (0, 20) else f"{installed} has no smoothing filters: {wanted}"


def tuned(method: str, noise: float, points: int) -> Filter:
    """The entry of SETTINGS nearest to a noise level and a number of points, both on a logarithmic scale."""

    def distance(key: tuple[float, int]) -> float:
        return math.hypot(math.log(key[0] / max(noise, 1e-6)), math.log(key[1] / max(points, 1)))

    entries = SETTINGS[method]
    return entries[min(entries, key=distance)]


def smooth(method: str, points: Float64, noise: float) -> Float64:
    """Filters (n, 3) points with noise of a level (a fraction of the diagonal), by the nearest tuned settings.

    Returns (n, 3) float64, row for row except for CGAL WLOP. Raises KeyError for a method that is not in `available()`,
    ImportError for one that is missing here.
    """
    return tuned(method, noise, len(points))(np.ascontiguousarray(points, np.float64))
