"""What a cloud needs where nobody says so: how large a ball, how many passes, for which of its points. The network's
first step is the gauge.

It knows shape from noise, whatever the density (docs/adr/0007-automatic-iterations.md). Where the step is long for the
few points that the ball holds, the answer is as noisy as they are, and the ball grows
(docs/adr/0014-radius-of-sparse-clouds.md); where the network takes the two sides of something thin for one, it
shrinks (docs/adr/0017-thin-sheets.md). Where most steps are next to nothing and a few are long, the noise is in
places only, and the points between them stay as they were (docs/adr/0015-noise-in-places.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pointfilter.patches import NeighbourIndex, Patches, sample_rows, sampling_key
from pointfilter.prediction import Float64, Predict, displacements
from pointfilter.ranges import over_ranges

SAMPLE_POINTS = 2_048  # points by which a cloud is judged: the standard error stays below two hundredths
CLEAN = 0.007  # of the radius: below such a mean displacement of one pass, the cloud is clean
CLEAN_OF_FEW = 0.35  # the same, times the points in a ball: of few points the network cannot tell detail from noise
CLEAN_AT_MOST = 0.012  # however few they are
PASSES = ((0.1, 2), (0.2, 3))
"""(Mean displacement of one pass, in units of the radius; passes over a cloud that stays below it and is not clean)."""
MOST_PASSES = 4  # above all of them
ENOUGH = 0.0105  # of the radius: a displacement that is longer, per root of the ball's points, asks for a larger ball
LARGEST_GROWTH = 1.5  # of the radius: more draws thin things together
LOOKS = 3  # at a cloud, each with a larger ball
TWO_SHEETS = 2.75  # kurtosis of the heights in a ball: noise on one sheet has about 3, two sheets have less
BLURRED = 2.65  # kurtosis: below it two sheets are nearly twice as far apart as the noise is high, or more
MERGED = 0.25  # of the squared heights are left after a step, or less: the network takes two sheets for one
WIDE = 0.6  # of the variance along the first axis of a ball is along the second one: a sheet and no wire
SHRINKING = 0.8  # of the radius, at a time: for two sheets that merge
SHRINKINGS = 2
TOO_FEW = 0.017  # of the radius: a displacement that is longer, per root of the ball's points, asks for no smaller ball
HEAVIEST = 6.0  # kurtosis that one ball counts with
FEWEST_HEIGHTS = 16  # of a ball whose kurtosis is taken
PATCHY = (0.15, 0.5)
"""(Of the mean step, share of the points): where more points than that take shorter steps, noise is in places only."""
MOSTLY_CLEAN = 0.5  # of the points in a ball take steps as short as in a CLEAN cloud: it is a clean place
UNTOUCHED = 0.03  # of the radius: a longer step is not taken for detail that looks like noise
LOOKED_AT = 64  # points in a ball that tell whether the place is clean, at least
POINTS_PER_TASK = 16_384


@dataclass(frozen=True)
class Look:
    """What one pass would do to a sample of a cloud. displacement: mean length, in units of the radius; neighbours:
    median of the points in a ball; kurtosis: mean over the balls, of the heights of the points above their plane;
    width: mean share of the variance along a ball's first axis that is along its second one; kept: share of the squared
    height of the points above the middle of their ball that is left after the step."""

    displacement: float
    neighbours: float
    kurtosis: float = 3.0
    width: float = 1.0
    kept: float = 0.0

    @property
    def clean(self) -> bool:
        return self.displacement < max(CLEAN, min(CLEAN_AT_MOST, CLEAN_OF_FEW / self.neighbours))

    @property
    def passes(self) -> int:
        """As many as the cloud needs: 0 for a clean one."""
        if self.clean:
            return 0
        return next((passes for below, passes in PASSES if self.displacement < below), MOST_PASSES)

    @property
    def growth(self) -> float:
        """By how much the radius must grow, at least; 1: it is large enough. In a ball of r, noise is shorter by r and
        its mean over the points, whose number goes with r², once more."""
        return 1.0 if self.clean else max(1.0, float(np.sqrt(self.error / ENOUGH)))

    @property
    def error(self) -> float:
        """Standard error of a mean over the ball, in units of the radius."""
        return self.displacement / float(np.sqrt(self.neighbours))

    @property
    def merges(self) -> bool:
        """Whether there are two sheets in a ball, and the step draws them together."""
        return not self.clean and self.kurtosis < BLURRED and self.width > WIDE and self.kept < MERGED


def look_at(
    points: Float64,
    ids: NDArray[np.uint64],
    index: NeighbourIndex,
    predict: Predict,
    patch_points: int,
    seed: int = 0,
    check: Callable[[], None] = lambda: None,
) -> Look:
    """Evaluates the first pass for a sample of the (n, 3) points. index, ids: of the points.

    The sample depends on ids and seed, so neither on the points' order nor on their pose.
    """
    rows = sample_rows(ids, SAMPLE_POINTS, seed)
    patches = index.patches(points[rows], ids[rows], patch_points, sampling_key(seed, 0))
    steps = displacements(predict, patches, check)
    kurtosis, width, middles = _spread(patches)
    before, after = (float(np.square(heights).sum()) for heights in (middles, steps[:, 2] - middles))
    return Look(
        displacement=float(np.linalg.norm(steps, axis=1).mean()),
        neighbours=float(np.median(patches.counts)),
        kurtosis=kurtosis,
        width=width,
        kept=after / before if before > 0 else 1.0,
    )


def with_fitting_ball(
    index: NeighbourIndex,
    points: Float64,
    ids: NDArray[np.uint64],
    predict: Predict,
    patch_points: int,
    seed: int = 0,
    check: Callable[[], None] = lambda: None,
) -> tuple[NeighbourIndex, Look]:
    """The index of the points with a radius that fits them, from the given index's on, and a look at it.

    It grows as long as the ball holds too few points for the noise, but no further than one sheet of the surface:
    points of another one are no help. It shrinks where the network takes two sheets for one.
    """

    def of(radius: float) -> tuple[NeighbourIndex, Look]:
        other = NeighbourIndex(points, radius, ids)
        return other, look_at(points, ids, other, predict, patch_points, seed, check)

    largest = LARGEST_GROWTH * index.radius
    look = look_at(points, ids, index, predict, patch_points, seed, check)
    for _ in range(LOOKS - 1):
        if look.growth == 1 or index.radius >= largest:
            break
        larger, next_look = of(min(largest, index.radius * look.growth))
        if next_look.kurtosis < TWO_SHEETS:
            break
        index, look = larger, next_look
    for _ in range(SHRINKINGS):
        if not look.merges:
            break
        smaller, next_look = of(SHRINKING * index.radius)
        if next_look.error > TOO_FEW:
            break
        index, look = smaller, next_look
    return index, look


def _spread(patches: Patches) -> tuple[float, float, Float64]:
    """Kurtosis of the points' z (of the least variance) and share of the variance along y (of the most) that is along
    x, each a mean over the patches, 3 and 1 where all are too few; and the mean z of every patch, (B,) float64.

    m₄ / m₂² times (n + 1) / (n - 1), which is 3 on average for n normal heights; at most HEAVIEST, for stray points.
    """
    counts = np.minimum(patches.counts, patches.points.shape[1])
    present = np.arange(patches.points.shape[1]) < counts[:, None]

    def about_the_mean(axis: int) -> tuple[Float64, Float64]:
        values = patches.points[:, :, axis].astype(np.float64)  # padding is 0
        means = values.sum(axis=1) / counts
        return np.where(present, values - means[:, None], 0), means

    heights, middles = about_the_mean(2)
    across, along = (np.square(about_the_mean(axis)[0]).sum(axis=1) for axis in (0, 1))
    second, fourth = (np.power(heights, order).sum(axis=1) / counts for order in (2, 4))
    told = (counts >= FEWEST_HEIGHTS) & (second > 0) & (along > 0)
    if not told.any():
        return 3.0, 1.0, middles
    found = fourth[told] / np.square(second[told]) * (counts[told] + 1) / (counts[told] - 1)
    return float(np.minimum(found, HEAVIEST).mean()), float((across[told] / along[told]).mean()), middles


def untouched(
    lengths: Float64, index: NeighbourIndex, threads: int = 1, check: Callable[[], None] = lambda: None
) -> NDArray[np.bool_]:
    """Which points no noise has moved, though it has moved others: (n,) bool.

    lengths: (n,) float64 of the first pass's steps, in units of the radius. index: of the points before it. All False
    where the noise is everywhere. check() is called between tasks.
    """
    short, share = PATCHY
    mean = np.sort(lengths).mean()  # sorted: the sum must not depend on the row order
    if (lengths < short * mean).mean() <= share:
        return np.zeros(len(lengths), dtype=np.bool_)
    quiet = np.zeros((len(lengths), 3))
    quiet[:, 0] = lengths[index.order] < CLEAN

    def shares(first: int, last: int) -> Float64:
        return index.averages(quiet, first, last, LOOKED_AT)[0][:, 0]

    clean = np.empty(len(lengths), dtype=np.bool_)
    clean[index.order] = np.concatenate(over_ranges(shares, len(quiet), POINTS_PER_TASK, threads, check)) > MOSTLY_CLEAN
    return clean & (lengths < UNTOUCHED)
