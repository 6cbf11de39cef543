"""Works off the jobs: takes one from the queue when a worker is free, follows it, and writes down how it ended."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from service.admission import Admission
from service.errors import DeadlineError, JobCancelledError, JobNotFoundError, WorkerDiedError
from service.exchange import current_request_id
from service.handlers import explained
from service.job import Job
from service.jobs import Jobs
from service.pace import Pace
from service.problem_types import TYPES
from service.problems import problem_of
from service.records import Outcome, Record, State
from service.settings import Settings, variable
from service.telemetry import Telemetry
from service.work import Delivery, Order, cancelled_when, in_worker, to_the_end

log = logging.getLogger("service.jobs")

POLL_SECONDS = 1.0  # how often the queue is looked at for jobs of other processes
CANCEL_SECONDS = 0.2  # how often a running job looks whether it shall stop
MOST_ATTEMPTS = 10  # a job that ends the whole process is given up at last
KEEP_SECONDS = 10.0  # how often lost jobs are looked for
EXPIRE_SECONDS = 60.0

CarryOut = Callable[[Order, Path, Path, threading.Event, Callable[[int, int, int], None]], Delivery]


class _NothingToDoError(Exception):
    """A worker was had and not needed; as an exception, so that Admission does not measure it."""


class Runner:
    """The jobs of one process. To be used from its event loop only."""

    def __init__(
        self,
        jobs: Jobs,
        settings: Settings,
        admission: Admission,
        telemetry: Telemetry,
        executor: Executor,
        carry_out: CarryOut,
        draining: Callable[[], bool] = lambda: False,
    ) -> None:
        self._jobs = jobs
        self._settings = settings
        self._admission = admission
        self._telemetry = telemetry
        self._executor = executor
        self._carry_out = carry_out
        self._draining = draining
        self._wake = asyncio.Event()
        self._stopping = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._pace = Pace(settings.workers)
        self.running = 0
        self.waiting = 0

    def open(self) -> None:
        self._begin(self._keep())
        for _ in range(self._settings.workers):
            self._begin(self._serve(small_only=False))
        if self._settings.small_points:
            self._begin(self._serve(small_only=True))

    async def close(self, seconds: float) -> None:
        """Begins no job any more; those that are not done after so many seconds go back to the queue."""
        self._stopping.set()
        self._wake.set()
        if self._tasks:
            _, late = await asyncio.wait(self._tasks, timeout=max(0.0, seconds))
            for task in late:
                task.cancel()
            if late:
                await asyncio.wait(late)

    @property
    def alive(self) -> bool:
        """Whether all that should go on does."""
        return self._stopping.is_set() or not any(task.done() for task in self._tasks)

    def wake(self) -> None:
        """There is a new job."""
        self._wake.set()

    def retry_after(self) -> int:
        """Seconds until, at the measured rate, a job leaves the queue."""
        return self._pace.retry_after()

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        self._tasks.add(asyncio.create_task(work))

    async def _serve(self, small_only: bool) -> None:
        queues = (True,) if small_only else (False, True)  # small ones have a worker of their own, large ones have not
        while not self._stopping.is_set():
            self._wake.clear()
            try:
                found = not self._draining() and await self._serve_one(queues)
            except _NothingToDoError:
                found = False
            except Exception:  # a full disk, a Redis that is away: it may come back
                log.exception("the jobs cannot be worked on")
                found = False
            if not found and not self._stopping.is_set():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._wake.wait(), POLL_SECONDS)

    async def _serve_one(self, queues: tuple[bool, ...]) -> bool:
        """Whether there was a job."""
        for small in queues:
            if await asyncio.to_thread(self._jobs.queued, small):
                async with self._admission.worker(small):
                    if self._stopping.is_set() or self._draining():
                        raise _NothingToDoError
                    job = await asyncio.to_thread(self._jobs.next, small)
                    if job is None or not await self._work(job):
                        raise _NothingToDoError
                    return True
        return False

    async def _work(self, job: Job) -> bool:
        """Whether there was anything to do."""
        with ExitStack() as stack:
            if not await to_the_end(stack.enter_context, job.locked()):
                return False  # another process is at it, or it is gone
            try:
                record = await asyncio.to_thread(job.read)
            except JobNotFoundError:
                return False
            if record.state.final:
                return False
            token = current_request_id.set(record.request_id)
            self.running += 1
            try:
                await self._follow(job, record)
            finally:
                self.running -= 1
                current_request_id.reset(token)
            return True

    async def _follow(self, job: Job, record: Record) -> None:
        started = time.time()
        record = record.model_copy(update={"state": State.RUNNING, "started": started, "attempts": record.attempts + 1})
        await to_the_end(job.write, record)
        self._telemetry.waited(started - record.created)
        end: dict[str, Any]
        try:
            if record.attempts > MOST_ATTEMPTS:
                raise WorkerDiedError(
                    f"{MOST_ATTEMPTS} processes of the service died while they worked on it", limit=MOST_ATTEMPTS
                )
            async with (
                asyncio.timeout(self._settings.job_seconds),
                cancelled_when(_asked_to_end(job), JobCancelledError("the job was cancelled")),
            ):
                delivery = await in_worker(self._executor, partial(self._in_thread, job, record.order))
        except asyncio.CancelledError:
            await to_the_end(self._give_back, job, record)
            log.info("job goes back to the queue", extra={"job": job.id})
            raise
        except JobCancelledError:
            end = {"state": State.CANCELLED}
        except TimeoutError:
            error = DeadlineError(
                f"the job was not done after {self._settings.job_seconds:g} s of work and was stopped",
                limit=self._settings.job_seconds,
                hint=f"send less, or whoever runs the service can raise {variable('job_seconds')}",
            )
            end = self._failed(job, record, error)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is how the job ended
            end = self._failed(job, record, error)
        else:
            self._telemetry.delivered(delivery)
            end = {"state": State.DONE, "outcome": Outcome.of(delivery)}
        record = record.model_copy(update={**end, "finished": time.time()})
        await to_the_end(job.conclude, record)
        self._note(record, time.time() - started)

    def _give_back(self, job: Job, record: Record) -> None:
        """To the queue; this attempt does not count."""
        update = {"state": State.QUEUED, "started": None, "attempts": record.attempts - 1}
        job.write(record.model_copy(update=update))
        self._jobs.requeue(record)

    def _in_thread(self, job: Job, order: Order, stop: threading.Event) -> Delivery:
        return self._carry_out(order, job.source, job.target, stop, job.progress_writer())

    def _failed(self, job: Job, record: Record, error: Exception) -> dict[str, Any]:
        code, told = explained(error)
        return {"state": State.FAILED, "problem": problem_of(code, told, f"/jobs/{job.id}", record.request_id)}

    def _note(self, record: Record, seconds: float) -> None:
        outcome = "ok"
        if record.state is State.CANCELLED:
            outcome = "cancelled"
        elif record.problem:
            outcome = TYPES[record.problem.code].outcome
        if record.state is State.DONE:
            self._pace.note(seconds)
        self._telemetry.job_ended(record.order.model, outcome, seconds)
        log.info(
            "job",
            extra={
                "job": record.id,
                "code": record.problem.code if record.problem else None,
                "seconds": round(seconds, 4),
                "model": record.order.model,
                "points": record.outcome.points if record.outcome else None,
                "attempt": record.attempts,
            },
        )

    async def _keep(self) -> None:
        """Finds jobs that were lost and ends those that are old, now and then, and once at the start."""
        expired = float("-inf")
        while not self._stopping.is_set():
            try:
                if lost := await asyncio.to_thread(self._jobs.recover):
                    log.warning("%d jobs that nobody worked on go back to the queue", lost)
                    self.wake()
                if time.monotonic() - expired > EXPIRE_SECONDS:
                    expired = time.monotonic()
                    settings = self._settings
                    await asyncio.to_thread(self._jobs.expire, settings.job_ttl_seconds, 2 * settings.transfer_seconds)
                self.waiting = await asyncio.to_thread(self._jobs.waiting)
            except Exception:
                log.exception("the jobs cannot be looked at")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), KEEP_SECONDS)


async def _asked_to_end(job: Job) -> None:
    while not await asyncio.to_thread(job.to_be_cancelled):
        await asyncio.sleep(CANCEL_SECONDS)
