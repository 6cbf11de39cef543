"""Eq. 8 and its passes: the one place where displacements become points.

p̄ᵢ = r · R⁻¹ · f(R(P̂ᵢ − p̂ᵢ)/r) + p̂ᵢ
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pointfilter.adaptive.balls import has_balls, probe_balls
from pointfilter.adaptive.calibration import Calibration
from pointfilter.adaptive.places import distinct_places, neighbourhood_keys
from pointfilter.adaptive.sharing import Means, Queries
from pointfilter.errors import DegenerateCloudError, FilteringCancelledError, ParameterError, TooFewPointsError
from pointfilter.grids import Grids
from pointfilter.network import MIN_NEIGHBOURS, Network, answers, patches_per_batch
from pointfilter.noise import bounding_box_centre, bounding_box_diagonal
from pointfilter.patches import SMALLEST_RADIUS, NeighbourIndex, UInt64, sampling_key
from pointfilter.ranges import numbers_of_ranges, over_ranges

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

DEFAULT_RADIUS = 0.05  # of the bounding-box diagonal, in the paper's mode (§3.2)
DEFAULT_ITERATIONS = 2  # in the paper's mode
MAX_ITERATIONS = 100
STAGES = ("index", "balls", "patches", "infer")
BATCHES_PER_TASK = 8  # batches that a worker cuts in one go, so that workers seldom meet at the interpreter's lock


@dataclass(eq=False)
class Filtered:
    """What became of a cloud of n points. Lengths in the unit of the points.

    points: (n, 3) float64. errors: (n,) float64, the expected distance to the surface, NaN where the network does not
    say. radii: (n,) float64, of the ball that each point took, NaN where it took none. moved: (n,) bool. normals:
    (n, 3) float64 of unit length and any sign, NaN where there is none. passes: how many were made. placeholder_rows:
    rows at places that hold many more rows than their surroundings, left as they were.
    """

    points: Float64
    errors: Float64
    radii: Float64
    moved: Bool
    normals: Float64
    passes: int
    placeholder_rows: int
    seconds: dict[str, float]
    """By stage; those of the network and of the patches are summed over the threads."""


@dataclass
class _Clock:
    """Seconds by stage."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[stage] += time.perf_counter() - started


