"""Jobs: what takes longer than a request should."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.responses import JSONResponse, Response

from service.dependencies import AdmittedPlace, CallerDep, ExchangeDep, HouseDep, Ready
from service.download import FileDownload, content_disposition, result_headers
from service.errors import JobCancelledError, JobNotFinishedError, JobNotFoundError
from service.house import House
from service.intake import ACCEPTED, JOB_CODES, accept, accepted
from service.job import Job, not_found
from service.ordering import OrderDep
from service.problems import MEDIA_TYPE, answers
from service.records import Record, State
from service.status import JobStatus, described
from service.upload import FILE_BODY
from service.work import to_the_end

router = APIRouter(prefix="/jobs", tags=["jobs"], dependencies=[Ready])

LONGEST_WAIT_SECONDS = 60
LOOK_SECONDS = 0.1
EVENT_SECONDS = 0.5
CANCEL_SECONDS = 5.0  # how long DELETE waits for the work to have stopped
_LOOK_CODES = ("unauthorized", "job-not-found", "parameter-out-of-range", "internal-error", "not-ready", "draining")
_FAILURES = (
    "malformed-file", "invalid-input", "limit-exceeded", "unsupported-format", "missing-coordinates", "too-few-points",
    "degenerate-cloud", "error", "model-error", "invalid-model", "worker-died", "provider-unavailable", "storage-full",
    "deadline-exceeded",
)  # fmt: skip


async def _job(house: HouseDep, caller: CallerDep, id: str) -> Job:  # noqa: A002 - its public name
    """Raises JobNotFoundError, for somebody else's job too."""
    job = house.jobs.find(id)
    if (await asyncio.to_thread(job.read)).owner != caller:
        raise not_found()
    return job


JobDep = Annotated[Job, Depends(_job)]


@router.post(
    "",
    summary="Filter a point cloud as a job",
    status_code=202,
    response_model=JobStatus,
    responses={202: ACCEPTED, **answers(*JOB_CODES)},
    openapi_extra=FILE_BODY,
)
async def begin_job(
    request: Request, house: HouseDep, caller: CallerDep, _place: AdmittedPlace, order: OrderDep
) -> Response:
    """Takes the same as POST /filter. Once this has answered, the job survives the end of the process."""
    return accepted(request, await accept(request, house, caller, order))


@router.get("/{id}", summary="State of a job", responses=answers(*_LOOK_CODES))
async def job_status(
    request: Request,
    house: HouseDep,
    job: JobDep,
    wait: Annotated[
        float,
        Query(ge=0, description=f"Answer when the job ends, or after so many seconds, at most {LONGEST_WAIT_SECONDS}"),
    ] = 0.0,
) -> JobStatus:
    end = time.monotonic() + min(wait, LONGEST_WAIT_SECONDS)
    while True:
        status = await asyncio.to_thread(_status, request, house, job)
        if status.state.final or time.monotonic() >= end or house.draining:
            return status
        await asyncio.sleep(min(LOOK_SECONDS, max(0.0, end - time.monotonic())))


@router.get(
    "/{id}/events",
    summary="Progress of a job, as it happens",
    response_class=EventSourceResponse,
    responses=answers(*_LOOK_CODES),
)
async def job_events(request: Request, house: HouseDep, job: JobDep) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events: `progress` whenever there is something new, at last `done`, `failed` or `cancelled`. The data
    is that of GET /jobs/{id}."""
    last = None
    while not house.draining:
        try:
            status = await asyncio.to_thread(_status, request, house, job)
        except JobNotFoundError:  # removed by now
            return
        if status != last:
            last = status
            yield ServerSentEvent(event=status.state.value if status.state.final else "progress", data=status)
        if status.state.final:
            return
        await asyncio.sleep(EVENT_SECONDS)


@router.get(
    "/{id}/result",
    summary="The filtered file",
    response_class=Response,
    responses={
        200: {
            "description": "The filtered file, with the headers of POST /filter",
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        },
        **answers(*_LOOK_CODES, "job-not-finished", "job-cancelled", *_FAILURES),
    },
)
async def job_result(house: HouseDep, exchange: ExchangeDep, job: JobDep) -> Response:
    """Of a job that failed, the problem that ended it."""
    record = await asyncio.to_thread(job.read)
    if record.problem is not None:
        exchange.code = record.problem.code
        instance = f"{record.problem.instance.partition('#')[0]}/result#{exchange.request_id}"
        problem = record.problem.model_copy(update={"request_id": exchange.request_id, "instance": instance})
        return JSONResponse(problem.model_dump(), problem.status, media_type=MEDIA_TYPE)
    if record.state is State.CANCELLED:
        raise JobCancelledError("the job was cancelled")
    if record.outcome is None:
        raise JobNotFinishedError(f"the job is {record.state.value}", retry_after=house.runner.retry_after())
    if not await asyncio.to_thread(job.target.exists):
        raise not_found()
    return FileDownload(
        job.target,
        record.outcome.size,
        house.settings.transfer_seconds,
        {
            "Content-Disposition": content_disposition(record.file_name),
            **result_headers(record.outcome, {"queue": (record.started or record.created) - record.created}),
        },
    )


@router.delete(
    "/{id}",
    summary="Cancel a job, or remove one that ended",
    status_code=204,
    responses=answers(*_LOOK_CODES),
)
async def end_job(house: HouseDep, job: JobDep) -> None:
    """The work is stopped when this answers. A job that was cancelled is listed as such until it expires; one that had
    ended is removed, with its result."""
    record = await asyncio.to_thread(job.read)
    if record.state.final:
        await to_the_end(house.jobs.remove, job)
        return
    await asyncio.to_thread(job.ask_to_cancel)
    end = time.monotonic() + CANCEL_SECONDS
    while not await to_the_end(job.end_if_free) and time.monotonic() < end:
        await asyncio.sleep(LOOK_SECONDS)
    if record.state is State.QUEUED and (await asyncio.to_thread(job.read)).started is None:
        house.telemetry.job_ended(record.order.model, "cancelled", 0.0)  # nobody else will count it


def _status(request: Request, house: House, job: Job) -> JobStatus:
    record: Record = job.read()
    return described(request, record, job.progress(), house.settings.job_ttl_seconds)
