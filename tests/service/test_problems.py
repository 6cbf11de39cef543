"""Problems: one table, and everything that shows it agrees with it."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

import service.work
from pointfilter.errors import PointfilterError
from service import errors as service_errors
from service.problem_types import TYPES
from tests.service.apps import metric
from tests.service.test_refusals import check


class RaisedError(PointfilterError):
    """With a code of the test's choice."""


ROOT = Path(__file__).parents[2]


def every_error(kind: type[PointfilterError] = PointfilterError) -> Iterator[type[PointfilterError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from every_error(child)


def test_every_error_has_a_row() -> None:
    assert issubclass(service_errors.QueueFullError, PointfilterError)
    missing = {
        kind.code for kind in every_error() if kind.code not in TYPES and kind is not service_errors.ServiceError
    }
    assert missing == set()


@pytest.mark.parametrize("code", TYPES)
def test_every_type_resolves_to_a_page_about_it(client: TestClient, code: str) -> None:
    page = client.get(f"/problems/{code}")
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    assert TYPES[code].title in page.text
    assert f"HTTP status {TYPES[code].status}" in page.text


def test_the_document_says_the_same_as_the_table() -> None:
    text = (ROOT / "docs" / "problems.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\S+)\n\n(.*?)(?=\n## |\Z)", text, re.DOTALL | re.MULTILINE))
    assert list(sections) == list(TYPES)
    for code, kind in TYPES.items():
        expected = f"{kind.status}: {kind.title}\n\n{kind.meaning}\n\nWhat to do: {kind.remedy}"
        assert sections[code].strip() == expected


def operations(client: TestClient) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method, operation in methods.items():
            yield method, path, operation


def test_every_documented_error_is_a_problem_and_every_route_documents_some(client: TestClient) -> None:
    seen = []
    for method, path, operation in operations(client):
        failing = {status: answer for status, answer in operation["responses"].items() if not status.startswith("2")}
        assert "500" in failing, (method, path)
        for status, answer in failing.items():
            schema = answer["content"]["application/problem+json"]["schema"]
            assert schema == {"$ref": "#/components/schemas/Problem"}
            codes = re.findall(r"\(([a-z-]+)\)", answer["description"])
            assert codes
            assert {TYPES[code].status for code in codes} == {int(status)}
            if status in ("429", "503"):
                assert "Retry-After" in answer["headers"]
        seen.append(path)
    assert set(seen) == {
        "/filter", "/look", "/jobs", "/jobs/{id}", "/jobs/{id}/events", "/jobs/{id}/result", "/health", "/health/live",
        "/health/ready", "/health/startup", "/models", "/models/{name}",
        "/version", "/metrics", "/", "/problems/{code}",
    }  # fmt: skip


@pytest.mark.parametrize("code", [code for code, kind in TYPES.items() if kind.status not in (404, 405, 409, 410)])
def test_every_problem_can_be_answered_as_documented(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, ply: bytes, code: str
) -> None:
    """Whatever the core raises: the status is documented for /filter, and the body fits the schema."""

    monkeypatch.setattr(RaisedError, "code", code)

    def fail(*_: object, **__: object) -> None:
        place = " in /srv/secret/place" if TYPES[code].private else ""
        raise RaisedError(f"what happened{place}", limit=float("nan"))

    monkeypatch.setattr(service.work, "filter_cloud", fail)
    problem = check(client.post("/filter", content=ply), TYPES[code].status, code)
    assert ("what happened" in str(problem["detail"])) is not TYPES[code].private
    assert "secret" not in str(problem)
    responses = next(operation for _, path, operation in operations(client) if path == "/filter")["responses"]
    assert f"({code})" in responses[str(TYPES[code].status)]["description"]
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome=TYPES[code].outcome) == 1


def test_the_unexpected_tells_nothing_and_is_logged(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, ply: bytes
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("secret in /srv/place")

    monkeypatch.setattr(service.work, "filter_cloud", fail)
    with caplog.at_level(logging.ERROR):
        answer = client.post("/filter", content=ply)
    check(answer, 500, "internal-error")
    assert "secret" not in answer.text
    assert "RuntimeError: secret" in caplog.text
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_full_disk_is_said_to_be_one(client: TestClient, monkeypatch: pytest.MonkeyPatch, ply: bytes) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "/srv/secret")

    monkeypatch.setattr(service.work, "filter_cloud", fail)
    answer = client.post("/filter", content=ply)
    check(answer, 503, "storage-full")
    assert answer.headers["retry-after"] == "30"
    assert "secret" not in answer.text


def test_a_host_that_is_none_is_no_reason_to_fail(client: TestClient) -> None:
    check(client.get("/nothing", headers={"Host": "[x"}), 404, "not-found")


def test_a_path_of_the_client_is_quoted(client: TestClient) -> None:
    answer = client.get("/%22%3E%3Cscript%3E%0d%0aX: y")
    check(answer, 404, "not-found")
    assert "<script>" not in answer.text