def filter_points(
    points: Float64,
    network: Network,
    *,
    calibration: Calibration | None = None,
    radius: float | None = None,
    iterations: int | None = None,
    patch_points: int = 500,
    seed: int = 0,
    threads: int = 1,
    normals: bool = False,
    origin: Float64 | None = None,
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    after_pass: Callable[[int, Float64], None] | None = None,
) -> Filtered:
    """Filters (n, 3) finite float64 points.

    With a calibration, the network's own, every point takes the ball in which the least error is expected, moves where
    that is better than staying by the calibration's margin, and goes through as many passes as help. Without one, the
    paper's mode: one radius, and `iterations` passes that move every point.

    radius: of all balls, in the unit of the points; by default chosen, or DEFAULT_RADIUS of the bounding-box diagonal
    in the paper's mode. iterations: most passes. patch_points: N, what the network was trained with. seed: of the
    downsampling. threads: how many batches are evaluated at once; the result does not depend on it. normals: also
    estimate normals for points that no pass has visited. origin: subtracted from the coordinates, by default the middle
    of the bounding box; pieces of one cloud must share it.
    progress(done, total) is called from this thread, in rows times passes, and never goes backwards. cancelled() is
    asked between batches, from any thread. after_pass(passes, points) sees the points after every pass.

    Raises TooFewPointsError, DegenerateCloudError, ParameterError, FilteringCancelledError.
    """
    points = checked(points, iterations, seed, patch_points, threads)
    passes = default_passes(calibration) if iterations is None else iterations
    resolved = resolve_radius(points, radius)  # checks the extent, too
    if radius is not None or calibration is None:
        radius = resolved

    def check() -> None:
        if cancelled is not None and cancelled():
            raise FilteringCancelledError("filtering was cancelled")

    clock = _Clock()
    if origin is None:  # large coordinates must not cost digits
        origin = bounding_box_centre(points)
    with clock.measure("index"):
        places = distinct_places(points - origin)
        keys, reach = neighbourhood_keys(places.points, threads)
    state = _State(places.points, keys)
    if radius is not None:
        state.radii[:] = radius
    elif calibration is not None and has_balls(len(places.points), calibration):
        with clock.measure("balls"):
            key = sampling_key(seed, 0)
            probes = probe_balls(places.points, keys, reach, network, calibration, patch_points, key, threads, check)
            state.radii[:], _, gains, errors = probes.spread(places.points, threads)
        state.radii[np.isinf(state.radii)] = np.nan  # there is no ball
        state.moving[gains > -calibration.margin] = False  # the best ball does not help enough
        still = np.flatnonzero(~state.moving & np.isfinite(errors))
        state.expect(still, np.log(errors[still]))
    else:
        state.moving[:] = False

    def result() -> Float64:
        kept = points.copy()
        moved = np.any(state.points != places.points, axis=1)[places.rows] & (places.rows >= 0)
        kept[moved] = state.points[places.rows[moved]] + origin  # what did not move does not lose a digit
        return kept

    total = passes * len(points)
    made = 0
    for iteration in range(passes):
        if not state.moving.any():
            break
        arrived = len(state.points) - int(state.moving.sum())

        def report(done: int, before: int = iteration * len(state.points) + arrived) -> None:
            if progress is not None:
                progress((before + done) * len(points) // len(state.points), total)

        report(0)
        _one_pass(state, iteration, network, calibration, patch_points, seed, threads, report, check, clock)
        made += 1
        if after_pass is not None:
            after_pass(made, result())
    without = np.isfinite(state.radii) & np.isnan(state.normals[:, 0])
    if normals and calibration is not None and without.any():
        asked = _State(state.points, keys)
        asked.radii[:], asked.moving[:] = state.radii, without
        _one_pass(asked, made, network, calibration, patch_points, seed, threads, lambda _: None, check, clock)
        state.normals[without] = asked.normals[without]
    if progress is not None:
        progress(total, total)
    filtered = result()
    there = places.rows >= 0

    def spread(values: NDArray[np.float64]) -> Float64:
        found = np.full((len(points), *values.shape[1:]), np.nan)
        found[there] = values[places.rows[there]]
        return found

    return Filtered(
        points=filtered,
        errors=spread(state.errors() * (calibration.error_factor if calibration is not None else 1.0)),
        radii=spread(state.radii),
        moved=np.any(filtered != points, axis=1),
        normals=spread(state.normals),
        passes=made,
        placeholder_rows=places.placeholder_rows,
        seconds=clock.seconds,
    )


def default_passes(calibration: Calibration | None) -> int:
    """Most passes where the caller names no number of them."""
    return DEFAULT_ITERATIONS if calibration is None else calibration.passes


class _State:
    """The distinct places of a cloud on their way through the passes. points (p, 3), keys (p,), radii (p,),
    normals (p, 3), and which of them the next pass looks at."""

    def __init__(self, points: Float64, keys: UInt64) -> None:
        self.points = points
        self.keys = keys
        self.radii = np.full(len(points), np.nan)
        self._log_errors = np.zeros(len(points))
        self._passes = np.zeros(len(points), dtype=np.int64)
        self.normals = np.full((len(points), 3), np.nan)
        self.moving = np.ones(len(points), dtype=bool)

    def expect(self, rows: Int64, log_errors: Float64) -> None:
        """Takes what a pass expects of the points `rows`."""
        self._log_errors[rows] += log_errors
        self._passes[rows] += 1

    def errors(self) -> Float64:
        """Expected distances to the surface: the geometric mean over the passes. The first one knows the noise best,
        the last one the surface; what the last one alone expects is too little under heavy noise, which it sees no
        longer."""
        with np.errstate(invalid="ignore"):
            return np.exp(self._log_errors / self._passes)


def _one_pass(
    state: _State,
    iteration: int,
    network: Network,
    calibration: Calibration | None,
    patch_points: int,
    seed: int,
    threads: int,
    report: Callable[[int], None],
    check: Callable[[], None],
    clock: _Clock,
) -> None:
    """Eq. 8 once for every point that is moving. A point takes the mean of what the patches that reach it answer."""
    key = sampling_key(seed, iteration)
    before = state.points
    with clock.measure("index"):
        grids = Grids(before)
        rows = np.flatnonzero(state.moving)
        if calibration is not None and calibration.query_reach > 0:
            queries = Queries.shared(grids, rows, state.radii, state.keys, key, calibration.query_reach, threads, check)
        else:
            queries = Queries.one_each(rows, len(before))
        centres, sizes = queries.centres, queries.sizes
        starts = np.cumsum(sizes) - sizes
    means = Means(state.radii)
    done = 0
    for chosen, index in grids.by_radius(centres, state.radii[centres]):

        def evaluate(first: int, last: int, chosen: Int64 = chosen, index: NeighbourIndex = index) -> int:
            part = chosen[first:last]
            with clock.measure("patches"):
                patches = index.patches(centres[part], state.radii[centres[part]], patch_points, key)
                patch, asked = numbers_of_ranges(starts[part], sizes[part])
                asked = queries.rows[asked]
                frames, radii = patches.frames[patch], patches.radii[patch][:, None]
                centre = centres[part][patch]
                places = np.einsum("mij,mj->mi", frames, before[asked] - before[centre]) / radii
            with clock.measure("infer"):
                said = answers(
                    network, patches.points, patches.counts, iteration > 0, places.astype(np.float32), patch, check
                )
            # r R⁻¹ f(.): R is a rotation, so its inverse is its transpose; the rows of `frames` are the axes.
            steps = np.einsum("mi,mij->mj", said.displacements.astype(np.float64), frames) * radii
            log_errors = None if said.log_errors is None else said.log_errors.astype(np.float64) + np.log(radii)
            told = patches.counts[patch] >= MIN_NEIGHBOURS
            means.add(asked[told], steps[told], None if log_errors is None else log_errors[told])
            if said.normals is not None:
                own = centre == queries.own[asked]
                normals = np.einsum("mi,mij->mj", said.normals[own].astype(np.float64), frames[own])
                state.normals[asked[own]] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            return len(asked)

        size = BATCHES_PER_TASK * patches_per_batch(patch_points)
        for answered in over_ranges(evaluate, len(chosen), size, threads, check):
            done += answered
            report(done * len(rows) // len(queries.rows))
    steps, log_errors = means.of(rows)
    better = np.ones(len(rows), dtype=bool)
    if calibration is not None and log_errors is not None:
        log_moved, log_still = log_errors.T
        better = log_moved < log_still  # not where nothing was told: NaN
        state.expect(rows, np.where(better, log_moved, log_still))
        state.moving[rows] = better
    after = before.copy()
    after[rows[better]] += np.nan_to_num(steps[better])
    state.points = after


def resolve_radius(points: Float64, radius: float | None, fraction: float = DEFAULT_RADIUS) -> float:
    """The absolute radius: the given one, or `fraction` of the bounding-box diagonal of the (n, 3) points.

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
    return diagonal * fraction


def checked(points: Float64, iterations: int | None, seed: int, patch_points: int, threads: int) -> Float64:
    """The points as float64. Raises TooFewPointsError, ParameterError, ValueError."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {points.shape}")
    if len(points) < MIN_NEIGHBOURS:
        raise TooFewPointsError(
            f"a cloud needs at least {MIN_NEIGHBOURS} finite points, this one has {len(points)}",
            limit=MIN_NEIGHBOURS,
            actual=len(points),
        )
    if iterations is not None and not 1 <= iterations <= MAX_ITERATIONS:
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
    return points
