"""Every way a request can fail, in one table: the answer's status, what it means, what to do, how it is counted.

Answers are RFC 9457 problem details. Their `type` is /problems/{code}, a page that this service itself serves from the
same table; docs/problems.md is that page for readers of the repository, and a test compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import quote

from pydantic import BaseModel, Field
from starlette.requests import Request
from starlette.responses import JSONResponse

from pointfilter.errors import PointfilterError
from service.exchange import exchange_of

MEDIA_TYPE = "application/problem+json"
Outcome = Literal["ok", "invalid", "too_large", "rejected", "timeout", "cancelled", "error"]


@dataclass(frozen=True)
class ProblemType:
    """One row. `private`: the exception's own words are for the log, the answer says `meaning` instead."""

    status: int
    title: str
    outcome: Outcome
    meaning: str
    remedy: str
    private: bool = False


TYPES: dict[str, ProblemType] = {
    "malformed-request": ProblemType(
        400, "The request does not hold one file", "invalid",
        "The body is empty, or it is a multipart form that is broken or does not have exactly one part called `file`.",
        "Send the file as the raw body, or as the only part `file` of a multipart form.",
    ),
    "malformed-file": ProblemType(
        400, "The file is damaged", "invalid",
        "The file is not what its own header promises. The detail names the line or the byte.",
        "Save or download the file again; a file that ends early was cut short on its way.",
    ),
    "invalid-input": ProblemType(
        400, "The file cannot be used", "invalid",
        "The file was read and cannot be filtered. The detail says why.",
        "Check the file with `pointfilter info`.",
    ),
    "not-found": ProblemType(
        404, "There is nothing here", "invalid",
        "The address is not one of this service's.",
        "GET /docs lists the addresses.",
    ),
    "model-not-found": ProblemType(
        404, "No such model", "invalid",
        "The service has no model of the name asked for.",
        "GET /models lists the names; leave `model` out for the default.",
    ),
    "method-not-allowed": ProblemType(
        405, "The method does not fit the address", "invalid",
        "The address exists and does not take this HTTP method.",
        "The Allow header lists the methods it takes.",
    ),
    "slow-transfer": ProblemType(
        408, "The transfer took too long", "timeout",
        "The file did not arrive within the time the service gives an upload. A result not fetched in that time is "
        "cut off, too; the log and the metrics count it here.",
        "Try a faster connection or a smaller file, or raise POINTFILTER_TRANSFER_SECONDS.",
    ),
    "limit-exceeded": ProblemType(
        413, "The file is too large", "too_large",
        "The file has more bytes, more points or a longer header than the service takes. `limit` and `actual` hold the "
        "numbers.",
        "Split or thin the cloud, or raise the knob that the hint names.",
    ),
    "unsupported-format": ProblemType(
        415, "Not a format this service reads", "invalid",
        "The file is not PLY: its first line is not `ply`.",
        "Convert the scan to PLY first.",
    ),
    "unsupported-coding": ProblemType(
        415, "Compressed bodies are not taken", "invalid",
        "The request has a Content-Encoding, and a compressed body can hide one that is any size.",
        "Send the file as it is.",
    ),
    "missing-coordinates": ProblemType(
        422, "The points have no coordinates", "invalid",
        "The file has no vertex element, or its vertices have no usable x, y and z.",
        "Export the cloud with float or double properties x, y and z.",
    ),
    "too-few-points": ProblemType(
        422, "Too few points", "invalid",
        "Not enough points have finite coordinates to say anything about a surface.",
        "Check the export: rows of NaN or Inf do not count.",
    ),
    "degenerate-cloud": ProblemType(
        422, "The cloud has no extent", "invalid",
        "The radius is a share of the cloud's size, and this cloud has no usable size.",
        "Pass `radius` as a length in the unit of the file, or remove stray points.",
    ),
    "parameter-out-of-range": ProblemType(
        422, "A parameter is out of range", "invalid",
        "A query parameter has a value that the service does not take.",
        "The detail names the parameter and the values it takes.",
    ),
    "queue-full": ProblemType(
        429, "The queue is full", "rejected",
        "As many requests are being worked on or waiting as the service takes.",
        "Try again after the seconds in Retry-After; the number comes from the measured rate.",
    ),
    "client-closed": ProblemType(
        499, "The client went away", "cancelled",
        "The connection closed before the answer; the work was stopped. Seen in logs and metrics, never by the client.",
        "Nothing to do; if it was you, check the timeout of your client or proxy.",
    ),
    "cancelled": ProblemType(
        499, "The work was stopped", "cancelled",
        "Somebody asked for the work to stop.",
        "Send the request again if it should be done after all.",
    ),
    "internal-error": ProblemType(
        500, "Something went wrong here", "error",
        "The service met something it did not expect. The log has it under the request id.",
        "Report it with the request id; trying again may help.", private=True,
    ),
    "error": ProblemType(
        500, "The filter failed", "error",
        "The filter failed in a way that has no name of its own. The log has it under the request id.",
        "Report it with the request id.", private=True,
    ),
    "model-error": ProblemType(
        500, "The model failed", "error",
        "The model could not be used. The log has the reason under the request id.",
        "Try another model, and tell whoever runs the service.", private=True,
    ),
    "invalid-model": ProblemType(
        500, "The model is damaged", "error",
        "The model's files do not fit together, or not this version. The log has the reason under the request id.",
        "Try another model, and tell whoever runs the service.", private=True,
    ),
    "not-ready": ProblemType(
        503, "Not ready yet", "rejected",
        "The default model has not answered its first inference yet, or it failed to load.",
        "Try again after the seconds in Retry-After.",
    ),
    "draining": ProblemType(
        503, "Shutting down", "rejected",
        "The process is finishing its last requests and takes no new ones.",
        "Try again after the seconds in Retry-After; another process should answer.",
    ),
    "provider-unavailable": ProblemType(
        503, "The device is not available", "error",
        "The device that the service was told to use is not there. The log has the reason under the request id.",
        "Tell whoever runs the service; POINTFILTER_DEVICE=auto takes what there is.", private=True,
    ),
    "storage-full": ProblemType(
        503, "No room for temporary files", "error",
        "The disk that holds uploads and results while they are worked on is full.",
        "Try again after the seconds in Retry-After, or give POINTFILTER_TEMP_DIR more room.",
    ),
    "deadline-exceeded": ProblemType(
        504, "The work took too long", "timeout",
        "The result was not there within the time the service gives a request, and the work was stopped.",
        "Send a smaller cloud, fewer iterations or a smaller radius, or raise POINTFILTER_TIMEOUT_SECONDS.",
    ),
}  # fmt: skip


