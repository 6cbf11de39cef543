"""Metrics and logs."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from service.exchange import current_request_id
from service.logs import JsonFormatter, TextFormatter
from tests.service.apps import metric

NAMES = {
    "pointfilter_requests": "counter",
    "pointfilter_request_duration_seconds": "histogram",
    "pointfilter_stage_duration_seconds": "histogram",
    "pointfilter_queue_wait_seconds": "histogram",
    "pointfilter_queue_depth": "gauge",
    "pointfilter_in_progress": "gauge",
    "pointfilter_workers": "gauge",
    "pointfilter_points": "counter",
    "pointfilter_points_per_request": "histogram",
    "pointfilter_model_info": "gauge",
    "http_requests": "counter",
    "http_request_duration_seconds": "histogram",
    "pointfilter_jobs": "counter",
    "pointfilter_job_duration_seconds": "histogram",
    "pointfilter_jobs_waiting": "gauge",
    "pointfilter_jobs_running": "gauge",
    "pointfilter_worker_deaths": "counter",
    "pointfilter_worker_memory_bytes": "gauge",
    "process_resident_memory_bytes": "gauge",
    "python_info": "gauge",
}


def test_every_promised_metric_is_there(client: TestClient, ply: bytes) -> None:
    assert client.post("/filter", content=ply).status_code == 200
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = {family.name: family for family in text_string_to_metric_families(answer.text)}
    assert {name: families[name].type for name in NAMES} == NAMES
    stages = {sample.labels["stage"] for sample in families["pointfilter_stage_duration_seconds"].samples}
    assert stages == {"parse", "index", "balls", "patches", "infer", "write"}
    info = next(sample for sample in families["pointfilter_model_info"].samples)
    assert info.labels.keys() == {"model", "version", "sha256", "provider"}
    assert info.labels["provider"] == "CPUExecutionProvider"
    edges = [
        float(sample.labels["le"])
        for sample in families["pointfilter_request_duration_seconds"].samples
        if sample.name.endswith("_bucket")
    ]
    assert (min(edges), sorted(edges)[-2]) == (0.05, 600)


def test_points_and_outcomes_are_counted(client: TestClient, ply: bytes) -> None:
    client.post("/filter", content=ply)
    client.post("/filter?model=other", content=ply)
    client.post("/filter", content=b"no ply")
    client.post("/filter?model=nobody", content=ply)
    client.get("/filter")
    assert metric(client, "pointfilter_points_total", model="tiny") == 500
    assert metric(client, "pointfilter_points_total", model="other") == 500
    assert metric(client, "pointfilter_points_per_request_sum") == 1000
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="ok") == 1
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="invalid") == 1
    assert metric(client, "pointfilter_requests_total", model="unknown", outcome="invalid") == 1
    assert metric(client, "pointfilter_request_duration_seconds_count", model="tiny") == 1
    assert metric(client, "pointfilter_stage_duration_seconds_count", stage="infer") == 2


def test_names_that_clients_send_are_no_labels(client: TestClient, ply: bytes) -> None:
    client.post("/filter?model=invented-by-a-client", files={"file": ("private.ply", ply)})
    text = client.get("/metrics").text
    assert "invented" not in text
    assert "private" not in text


def test_two_apps_count_for_themselves(make_client: Callable[..., TestClient], ply: bytes) -> None:
    first, second = make_client(), make_client(workers=2)
    first.post("/filter", content=ply)
    assert metric(first, "pointfilter_requests_total", model="tiny", outcome="ok") == 1
    assert metric(second, "pointfilter_requests_total", model="tiny", outcome="ok") == 0
    assert metric(second, "pointfilter_workers") == 2


def test_models_come_and_go(make_client: Callable[..., TestClient], bundles: object, ply: bytes) -> None:
    client = make_client(max_models=2)
    client.post("/filter?model=other", content=ply)
    text = client.get("/metrics").text
    assert 'model="tiny"' in text
    assert 'pointfilter_model_info{model="other"' in text


def test_a_request_is_one_line_with_its_id_and_without_names(
    client: TestClient, ply: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            seen.append(self.format(record))

    collector = Collector()
    collector.setFormatter(JsonFormatter())
    log = logging.getLogger("service")
    log.addHandler(collector)
    try:
        with caplog.at_level(logging.DEBUG):
            client.post("/filter?seed=5", files={"file": ("private.ply", ply)}, headers={"X-Request-ID": "my-id"})
    finally:
        log.removeHandler(collector)
    (entry,) = [json.loads(line) for line in seen]
    assert entry["message"] == "request"
    assert entry["request_id"] == "my-id"
    assert (entry["method"], entry["route"], entry["status"]) == ("POST", "/filter", 200)
    assert (entry["model"], entry["points"]) == ("tiny", 500)
    assert "private" not in str(seen)


def test_a_line_break_cannot_forge_a_line() -> None:
    record = logging.LogRecord("service", logging.INFO, "", 0, "two\nlines", None, None)
    assert "\n" not in JsonFormatter().format(record)
    assert json.loads(JsonFormatter().format(record))["message"] == "two\nlines"


def test_text_carries_the_same() -> None:
    record = logging.LogRecord("service", logging.INFO, "", 0, "request", None, None)
    record.status = 200
    token = current_request_id.set("abc")
    try:
        assert TextFormatter().format(record).endswith("INFO service: request  request_id=abc status=200")
    finally:
        current_request_id.reset(token)
