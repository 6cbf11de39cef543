"""POST /filter: a noisy cloud in, the clean one out, in one request."""

from __future__ import annotations

import asyncio
import re
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from pointfilter.errors import ParameterError
from pointfilter.models import AUTO, Auto
from pointfilter.pipeline import Radius
from service.dependencies import AdmittedFolder, ExchangeDep, HouseDep, Ready
from service.download import FileDownload, content_disposition
from service.errors import DeadlineError, DrainingError
from service.exchange import Exchange
from service.house import House
from service.problems import answers
from service.settings import variable
from service.upload import receive_upload
from service.work import Delivery, Order, cancelled_on_disconnect, carry_out, in_worker

router = APIRouter()

_HEADERS = {
    "Content-Disposition": "attachment, with the name of the upload and `_filtered`",
    "Server-Timing": "Milliseconds by stage; patches and infer are summed over the threads",
    "X-Request-ID": "The caller's, where it sent a sane one",
    "X-Model": "Name of the model that was used",
    "X-Points": "Points in the file",
    "X-Iterations": "Passes over the cloud; 0: it was found clean and came back as it was",
    "ETag": "sha256 of the file",
}
_FILE = {"type": "string", "format": "binary"}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The filtered file: moved coordinates, everything else as it came",
        "content": {"application/octet-stream": {"schema": _FILE}},
        "headers": {name: {"description": text, "schema": {"type": "string"}} for name, text in _HEADERS.items()},
    },
    **answers(
        "malformed-request", "malformed-file", "invalid-input", "model-not-found", "slow-transfer", "limit-exceeded",
        "unsupported-format", "unsupported-coding", "missing-coordinates", "too-few-points", "degenerate-cloud",
        "parameter-out-of-range", "queue-full", "client-closed", "cancelled", "internal-error", "error", "model-error",
        "invalid-model", "not-ready", "draining", "provider-unavailable", "storage-full", "deadline-exceeded",
    ),
}  # fmt: skip
_BODY = {
    "requestBody": {
        "required": True,
        "description": "The file, as the only part of a form or as the body itself",
        "content": {
            "multipart/form-data": {
                "schema": {"type": "object", "properties": {"file": _FILE}, "required": ["file"]},
            },
            "application/octet-stream": {"schema": _FILE},
        },
    }
}


@router.post(
    "/filter",
    summary="Filter a point cloud",
    tags=["filter"],
    dependencies=[Ready],
    response_class=Response,
    responses=_ANSWERS,
    openapi_extra=_BODY,
)
async def filter_file(
    request: Request,
    house: HouseDep,
    exchange: ExchangeDep,
    folder: AdmittedFolder,
    model: Annotated[str | None, Query(description="A name from /models", max_length=100)] = None,
    iterations: Annotated[
        str | None,
        Query(
            description="Passes over the cloud, a number from 1 on, or auto for as many as it needs; by default the "
            "model's",
            json_schema_extra={"pattern": "^(auto|[1-9][0-9]*)$"},
        ),
    ] = None,
    radius: Annotated[
        str | None,
        Query(
            description="Patch radius: a share of the bounding box's diagonal (5%, in an address 5%25) or a length in "
            "the unit of the file (0.02); by default the model's",
            max_length=40,
        ),
    ] = None,
    seed: Annotated[int, Query(description="Of the choice of neighbours in dense patches", ge=0, lt=2**63)] = 0,
    format: Annotated[  # noqa: A002 - the parameter's public name
        Literal["same", "ascii", "binary_little_endian", "binary_big_endian"],
        Query(description="Encoding of the answer"),
    ] = "same",
) -> Response:
    order = await _order(house, exchange, model, iterations, radius, seed, format)
    upload = await receive_upload(request, folder / "input.ply", house.settings)
    target = folder / "output.ply"
    work = partial(carry_out, order, upload.path, target, house.engines.engine, house.settings.read_limits)
    try:
        async with (
            asyncio.timeout(house.settings.timeout_seconds),
            cancelled_on_disconnect(request),
            house.admission.worker() as waited,
        ):
            house.telemetry.waited(waited)
            delivery = await in_worker(house.workers, work)
    except TimeoutError:
        raise DeadlineError(
            f"the result was not there after {house.settings.timeout_seconds:g} s; the work was stopped",
            limit=house.settings.timeout_seconds,
            hint=f"send less, or whoever runs the service can raise {variable('timeout_seconds')}",
        ) from None
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if not house.draining or task is None:
            raise
        task.uncancel()  # the server cancels what outlasts the drain; there is just time to say so
        raise DrainingError(
            "this process had to end before the result was there; the work was stopped", hint="send the request again"
        ) from None
    house.telemetry.delivered(delivery)
    exchange.points = delivery.report.points
    return FileDownload(
        target,
        delivery.size,
        house.settings.transfer_seconds,
        {
            "Content-Disposition": content_disposition(upload.file_name),
            "Server-Timing": _server_timing(delivery, waited),
            "X-Model": delivery.report.model,
            "X-Points": str(delivery.report.points),
            "X-Iterations": str(delivery.report.iterations),
            "ETag": f'"{delivery.sha256}"',
        },
    )


async def _order(
    house: House,
    exchange: Exchange,
    model: str | None,
    iterations: str | None,
    radius: str | None,
    seed: int,
    encoding: str,
) -> Order:
    """Checks what can be checked before the upload. Raises ParameterError, ModelError."""
    bundle = await asyncio.to_thread(house.engines.bundle, model or house.settings.model)
    exchange.model = bundle.name
    return Order(
        model=model or house.settings.model,
        iterations=None if iterations is None else _iterations(iterations, house.settings.max_iterations),
        radius=None if radius is None else Radius.parse(radius),
        seed=seed,
        encoding=encoding,
    )


def _iterations(text: str, most: int) -> int | Auto:
    """Raises ParameterError."""
    if text == AUTO:
        return AUTO
    number = int(text) if re.fullmatch(r"-?[0-9]{1,9}", text) else None
    if number is None or not 1 <= number <= most:
        raise ParameterError(
            f"iterations must be auto or a number from 1 to {most}, got {text[:40]}",
            limit=most,
            actual=text[:40] if number is None else number,
            hint=f"whoever runs the service can raise {variable('max_iterations')}",
        )
    return number


def _server_timing(delivery: Delivery, waited: float) -> str:
    stages = {"queue": waited, **delivery.seconds}
    return ", ".join(f"{stage};dur={1000 * seconds:.1f}" for stage, seconds in stages.items())
