"""A cloud through the whole filter: what the command line and the service both call."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pointfilter.attributes import (
    KEEP,
    RECOMPUTE,
    check_new_columns,
    check_normal_columns,
    check_normals,
    checked_columns,
    with_figures,
    with_normals,
)
from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import ParameterError
from pointfilter.filter import filter_points, resolve_radius
from pointfilter.network import MIN_NEIGHBOURS

COARSE_STEP = 0.05  # of the median ball: larger steps of the file's coordinates are worth a warning


@dataclass(frozen=True)
class Radius:
    """A patch radius: in the unit of the file, or as a fraction of the bounding-box diagonal."""

    value: float
    relative: bool

    @classmethod
    def parse(cls, text: str) -> Radius:
        """ "5%" is a share of the diagonal, "0.02" a length. Raises ParameterError."""
        relative = text.strip().endswith("%")
        try:
            value = float(text.strip().removesuffix("%"))
        except ValueError:
            value = float("nan")
        if not (np.isfinite(value) and value > 0 and (not relative or value <= 100)):
            raise ParameterError(
                "radius must be a length above 0 such as 0.02, or a share of the diagonal such as 5% (at most 100%)",
                actual=text[:40],
            )
        return cls(value / 100 if relative else value, relative)


@dataclass(frozen=True)
class Report:
    """What was done. Lengths in the unit of the file, times in seconds."""

    model: str
    model_version: str
    model_sha256: str
    provider: str
    threads: int
    points: int
    skipped: int
    """Rows with NaN or Inf, left as they were."""
    placeholders: int
    """Rows at places that hold many more rows than their surroundings, such as 0 0 0 for no measurement, left as they
    were."""
    moved: int
    """Rows that the filter moved; the others were expected to be no nearer to the surface after it."""
    iterations: int
    """Passes over the cloud."""
    radius: float
    """Median of the balls, over the points."""
    radius_low: float
    radius_high: float
    """5th and 95th percentile of the balls."""
    expected_error: float | None
    """Mean distance to the surface that the network expects of the filtered points; None where it does not say, and
    where `strength` or `max_move` limits the displacements."""
    seed: int
    mean_displacement: float
    largest_displacement: float
    seconds: dict[str, float]
    """By stage; `patches` and `infer` are summed over the threads, `total` is the clock's."""
    warnings: tuple[str, ...] = ()
    """What is worth knowing before the result is used, a sentence each."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    @property
    def comment(self) -> str:
        """The line that goes into the filtered file's header."""
        return (
            f"filtered by pointfilter model {self.model} {self.model_version} sha256 {self.model_sha256[:16]} "
            f"iterations {self.iterations} radius {self.radius:.9g} seed {self.seed}"
        )


