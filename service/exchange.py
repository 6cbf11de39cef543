"""What is known about one request while it lasts: for the log, the metrics and the headers of every answer."""

from __future__ import annotations

import re
import time
import uuid
from contextvars import ContextVar
from dataclasses import dataclass, field

from starlette.datastructures import Headers
from starlette.types import Scope

_SANE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

current_request_id: ContextVar[str | None] = ContextVar("current_request_id", default=None)
"""For log records made while a request is served; worker threads inherit it."""


@dataclass
class Exchange:
    """One request and its answer."""

    request_id: str
    started: float = field(default_factory=time.perf_counter)
    model: str | None = None
    """A model that exists; never a name as the client sent it."""
    code: str | None = None
    """Of service.problems.TYPES, when the request failed."""
    points: int | None = None
    key: str | None = None
    """Name of the caller's API key."""
    status: int | None = None


def begin_exchange(scope: Scope) -> Exchange:
    """Attaches an Exchange to the request; takes over the caller's X-Request-ID where it is harmless."""
    given = Headers(scope=scope).get("x-request-id", "")
    exchange = Exchange(given if _SANE_ID.fullmatch(given) else uuid.uuid4().hex)
    scope.setdefault("state", {})["exchange"] = exchange
    return exchange


def exchange_of(scope: Scope) -> Exchange:
    exchange: Exchange = scope["state"]["exchange"]
    return exchange
