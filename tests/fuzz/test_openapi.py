"""Requests made up from the OpenAPI document: every answer is a documented one. CONTRIBUTING.md has a longer run."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.conftest import running_service

EXAMPLES = os.environ.get("POINTFILTER_FUZZ_EXAMPLES", "10")
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_headers_conformance",
    "response_schema_conformance",
)  # fmt: skip


@pytest.mark.timeout(3600)
def test_every_answer_is_documented(tmp_path: Path) -> None:
    if not importlib.util.find_spec("schemathesis"):
        pytest.skip("schemathesis is not installed")
    limits = {"POINTFILTER_QUEUE_SIZE": "1000", "POINTFILTER_DRAIN_SECONDS": "0"}
    with running_service(tmp_path, **limits) as (server, _):
        command = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}/openapi.json", "--no-color"]
        options = ["--max-examples", EXAMPLES, "--checks", ",".join(CHECKS), "--request-timeout", "30", "--seed", "1"]
        done = subprocess.run([*command, *options], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
        assert server.get("/health/live").status == 200
