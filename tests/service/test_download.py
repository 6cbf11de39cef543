"""The name of the answer, whatever the upload was called."""

from __future__ import annotations

from urllib.parse import unquote

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from service.download import MAX_STEM, content_disposition, result_headers
from service.records import Outcome


@pytest.mark.parametrize(
    ("given_name", "header"),
    [
        ("scan.ply", 'attachment; filename="scan_filtered.ply"'),
        ("Scan.PLY", 'attachment; filename="Scan_filtered.ply"'),
        ("a b-1.2.ply", 'attachment; filename="a b-1.2_filtered.ply"'),
        ("../../etc/passwd", 'attachment; filename="passwd_filtered.ply"'),
        (r"C:\scans\hall.ply", 'attachment; filename="hall_filtered.ply"'),
        (None, 'attachment; filename="cloud_filtered.ply"'),
        ("", 'attachment; filename="cloud_filtered.ply"'),
        (".ply", 'attachment; filename="cloud_filtered.ply"'),
        ("...", 'attachment; filename="cloud_filtered.ply"'),
        ("Größe.ply", "attachment; filename=\"Gr__e_filtered.ply\"; filename*=UTF-8''Gr%C3%B6%C3%9Fe_filtered.ply"),
        (
            'a"; x="b.ply',
            "attachment; filename=\"a__ x__b_filtered.ply\"; filename*=UTF-8''a%22%3B%20x%3D%22b_filtered.ply",
        ),
        ("a\r\nSet-Cookie: b.ply", None),
        ("ylp.\u202etxt.ply", None),
    ],
)
def test_names(given_name: str | None, header: str | None) -> None:
    made = content_disposition(given_name)
    if header is not None:
        assert made == header
    assert "\r" not in made
    assert "\n" not in made
    assert "\u202e" not in unquote(made)


@given(st.text(max_size=300))
def test_any_name_gives_a_harmless_header(name: str) -> None:
    header = content_disposition(name)
    assert header.isascii()
    assert header.isprintable()
    plain = header.removeprefix('attachment; filename="').split('"')[0]
    assert plain.endswith("_filtered.ply")
    assert not set(plain) & set('/\\";%')
    assert header.count('"') == 2
    assert len(plain) <= MAX_STEM + len("_filtered.ply")


def test_a_name_in_a_form_arrives_in_the_answer(client: TestClient, ply: bytes) -> None:
    answer = client.post("/filter", files={"file": ("Größe.ply", ply)})
    assert answer.headers["content-disposition"].endswith("filename*=UTF-8''Gr%C3%B6%C3%9Fe_filtered.ply")


OUTCOME = Outcome(sha256="ab", size=1, points=5, iterations=2, model="tiny", seconds={})


def test_headers_of_what_is_not_known_are_absent() -> None:
    assert result_headers(OUTCOME, {}).keys() == {"Server-Timing", "X-Model", "X-Points", "X-Iterations", "ETag"}
    known = OUTCOME.model_copy(update={"moved": 0, "radius": 0.0, "expected_error": 0.0})
    headers = result_headers(known, {})
    assert (headers["X-Moved"], headers["X-Radius"], headers["X-Expected-Error"]) == ("0", "0", "0")
    assert "X-Warnings" not in headers


@given(st.lists(st.text(min_size=1, max_size=50), min_size=1, max_size=3))
def test_any_warnings_give_a_harmless_header(warnings: list[str]) -> None:
    headers = result_headers(OUTCOME.model_copy(update={"warnings": tuple(warnings)}), {})
    assert headers["X-Warnings"].isascii()
    assert headers["X-Warnings"].isprintable()
    assert unquote(headers["X-Warnings"]) == "; ".join(warnings)


def test_plain_warnings_stay_readable() -> None:
    told = "3 rows share places, as where a scanner writes 0 0 0; they were left as they were"
    assert result_headers(OUTCOME.model_copy(update={"warnings": (told,)}), {})["X-Warnings"] == told
