"""Backpressure: a place in the house or a refusal at the door, then a worker. Both are released in `finally`."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from service.errors import QueueFullError
from service.settings import variable

UNMEASURED_SECONDS = 10.0  # Retry-After before anything was measured
LONGEST_RETRY_SECONDS = 600
NEW_SHARE = 0.2  # of the newest measurement in the running mean


class Admission:
    """Counts who is in the house. To be used from one event loop only."""

    def __init__(self, workers: int, queue_size: int) -> None:
        self.workers = workers
        self.places = workers + queue_size
        self.held = 0
        self.waiting = 0
        self.running = 0
        self._semaphore = asyncio.Semaphore(workers)
        self._mean_seconds: float | None = None

    @contextmanager
    def place(self) -> Iterator[None]:
        """Holds a place from before the upload until after the download, so that files on disk are bounded too.

        Raises QueueFullError at once when there is none.
        """
        if self.held >= self.places:
            raise QueueFullError(
                f"{self.held} requests are in progress or waiting, as many as this service takes",
                limit=self.places,
                actual=self.held + 1,
                hint=f"try again later; whoever runs the service can raise {variable('queue_size')}",
                retry_after=self.retry_after(),
            )
        self.held += 1
        try:
            yield
        finally:
            self.held -= 1

    @asynccontextmanager
    async def worker(self) -> AsyncIterator[float]:
        """Waits for a worker, first come first served; yields the seconds waited."""
        asked = time.perf_counter()
        self.waiting += 1
        try:
            await self._semaphore.acquire()
        finally:
            self.waiting -= 1
        begun = time.perf_counter()
        self.running += 1
        try:
            yield begun - asked
        except Exception:
            raise  # a file that is refused at its first line says nothing about the rate
        except BaseException:
            self._measure(time.perf_counter() - begun)  # stopped: it would have taken longer still
            raise
        else:
            self._measure(time.perf_counter() - begun)
        finally:
            self.running -= 1
            self._semaphore.release()

    def retry_after(self) -> int:
        """Seconds until, at the measured rate, the next place falls free."""
        seconds = UNMEASURED_SECONDS if self._mean_seconds is None else self._mean_seconds / self.workers
        return max(1, min(LONGEST_RETRY_SECONDS, math.ceil(seconds)))

    def _measure(self, seconds: float) -> None:
        mean = seconds if self._mean_seconds is None else self._mean_seconds
        self._mean_seconds = mean + NEW_SHARE * (seconds - mean)
