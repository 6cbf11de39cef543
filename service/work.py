"""What a worker does for one request, start to end, in one thread; and how the event loop waits for it."""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Executor
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TypeVar

from starlette.requests import Request

from pointfilter.attributes import KEEP
from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import FilteringCancelledError, InputError, LimitExceededError
from pointfilter.filter import STAGES
from pointfilter.formats.ply_header import read_header
from pointfilter.inspection import Look, look
from pointfilter.limits import ReadLimits
from pointfilter.pipeline import Radius, Report, filter_cloud
from service.errors import ClientGoneError

T = TypeVar("T")

SMALL_HEADER_BYTES = 1 << 16
SMALL_ROW_BYTES = 1_000  # more than a row of a scan has, faces included


@dataclass(frozen=True)
class Order:
    """What to do: the request's parameters, checked."""

    model: str
    iterations: int | None
    radius: Radius | None
    seed: int
    encoding: str
    strength: float = 1.0
    max_move: float | None = None
    paper: bool = False
    normals: str = KEEP
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class LookOrder:
    """What to look at a cloud with: the request's parameters, checked."""

    model: str
    seed: int


@dataclass(frozen=True)
class Delivery:
    """What was done. seconds: by stage; patches and infer are summed over the threads. sha256: of the result."""

    report: Report
    sha256: str
    size: int
    seconds: dict[str, float]


def carry_out(
    order: Order,
    source: Path,
    target: Path,
    find_engine: Callable[[str], Engine],
    limits: ReadLimits,
    stopped: Callable[[], bool],
    progress: Callable[[int, int, int], None] = lambda _done, _total, _points: None,
) -> Delivery:
    """Reads `source`, filters, writes `target`. Gives up soon after stopped() is true, by FilteringCancelledError.

    progress(done, total, points): in units of points times iterations, and how many points are filtered. Raises what
    the core raises: see pointfilter.errors.
    """
    _go_on(stopped)
    engine = find_engine(order.model)
    seconds: dict[str, float] = {}
    started = time.perf_counter()
    cloud = PointCloud.read(source, limits)
    seconds["parse"] = time.perf_counter() - started
    _go_on(stopped)
    points = int(cloud.finite.sum())
    filtered, report = filter_cloud(
        cloud,
        engine,
        iterations=order.iterations,
        radius=order.radius,
        seed=order.seed,
        strength=order.strength,
        max_move=order.max_move,
        paper=order.paper,
        normals=order.normals,
        columns=order.columns,
        progress=lambda done, total: progress(done, total, points),
        cancelled=stopped,
    )
    seconds.update({stage: report.seconds[stage] for stage in STAGES})
    _go_on(stopped)
    started = time.perf_counter()
    filtered.write(target, order.encoding, report.comment)
    with target.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    seconds["write"] = time.perf_counter() - started
    return Delivery(report, sha256, target.stat().st_size, seconds)


def look_over(
    order: LookOrder,
    source: Path,
    find_engine: Callable[[str], Engine],
    limits: ReadLimits,
    stopped: Callable[[], bool],
) -> Look:
    """Reads `source` and looks at it. Gives up, and raises, as carry_out does."""
    _go_on(stopped)
    engine = find_engine(order.model)
    cloud = PointCloud.read(source, limits)
    _go_on(stopped)
    return look(cloud, engine, seed=order.seed, cancelled=stopped)


def _go_on(stopped: Callable[[], bool]) -> None:
    if stopped():
        raise FilteringCancelledError("the work was stopped")


def is_small(path: Path, points: int) -> bool:
    """Whether a file's header promises a cloud of at most so many points, and little else. A damaged one is small: it
    is refused at once."""
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            header = read_header(file, size, ReadLimits(max_header_bytes=SMALL_HEADER_BYTES))
    except LimitExceededError:
        return False
    except InputError:
        return size <= points * SMALL_ROW_BYTES
    return header.vertex.count <= points and size <= points * SMALL_ROW_BYTES


async def to_the_end(function: Callable[..., T], *arguments: object) -> T:
    """Calls a function in a thread, and goes on only when it has returned, a cancellation too."""
    future = asyncio.ensure_future(asyncio.to_thread(function, *arguments))
    try:
        return await asyncio.shield(future)
    except asyncio.CancelledError:
        await _outwait(future)
        raise


async def _outwait(future: asyncio.Future[T]) -> None:
    """Waits for a future that nobody can stop, whatever else happens."""
    while not future.done():
        try:
            await asyncio.wait([future])
        except asyncio.CancelledError:  # a second one must not leave the thread behind
            continue
    if not future.cancelled():
        future.exception()  # looked at, so that asyncio does not complain about it


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
        await _outwait(future)
        raise


@asynccontextmanager
async def cancelled_when(happens: Awaitable[object], error: Exception) -> AsyncIterator[None]:
    """Cancels what is inside when something happens, and raises `error` in place of the cancellation."""
    task = asyncio.current_task()
    assert task is not None  # noqa: S101 - a coroutine always runs in one
    happened = False

    async def wait() -> None:
        nonlocal happened
        await happens
        happened = True
        task.cancel()

    waiting = asyncio.create_task(wait())
    try:
        yield
    except asyncio.CancelledError:
        if happened and task.uncancel() == 0:
            raise error from None
        raise
    finally:
        waiting.cancel()
        await asyncio.wait([waiting])


def cancelled_on_disconnect(request: Request) -> AbstractAsyncContextManager[None]:
    """Cancels what is inside when the client goes away, and raises ClientGoneError in its place.

    For use once the whole body was read: it listens to what the connection has to say.
    """

    async def listen() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    return cancelled_when(listen(), ClientGoneError("the client went away; the work was stopped"))
