"""Metrics for Prometheus: base units, histograms, labels with few values, never a name that a client sent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import get_args

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from pointfilter.filter import STAGES as FILTER_STAGES
from service.admission import Admission
from service.exchange import Exchange
from service.problem_types import TYPES, Outcome
from service.work import Delivery
from service.worker import Loaded

MEDIA_TYPE = CONTENT_TYPE_LATEST
STAGES = ("parse", *FILTER_STAGES, "write")
SECONDS = (0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600)
STAGE_SECONDS = (0.001, 0.005, 0.01, 0.05, 0.1, 0.5, 1, 5, 10, 30, 60, 300, 600)
POINTS = (1e3, 1e4, 5e4, 1e5, 2.5e5, 5e5, 1e6, 2.5e6, 5e6, 1e7)
UNKNOWN_MODEL = "unknown"


class Telemetry:
    """The metrics of one app, in a registry of its own."""

    def __init__(self, admission: Admission, model: str) -> None:
        """model: the default one, whose counters are there from the start, so that a rate sees the first event."""
        registry = self.registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        GCCollector(registry=registry)
        self._requests = Counter(
            "pointfilter_requests",
            "Filter requests by how they ended; of POST /jobs those that were refused",
            ["model", "outcome"],
            registry=registry,
        )
        self._http = Counter("http_requests", "All requests", ["method", "route", "status"], registry=registry)
        self._http_seconds = Histogram(
            "http_request_duration_seconds",
            "All requests, first byte in to last byte out",
            ["method", "route"],
            buckets=(0.005, 0.025, *SECONDS),
            registry=registry,
        )
        self._request_seconds = Histogram(
            "pointfilter_request_duration_seconds",
            "Filter requests that ended well, first byte in to last byte out",
            ["model"],
            buckets=SECONDS,
            registry=registry,
        )
        self._stage_seconds = Histogram(
            "pointfilter_stage_duration_seconds",
            "Time in a stage; patches and infer are summed over the threads",
            ["stage"],
            buckets=STAGE_SECONDS,
            registry=registry,
        )
        self._queue_wait = Histogram(
            "pointfilter_queue_wait_seconds",
            "Time that requests and jobs waited for a worker",
            buckets=(0.001, *SECONDS),
            registry=registry,
        )
        self._jobs = Counter("pointfilter_jobs", "Jobs by how they ended", ["model", "outcome"], registry=registry)
        self._job_seconds = Histogram(
            "pointfilter_job_duration_seconds",
            "Work on jobs that ended well, waiting not included",
            ["model"],
            buckets=(*SECONDS, 1800, 3600, 7200, 14400),
            registry=registry,
        )
        self._jobs_waiting = Gauge("pointfilter_jobs_waiting", "Jobs in the queue, of all processes", registry=registry)
        self._jobs_running = Gauge("pointfilter_jobs_running", "Jobs being worked on", registry=registry)
        self._worker_deaths = Counter(
            "pointfilter_worker_deaths", "Workers that died or had to be killed, and were replaced", registry=registry
        )
        self._worker_memory = Gauge(
            "pointfilter_worker_memory_bytes", "Resident memory of all workers", registry=registry
        )
        self._points = Counter("pointfilter_points", "Points filtered", ["model"], registry=registry)
        self._points_per_request = Histogram(
            "pointfilter_points_per_request", "Points of a cloud", buckets=POINTS, registry=registry
        )
        self._model_info = Gauge(
            "pointfilter_model_info", "1 for each model in memory", ["model", "version", "sha256", "provider"],
            registry=registry,
        )  # fmt: skip
        depth = Gauge("pointfilter_queue_depth", "Requests waiting for a worker", registry=registry)
        depth.set_function(lambda: admission.waiting)
        running = Gauge("pointfilter_in_progress", "Requests being worked on", registry=registry)
        running.set_function(lambda: admission.running)
        Gauge("pointfilter_workers", "Workers", registry=registry).set(admission.workers)
        for stage in STAGES:
            self._stage_seconds.labels(stage)
        for outcome in get_args(Outcome):
            self._requests.labels(model, outcome)
            self._jobs.labels(model, outcome)

    def http_ended(self, method: str, route: str, status: int, seconds: float) -> None:
        self._http.labels(method, route, str(status)).inc()
        self._http_seconds.labels(method, route).observe(seconds)

    def waited(self, seconds: float) -> None:
        self._queue_wait.observe(seconds)

    def delivered(self, delivery: Delivery) -> None:
        """Work that was done, whether or not anybody fetches it."""
        for stage, seconds in delivery.seconds.items():
            self._stage_seconds.labels(stage).observe(seconds)
        self._points.labels(delivery.report.model).inc(delivery.report.points)
        self._points_per_request.observe(delivery.report.points)

    def filter_ended(self, exchange: Exchange, seconds: float) -> None:
        model = exchange.model or UNKNOWN_MODEL
        outcome = TYPES[exchange.code].outcome if exchange.code else "ok"
        self._requests.labels(model, outcome).inc()
        if outcome == "ok":
            self._request_seconds.labels(model).observe(seconds)

    def job_ended(self, model: str, outcome: str, seconds: float) -> None:
        self._jobs.labels(model, outcome).inc()
        if outcome == "ok":
            self._job_seconds.labels(model).observe(seconds)

    def watch(
        self, jobs_waiting: Callable[[], float], jobs_running: Callable[[], float], worker_memory: Callable[[], float]
    ) -> None:
        self._jobs_waiting.set_function(jobs_waiting)
        self._jobs_running.set_function(jobs_running)
        self._worker_memory.set_function(worker_memory)

    def worker_died(self) -> None:
        self._worker_deaths.inc()

    def models_loaded(self, models: Sequence[Loaded]) -> None:
        self._model_info.clear()
        for model in models:
            self._model_info.labels(model.name, model.version, model.sha256, model.provider).set(1)

    def exposition(self) -> bytes:
        return generate_latest(self.registry)
