"""OpenTelemetry traces, where they were asked for: FastAPI's own spans, and what the filter says about its work."""

from __future__ import annotations

from fastapi.telemetry import TelemetryConfig
from opentelemetry import trace

from service.settings import Settings
from service.work import Delivery

QUIET = ("/health", "/metrics")


def tracing(settings: Settings) -> TelemetryConfig:
    """Spans only: metrics are Prometheus's, and logs have a format of their own. Where they go is said by
    OpenTelemetry's own variables, OTEL_EXPORTER_OTLP_ENDPOINT first of all."""
    return {
        "tracing": settings.traces,
        "operation_spans": settings.traces,
        "metrics": False,
        "logs": False,
        "auto_configure": settings.traces,
        "exclude": lambda scope: scope["path"].startswith(QUIET),
    }


def note_work(delivery: Delivery) -> None:
    """What was done, on the span that is under way."""
    report = delivery.report
    trace.get_current_span().set_attributes(
        {
            "pointfilter.model": report.model,
            "pointfilter.points": report.points,
            "pointfilter.iterations": report.iterations,
            **{f"pointfilter.seconds.{stage}": seconds for stage, seconds in delivery.seconds.items()},
        }
    )