class Problem(BaseModel):
    """An RFC 9457 problem."""

    type: str = Field(
        description="Address of a page that explains this kind of problem", examples=["/problems/malformed-file"]
    )
    title: str = Field(description="The kind of problem in a few words")
    status: int
    detail: str = Field(description="What is wrong with this very request")
    instance: str = Field(description="The request's path and, after #, its id")
    code: str = Field(description="The kind of problem as a stable word", json_schema_extra={"enum": list(TYPES)})
    limit: int | float | str | None = Field(None, description="The limit that was broken, where there is one")
    actual: int | float | str | None = Field(None, description="The value that broke it")
    hint: str | None = Field(None, description="What to do about it")
    request_id: str = Field(description="The same as in X-Request-ID; the log has it too")


def problem_response(
    request: Request, code: str, error: PointfilterError | None = None, headers: dict[str, str] | None = None
) -> JSONResponse:
    """The answer for a code of TYPES; also notes the code for the log and the metrics."""
    kind = TYPES[code]
    exchange = exchange_of(request.scope)
    exchange.code = code
    told = None if kind.private else error
    root = request.scope.get("root_path", "")
    problem = Problem(
        type=f"{root}/problems/{code}",
        title=kind.title,
        status=kind.status,
        detail=told.message if told else kind.meaning,
        instance=f"{quote(request.scope['path'][:200])}#{exchange.request_id}",
        code=code,
        limit=_shown(told.limit) if told else None,
        actual=_shown(told.actual) if told else None,
        hint=(told.hint if told else None) or kind.remedy,
        request_id=exchange.request_id,
    )
    headers = dict(headers or {})
    if (retry_after := getattr(error, "retry_after", None)) is not None:
        headers["Retry-After"] = str(retry_after)
    return JSONResponse(problem.model_dump(), kind.status, headers, MEDIA_TYPE)


def _shown(value: float | str | None) -> float | str | None:
    """JSON has no NaN and no infinity."""
    if isinstance(value, float) and not abs(value) < float("inf"):
        return str(value)
    return value[:200] if isinstance(value, str) else value


def answers(*codes: str) -> dict[int | str, dict[str, Any]]:
    """For a route's `responses=`: the statuses of these codes, each with the problem schema."""
    found: dict[int | str, dict[str, Any]] = {}
    for code in codes:
        kind = TYPES[code]
        entry = found.setdefault(
            kind.status,
            {"description": "", "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}},
        )
        entry["description"] += f"{' | ' if entry['description'] else ''}{kind.title} ({code})"
        if kind.status in (429, 503):
            entry["headers"] = {"Retry-After": {"description": "Seconds", "schema": {"type": "integer"}}}
    return found
