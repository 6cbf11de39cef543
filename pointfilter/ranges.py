"""Work on a long array range by range, several at once, that can be stopped in between; numbers of several ranges."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Int64 = NDArray[np.int64]
T = TypeVar("T")


def over_ranges(
    work: Callable[[int, int], T], count: int, size: int, threads: int, check: Callable[[], None]
) -> Iterator[T]:
    """work(first, last) for the rows 0 to count in pieces of `size`, `threads` of them at once: yields the answers in
    order, each as soon as it and those before it are there. Nothing is done until the answers are asked for.

    check() is called from this thread after every piece; what it raises ends the work.
    """
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="ranges") as pool:
        try:
            for first in range(0, count, size):
                waiting.append(pool.submit(work, first, min(first + size, count)))
                if len(waiting) == 2 * threads:  # as many again as are under way, so that no thread runs out of work
                    yield waiting.popleft().result()
                    check()
            while waiting:
                yield waiting.popleft().result()
                check()
        finally:
            for future in waiting:
                future.cancel()


def numbers_of_ranges(starts: Int64, sizes: Int64) -> tuple[Int64, Int64]:
    """For ranges of `sizes` (q,) numbers from `starts` (q,) on, one after the other: which range each number is of, and
    the number itself, both (sum of sizes,)."""
    which = np.repeat(np.arange(len(sizes)), sizes)
    return which, np.arange(len(which)) + (starts - np.cumsum(sizes) + sizes)[which]
