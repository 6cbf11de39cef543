"""A request's turn at a worker: with a deadline, and only as long as the client is there."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from threading import Event
from typing import TypeVar

from starlette.requests import Request

from service.errors import DeadlineError
from service.house import House
from service.settings import variable
from service.upload import Upload
from service.work import cancelled_on_disconnect, in_worker, is_small

T = TypeVar("T")

WORK_CODES = (
    "malformed-file", "invalid-input", "unsupported-format", "missing-coordinates", "too-few-points",
    "degenerate-cloud", "cancelled", "error", "model-error", "provider-unavailable", "deadline-exceeded", "worker-died",
)  # fmt: skip


async def in_turn(
    request: Request, house: House, upload: Upload, work: Callable[[Event], T], advice: str
) -> tuple[T, float]:
    """Waits for a worker, then runs work(stop) in a thread: its result, and the seconds waited.

    advice: what a client can do about a deadline, for the hint. Raises DeadlineError, ClientGoneError, QueueFullError
    and what the work raises.
    """
    small = await asyncio.to_thread(is_small, upload.path, house.settings.small_points)
    try:
        async with (
            asyncio.timeout(house.settings.timeout_seconds),
            cancelled_on_disconnect(request),
            house.admission.worker(small) as waited,
        ):
            house.telemetry.waited(waited)
            return await in_worker(house.executor, work), waited
    except TimeoutError:
        raise DeadlineError(
            f"the result was not there after {house.settings.timeout_seconds:g} s; the work was stopped",
            limit=house.settings.timeout_seconds,
            hint=f"{advice}; whoever runs the service can raise {variable('timeout_seconds')}",
        ) from None
