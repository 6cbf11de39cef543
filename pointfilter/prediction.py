"""The network, seen from the filter: batches of patches in, finite displacements out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import InvalidModelError
from pointfilter.patches import Patches

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Predict = Callable[[Float32], Float32]
"""A network: patches (B, N, 3) float32 -> displacements (B, 3) float32, both in patch frames and in units of r."""

MIN_NEIGHBOURS = 4  # fewer, the centre included, say nothing about a surface: the point stays where it is
ROWS_PER_BATCH = 2_048  # points a batch, all its patches together; measured: docs/adr/0005-one-thread-a-call.md


def displacements(predict: Predict, patches: Patches, check: Callable[[], None] = lambda: None) -> Float64:
    """The network's answers for a batch, (B, 3) in patch frames and in units of r; 0 where a patch is none.

    check() is called between the network's batches.
    """
    count, length, _ = patches.points.shape
    size = patches_per_batch(length)
    parts = []
    for start in range(0, count, size):
        check()
        parts.append(predict(patches.points[start : start + size]))
    answers = np.concatenate(parts).astype(np.float64)
    if answers.shape != (count, 3) or not np.isfinite(answers).all():
        raise InvalidModelError("the network answered with something else than finite displacements")
    answers[(patches.counts < MIN_NEIGHBOURS) | ~patches.points.any(axis=(1, 2))] = 0.0
    return answers


def patches_per_batch(length: int) -> int:
    """Patches of `length` points that go through the network together."""
    return max(1, ROWS_PER_BATCH // length)
