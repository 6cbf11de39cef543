"""What a worker does for one request, start to end, in one thread; and how the event loop waits for it."""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TypeVar

from starlette.requests import Request

from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import FilteringCancelledError
from pointfilter.limits import ReadLimits
from pointfilter.models import Auto
from pointfilter.pipeline import Radius, Report, filter_cloud
from service.errors import ClientGoneError

T = TypeVar("T")


@dataclass(frozen=True)
class Order:
    """What to do: the request's parameters, checked."""

    model: str
    iterations: int | Auto | None
    radius: Radius | None
    seed: int
    encoding: str


@dataclass(frozen=True)
class Delivery:
    """What was done. seconds: by stage; patches and infer are summed over the threads. sha256: of the result."""

    report: Report
    sha256: str
    size: int
    seconds: dict[str, float]


def carry_out(
    order: Order, source: Path, target: Path, find_engine: Callable[[str], Engine], limits: ReadLimits, stop: Event
) -> Delivery:
    """Reads `source`, filters, writes `target`. Gives up soon after `stop` is set, by FilteringCancelledError.

    Raises what the core raises: see pointfilter.errors.
    """
    _go_on(stop)
    engine = find_engine(order.model)
    seconds: dict[str, float] = {}
    started = time.perf_counter()
    cloud = PointCloud.read(source, limits)
    seconds["parse"] = time.perf_counter() - started
    _go_on(stop)
    filtered, report = filter_cloud(
        cloud, engine, iterations=order.iterations, radius=order.radius, seed=order.seed, cancelled=stop.is_set
    )
    seconds.update({stage: report.seconds[stage] for stage in ("index", "patches", "infer")})
    _go_on(stop)
    started = time.perf_counter()
    filtered.write(target, order.encoding, report.comment)
    with target.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    seconds["write"] = time.perf_counter() - started
    return Delivery(report, sha256, target.stat().st_size, seconds)


def _go_on(stop: Event) -> None:
    if stop.is_set():
        raise FilteringCancelledError("the work was stopped")


async def in_worker(executor: Executor, work: Callable[[Event], T]) -> T:
    """Runs work(stop) in a thread. Cancelling the waiting task sets `stop`, and the cancellation goes on only when the
    thread has ended: whoever catches it may free the worker and remove the files."""
    stop = Event()
    context = contextvars.copy_context()  # what the thread logs carries the request's id
    future = asyncio.get_running_loop().run_in_executor(executor, context.run, work, stop)
    try:
        return await asyncio.shield(future)
    except asyncio.CancelledError:
        stop.set()
        while not future.done():
            try:
                await asyncio.wait([future])
            except asyncio.CancelledError:  # a second one must not leave the thread behind
                continue
        if not future.cancelled():
            future.exception()  # looked at, so that asyncio does not complain about it
        raise


@asynccontextmanager
async def cancelled_on_disconnect(request: Request) -> AsyncIterator[None]:
    """Cancels what is inside when the client goes away, and raises ClientGoneError in its place.

    For use once the whole body was read: it listens to what the connection has to say.
    """
    task = asyncio.current_task()
    assert task is not None  # noqa: S101 - a coroutine always runs in one
    gone = False

    async def listen() -> None:
        nonlocal gone
        while (await request.receive())["type"] != "http.disconnect":
            pass
        gone = True
        task.cancel()

    listener = asyncio.create_task(listen())
    try:
        yield
    except asyncio.CancelledError:
        if gone and task.uncancel() == 0:
            raise ClientGoneError("the client went away; the work was stopped") from None
        raise
    finally:
        listener.cancel()
        await asyncio.wait([listener])
