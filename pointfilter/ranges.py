"""Work on a long array piece by piece, several at once, that can be stopped in between."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def over_ranges(
    work: Callable[[int, int], T], count: int, size: int, threads: int, check: Callable[[], None]
) -> list[T]:
    """work(first, last) for the rows 0 to count in pieces of `size`, `threads` of them at once; the answers in order.

    check() is called from this thread after so many pieces; what it raises ends the work.
    """
    starts = range(0, count, size)
    parts: list[T] = []
    with ThreadPoolExecutor(threads, thread_name_prefix="ranges") as pool:
        for group in range(0, len(starts), threads):
            parts += pool.map(lambda first: work(first, min(first + size, count)), starts[group : group + threads])
            check()
    return parts
