"""What people and programs can look up."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest
from starlette.testclient import TestClient

import pointfilter
from pointfilter.models import DEFAULT_MODEL


def test_the_page_needs_nothing_from_elsewhere(client: TestClient) -> None:
    page = client.get("/")
    assert page.status_code == 200
    assert "http://" not in page.text
    assert "https://" not in page.text
    assert not re.search(r"<script\s[^>]*src|<link[^>]*stylesheet|\son\w+=|\sstyle=", page.text)


@pytest.mark.parametrize("path", ["/", "/problems/queue-full"])
def test_the_policy_allows_exactly_what_the_page_holds(client: TestClient, path: str) -> None:
    page = client.get(path)
    policy = dict(part.strip().split(" ", 1) for part in page.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert "unsafe" not in page.headers["content-security-policy"]
    for tag, directive in (("script", "script-src"), ("style", "style-src")):
        digests = [
            base64.b64encode(hashlib.sha256(part.encode()).digest()).decode()
            for part in re.findall(f"<{tag}>(.*?)</{tag}>", page.text, re.DOTALL)
        ]
        assert policy[directive] == (" ".join(f"'sha256-{digest}'" for digest in digests) or "'none'")


def test_the_page_can_be_used_without_a_mouse_or_eyes(client: TestClient) -> None:
    page = client.get("/").text
    assert '<html lang="en">' in page
    assert 'role="status"' in page
    assert 'role="alert"' in page
    fields = re.findall(r"<(?:input|select)\s[^>]*>", page)
    labels = re.findall(r"<label.*?</label>", page, re.DOTALL)
    assert len(fields) == 6
    assert all(any(field in label for label in labels) for field in fields)


def test_swagger_page(client: TestClient) -> None:
    page = client.get("/docs")
    assert page.status_code == 200
    assert "/openapi.json" in page.text
    assert "sha256-" in page.headers["content-security-policy"]


@pytest.mark.parametrize(
    "path", ["/", "/version", "/docs", "/problems/draining", "/nothing", "/metrics", "/openapi.json"]
)
def test_every_answer_carries_the_security_headers(client: TestClient, path: str) -> None:
    headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["referrer-policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-request-id"]


def test_models_default_first_and_damaged_ones_left_out(client: TestClient) -> None:
    models = client.get("/models").json()
    assert [(model["name"], model["default"]) for model in models[:2]] == [("tiny", True), ("other", False)]
    assert "broken" not in [model["name"] for model in models]
    assert client.get("/models/other").json() == models[1]
    assert re.fullmatch(r"[0-9a-f]{64}", models[0]["sha256"])
    assert [model["provider"] for model in models[:2]] == ["CPUExecutionProvider", None]
    assert models[0]["precision"] == "float32"
    assert models[0]["calibration"] is None  # the paper's mode
    adaptive = client.get(f"/models/{DEFAULT_MODEL}").json()
    assert adaptive["calibration"]["passes"] >= 1
    assert adaptive["calibration"]["balls"] == sorted(adaptive["calibration"]["balls"])
    assert not {"radius", "iterations"} & adaptive.keys()


def test_version(client: TestClient) -> None:
    found = client.get("/version").json()
    assert found["pointfilter"] == pointfilter.__version__
    assert found.keys() == {"pointfilter", "onnxruntime", "python"}


def test_openapi_describes_both_ways_to_send_a_file(client: TestClient) -> None:
    operation = client.get("/openapi.json").json()["paths"]["/filter"]["post"]
    assert set(operation["requestBody"]["content"]) == {"multipart/form-data", "application/octet-stream"}
    assert {parameter["name"] for parameter in operation["parameters"]} == {
        "model", "iterations", "radius", "seed", "format", "strength", "max_move", "paper",
        "normals", "columns",
    }  # fmt: skip
    assert set(operation["responses"]["200"]["headers"]) == {
        "Content-Disposition", "Server-Timing", "X-Request-ID", "X-Model", "X-Points", "X-Iterations", "X-Moved",
        "X-Radius", "X-Expected-Error", "X-Warnings", "ETag",
    }  # fmt: skip
