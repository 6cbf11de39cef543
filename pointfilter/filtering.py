"""Eq. 8 and its iterations: the one place where displacements become points.

p̄ᵢ = r · R⁻¹ · f(R(P̂ᵢ − p̂ᵢ)/r) + p̂ᵢ
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pointfilter.automatic import look_at, untouched, with_fitting_ball
from pointfilter.drift import without_drift
from pointfilter.errors import (
    DegenerateCloudError,
    FilteringCancelledError,
    ParameterError,
    TooFewPointsError,
)
from pointfilter.extent import extent
from pointfilter.models import Auto
from pointfilter.noise import bounding_box_diagonal
from pointfilter.patches import NeighbourIndex, length_buckets, sampling_key, stable_ids
from pointfilter.prediction import MIN_NEIGHBOURS, Float64, Predict, displacements, patches_per_batch
from pointfilter.ranges import over_ranges

DEFAULT_RADIUS = 0.05  # of the bounding-box diagonal (§3.2)
DEFAULT_ITERATIONS = 2
MAX_ITERATIONS = 100
SMALLEST_RADIUS = 1e-150  # its square is still a number
BATCHES_PER_TASK = 8  # batches that a worker cuts in one go, so that workers seldom meet at the interpreter's lock
ARRIVED = 0.04  # of the radius: after the second pass, a point whose step was shorter stays where it is
DRIFT_FROM = 3  # passes: so many take more than noise away, and their drift is given back
CENTRES_PER_COUNT = 1024  # centres whose neighbours are counted between two looks at `cancelled`


@dataclass
class Timings:
    """Seconds spent, by stage, and what was decided. `patches` and `infer` are summed over the threads."""

    passes: int = 0
    radius: float = 0.0
    """In the unit of the points."""
    index: float = 0.0
    patches: float = 0.0
    infer: float = 0.0
    drift: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def as_dict(self) -> dict[str, float]:
        return {"index": self.index, "patches": self.patches, "infer": self.infer, "drift": self.drift}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                setattr(self, stage, getattr(self, stage) + time.perf_counter() - started)


def resolve_radius(points: Float64, radius: float | None, fraction: float = DEFAULT_RADIUS) -> float:
    """The absolute radius: the given one, or `fraction` of the bounding-box diagonal of the (n, 3) points, without
    stray ones that stretch it (extent.py).

    Raises ParameterError for a radius that is no finite number above 0 or is larger than the diagonal,
    DegenerateCloudError when the points have no extent to take a fraction of, or one beyond double precision.
    """
    diagonal = bounding_box_diagonal(points)
    if not np.isfinite(diagonal):  # squares of such distances would overflow
        raise DegenerateCloudError("the extent of the cloud is beyond double precision", hint="remove the stray points")
    if radius is not None:
        if not (np.isfinite(radius) and radius >= SMALLEST_RADIUS):
            raise ParameterError(
                f"radius must be a finite number above 0 (at least {SMALLEST_RADIUS:g}), got {radius:g}",
                limit=SMALLEST_RADIUS,
                actual=radius,
            )
        if 0 < diagonal < radius:
            raise ParameterError(
                f"radius {radius:g} is larger than the cloud, whose bounding box has a diagonal of {diagonal:g}",
                limit=diagonal,
                actual=radius,
                hint="it is in the unit of the file; 5% takes a share of the diagonal",
            )
        return float(radius)
    if not diagonal * fraction >= SMALLEST_RADIUS:
        raise DegenerateCloudError(
            "all points are at the same place, as far as numbers can tell: there is no extent to take a radius from",
            hint="pass radius in the units of the file",
        )
    return extent(points) * fraction


def filter_points(
    points: Float64,
    predict: Predict,
    *,
    radius: float | None = None,
    least_radius: float = DEFAULT_RADIUS,
    iterations: int | Auto = DEFAULT_ITERATIONS,
    patch_points: int = 500,
    seed: int = 0,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    after_pass: Callable[[int, Float64], None] | None = None,
    timings: Timings | None = None,
) -> Float64:
    """Filters (n, 3) finite float64 points; returns the moved points, same shape, same order.

    radius: absolute, in the unit of the points; by default least_radius, a fraction of the cloud's extent, or more
    where a ball of it holds too few points for the cloud's noise, or less where two thin sheets would become one
    (automatic.py). It is taken once, from the input, and kept for all iterations. iterations: a number, or "auto" for
    as many as the cloud needs; a clean one comes back as it was. Where noise is in places only, the points between them
    stay as they are (automatic.untouched); a point that has ARRIVED stays where it is in later iterations; what
    DRIFT_FROM and more of them take away on average is given back at the end (drift.py). patch_points: N, what the
    network was trained with. seed: of the downsampling. threads: how many batches are evaluated at once; the result
    does not depend on it.
    progress(done, total) is called from this thread, in units of points times iterations, from 0 on. cancelled() is
    asked between batches, from any thread. after_pass(passes, points) sees after every pass what the result of so many
    iterations is.

    Raises TooFewPointsError, DegenerateCloudError, ParameterError, FilteringCancelledError.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {points.shape}")
    if len(points) < MIN_NEIGHBOURS:
        raise TooFewPointsError(
            f"a cloud needs at least {MIN_NEIGHBOURS} finite points, this one has {len(points)}",
            limit=MIN_NEIGHBOURS,
            actual=len(points),
        )
    if not isinstance(iterations, str) and not 1 <= iterations <= MAX_ITERATIONS:
        raise ParameterError(
            f"iterations must be from 1 to {MAX_ITERATIONS}, got {iterations}", limit=MAX_ITERATIONS, actual=iterations
        )
    if not 0 <= seed < 2**63:
        raise ParameterError(f"seed must be from 0 to 2^63 - 1, got {seed}", actual=seed)
    for name, value in (("patch_points", patch_points), ("threads", threads)):
        if value < 1:
            raise ParameterError(f"{name} must be at least 1, got {value}", limit=1, actual=value)
    if not np.isfinite(points).all():
        raise ParameterError("points must be finite", hint="filter_cloud leaves rows with NaN or Inf alone")
    absolute_radius = resolve_radius(points, radius, least_radius)
    timings = timings or Timings()
    low, high = points.min(axis=0), points.max(axis=0)
    offset = low + (high - low) / 2  # large coordinates must not cost digits
    moved = original = points - offset
    ids = stable_ids(moved)
    with timings.measure("index"):
        index = NeighbourIndex(moved, absolute_radius, ids)

    def check() -> None:
        if cancelled is not None and cancelled():
            raise FilteringCancelledError("filtering was cancelled")

    look = None
    with timings.measure("infer"):
        if radius is None:
            index, look = with_fitting_ball(index, moved, ids, predict, patch_points, seed, check)
        elif isinstance(iterations, str):
            look = look_at(moved, ids, index, predict, patch_points, seed, check)
    timings.radius = absolute_radius = index.radius
    passes = look.passes if look is not None and isinstance(iterations, str) else int(iterations)
    if passes == 0:
        return points.copy()

    def result(done: int) -> Float64:
        kept = moved
        if done >= DRIFT_FROM:
            with timings.measure("drift"):
                kept = without_drift(moved, original, ids, absolute_radius, threads, check)
        return np.where(kept == original, points, kept + offset)  # what did not move does not lose a digit either

    moving = np.ones(len(points), dtype=bool)
    for iteration in range(passes):
        if iteration and moving.any():
            with timings.measure("index"):
                index = NeighbourIndex(moved, absolute_radius, ids)

        arrived = len(points) - int(moving.sum())

        def report(done: int, done_before: int = iteration * len(points) + arrived) -> None:
            if progress is not None:
                progress(done_before + done, passes * len(points))

        report(0)
        before, key = moved, sampling_key(seed, iteration)
        moved = _one_pass(before, moving, ids, index, predict, patch_points, key, threads, report, check, timings)
        lengths = np.linalg.norm(moved - before, axis=1) / absolute_radius
        if iteration == 0:
            moving = ~untouched(lengths, index, threads, check)
            moved = np.where(moving[:, None], moved, before)
        else:  # the second step is the first one that sees cleaned neighbours
            moving &= lengths >= ARRIVED
        timings.passes += 1
        if after_pass is not None and iteration + 1 < passes:
            after_pass(iteration + 1, result(iteration + 1))
    filtered = result(passes)
    if after_pass is not None:
        after_pass(passes, filtered)
    return filtered


