"""Which ball a point takes: the one in which the network expects the least error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.adaptive.calibration import Calibration
from pointfilter.adaptive.places import NEIGHBOURS
from pointfilter.errors import InvalidModelError
from pointfilter.grids import Grids
from pointfilter.network import Network, answers
from pointfilter.patches import SMALLEST_RADIUS, NeighbourIndex, UInt64
from pointfilter.ranges import over_ranges

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

PROBE_REACH = 3.0  # distance to the probe that stands for a point, in units of the distance to its 24th neighbour
SMOOTHED = 8  # probes whose expected errors are averaged
SPREAD = 4  # probes whose radii a point takes the mean of
PROBES_PER_TASK = 64


@dataclass(frozen=True, eq=False)
class Probes:
    """The best ball of each of k probes, points that stand for their neighbourhoods.

    points: (k, 3). radii: (k,), inf where there is no ball. ball_points: (k,) int64, points in the ball. gains: (k,),
    logarithm of the expected error as a share of the error without a filter, above 0 where the ball does not help.
    errors: (k,), expected distance to the surface without a filter, in the unit of the points; NaN without a ball.
    """

    points: Float64
    radii: Float64
    ball_points: Int64
    gains: Float64
    errors: Float64

    def spread(self, points: Float64, threads: int) -> tuple[Float64, Float64, Float64, Float64]:
        """For (n, 3) points radii, ball_points, gains and errors, each (n,) float64: means over the SPREAD nearest
        probes, of the logarithms except for gains."""
        near = _nearest(self.points, points, SPREAD, threads)
        radii, ball_points, errors = (
            np.exp(np.log(each)[near].mean(axis=1)) for each in (self.radii, self.ball_points, self.errors)
        )
        return radii, ball_points, self.gains[near].mean(axis=1), errors


def has_balls(count: int, calibration: Calibration) -> bool:
    """Whether a cloud of so many distinct points has balls to choose from."""
    return count > max(calibration.balls[0], NEIGHBOURS)


def probe_balls(
    points: Float64,
    keys: UInt64,
    reach: Float64,
    network: Network,
    calibration: Calibration,
    patch_points: int,
    key: int,
    threads: int,
    check: Callable[[], None],
) -> Probes:
    """The best ball of one point in each neighbourhood.

    Balls are compared by the expected error as a share of that without a filter, as far as calibration.still_weight
    says: the error without a filter is the same for all balls, so that what a ball knows wrongly cancels out; one that
    holds only noise underestimates both.

    points: (n, 3) distinct, so many that has_balls is true. keys, reach: of neighbourhood_keys. One point in
    a neighbourhood is a probe: all balls of the calibration are evaluated for it. The expected errors are averaged over
    SMOOTHED probes, for the least of several estimates is biased, and the radii over SPREAD.
    """
    grids = Grids(points)
    probes = np.unique(grids.smallest_key(np.arange(len(points)), PROBE_REACH * reach, keys, threads, check))
    sizes = np.array(calibration.balls)
    radii = np.empty((len(probes), len(sizes)))
    gains, still = np.full((2, len(probes), len(sizes)), np.inf)

    for rows, index in grids.by_radius(probes, reach[probes]):

        def evaluate(first: int, last: int, rows: Int64 = rows, index: NeighbourIndex = index) -> None:
            chosen = rows[first:last]
            found = index.ball_radii(probes[chosen], np.tile(sizes, (len(chosen), 1)), reach[probes[chosen]])
            found = np.where(found > 0, found, np.inf)  # squares of such distances have no digits left
            radii[chosen] = found
            there, column = np.nonzero(np.isfinite(found))
            if not len(there):
                return
            patches = index.patches(probes[chosen[there]], found[there, column], patch_points, key)
            centres = np.zeros((len(there), 3), np.float32)
            said = answers(network, patches.points, patches.counts, False, centres, np.arange(len(there)), check)
            if said.log_errors is None:
                raise InvalidModelError("the network has a calibration and answers without expected errors")
            gains[chosen[there], column] = said.log_errors[:, 0] - said.log_errors[:, 1]
            still[chosen[there], column] = said.log_errors[:, 1] + np.log(found[there, column])

        for _ in over_ranges(evaluate, len(rows), PROBES_PER_TASK, threads, check):
            pass

    places = points[probes]
    near = _nearest(places, places, SMOOTHED, threads)
    gains, smooth_still = gains[near].mean(axis=1), still[near].mean(axis=1)
    # Both are inf where there is no ball, and 0 times that would be NaN.
    wanted = gains if calibration.still_weight == 1 else gains + (1 - calibration.still_weight) * smooth_still
    doublings = np.log2(np.where(np.isfinite(radii), radii, 1.0) / np.maximum(reach[probes], SMALLEST_RADIUS)[:, None])
    wanted = wanted + calibration.preference * doublings
    best = len(sizes) - 1 - np.argmin(wanted[:, ::-1], axis=1)  # the larger at a tie
    rows = np.arange(len(probes))
    taken = radii[rows, best]
    errors = np.exp(still[rows, best], where=np.isfinite(taken), out=np.full(len(probes), np.nan))
    return Probes(places, taken, sizes[best], gains[rows, best], errors)


def _nearest(places: Float64, points: Float64, count: int, threads: int) -> Int64:
    """The nearest of (k, 3) places of each of (n, 3) points: (n, count) int64, fewer columns where k is smaller."""
    wanted = np.arange(1, min(count, len(places)) + 1)
    nearest: Int64 = cKDTree(places).query(points, k=wanted, workers=threads)[1]
    return nearest
