"""How a request's body becomes a job."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from service.errors import JobsFullError
from service.exchange import exchange_of
from service.house import House
from service.records import Record
from service.settings import variable
from service.status import JobStatus, described
from service.upload import Upload, adopt, receive_upload
from service.work import Order, is_small, to_the_end

UPLOAD_CODES = (
    "malformed-request", "unauthorized", "model-not-found", "slow-transfer", "limit-exceeded", "unsupported-coding",
    "parameter-out-of-range", "queue-full", "client-closed", "internal-error", "invalid-model", "not-ready",
    "draining", "storage-full",
)  # fmt: skip
JOB_CODES = (*UPLOAD_CODES, "jobs-full")
_HEADERS = {"Location": {"description": "Address of the job", "schema": {"type": "string"}}}
ACCEPTED: dict[str, Any] = {
    "description": "Accepted: the job's status, and its address in Location",
    "model": JobStatus,
    "headers": _HEADERS,
}


async def accept(
    request: Request, house: House, caller: str | None, order: Order, upload: Upload | None = None
) -> Record:
    """Makes a job of the request's body, or of one that arrived already. Raises JobsFullError and as receive_upload."""
    await asyncio.to_thread(_check_room, house, caller)
    incoming = await asyncio.to_thread(house.jobs.begin)
    try:
        if upload is None:
            upload = await receive_upload(request, incoming.source, house.settings)
        else:
            await asyncio.to_thread(adopt, upload, incoming.source)
        record = Record(
            id=incoming.id,
            created=time.time(),
            order=order,
            file_name=upload.file_name,
            small=await asyncio.to_thread(is_small, incoming.source, house.settings.small_points),
            owner=caller,
            request_id=exchange_of(request.scope).request_id,
        )
        await to_the_end(house.jobs.accept, incoming, record)
    except BaseException:
        await asyncio.to_thread(incoming.remove)
        raise
    house.runner.wake()
    return record


def accepted(request: Request, record: Record) -> Response:
    status = described(request, record, None, None)
    return JSONResponse(status.model_dump(mode="json"), 202, {"Location": status.href})


def _check_room(house: House, caller: str | None) -> None:
    """Raises JobsFullError."""
    settings = house.settings

    def check(count: int, limit: int, told: str, hint: str) -> None:
        if count >= limit:
            retry_after = house.runner.retry_after()
            raise JobsFullError(f"{count} {told}", limit=limit, actual=count + 1, hint=hint, retry_after=retry_after)

    check(
        house.jobs.waiting(),
        settings.job_queue_size,
        "jobs are waiting, as many as this service keeps",
        f"try again later; whoever runs the service can raise {variable('job_queue_size')}",
    )
    if settings.jobs_per_key and caller is not None:
        check(
            house.jobs.unfinished(caller),
            settings.jobs_per_key,
            "jobs of this API key are not finished, as many as it may have",
            f"whoever runs the service can raise {variable('jobs_per_key')}",
        )
