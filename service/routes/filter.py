"""POST /filter: a noisy cloud in, the clean one out, in one request, or as a job when that takes too long."""

from __future__ import annotations

from functools import partial
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from service.dependencies import AdmittedFolder, CallerDep, ExchangeDep, HouseDep, Ready
from service.download import FileDownload, content_disposition, result_headers
from service.intake import ACCEPTED, JOB_CODES, accept, accepted
from service.ordering import OrderDep
from service.problems import answers
from service.records import Outcome
from service.tracing import note_work
from service.turn import WORK_CODES, in_turn
from service.upload import FILE_BODY, receive_upload

router = APIRouter()

HEADERS = {
    "Content-Disposition": "attachment, with the name of the upload and `_filtered`",
    "Server-Timing": "Milliseconds by stage; patches and infer are summed over the threads",
    "X-Request-ID": "The caller's, where it sent a sane one",
    "X-Model": "Name of the model that was used",
    "X-Points": "Points in the file",
    "X-Iterations": "Passes over the cloud",
    "X-Moved": "Points that were moved; the others have the coordinates that were sent",
    "X-Radius": "Median radius of the balls, in the unit of the file; 0 where no point took one",
    "X-Expected-Error": "Mean distance to the surface that the network expects of the filtered points, in "
    "the unit of the file; absent in the paper's mode and with a limit on displacements",
    "X-Warnings": "What to know before the result is used, percent-encoded, joined by '; '; absent without warnings",
    "ETag": "sha256 of the file",
}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The filtered file: moved coordinates, columns that were asked for, everything else as it came",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        "headers": {name: {"description": text, "schema": {"type": "string"}} for name, text in HEADERS.items()},
    },
    202: ACCEPTED,
    **answers(*JOB_CODES, *WORK_CODES),
}


@router.post(
    "/filter",
    summary="Filter a point cloud",
    tags=["filter"],
    dependencies=[Ready],
    response_class=Response,
    responses=_ANSWERS,
    openapi_extra=FILE_BODY,
)
async def filter_file(
    request: Request,
    house: HouseDep,
    exchange: ExchangeDep,
    caller: CallerDep,
    folder: AdmittedFolder,
    order: OrderDep,
) -> Response:
    """With `Prefer: respond-async`, and for files above the service's limit for one request, the answer is that of
    POST /jobs."""
    if _asks_for_a_job(request):
        return accepted(request, await accept(request, house, caller, order))
    upload = await receive_upload(request, folder / "input.ply", house.settings)
    if upload.size > house.settings.sync_bytes:
        return accepted(request, await accept(request, house, caller, order, upload))
    target = folder / "output.ply"
    delivery, waited = await in_turn(
        request,
        house,
        upload,
        partial(house.crew.carry_out, order, upload.path, target),
        "send it as a job (Prefer: respond-async), which has more time, or send less",
    )
    house.telemetry.delivered(delivery)
    note_work(delivery)
    exchange.points = delivery.report.points
    return FileDownload(
        target,
        delivery.size,
        house.settings.transfer_seconds,
        {
            "Content-Disposition": content_disposition(upload.file_name),
            **result_headers(Outcome.of(delivery), {"queue": waited}),
        },
    )


def _asks_for_a_job(request: Request) -> bool:
    """RFC 7240."""
    preferences = ",".join(request.headers.getlist("prefer")).lower().split(",")
    return any(preference.partition(";")[0].strip() == "respond-async" for preference in preferences)
