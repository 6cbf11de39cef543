"""A request's body onto the disk, counted on its way; never whole in memory."""

from __future__ import annotations

import asyncio
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from starlette.requests import ClientDisconnect, Request

from pointfilter.errors import LimitExceededError
from service.errors import ClientGoneError, MalformedRequestError, SlowTransferError, UnsupportedCodingError
from service.multipart import MAX_OVERHEAD_BYTES, FilePart
from service.settings import Settings, variable

_FILE = {"type": "string", "format": "binary"}
FILE_BODY = {
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
"""For the OpenAPI document: what receive_upload takes."""
WRITE_BYTES = 1 << 20  # collected before a thread is asked to write


@dataclass(frozen=True)
class Upload:
    """A file that arrived. file_name: what the client calls it, as sent; only a form says so."""

    path: Path
    size: int
    file_name: str | None


async def receive_upload(request: Request, path: Path, settings: Settings) -> Upload:
    """Writes the raw body, or the part `file` of a multipart form, to a new private file at `path`.

    Raises LimitExceededError (before reading where the client declares the size), UnsupportedCodingError,
    MalformedRequestError, SlowTransferError, ClientGoneError, OSError.
    """
    if request.headers.get("content-encoding", "identity").strip().lower() not in ("identity", ""):
        raise UnsupportedCodingError("the request has a Content-Encoding")
    content_type = request.headers.get("content-type", "")
    multipart = content_type.split(";", 1)[0].strip().lower() == "multipart/form-data"
    part = FilePart(content_type) if multipart else None
    overhead = MAX_OVERHEAD_BYTES if part else 0
    declared = request.headers.get("content-length", "")
    if declared.isascii() and declared.isdigit() and int(declared[:20]) > settings.max_upload_bytes + overhead:
        raise too_large(settings, int(declared[:20]))
    try:
        async with asyncio.timeout(settings.transfer_seconds):
            with _private(path) as file:
                size = await _copy(request, file, part, settings, overhead)
    except TimeoutError:
        raise SlowTransferError(
            f"the file did not arrive within {settings.transfer_seconds:g} s",
            limit=settings.transfer_seconds,
            hint=f"whoever runs the service can raise {variable('transfer_seconds')}",
        ) from None
    except ClientDisconnect:
        raise ClientGoneError("the client went away during the upload") from None
    if part:
        part.finish()
    if not size:
        raise MalformedRequestError("the file is empty" if part else "the body is empty")
    return Upload(path, size, part.file_name if part else None)


def adopt(upload: Upload, path: Path) -> None:
    """Moves an upload to another place, which may be on another disk."""
    shutil.move(upload.path, path)


async def _copy(request: Request, file: BinaryIO, part: FilePart | None, settings: Settings, overhead: int) -> int:
    """Returns the size of the file."""
    arrived = size = 0
    collected = bytearray()
    async for chunk in request.stream():
        arrived += len(chunk)
        data = part.feed(chunk) if part else chunk
        size += len(data)
        if size > settings.max_upload_bytes or arrived > settings.max_upload_bytes + overhead:
            raise too_large(settings, None)
        collected += data
        if len(collected) >= WRITE_BYTES:
            await asyncio.to_thread(file.write, collected)
            collected = bytearray()
    if collected:
        await asyncio.to_thread(file.write, collected)
    return size


def too_large(settings: Settings, actual: int | None) -> LimitExceededError:
    return LimitExceededError(
        f"the file is larger than the limit of {settings.max_upload_bytes} bytes",
        limit=settings.max_upload_bytes,
        actual=actual,
        hint=f"split or thin the cloud; whoever runs the service can raise {variable('max_upload_bytes')}",
    )


def _private(path: Path) -> BinaryIO:
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
