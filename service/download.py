"""The way out: what the file is called, and the file itself, streamed from disk against the clock."""

from __future__ import annotations

import asyncio
import string
import unicodedata
from pathlib import Path
from urllib.parse import quote

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.exchange import exchange_of
from service.records import Outcome

CHUNK_BYTES = 1 << 18
MAX_STEM = 100
NO_NAME = "cloud"
_ATTR_CHAR = "!#$&+-.^_`|~"  # RFC 8187, beside letters and digits
_PLAIN = string.punctuation.replace("%", "") + " "  # in X-Warnings as it is; everything else is percent-encoded


def content_disposition(file_name: str | None) -> str:
    """The header's value for the filtered version of a file (RFC 6266), whatever the client called it."""
    name = f"{_stem(file_name or '')}_filtered.ply"
    plain = "".join(letter if letter.isascii() and (letter.isalnum() or letter in " ._-") else "_" for letter in name)
    value = f'attachment; filename="{plain}"'
    return value if plain == name else f"{value}; filename*=UTF-8''{quote(name, safe=_ATTR_CHAR)}"


def _stem(file_name: str) -> str:
    """Without folders, suffix, control characters (those that turn the writing direction too) and oddities."""
    name = file_name.replace("\\", "/").rsplit("/", 1)[-1]
    name = "".join(letter for letter in name if unicodedata.category(letter)[0] != "C" and letter != "\ufffd")
    if name.lower().endswith(".ply"):
        name = name[:-4]
    return name.strip(" .")[:MAX_STEM].rstrip(" .") or NO_NAME


def result_headers(outcome: Outcome, seconds: dict[str, float]) -> dict[str, str]:
    """Of a filtered file. seconds: by stage, before those of the outcome."""
    stages = {**seconds, **outcome.seconds}
    known = {
        "X-Moved": outcome.moved,
        "X-Radius": None if outcome.radius is None else f"{outcome.radius:.9g}",
        "X-Expected-Error": None if outcome.expected_error is None else f"{outcome.expected_error:.4g}",
        "X-Warnings": quote("; ".join(outcome.warnings), safe=_PLAIN) or None,
    }
    return {
        "Server-Timing": ", ".join(f"{stage};dur={1000 * each:.1f}" for stage, each in stages.items()),
        "X-Model": outcome.model,
        "X-Points": str(outcome.points),
        "X-Iterations": str(outcome.iterations),
        **{name: str(value) for name, value in known.items() if value is not None},
        "ETag": f'"{outcome.sha256}"',
    }


class FileDownload(Response):
    """A file from disk, a chunk at a time.

    A client that takes longer than `seconds` to fetch it loses the connection: it holds a place and the disk.
    """

    media_type = "application/octet-stream"

    def __init__(self, path: Path, size: int, seconds: float, headers: dict[str, str]) -> None:
        super().__init__(status_code=200, headers={**headers, "Content-Length": str(size)})
        self._path = path
        self._seconds = seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG002 - ASGI's signature
        try:
            async with asyncio.timeout(self._seconds):
                await self._stream(send)
        except TimeoutError:
            exchange_of(scope).code = "slow-transfer"  # an answer without its end: the server cuts the connection

    async def _stream(self, send: Send) -> None:
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        with self._path.open("rb") as file:
            more = True
            while more:
                chunk = await asyncio.to_thread(file.read, CHUNK_BYTES)
                more = bool(chunk)
                await send({"type": "http.response.body", "body": chunk, "more_body": more})
