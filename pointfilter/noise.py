"""Noise for experiments, training and tests. Levels are fractions of the bounding-box diagonal (§4.1)."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import ParameterError

Float64 = NDArray[np.float64]
NoiseKind = Literal["gaussian", "impulsive", "uniform", "outliers"]
NOISE_KINDS: tuple[NoiseKind, ...] = get_args(NoiseKind)

IMPULSE_SHARE = 0.1  # of the points that impulsive noise moves
OUTLIER_SHARE = 0.01  # of the points that become outliers


def bounding_box_diagonal(points: Float64) -> float:
    """Length of the diagonal of the axis-aligned bounding box of (n, 3) points; 0 for no points, inf beyond doubles."""
    with np.errstate(over="ignore"):
        return float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) if len(points) else 0.0


def bounding_box_centre(points: Float64) -> Float64:
    """The middle (3,) of the axis-aligned bounding box of (n, 3) points, n above 0."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre: Float64 = low + (high - low) / 2
    return centre


def add_noise(
    points: Float64,
    level: float,
    rng: np.random.Generator,
    kind: NoiseKind = "gaussian",
    diagonal: float | None = None,
) -> Float64:
    """Returns a noisy copy of (n, 3) points.

    gaussian: every coordinate moves by N(0, level·diagonal).
    impulsive: one point in ten moves so, with twice the deviation; the others stay.
    uniform: every point moves by a vector drawn evenly from the ball of radius level·diagonal.
    outliers: gaussian, and one point in a hundred is drawn from the bounding box grown by a tenth.

    `diagonal` is that of the points unless given. Raises ParameterError for a negative level or an unknown kind.
    """
    if not level >= 0:
        raise ParameterError(f"noise level must be at least 0, got {level!r}")
    if kind not in NOISE_KINDS:
        raise ParameterError(f"noise kind must be one of {', '.join(NOISE_KINDS)}, got {kind!r}")
    scale = level * (bounding_box_diagonal(points) if diagonal is None else diagonal)
    if kind == "uniform":
        direction = rng.normal(size=points.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return points + direction * scale * np.cbrt(rng.random((len(points), 1)))
    if kind == "impulsive":
        hit = rng.random((len(points), 1)) < IMPULSE_SHARE
        return points + np.where(hit, rng.normal(scale=2 * scale, size=points.shape), 0.0)
    noisy = points + rng.normal(scale=scale, size=points.shape)
    if kind == "outliers":
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.05 * (high - low)
        hit = rng.random((len(points), 1)) < OUTLIER_SHARE
        noisy = np.where(hit, rng.uniform(low - margin, high + margin, size=points.shape), noisy)
    return noisy
