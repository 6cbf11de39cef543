"""The one file of a multipart form, as it arrives: bytes of the form in, bytes of the file out, nothing kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.errors import MalformedRequestError

if TYPE_CHECKING:  # it exists for type checkers only
    from python_multipart.multipart import MultipartCallbacks

MAX_HEADER_BYTES = 8192  # of a part
MAX_OVERHEAD_BYTES = 32_768  # boundaries and headers of the one part we take, with room to spare
FIELD = "file"


class FilePart:
    """Feed it the body's chunks; it returns the bytes of the part `file` that were in each."""

    def __init__(self, content_type: str) -> None:
        """content_type: the request's. Raises MalformedRequestError."""
        boundary = parse_options_header(content_type)[1].get(b"boundary")
        if not boundary:
            raise MalformedRequestError("the multipart form has no boundary in its Content-Type")
        callbacks: MultipartCallbacks = {
            "on_part_begin": self._begin_part,
            "on_header_begin": self._begin_header,
            "on_header_field": self._header_name,
            "on_header_value": self._header_value,
            "on_header_end": self._end_header,
            "on_headers_finished": self._end_headers,
            "on_part_data": self._data,
            "on_end": self._end,
        }
        try:
            self._parser = MultipartParser(boundary, callbacks)
        except FormParserError as error:
            raise MalformedRequestError("the multipart form has an unusable boundary") from error
        self.file_name: str | None = None
        self._found = False
        self._complete = False
        self._header_bytes = 0
        self._name = self._value = b""
        self._disposition = b""
        self._fresh: list[bytes] = []

    def feed(self, chunk: bytes) -> bytes:
        """Raises MalformedRequestError."""
        try:
            self._parser.write(chunk)
        except FormParserError as error:
            raise MalformedRequestError("the multipart form is broken") from error
        fresh = b"".join(self._fresh)
        self._fresh.clear()
        return fresh

    def finish(self) -> None:
        """To be called after the last chunk. Raises MalformedRequestError."""
        if not self._complete:
            raise MalformedRequestError("the multipart form ends before its closing boundary")
        if not self._found:
            raise MalformedRequestError(f"the multipart form has no part called {FIELD!r}")

    def _begin_part(self) -> None:
        self._disposition = b""
        self._header_bytes = 0

    def _begin_header(self) -> None:
        self._name = self._value = b""

    def _header_name(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]
        self._count(end - start)

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]
        self._count(end - start)

    def _count(self, size: int) -> None:
        self._header_bytes += size
        if self._header_bytes > MAX_HEADER_BYTES:
            raise MalformedRequestError(
                f"a part of the multipart form has more than {MAX_HEADER_BYTES} bytes of headers",
                limit=MAX_HEADER_BYTES,
            )

    def _end_header(self) -> None:
        if self._name.strip().lower() == b"content-disposition":
            self._disposition = self._value

    def _end_headers(self) -> None:
        options = parse_options_header(self._disposition)[1]
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if name != FIELD:
            raise MalformedRequestError(
                f"the multipart form has a part {name[:60]!a}, and only {FIELD!r} is taken",
                hint="parameters such as radius go into the query string",
            )
        if self._found:
            raise MalformedRequestError(
                f"the multipart form has a second part {FIELD!r}", hint="send one file a request"
            )
        self._found = True
        if b"filename" in options:
            self.file_name = options[b"filename"].decode("utf-8", "replace")

    def _data(self, data: bytes, start: int, end: int) -> None:
        self._fresh.append(data[start:end])

    def _end(self) -> None:
        self._complete = True
