"""Forms, however they are cut into chunks."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import MalformedRequestError
from service.multipart import MAX_HEADER_BYTES, FilePart

TYPE = "multipart/form-data; boundary=edge"


def form(*parts: tuple[str, bytes], end: bytes = b"--edge--\r\n") -> bytes:
    body = b"".join(b"--edge\r\n" + head.encode() + b"\r\n\r\n" + content + b"\r\n" for head, content in parts)
    return body + end


FILE = 'Content-Disposition: form-data; name="file"; filename="scan.ply"\r\nContent-Type: application/octet-stream'


def fed(body: bytes, cuts: list[int] | None = None, content_type: str = TYPE) -> tuple[bytes, FilePart]:
    part = FilePart(content_type)
    edges = [0, *sorted(cuts or []), len(body)]
    content = b"".join(part.feed(body[start:stop]) for start, stop in itertools.pairwise(edges))
    part.finish()
    return content, part


@given(
    content=st.binary(max_size=300) | st.sampled_from([b"--edge", b"\r\n--edg", b"\r\n--edge", b"\r\n\r\n", b"-"] * 2),
    data=st.data(),
)
def test_any_content_survives_any_cutting(content: bytes, data: st.DataObject) -> None:
    if b"\r\n--edge" in b"\r\n" + content:
        return  # the boundary itself cannot be content
    body = form((FILE, content))
    cuts = data.draw(st.lists(st.integers(0, len(body)), max_size=20))
    found, part = fed(body, cuts)
    assert found == content
    assert part.file_name == "scan.ply"


@given(body=st.binary(max_size=400))
def test_rubbish_is_refused_and_nothing_else(body: bytes) -> None:
    with pytest.raises(MalformedRequestError):
        fed(b"--edge\r\n" + body)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (b"", "closing boundary"),
        (form(), "no part called"),
        (form((FILE, b"abc"), end=b""), "closing boundary"),
        (form((FILE, b"abc"), (FILE, b"abc")), "second part"),
        (form(('Content-Disposition: form-data; name="radius"', b"5%")), "'radius'"),
        (form(("Content-Type: text/plain", b"abc")), "''"),
        (form((FILE + "\r\nX-Padding: " + "x" * MAX_HEADER_BYTES, b"abc")), "broken|bytes of headers"),
        (form((FILE + "".join(f"\r\nX-{i}: {'x' * 900}" for i in range(10)), b"abc")), "broken|bytes of headers"),
    ],
)
def test_forms_that_are_not_one_file(body: bytes, told: str) -> None:
    with pytest.raises(MalformedRequestError, match=told):
        fed(body)


@pytest.mark.parametrize("content_type", ["multipart/form-data", "multipart/form-data; boundary=" + "x" * 500])
def test_unusable_boundaries(content_type: str) -> None:
    with pytest.raises(MalformedRequestError, match="boundary"):
        fed(form((FILE, b"abc")), content_type=content_type)


def test_a_part_without_a_file_name_is_taken() -> None:
    content, part = fed(form(('Content-Disposition: form-data; name="file"', b"abc")))
    assert (content, part.file_name) == (b"abc", None)