def filter_cloud(
    cloud: PointCloud,
    engine: Engine,
    *,
    iterations: int | None = None,
    radius: Radius | None = None,
    seed: int = 0,
    strength: float = 1.0,
    max_move: float | None = None,
    paper: bool = False,
    normals: str = KEEP,
    columns: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> tuple[PointCloud, Report]:
    """Filters every finite row of a cloud; everything else in it stays as it is.

    iterations: most passes. radius: of all balls; by default the network chooses, point by point. strength: factor of
    each displacement, from 0 to 1. max_move: longest displacement of a point, in the unit of the file, applied after
    strength. paper: the paper's mode, for bundles that have another one. normals: of attributes.NORMALS, what becomes
    of the columns nx, ny and nz: "keep" leaves them, "recompute" writes the network's normals of the filtered points
    (unit length, on the side of the old normal, else away from the centre of the bounding box; a row without an answer
    keeps its old normal, or gets 0 0 0), "drop" leaves the columns out. columns: some of attributes.COLUMNS,
    each of which adds a column (see attributes.with_figures): "displacement", "uncertainty", "outlier".

    See filter.filter_points for progress, cancelled and what is raised; ParameterError is raised for normals that
    cannot be recomputed and for columns that the cloud has already, too.
    """
    started = time.perf_counter()
    if not 0 <= strength <= 1:
        raise ParameterError(f"strength must be from 0 to 1, got {strength:g}", limit=1, actual=strength)
    if max_move is not None and not (np.isfinite(max_move) and max_move > 0):
        raise ParameterError(
            f"max_move must be a length above 0 in the unit of the file, got {max_move:g}", actual=max_move
        )
    bundle = engine.bundle
    check_normals(normals, bundle, paper)
    check_normal_columns(cloud, normals)
    columns = checked_columns(columns)
    check_new_columns(cloud, columns)
    finite = cloud.finite
    points = cloud.xyz[finite]
    absolute = None
    if radius is not None:
        # Too few points are filter_points' business, and have no extent to speak of.
        share_of_extent = radius.relative and len(points) >= MIN_NEIGHBOURS
        absolute = resolve_radius(points, None, radius.value) if share_of_extent else radius.value
    result = filter_points(
        points,
        engine,
        calibration=None if paper else bundle.calibration,
        radius=absolute,
        iterations=iterations,
        patch_points=bundle.patch_points,
        seed=seed,
        threads=engine.threads,
        normals=normals == RECOMPUTE,
        progress=progress,
        cancelled=cancelled,
    )
    filtered = limited(points, result.points, strength, max_move)
    displacements = np.linalg.norm(filtered - points, axis=1)
    xyz = cloud.xyz.copy()
    xyz[finite] = filtered
    clean, on_normals = with_normals(cloud.with_xyz(xyz), normals, finite, result, displacements)
    clean, on_columns = with_figures(clean, columns, finite, points, result, displacements)
    low, middle, high = percentiles(result.radii)
    told = np.isfinite(result.errors)
    report = Report(
        model=bundle.name,
        model_version=bundle.version,
        model_sha256=bundle.sha256,
        provider=engine.provider,
        threads=engine.threads,
        points=len(cloud),
        skipped=int(len(cloud) - finite.sum()),
        placeholders=result.placeholder_rows,
        moved=int((displacements > 0).sum()),
        iterations=result.passes,
        radius=middle,
        radius_low=low,
        radius_high=high,
        expected_error=float(result.errors[told].mean()) if told.any() and filtered is result.points else None,
        seed=seed,
        mean_displacement=float(displacements.mean()),
        largest_displacement=float(displacements.max()),
        seconds={**result.seconds, "total": time.perf_counter() - started},
        warnings=(*input_warnings(cloud, points, result.placeholder_rows, result.radii), *on_normals, *on_columns),
    )
    return clean, report


def limited(
    points: NDArray[np.float64], filtered: NDArray[np.float64], strength: float, max_move: float | None
) -> NDArray[np.float64]:
    """The filtered points (n, 3) with each displacement times `strength`, and then no longer than max_move."""
    if strength == 1 and max_move is None:
        return filtered
    moves = strength * (filtered - points)
    if max_move is not None:
        moves *= np.minimum(1, max_move / np.maximum(np.linalg.norm(moves, axis=1, keepdims=True), 1e-300))
    return points + moves


def percentiles(radii: NDArray[np.float64]) -> tuple[float, float, float]:
    """5th, 50th and 95th of those that are finite; 0 where none is."""
    taken = radii[np.isfinite(radii)]
    if not len(taken):
        return 0.0, 0.0, 0.0
    low, middle, high = np.percentile(taken, (5, 50, 95))
    return float(low), float(middle), float(high)


def input_warnings(
    cloud: PointCloud, points: NDArray[np.float64], placeholder_rows: int, radii: NDArray[np.float64]
) -> tuple[str, ...]:
    """What the cloud itself makes worth knowing, a sentence each. points: (m, 3), its finite rows. radii: of their
    balls, NaN where there is none."""
    warnings = []
    if placeholder_rows:
        warnings.append(
            f"{placeholder_rows} rows share places that hold many more rows than their surroundings, as where a "
            "scanner writes 0 0 0 for no measurement; the filter leaves them as they are"
        )
    taken = radii[np.isfinite(radii)]
    if not len(taken):
        warnings.append("there are too few points for the smallest ball; the filter leaves the cloud as it is")
    step = _storage_step(cloud, points)
    if len(taken) and step > COARSE_STEP * float(np.median(taken)):
        warnings.append(
            f"the file keeps coordinates as float32, in steps of {step:.3g} where they are largest, which is coarse "
            "beside the distances between points; subtract an offset from the coordinates, or save them as double"
        )
    return tuple(warnings)


def _storage_step(cloud: PointCloud, points: NDArray[np.float64]) -> float:
    """Largest distance between neighbouring values of the coordinates as the file keeps them; 0 for doubles."""
    if cloud.source is None or not cloud.source.single_precision:
        return 0.0
    return float(np.spacing(np.abs(points).max().astype(np.float32)))
