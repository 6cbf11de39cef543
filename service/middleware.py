"""Around every request: its id, the headers of its answer, its line in the log, and an answer whatever happens."""

from __future__ import annotations

import asyncio
import logging
import time

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import DrainingError
from service.exchange import Exchange, begin_exchange, current_request_id
from service.house import RETRY_SECONDS, House
from service.problems import problem_response

log = logging.getLogger("service.requests")

LINGER_SECONDS = 10.0
FILTER_ROUTES = ("/filter", "/jobs")
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})  # labels are few
ACCEPTED = 202
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",  # pages bring their own
    "Cache-Control": "no-store",
}


class _Body:
    """Knows whether the client still has something to send."""

    def __init__(self, scope: Scope, receive: Receive) -> None:
        headers = Headers(scope=scope)
        declared = "transfer-encoding" in headers or headers.get("content-length", "0") != "0"
        self.pending = declared and "expect" not in headers  # one that asks first has sent nothing
        self._receive = receive

    async def receive(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.disconnect" or not message.get("more_body", False):
            self.pending = False
        return message

    async def discard(self) -> None:
        """Reads what is left, for a while."""
        try:
            async with asyncio.timeout(LINGER_SECONDS):
                while self.pending:
                    await self.receive()
        except TimeoutError:
            self.pending = False


class ExchangeMiddleware:
    """Outermost of ours; plain ASGI, so that uploads, downloads and disconnects pass through untouched."""

    def __init__(self, app: ASGIApp, house: House) -> None:
        self._app = app
        self._house = house

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        exchange = begin_exchange(scope)
        token = current_request_id.set(exchange.request_id)
        body = _Body(scope, receive)
        head = scope["method"] == "HEAD"
        if head:
            scope = {**scope, "method": "GET"}  # every page that can be fetched can be asked about

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                exchange.status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = exchange.request_id
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            elif head:
                message = {**message, "body": b""}
            if message["type"] == "http.response.body" and not message.get("more_body") and body.pending:
                # A client that sends before it listens would find its connection reset and never see the answer.
                await send({**message, "more_body": True})
                await body.discard()
                message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        try:
            await self._app(scope, body.receive, answer)
        except Exception:
            log.exception("unexpected error")
            exchange.code = "internal-error"
            if exchange.status is not None:
                raise
            await problem_response(Request(scope), "internal-error")(scope, body.receive, answer)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if not self._house.draining or exchange.status is not None or task is None:
                exchange.code = exchange.code or "cancelled"
                raise
            task.uncancel()  # the server cancels what outlasts the drain; there is just time to say so
            error = DrainingError(
                "this process had to end before the answer was there; the work was stopped",
                hint="send the request again",
                retry_after=RETRY_SECONDS,
            )
            await problem_response(Request(scope), error.code, error)(scope, body.receive, answer)
        finally:
            self._note(exchange, scope, "HEAD" if head else scope["method"])
            current_request_id.reset(token)

    def _note(self, exchange: Exchange, scope: Scope, method: str) -> None:
        seconds = time.perf_counter() - exchange.started
        route = getattr(scope.get("route"), "path", None)  # the pattern; the path itself is the client's text
        if (
            route in FILTER_ROUTES and method == "POST" and exchange.status != ACCEPTED
        ):  # jobs are counted when they end
            self._house.telemetry.filter_ended(exchange, seconds)
        if method in METHODS and exchange.status is not None:
            self._house.telemetry.http_ended(method, route or "none", exchange.status, seconds)
        quiet = route is not None and (route.startswith("/health") or route == "/metrics") and exchange.code is None
        log.log(
            logging.DEBUG if quiet else logging.INFO,
            "request",
            extra={
                "method": method,
                "route": route or "none",
                "status": exchange.status,
                "code": exchange.code,
                "seconds": round(seconds, 4),
                "model": exchange.model,
                "points": exchange.points,
                "key": exchange.key,
            },
        )
