"""What is measured of a network at export, on procedural clouds that no training sees: how the filter is to use its
expected errors."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from export.graph import graph_network
from pointfilter.adaptive.calibration import Calibration
from pointfilter.filter import filter_points
from pointfilter.metrics import point_to_surface
from pointfilter.network import Network
from training.own import UNCALIBRATED, rows_of_piece
from training.scanning import scan
from training.shapes import Mesh, random_shape

Float64 = NDArray[np.float64]

FAMILY = 2  # of shapes; training has family 0, validation family 1
CLOUDS = 15
LEVELS = (0.001, 0.0025, 0.006, 0.012, 0.025)  # of the noise, in turn; fractions of the diagonal
POINTS = (4_000, 20_000, 100_000)  # points in a cloud; every number is combined with every level
PIECE_POINTS = 10_000  # only a piece of each cloud is filtered; it has three times the points of the largest ball
MEASURED_POINTS = 1_500  # distances are measured at this many points in the middle of the piece
STILL_WEIGHTS = (0.25, 0.5, 0.75, 1.0)
PREFERENCES = (0.0, -0.1, 0.1)  # at a tie the first one is taken
MARGINS = (0.0, 0.1, 0.2)
MOST_LOSS = 0.01  # largest rise of the log error on noisy clouds that is accepted for a larger margin


@dataclass(frozen=True, eq=False)
class _Cloud:
    """A piece (n, 3) of a noisy cloud, from its middle outwards."""

    noisy: Float64
    mesh: Mesh
    level: float


def calibrate(serialised: bytes, patch_points: int) -> Calibration:
    """The calibration of a serialised adaptive graph."""
    network = graph_network(serialised)
    noisy = [_cloud(number, LEVELS[number % len(LEVELS)]) for number in range(CLOUDS)]

    @cache
    def measured(calibration: Calibration) -> list[tuple[Float64, Float64]]:
        """Distances that are left and that are expected in the middle of every piece."""
        return [_measured(cloud, network, calibration, patch_points) for cloud in noisy]

    def cost(calibration: Calibration) -> float:
        """Mean logarithm of the distance that is left, as a share of the noise."""
        left = [distances.mean() for distances, _ in measured(calibration)]
        return float(np.mean(np.log(left) - np.log([cloud.level for cloud in noisy])))

    chosen = dataclasses.replace(UNCALIBRATED, preference=0.0)
    chosen = min((dataclasses.replace(chosen, still_weight=weight) for weight in STILL_WEIGHTS), key=cost)
    chosen = min((dataclasses.replace(chosen, preference=preference) for preference in PREFERENCES), key=cost)
    least = cost(chosen)
    for margin in MARGINS:
        larger = dataclasses.replace(chosen, margin=margin)
        if cost(larger) <= least + MOST_LOSS:
            chosen = larger
    factors = [
        np.log(distances[told := np.isfinite(expected)].mean() / expected[told].mean())
        for distances, expected in measured(chosen)
    ]
    return dataclasses.replace(chosen, error_factor=float(np.exp(np.mean(factors))))


def _cloud(number: int, level: float) -> _Cloud:
    mesh = random_shape(number, FAMILY)
    rng = np.random.default_rng([number, 0xCA1])
    noisy = scan(mesh, POINTS[number // len(LEVELS) % len(POINTS)], level, rng, plain_share=1.0)
    return _Cloud(noisy[rows_of_piece(noisy, PIECE_POINTS, rng)], mesh, level)


def _measured(cloud: _Cloud, network: Network, calibration: Calibration, patch_points: int) -> tuple[Float64, Float64]:
    filtered = filter_points(cloud.noisy, network, calibration=calibration, patch_points=patch_points)
    left = point_to_surface(filtered.points[:MEASURED_POINTS], cloud.mesh.vertices, cloud.mesh.faces)
    return left, filtered.errors[:MEASURED_POINTS]
