"""What the filter would do to a cloud, without filtering it: how noisy it is, which balls it takes, what moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.adaptive.balls import has_balls, probe_balls
from pointfilter.adaptive.places import distinct_places, neighbourhood_keys
from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import FilteringCancelledError
from pointfilter.filter import checked, resolve_radius
from pointfilter.noise import bounding_box_centre, bounding_box_diagonal
from pointfilter.patches import sampling_key
from pointfilter.pipeline import input_warnings, percentiles

Float64 = NDArray[np.float64]

Verdict = Literal["clean", "noisy", "cannot tell"]
CLEAN: Verdict = "clean"
NOISY: Verdict = "noisy"
CANNOT_TELL: Verdict = "cannot tell"

LEAST_WITH_BALL = 0.5  # share of the points that must have a ball for a verdict
NOTICEABLE = 0.05  # fall of the logarithm of the expected error, 5 %: smaller ones may be the network's own error
MOST_HELPED = 0.1  # share of the points that may be helped in a clean cloud, and must be exceeded in a noisy one
SPACING_SAMPLE = 20_000  # points whose nearest neighbours are looked at


@dataclass(frozen=True)
class Look:
    """What was found. Lengths in the unit of the file; percentiles are the 5th, 50th and 95th."""

    verdict: Verdict
    """CLEAN, NOISY or CANNOT_TELL, by the rule of `verdict`."""
    model: str
    model_version: str
    model_sha256: str
    points: int
    skipped: int
    """Rows with NaN or Inf."""
    duplicates: int
    """Rows at a place that an earlier row has, placeholders not counted."""
    placeholders: int
    """Rows at places that hold many more rows than their surroundings, such as 0 0 0 for no measurement."""
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    """Corners of the bounding box of the finite rows."""
    diagonal: float
    spacing: float | None
    """Median distance of a place to the nearest other one, over a sample; None for a single place."""
    noise: float | None
    """Median distance to the surface that the network expects of the points as they are; None where it does not say."""
    ball_points: tuple[float, float, float] | None
    """Percentiles of the points in the balls that would be taken."""
    ball_radii: tuple[float, float, float] | None
    """Percentiles of their radii."""
    with_ball: float
    """Share of the finite rows for which there is a ball."""
    would_move: float | None
    """Share of the finite rows that the first pass of the filter would look at: those for which a ball helps."""
    seconds: float
    warnings: tuple[str, ...] = ()
    """What is worth knowing, a sentence each."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def look(cloud: PointCloud, engine: Engine, *, seed: int = 0, cancelled: Callable[[], bool] | None = None) -> Look:
    """Looks at every finite row of a cloud, in about the time in which the filter chooses balls.

    seed: of the downsampling. cancelled() is asked between batches, from any thread. With a model without a
    calibration, which tells no expected errors, the verdict is CANNOT_TELL.

    Raises TooFewPointsError, DegenerateCloudError, ParameterError, FilteringCancelledError.
    """

    def check() -> None:
        if cancelled is not None and cancelled():
            raise FilteringCancelledError("looking was cancelled")

    started = time.perf_counter()
    bundle = engine.bundle
    points = checked(cloud.xyz[cloud.finite], None, seed, bundle.patch_points, engine.threads)
    resolve_radius(points, None)  # checks the extent
    low, high = points.min(axis=0), points.max(axis=0)
    places = distinct_places(points - bounding_box_centre(points))
    check()
    balls = _balls(places.points, engine, seed, check)
    rows = places.rows[places.rows >= 0]
    # By row of the cloud from here on: a place counts as often as it has rows, a placeholder's rows have no ball.
    radii, sizes, gains = balls.radii[rows], balls.sizes[rows], balls.gains[rows]
    with_ball = float(np.isfinite(radii).sum() / len(points))
    calibration = bundle.calibration
    if calibration is None:
        opinion, reasons, would_move = CANNOT_TELL, [_NO_ERRORS], None
    else:
        opinion, reasons = verdict(gains, with_ball, calibration.margin)
        reasons = [*input_warnings(cloud, points, places.placeholder_rows, radii), *reasons]
        would_move = float((gains <= -calibration.margin).sum() / len(points))
    return Look(
        verdict=opinion,
        model=bundle.name,
        model_version=bundle.version,
        model_sha256=bundle.sha256,
        points=len(cloud),
        skipped=len(cloud) - len(points),
        duplicates=len(rows) - len(places.points),
        placeholders=places.placeholder_rows,
        low=_triple(low),
        high=_triple(high),
        diagonal=bounding_box_diagonal(points),
        spacing=_spacing(places.points, engine.threads),
        noise=balls.noise,
        ball_points=percentiles(np.round(sizes)) if with_ball else None,
        ball_radii=percentiles(radii) if with_ball else None,
        with_ball=with_ball,
        would_move=would_move,
        seconds=time.perf_counter() - started,
        warnings=tuple(reasons),
    )


