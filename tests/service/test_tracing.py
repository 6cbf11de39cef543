"""Traces: off unless asked for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from pydantic import ValidationError
from starlette.testclient import TestClient

import service.settings
from service.settings import Settings


@pytest.fixture(scope="module")
def exporter() -> InMemorySpanExporter:
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    trace.set_tracer_provider(provider)
    return exporter


def test_no_spans_unless_asked_for(
    exporter: InMemorySpanExporter, make_client: Callable[..., TestClient], ply: bytes
) -> None:
    exporter.clear()
    assert make_client().post("/filter", content=ply).status_code == 200
    assert exporter.get_finished_spans() == ()


def test_spans_tell_what_was_done_and_no_names(
    exporter: InMemorySpanExporter, make_client: Callable[..., TestClient], ply: bytes
) -> None:
    client = make_client(traces=True)
    exporter.clear()
    client.post("/filter?seed=3", files={"file": ("private.ply", ply)})
    client.get("/health/live")
    client.get("/metrics")
    spans = exporter.get_finished_spans()
    work = next(span for span in spans if "pointfilter.points" in (span.attributes or {}))
    assert work.attributes is not None
    assert work.attributes["pointfilter.points"] == 500
    assert work.attributes["pointfilter.model"] == "tiny"
    assert {f"pointfilter.seconds.{stage}" for stage in ("parse", "infer", "write")} <= work.attributes.keys()
    assert any(span.name == "POST /filter" for span in spans)
    assert not any("/health" in span.name or "/metrics" in span.name for span in spans)
    assert "private" not in str([(span.name, span.attributes, span.events) for span in spans])


def test_without_the_extra_the_start_ends(
    make_settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.settings, "_installed", lambda _: False)
    with pytest.raises(ValidationError, match="extra"):
        make_settings(traces=True)
    assert make_settings().traces is False
