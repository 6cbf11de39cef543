"""Exceptions to answers: each becomes a problem of service.problems.TYPES."""

from __future__ import annotations

import errno
import logging

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from pointfilter.errors import ParameterError, PointfilterError
from service.errors import StorageFullError
from service.problem_types import TYPES
from service.problems import problem_response

log = logging.getLogger("service.problems")

_ROUTING = {404: "not-found", 405: "method-not-allowed"}
_BOUNDS = ("ge", "gt", "le", "lt", "max_length")  # what pydantic calls the limits of a parameter
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def install_handlers(app: FastAPI) -> None:
    app.add_exception_handler(PointfilterError, _pointfilter)
    app.add_exception_handler(RequestValidationError, _validation)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(OSError, _os)


def explained(error: Exception) -> tuple[str, PointfilterError | None]:
    """The code of an error, and what may be said about it; logs what may not."""
    if isinstance(error, PointfilterError):
        code = error.code if error.code in TYPES else "error"
        if TYPES[code].private:
            log.error("%s: %s", type(error).__name__, error, exc_info=error)
        return code, error
    if isinstance(error, OSError) and error.errno in _FULL:
        log.error("no room for files: %s", error.strerror)
        full = StorageFullError("there is no room left for the upload or the result", retry_after=30)
        return full.code, full
    log.error("unexpected error", exc_info=error)
    return "internal-error", None


async def _pointfilter(request: Request, error: Exception) -> Response:
    code, told = explained(error)
    return problem_response(request, code, told)


async def _validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101
    first = error.errors()[0]
    name = str(first["loc"][-1])
    actual = _short(first.get("input"))
    got = "" if actual is None else f", got {actual}"
    limit = next((bound for key, bound in first.get("ctx", {}).items() if key in _BOUNDS), None)
    told = ParameterError(f"{name}: {first['msg']}{got}", limit=limit, actual=actual)
    return problem_response(request, "parameter-out-of-range", told)


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101
    code = _ROUTING.get(error.status_code)
    if code is None:
        raise error  # nothing of ours raises any other: an error like all unexpected ones
    return problem_response(request, code, headers=dict(error.headers or {}))


async def _os(request: Request, error: Exception) -> Response:
    if not (isinstance(error, OSError) and error.errno in _FULL):
        raise error
    code, told = explained(error)
    return problem_response(request, code, told)


def _short(value: object) -> str | float | None:
    if value is None or isinstance(value, (int, float)):
        return value
    return str(value)[:60]
