"""How long work takes, from what was seen lately, and so when it makes sense to ask again."""

from __future__ import annotations

import math

UNMEASURED_SECONDS = 10.0  # Retry-After before anything was measured
LONGEST_RETRY_SECONDS = 600
NEW_SHARE = 0.2  # of the newest measurement in the running mean


class Pace:
    """The running mean of the seconds that a piece of work takes one of so many workers."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._mean_seconds: float | None = None

    def note(self, seconds: float) -> None:
        """One more piece of work took so long."""
        mean = seconds if self._mean_seconds is None else self._mean_seconds
        self._mean_seconds = mean + NEW_SHARE * (seconds - mean)

    def retry_after(self) -> int:
        """Seconds until, at this pace, one of the workers falls free."""
        seconds = UNMEASURED_SECONDS if self._mean_seconds is None else self._mean_seconds / self._workers
        return max(1, min(LONGEST_RETRY_SECONDS, math.ceil(seconds)))