def _one_pass(
    points: Float64,
    moving: NDArray[np.bool_],
    ids: NDArray[np.uint64],
    index: NeighbourIndex,
    predict: Predict,
    patch_points: int,
    key: int,
    threads: int,
    report: Callable[[int], None],
    check: Callable[[], None],
    timings: Timings,
) -> Float64:
    """Eq. 8 once for every point that is `moving` (n,). Each point's answer depends on its own patch alone."""
    rows = index.order[moving[index.order]]  # in this order neighbours in space are neighbours in memory
    centres, centre_ids = points[rows], ids[rows]
    result = points.copy()

    def evaluate(chosen: NDArray[np.int64], length: int) -> int:
        with timings.measure("patches"):
            patches = index.patches(centres[chosen], centre_ids[chosen], length, key)
        with timings.measure("infer"):
            answers = displacements(predict, patches, check)
        # r R⁻¹ f(.): R is a rotation, so its inverse is its transpose; rows of `frames` are the axes.
        steps = np.einsum("bi,bij->bj", answers, patches.frames) * index.radius
        result[rows[chosen]] = centres[chosen] + steps
        return len(chosen)

    with timings.measure("patches"):
        counts = _count(index, centres, patch_points, threads, check)

    def tasks() -> Iterator[tuple[NDArray[np.int64], int]]:
        for length, positions in length_buckets(counts, patch_points):
            size = BATCHES_PER_TASK * patches_per_batch(length)
            for start in range(0, len(positions), size):
                yield positions[start : start + size], length

    done = 0
    with ThreadPoolExecutor(threads, thread_name_prefix="patches") as pool:
        waiting: set[Future[int]] = set()
        queue = tasks()
        exhausted = False
        try:
            while waiting or not exhausted:
                while not exhausted and len(waiting) < 2 * threads:
                    if (task := next(queue, None)) is None:
                        exhausted = True
                    else:
                        waiting.add(pool.submit(evaluate, *task))
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                done += sum(future.result() for future in finished)
                report(done)
                check()
        finally:
            for future in waiting:
                future.cancel()
    return result


def _count(
    index: NeighbourIndex, centres: Float64, enough: int, threads: int, check: Callable[[], None]
) -> NDArray[np.int64]:
    """Neighbours of every centre, up to `enough`. Can be cancelled."""

    def count(first: int, last: int) -> NDArray[np.int64]:
        return index.count(centres[first:last], enough=enough)

    counts = over_ranges(count, len(centres), CENTRES_PER_COUNT, threads, check)
    return np.concatenate([np.empty(0, dtype=np.int64), *counts])
