"""Every knob of the service. docs/configuration.md lists them; a test compares the two."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from pointfilter.limits import ReadLimits
from pointfilter.models import DEFAULT_MODEL

PREFIX = "POINTFILTER_"


class Settings(BaseSettings):
    """Read from the environment, each with the prefix POINTFILTER_."""

    model_config = SettingsConfigDict(
        env_prefix=PREFIX,
        env_ignore_empty=True,
        extra="ignore",
        frozen=True,
        use_attribute_docstrings=True,
        protected_namespaces=(),  # `model` and `model_dir` are our words here
    )

    host: str = "127.0.0.1"
    """Address to listen on. The default is this machine only; a container sets 0.0.0.0."""

    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """Port to listen on; 0 takes a free one."""

    model: str = DEFAULT_MODEL
    """Model that requests get unless they name one. It is loaded at start, and readiness waits for it."""

    model_dir: Path | None = None
    """Folder of further model bundles, each a folder with model.onnx and model.json; they come before the
    built-in ones."""

    max_models: Annotated[int, Field(ge=2)] = 4
    """Most models kept loaded at once; the one used longest ago makes room, the default model never does."""

    device: Literal["auto", "cpu", "openvino", "cuda", "tensorrt", "coreml", "directml"] = "auto"
    """Where the network runs. `auto` takes CUDA where it is there, else the CPU; `cpu`, `openvino`, `cuda`, `tensorrt`,
    `coreml` or `directml` by name; one that is missing ends the start."""

    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads a filter request uses. 0 shares the CPUs that the process may use among the workers."""

    workers: Annotated[int, Field(ge=1, le=256)] = 1
    """Filter requests worked on at the same time. One keeps all threads busy; more only helps many small clouds."""

    queue_size: Annotated[int, Field(ge=0, le=10_000)] = 8
    """Filter requests that may be in the house beyond those worked on: arriving, waiting or leaving. More get a 429."""

    small_points: Annotated[int, Field(ge=0)] = 10_000
    """Clouds up to this size have one more worker of their own, so that they need not wait for large ones; 0: they
    have none."""

    sync_bytes: Annotated[int, Field(ge=0)] = 128 * 1024 * 1024
    """Larger files sent to /filter become jobs: the answer is 202 and the address of the job."""

    data_dir: Path | None = None
    """Folder for jobs, their files and their queue; by default one in the user's state folder (XDG_STATE_HOME, else
    ~/.local/state). Processes that share it share the jobs."""

    redis_url: str | None = None
    """A Redis that holds the queue of jobs in place of a file in the data folder, such as redis://redis:6379/0."""

    job_queue_size: Annotated[int, Field(ge=0, le=1_000_000)] = 100
    """Most jobs that may wait; more get a 429."""

    job_seconds: Annotated[float, Field(gt=0)] = 14_400.0
    """Longest time that the work on a job may take, waiting not included; then it stops and the job has failed."""

    job_ttl_seconds: Annotated[float, Field(gt=0)] = 86_400.0
    """How long a job that ended, and its result, are kept."""

    keys_file: Path | None = None
    """File with the API keys that may filter, a line each, made by `python -m service key NAME`; it is read again
    when it changes. By default nobody needs one."""

    places_per_key: Annotated[int, Field(ge=0)] = 0
    """Most filter requests that one API key may have in the house; more get a 429. 0: as many as there are."""

    jobs_per_key: Annotated[int, Field(ge=0)] = 0
    """Most unfinished jobs that one API key may have; more get a 429. 0: as many as may wait."""

    max_upload_bytes: Annotated[int, Field(ge=1)] = 512 * 1024 * 1024
    """Largest file taken, in bytes; larger ones get a 413."""

    max_points: Annotated[int, Field(ge=1)] = 10_000_000
    """Most points of a cloud; more get a 413."""

    max_iterations: Annotated[int, Field(ge=1, le=100)] = 10
    """Most passes over the cloud: a request that asks for more (`iterations`) gets a 422, one that names no
    number gets no more."""

    timeout_seconds: Annotated[float, Field(gt=0)] = 600.0
    """Longest time from the end of the upload to the finished result, waiting included; then the work stops: 504."""

    transfer_seconds: Annotated[float, Field(gt=0)] = 600.0
    """Longest time a client may take to send its file (408), and again to fetch the result (the connection is cut)."""

    drain_seconds: Annotated[int, Field(ge=0)] = 30
    """After SIGTERM, how long running requests and jobs may take to finish; then requests are stopped, and jobs go back
    to the queue."""

    temp_dir: Path | None = None
    """Folder for uploads and results while a request lasts; by default the system's. Leave room for workers +
    queue_size uploads of the largest size and their results."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe messages that are logged."""

    log_format: Literal["json", "text"] = "json"
    """One JSON object a line, or text for people."""

    traces: bool = False
    """Send OpenTelemetry traces (OTLP over HTTP) to where OTEL_EXPORTER_OTLP_ENDPOINT says; needs the extra
    `traces`."""

    @field_validator("traces")
    @classmethod
    def _can_be_sent(cls, traces: bool) -> bool:
        if traces and not all(map(_installed, ("opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http"))):
            raise ValueError("traces need the extra: pip install 'pointfilter[service,traces]'")
        return traces

    @property
    def job_folder(self) -> Path:
        """Where jobs lie."""
        if self.data_dir is not None:
            return self.data_dir
        state = os.environ.get("XDG_STATE_HOME")
        return (Path(state) if state else Path.home() / ".local" / "state") / "pointfilter"

    @property
    def read_limits(self) -> ReadLimits:
        return ReadLimits(max_points=self.max_points, max_points_knob=variable("max_points"))


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # not even its parent
        return False


def variable(field: str) -> str:
    """The environment variable of a field."""
    return PREFIX + field.upper()
