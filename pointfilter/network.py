"""The network, seen from the filter: batches of patches in, finite answers out.

Anything with this signature is a network: an onnxruntime session (engine.py), a torch module, or a few lines in a test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pointfilter.errors import InvalidModelError
from pointfilter.ranges import numbers_of_ranges

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MIN_NEIGHBOURS = 4  # fewer, the centre included, say nothing about a surface: the point stays where it is
LENGTH_STEP = 32  # points: lengths of patches are rounded up to it
ROWS_PER_BATCH = 2_048  # points a batch, all its patches together; measured: docs/adr/0005-one-thread-a-call.md


class Answers(NamedTuple):
    """What a network says of M query points, in the frames of their patches and in units of their radii.

    displacements: (M, 3) float32. log_errors: (M, 2) float32 or None, natural logarithms of the expected distance to
    the surface, after the displacement and without it. normals: (M, 3) float32 or None, of the surface at the moved
    point, of any sign and length.
    """

    displacements: Float32
    log_errors: Float32 | None = None
    normals: Float32 | None = None


Network = Callable[[Float32, Float32, Float32, Int64], Answers]
"""(patches (B, N, 3), context (B, 2), queries (M, 3), owners (M,)) to the answers for the M queries.

queries are points in the frames of the patches `owners`; a network without log_errors is asked for the centre of each
patch alone: M = B, queries 0. context: see `context`.
"""


def context(counts: Int64, later: bool) -> Float32:
    """What a decoder is told of each patch beside its points: (B, 2) float32.

    counts: (B,), points in the ball. later: whether the cloud has been through a pass already.
    """
    told = np.empty((len(counts), 2), dtype=np.float32)
    told[:, 0] = np.log2(np.maximum(counts, 1)) / 6 - 1
    told[:, 1] = later
    return told


def answers(
    network: Network,
    patches: Float32,
    counts: Int64,
    later: bool,
    queries: Float32,
    owners: Int64,
    check: Callable[[], None] = lambda: None,
) -> Answers:
    """The network's answers for B patches and M queries sorted by owner, batch by batch; check() is called in between.

    A patch that holds fewer than MIN_NEIGHBOURS points, or all of them at one place, moves nothing: displacement 0,
    both expected errors the same. Raises InvalidModelError for an answer of another shape or with values that are
    not finite.
    """
    told = context(counts, later)
    starts = np.searchsorted(owners, np.arange(len(patches) + 1))
    order, parts = [], []
    for length, positions in by_length(counts, patches.shape[1]):
        for start in range(0, len(positions), patches_per_batch(length)):
            check()
            batch = positions[start : start + patches_per_batch(length)]
            owner, rows = numbers_of_ranges(starts[batch], starts[batch + 1] - starts[batch])
            order.append(rows)
            parts.append(network(np.ascontiguousarray(patches[batch, :length]), told[batch], queries[rows], owner))
    back = np.argsort(np.concatenate(order))

    def in_order(values: list[Float32 | None]) -> Float32 | None:
        known = [value for value in values if value is not None]
        return np.concatenate(known)[back] if known else None

    joined = Answers(
        np.concatenate([part.displacements for part in parts])[back],
        in_order([part.log_errors for part in parts]),
        in_order([part.normals for part in parts]),
    )
    for values, width in ((joined.displacements, 3), (joined.log_errors, 2), (joined.normals, 3)):
        if values is not None and (values.shape != (len(queries), width) or not np.isfinite(values).all()):
            raise InvalidModelError(f"the network answered with shape {values.shape} or values that are not finite")
    nothing = (counts < MIN_NEIGHBOURS) | ~patches.any(axis=(1, 2))
    joined.displacements[nothing[owners]] = 0.0
    if joined.log_errors is not None:  # the frame of such a patch is arbitrary, and so is what was answered in it
        joined.log_errors[nothing[owners], 0] = joined.log_errors[nothing[owners], 1]
    return joined


def by_length(counts: Int64, longest: int) -> Iterator[tuple[int, Int64]]:
    """Groups patches by the length they need: yields (length, positions), lengths rounded up to LENGTH_STEP.

    Evaluating a patch at its own length is exact (the padding is the centre point once more) and saves the rest.
    """
    lengths = np.minimum(-(-np.maximum(counts, 1) // LENGTH_STEP) * LENGTH_STEP, longest)
    for length in np.unique(lengths):
        yield int(length), np.flatnonzero(lengths == length)


def patches_per_batch(length: int) -> int:
    """Patches of `length` points that go through the network together."""
    return max(1, ROWS_PER_BATCH // length)
