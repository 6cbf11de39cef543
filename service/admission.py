"""Backpressure: a place in the house or a refusal at the door, then a worker. Both are released in `finally`.

Small clouds have a worker of their own beside the ones that they share with all others, so that none of them waits for
a large one to be done.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from enum import Enum

from service.errors import QueueFullError
from service.pace import Pace
from service.settings import variable


class _Lane(Enum):
    """What a worker is for."""

    ANY = "any"
    SMALL = "small"


class Admission:
    """Counts who is in the house. To be used from one event loop only.

    express: workers for small clouds alone. places_per_key: of one API key; 0 for all there are.
    """

    def __init__(self, workers: int, queue_size: int, express: int = 0, places_per_key: int = 0) -> None:
        self.workers = workers
        self.places = workers + queue_size
        self.held = 0
        self._held_by: Counter[str] = Counter()
        self._places_per_key = places_per_key
        self.waiting = 0
        self.running = 0
        self._free = {_Lane.ANY: workers, _Lane.SMALL: express}
        self._queue: deque[tuple[bool, asyncio.Future[_Lane]]] = deque()
        self._pace = Pace(workers)

    @contextmanager
    def place(self, key: str | None = None) -> Iterator[None]:
        """Holds a place from before the upload until after the download, so that files on disk are bounded too.

        key: the name of the caller's API key. Raises QueueFullError at once when there is no place.
        """
        if self.held >= self.places:
            raise QueueFullError(
                f"{self.held} requests are in progress or waiting, as many as this service takes",
                limit=self.places,
                actual=self.held + 1,
                hint=f"try again later; whoever runs the service can raise {variable('queue_size')}",
                retry_after=self.retry_after(),
            )
        if key is not None and self._places_per_key and self._held_by[key] >= self._places_per_key:
            raise QueueFullError(
                f"{self._held_by[key]} requests of this API key are in progress or waiting, as many as it may have",
                limit=self._places_per_key,
                actual=self._held_by[key] + 1,
                hint=f"try again later; whoever runs the service can raise {variable('places_per_key')}",
                retry_after=self.retry_after(),
            )
        self.held += 1
        if key is not None:
            self._held_by[key] += 1
        try:
            yield
        finally:
            self.held -= 1
            if key is not None:
                self._held_by[key] -= 1

    @asynccontextmanager
    async def worker(self, small: bool = False) -> AsyncIterator[float]:
        """Waits for a worker, first come first served; yields the seconds waited."""
        asked = time.perf_counter()
        lane = await self._wait(small)
        begun = time.perf_counter()
        self.running += 1
        try:
            yield begun - asked
        except Exception:
            raise  # a file that is refused at its first line says nothing about the rate
        except BaseException:
            self._pace.note(time.perf_counter() - begun)  # stopped: it would have taken longer still
            raise
        else:
            self._pace.note(time.perf_counter() - begun)
        finally:
            self.running -= 1
            self._release(lane)

    async def _wait(self, small: bool) -> _Lane:
        given: asyncio.Future[_Lane] = asyncio.get_running_loop().create_future()
        self._queue.append((small, given))
        self.waiting += 1
        self._assign()
        try:
            return await given
        except asyncio.CancelledError:
            if given.done() and not given.cancelled():  # given in the very moment
                self._release(given.result())
            else:
                self._queue.remove((small, given))
            raise
        finally:
            self.waiting -= 1

    def _assign(self) -> None:
        for waiting in list(self._queue):
            small, given = waiting
            if given.done():  # gave up, and has not come round to say so
                continue
            lanes = (_Lane.ANY, _Lane.SMALL) if small else (_Lane.ANY,)
            if lane := next((lane for lane in lanes if self._free[lane]), None):
                self._free[lane] -= 1
                self._queue.remove(waiting)
                given.set_result(lane)

    def _release(self, lane: _Lane) -> None:
        self._free[lane] += 1
        self._assign()

    def retry_after(self) -> int:
        """Seconds until, at the measured rate, the next place falls free."""
        return self._pace.retry_after()