@dataclass(frozen=True, eq=False)
class _Balls:
    """Of p places: radii, points in the ball and gains (p,), NaN where there is no ball; and the noise."""

    radii: Float64
    sizes: Float64
    gains: Float64
    noise: float | None


def _balls(places: Float64, engine: Engine, seed: int, check: Callable[[], None]) -> _Balls:
    """The balls that the filter would choose for (p, 3) places."""
    bundle = engine.bundle
    if bundle.calibration is None or not has_balls(len(places), bundle.calibration):
        unknown = np.full(len(places), np.nan)
        return _Balls(unknown, unknown, unknown, None)
    keys, reach = neighbourhood_keys(places, engine.threads)
    key = sampling_key(seed, 0)
    probes = probe_balls(
        places, keys, reach, engine, bundle.calibration, bundle.patch_points, key, engine.threads, check
    )
    values = np.stack(probes.spread(places, engine.threads)[:3])
    values[:, np.isinf(values[0])] = np.nan
    known = probes.errors[np.isfinite(probes.errors)]
    return _Balls(values[0], values[1], values[2], float(np.median(known)) if len(known) else None)


_NO_ERRORS = "this model tells no expected errors, so noise and balls are not known; use an adaptive model"


def verdict(gains: Float64, with_ball: float, margin: float) -> tuple[Verdict, list[str]]:
    """The verdict, and a sentence on the reason where it is CANNOT_TELL.

    gains: (m,) the least logarithm of the expected error of each point as a share of that without a filter, NaN where
    there is no ball. with_ball: share of the points that have one. margin: by how much that logarithm must fall below 0
    for the filter to move a point.

    CANNOT_TELL where fewer than LEAST_WITH_BALL of the points have a ball. Of those that have one: NOISY where for
    more than MOST_HELPED of them a ball lowers the expected error noticeably, by NOTICEABLE beyond the margin from
    which the filter moves a point; CLEAN where for at most MOST_HELPED of them a ball lowers it by that margin at all;
    CANNOT_TELL in between.
    """
    if with_ball < LEAST_WITH_BALL:
        return (
            CANNOT_TELL,
            [f"only {with_ball:.0%} of the points have a ball, too few to tell whether the cloud is noisy"],
        )
    told = gains[np.isfinite(gains)]
    if (told < -margin - NOTICEABLE).mean() > MOST_HELPED:
        return NOISY, []
    if (told <= -margin).mean() <= MOST_HELPED:
        return CLEAN, []
    return CANNOT_TELL, [
        f"the filter would move points, but lower the expected error by more than {NOTICEABLE:.0%} for few of them; "
        "there is no noise, or too little to be sure of it"
    ]


def _triple(values: Sequence[float] | Float64) -> tuple[float, float, float]:
    first, second, third = map(float, values)
    return first, second, third


def _spacing(places: Float64, threads: int) -> float | None:
    if len(places) < 2:
        return None
    sample = places[:: -(-len(places) // SPACING_SAMPLE)]
    distances, _ = cKDTree(places).query(sample, k=[2], workers=threads)
    return float(np.median(distances))
