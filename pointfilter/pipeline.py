"""A cloud through the whole filter: what the command line and the service both call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import ParameterError
from pointfilter.filtering import Timings, filter_points, resolve_radius
from pointfilter.models import Auto
from pointfilter.prediction import MIN_NEIGHBOURS


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
    """Rows with NaN or Inf, passed through untouched."""
    iterations: int
    """Passes over the cloud; 0: it was found clean and came back as it was."""
    radius: float
    seed: int
    mean_displacement: float
    largest_displacement: float
    seconds: dict[str, float]
    """By stage; `patches` and `infer` are summed over the threads, `total` is the clock's."""

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
    iterations: int | Auto | None = None,
    radius: Radius | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> tuple[PointCloud, Report]:
    """Filters every finite row of a cloud; everything else in it stays as it is.

    iterations: a number, or "auto" for as many as the cloud needs; by default what the engine's bundle says. radius: by
    default the bundle's share of the diagonal, or more for a sparse cloud. See filtering.filter_points for that, for
    progress, cancelled and what is raised.
    """
    started = time.perf_counter()
    bundle = engine.bundle
    finite = cloud.finite
    points = cloud.xyz[finite]
    iterations = bundle.iterations if iterations is None else iterations
    timings = Timings()
    absolute = None
    if radius is not None:
        # Too few points are filter_points' business, and have no extent to speak of.
        share_of_extent = radius.relative and len(points) >= MIN_NEIGHBOURS
        absolute = resolve_radius(points, None, radius.value) if share_of_extent else radius.value
    filtered = filter_points(
        points,
        engine,
        radius=absolute,
        least_radius=bundle.radius,
        iterations=iterations,
        patch_points=bundle.patch_points,
        seed=seed,
        threads=engine.threads,
        progress=progress,
        cancelled=cancelled,
        timings=timings,
    )
    displacements = np.linalg.norm(filtered - points, axis=1)
    xyz = cloud.xyz.copy()
    xyz[finite] = filtered
    report = Report(
        model=bundle.name,
        model_version=bundle.version,
        model_sha256=bundle.sha256,
        provider=engine.provider,
        threads=engine.threads,
        points=len(cloud),
        skipped=int(len(cloud) - finite.sum()),
        iterations=timings.passes,
        radius=timings.radius,
        seed=seed,
        mean_displacement=float(displacements.mean()),
        largest_displacement=float(displacements.max()),
        seconds={**timings.as_dict(), "total": time.perf_counter() - started},
    )
    return cloud.with_xyz(xyz), report
