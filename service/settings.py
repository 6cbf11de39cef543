"""Every knob of the service. docs/configuration.md lists them; a test compares the two."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
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

    max_upload_bytes: Annotated[int, Field(ge=1)] = 512 * 1024 * 1024
    """Largest file taken, in bytes; larger ones get a 413."""

    max_points: Annotated[int, Field(ge=1)] = 10_000_000
    """Most points of a cloud; more get a 413."""

    max_iterations: Annotated[int, Field(ge=1, le=100)] = 10
    """Most iterations a request may ask for; more get a 422."""

    timeout_seconds: Annotated[float, Field(gt=0)] = 600.0
    """Longest time from the end of the upload to the finished result, waiting included; then the work stops: 504."""

    transfer_seconds: Annotated[float, Field(gt=0)] = 600.0
    """Longest time a client may take to send its file (408), and again to fetch the result (the connection is cut)."""

    drain_seconds: Annotated[int, Field(ge=0)] = 30
    """After SIGTERM, how long running requests may take to finish before they are stopped."""

    temp_dir: Path | None = None
    """Folder for uploads and results while a request lasts; by default the system's. Leave room for workers +
    queue_size uploads of the largest size and their results."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe messages that are logged."""

    log_format: Literal["json", "text"] = "json"
    """One JSON object a line, or text for people."""

    @property
    def read_limits(self) -> ReadLimits:
        return ReadLimits(max_points=self.max_points, max_points_knob=variable("max_points"))


def variable(field: str) -> str:
    """The environment variable of a field."""
    return PREFIX + field.upper()
