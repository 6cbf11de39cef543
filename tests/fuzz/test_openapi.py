"""Requests made up from the OpenAPI document: every answer is a documented one. CONTRIBUTING.md has a longer run."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from starlette.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from tests.service.apps import until
from tests.service.conftest import write_bundle

EXAMPLES = int(os.environ.get("POINTFILTER_FUZZ_EXAMPLES", "15"))
CHECKS = [
    not_a_server_error, status_code_conformance, content_type_conformance, response_headers_conformance,
    response_schema_conformance,
]  # fmt: skip


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[schemathesis.BaseSchema]:
    folder = tmp_path_factory.mktemp("api")
    write_bundle(folder / "bundles" / "tiny")
    app = create_app(
        Settings(model_dir=folder / "bundles", model="tiny", data_dir=folder / "data", threads=1, queue_size=1_000)
    )
    with TestClient(app) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        yield schemathesis.openapi.from_asgi("/openapi.json", app)


schema = schemathesis.pytest.from_fixture("api")


@pytest.mark.timeout(3600)
@schema.parametrize()
@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
def test_every_answer_is_documented(case: schemathesis.Case, workers_are_threads: None) -> None:
    case.call_and_validate(checks=CHECKS, timeout=30)
