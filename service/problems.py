"""Problems as answers: RFC 9457 problem details, made from the table in problem_types.py.

Their `type` is /problems/{code}, a page that this service itself serves from the same table.
"""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from pydantic import BaseModel, Field
from starlette.requests import Request
from starlette.responses import JSONResponse

from pointfilter.errors import PointfilterError
from service.exchange import exchange_of
from service.problem_types import TYPES

MEDIA_TYPE = "application/problem+json"


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
    exchange = exchange_of(request.scope)
    exchange.code = code
    root = request.scope.get("root_path", "")
    problem = problem_of(code, error, request.scope["path"], exchange.request_id, root)
    headers = dict(headers or {})
    if (retry_after := getattr(error, "retry_after", None)) is not None:
        headers["Retry-After"] = str(retry_after)
    if problem.status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    return JSONResponse(problem.model_dump(), problem.status, headers, MEDIA_TYPE)


def problem_of(code: str, error: PointfilterError | None, path: str, request_id: str, root: str = "") -> Problem:
    """What is said about an error. path: of the request that it is about. root: where the service is mounted."""
    kind = TYPES[code]
    told = None if kind.private else error
    return Problem(
        type=f"{root}/problems/{code}",
        title=kind.title,
        status=kind.status,
        detail=told.message if told else kind.meaning,
        instance=f"{quote(path[:200])}#{request_id}",
        code=code,
        limit=_shown(told.limit) if told else None,
        actual=_shown(told.actual) if told else None,
        hint=(told.hint if told else None) or kind.remedy,
        request_id=request_id,
    )


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
