"""What this service is: its models, its version, its metrics."""

from __future__ import annotations

import logging
import platform
from typing import Any

import onnxruntime
from fastapi import APIRouter
from pydantic import BaseModel
from starlette.responses import Response

import pointfilter
from pointfilter.errors import ModelError
from pointfilter.models import ModelBundle
from service.dependencies import HouseDep
from service.house import House
from service.problems import answers
from service.telemetry import MEDIA_TYPE

log = logging.getLogger("service.models")

router = APIRouter(tags=["about"])


class Model(BaseModel):
    """A model bundle; without a calibration it runs in the paper's mode."""

    model_config = {"protected_namespaces": ()}

    name: str
    default: bool
    version: str
    sha256: str
    opset: int
    patch_points: int
    precision: str
    parameters: int
    network: dict[str, Any]
    training: dict[str, Any]
    scores: dict[str, Any]
    calibration: dict[str, Any] | None
    provider: str | None
    """What evaluates it, while it is loaded."""


class Version(BaseModel):
    pointfilter: str
    onnxruntime: str
    python: str


@router.get("/models", summary="The models at hand, the default first", responses=answers("internal-error"))
def models(house: HouseDep) -> list[Model]:
    """Damaged bundles are left out; the log names them."""
    found = []
    for name in house.engines.names():
        try:
            found.append(_described(house.engines.bundle(name), house))
        except ModelError as error:
            log.warning("bundle %s: %s", name, error)
    return found


@router.get(
    "/models/{name}",
    summary="One model",
    responses=answers("model-not-found", "internal-error", "invalid-model"),
)
def model(name: str, house: HouseDep) -> Model:
    return _described(house.engines.bundle(name), house)


def _described(bundle: ModelBundle, house: House) -> Model:
    return Model(
        default=bundle.name == house.settings.model,
        provider=next((model.provider for model in house.crew.loaded() if model.sha256 == bundle.sha256), None),
        **bundle.summary(),
    )


@router.get("/version", summary="Versions", responses=answers("internal-error"))
async def version() -> Version:
    return Version(
        pointfilter=pointfilter.__version__, onnxruntime=onnxruntime.__version__, python=platform.python_version()
    )


class MetricsResponse(Response):
    media_type = MEDIA_TYPE


@router.get(
    "/metrics", summary="Metrics for Prometheus", response_class=MetricsResponse, responses=answers("internal-error")
)
def metrics(house: HouseDep) -> Response:
    return MetricsResponse(house.telemetry.exposition())
